"""`flasher conformance init`: determine a device's profile by asking it on the bus.

All questions are asked during upgrades to the good image, which are completed. Keys that cannot be
determined stay open, with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from flasher.conformance.init import entry_questions, transfer_questions
from flasher.conformance.init.answers import Findings, Trial, decide, limit_answer
from flasher.conformance.init.session import ANSWER_S, InitSession
from flasher.conformance.judge import TimeName
from flasher.conformance.profile import ConformanceProfile, Limits, Value, profile_keys
from flasher.conformance.restore import restore
from flasher.conformance.results import CaseEnded, InitResult, KeyAnswer, RunStopped
from flasher.conformance.subject import Subject

UPGRADES: Final = 180
"""Approximate number of erases, with those of the quick cases."""
Question = Callable[[InitSession], Findings]
QUESTIONS: Final[tuple[tuple[Question, tuple[str, ...]], ...]] = (
    (
        entry_questions.burst,
        (
            "device.reset_command",
            "device.reset_data",
            "device.versions",
            "limits.version_spacing_s",
            "limits.version_spacing_tolerance_s",
        ),
    ),
    (entry_questions.upgrade, ("en_03",)),
    (entry_questions.in_burst, ("up_04_burst",)),
    (entry_questions.window, ("limits.window_s", "limits.window_tolerance_s", "up_04")),
    (entry_questions.reset_in_bootloader, ("rs_02",)),
    (entry_questions.rejected_update, ("up_02",)),
    (entry_questions.application, ("up_03",)),
    (entry_questions.feedback, ("fr_10",)),
    (entry_questions.update_twice, ("up_05",)),
    (transfer_questions.pause, ("tx_12", "limits.pause_s")),
    (transfer_questions.frame_gap, ("limits.inter_frame_s",)),
    (transfer_questions.repeated_packet, ("tx_02",)),
    (transfer_questions.reset_again, ("tx_13",)),
    (transfer_questions.update_again, ("up_08",)),
    (transfer_questions.bad_packet, ("tx_01",)),
    (transfer_questions.lost_frame, ("tx_01_lost_frame",)),
    (transfer_questions.older_packet, ("tx_03",)),
    (transfer_questions.filler, ("tx_08",)),
    (transfer_questions.splits, ("fr_01",)),
    (partial(transfer_questions.in_forms, key="fr_02"), ("fr_02",)),
    (partial(transfer_questions.in_forms, key="fr_04"), ("fr_04",)),
    (transfer_questions.padded, ("fr_07",)),
    (transfer_questions.gaps, ("tm_02",)),
    (transfer_questions.end_again, ("en_02",)),
    (entry_questions.old_application, ("rs_03_old",)),
    (entry_questions.without_application, ("rs_03",)),
    (entry_questions.largest_image, ("device.largest_image_bytes",)),
    (transfer_questions.buffer, ("device.buffer_bytes",)),
)
"""Questions in order, with the keys that each one answers; later ones use earlier answers."""
LIMITS: Final[dict[str, tuple[float, tuple[str, ...]]]] = {
    "limits.feedback_s": (0.2, (TimeName.FEEDBACK,)),
    "limits.first_version_s": (
        0.5,
        (TimeName.FIRST, TimeName.POWERED, TimeName.GAP, TimeName.LATE, TimeName.RESTARTED),
    ),
    "limits.start_s": (1.0, (TimeName.START, TimeName.START_AGAIN)),
    "limits.erase_s": (0.5, (TimeName.REQUEST,)),
    "limits.ack_s": (0.1, (TimeName.ANSWER, TimeName.REJECTED)),
    # A rejected image may be reported later than complete, and no question ends one.
    "limits.complete_s": (Limits().complete_s, (TimeName.COMPLETE,)),
}
"""Smallest value of a limit in seconds, and the measured times that determine it."""
NOT_ASKED: Final = {
    "en_04": "needs a transfer with a wrong checksum; enter what the product has",
    "limits.refused_s": "needs an image that is rejected",
    "limits.silence_s": "it is a setting of the suite, not of the device",
    "device.application_address": "no message reports it",
    "device.application_bytes": "no message reports it; it is at least the largest image",
}
"""Keys that no question covers, with the reason."""
_PATIENCE: Final[dict[str, Value]] = {
    "limits.feedback_s": 2.0,
    "limits.first_version_s": 10.0,
    "limits.start_s": 20.0,
    "limits.erase_s": 60.0,
    "limits.ack_s": ANSWER_S,
    "limits.complete_s": 60.0,
    "limits.window_s": 2.0,
}
"""Limits to use before anything was measured."""


def ask_device(
    subject: Subject,
    start: ConformanceProfile,
    *,
    stopped: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> InitResult:
    """Ask the device all questions. The good image runs before and afterwards; `start` provides the
    keys that no question answers. Raises BusError.
    """
    return _Interview(subject, start, stopped).run(progress)


class _Interview:
    def __init__(
        self, subject: Subject, start: ConformanceProfile, stopped: Callable[[], bool]
    ) -> None:
        self._subject = subject
        self._start = start
        self._stopped = stopped
        self._answers: dict[str, KeyAnswer] = {}
        self._measured: dict[str, list[float]] = {}

    def run(self, progress: Callable[[int, int], None]) -> InitResult:
        was_brought_up = True
        try:
            trouble = self._restore("before the first question", flash=True)
            was_brought_up = not trouble
            for done, (question, keys) in enumerate(QUESTIONS):
                if trouble:
                    break
                progress(done, len(QUESTIONS))
                self._ask(question, keys)
                trouble = self._restore(f"after the question about {keys[0]}", flash=False)
            if not trouble:
                trouble = self._restore("at the end", flash=True)
        except RunStopped as ended:
            self._stopped = lambda: False
            lost = self._restore("after the stop", flash=True)
            return self._result(lost or str(ended))
        return self._result(trouble, was_brought_up=was_brought_up)

    def _ask(self, question: Question, keys: tuple[str, ...]) -> None:
        """Ask a question, and again after unexpected behaviour: a frame may have been late."""
        why = self._try(question, keys)
        if why and not self._restore("before the question was repeated", flash=False):
            why = self._try(question, keys) or "no observation"
        for key in keys:
            self._answers.setdefault(key, KeyAnswer(key, None, why))

    def _try(self, question: Question, keys: tuple[str, ...]) -> str:
        """Ask a question once; returns the unexpected behaviour of the device, or ""."""
        session = InitSession(self._subject, self._profile(), self._stopped)
        why, trials = "", list[Trial]()
        try:
            session.settle()
            for found in question(session):
                if isinstance(found, Trial):
                    trials.append(found)
                elif isinstance(found, KeyAnswer):
                    self._answers[found.key] = found
                else:
                    self._answers |= {key: KeyAnswer(key, None, found) for key in keys}
            if trials:
                choice = next(key for key in keys if "." not in key)
                self._answers[choice] = decide(choice, trials)
        except RunStopped:
            raise
        except CaseEnded as ended:
            failed = [
                check for check in session.bench.judge.checks if check.outcome.value == "fail"
            ]
            why = f"unexpected behaviour: {failed[-1]}" if failed else str(ended)
        if session.bench.is_off:
            session.bench.power_on()
        for one in session.bench.judge.measurements:
            self._measured.setdefault(one.name, []).append(one.value_s)
        return why

    def _limits(self) -> Iterator[KeyAnswer]:
        for key, (least_s, names) in LIMITS.items():
            values_s = [value_s for name in names for value_s in self._measured.get(name, ())]
            yield limit_answer(key, values_s, least_s, self._subject.port.uncertainty_s)

    def _profile(self) -> ConformanceProfile:
        """Make a profile of the answers so far, with long limits where nothing was measured."""
        found = (*self._answers.values(), *self._limits())
        given = {one.key: one.value for one in found if one.value is not None}
        return ConformanceProfile({**_PATIENCE, **self._start.given, **given})

    def _restore(self, when: str, *, flash: bool) -> str:
        """Restore the good image; returns what went wrong, or ""."""
        done = restore(self._subject, self._profile(), flash=flash, stopped=self._stopped)
        if done.ok:
            return ""
        reasons = "; ".join((done.reason, *done.diagnosis))
        return f"{when}, the device could not be restored: {reasons}"

    def _result(self, stopped: str, *, was_brought_up: bool = True) -> InitResult:
        self._answers |= {one.key: one for one in self._limits()}
        found = [
            self._answers.get(key) or KeyAnswer(key, None, NOT_ASKED.get(key, "not determined"))
            for key in profile_keys()
        ]
        name, target = self._subject.name, self._subject.target
        return InitResult(name, target, tuple(found), stopped, was_brought_up)
