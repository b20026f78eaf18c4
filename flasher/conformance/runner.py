"""Runs cases one after another, each from the known state, and yields the report.

What a case left the device in is repaired before the next one. A device that cannot be brought back
ends the run: the case is named, the rest is reported as not run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, NamedTuple, Protocol

import flasher.conformance.cases  # noqa: F401  registers the cases
from flasher.conformance import selection as choosing
from flasher.conformance.bench import Bench
from flasher.conformance.cases.elsewhere import HOST_CASES, NOT_IMPLEMENTED
from flasher.conformance.execute import case_text, execute
from flasher.conformance.model import (
    CASES,
    Case,
    CaseEnded,
    CaseResult,
    Check,
    Outcome,
    Requirement,
    Status,
)
from flasher.conformance.profile import ConformanceProfile, check_deviations
from flasher.conformance.profile_keys import KEYS
from flasher.conformance.report import FINAL_IMAGE_OK, Report, Rescue
from flasher.conformance.restore import BY_POWER, Restored, is_reachable, needs_power, restore
from flasher.conformance.selection import Selection
from flasher.conformance.subject import Subject
from flasher.errors import BusError


@dataclass(frozen=True)
class RunOptions:
    """How to run: `seed` decides every chance, each case is run `repeat` times, `limit_s` ends the
    run after that time on the bench's clock, `strict` makes a deviation that is none any more a
    failure.
    """

    seed: str = "1"
    repeat: int = 1
    limit_s: float | None = None
    strict: bool = False


_EVERYTHING: Final = Selection()
_PLAIN: Final = RunOptions()


class Listener(Protocol):
    """Is told how a run goes on."""

    def run_began(self, count: int) -> None:
        """So many case runs follow."""
        ...

    def preparing(self, what: str) -> None:
        """The device is brought to the known state, for the reason `what`."""
        ...

    def case_began(self, case: Case, repeat: int) -> None:
        """A case begins, for the `repeat`-th time."""
        ...

    def case_ended(self, result: CaseResult) -> None:
        """A case has its verdict."""
        ...


class Silent:
    """A listener that does nothing."""

    def run_began(self, count: int) -> None:
        """Nothing."""

    def preparing(self, what: str) -> None:
        """Nothing."""

    def case_began(self, case: Case, repeat: int) -> None:
        """Nothing."""

    def case_ended(self, result: CaseResult) -> None:
        """Nothing."""


class _Turn(NamedTuple):
    case: Case
    repeat: int


def run(
    subject: Subject,
    profile: ConformanceProfile,
    *,
    selection: Selection = _EVERYTHING,
    options: RunOptions = _PLAIN,
    listener: Listener | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Report:
    """Run the selected cases on a device and report; `stopped` is asked while it runs.

    Raises UsageError for a case, group or deviation that does not exist. An adapter that fails ends
    the run and is in the report.
    """
    choosing.check_selection(selection)
    check_deviations(profile, (*CASES, *NOT_IMPLEMENTED))
    return Run(subject, profile, selection, options, listener or Silent(), stopped).go()


class Run:
    """A run case by case (`begin`, `take`, `finish`, `report`), or whole (`go`). Its arguments are
    those of `run`, which checks them.
    """

    def __init__(
        self,
        subject: Subject,
        profile: ConformanceProfile,
        selection: Selection,
        options: RunOptions,
        listener: Listener,
        stopped: Callable[[], bool],
    ) -> None:
        self._subject = subject
        self._profile = profile
        self._selection = selection
        self._options = options
        self._listener = listener
        self._began_at = subject.port.now()
        self._ends_at = self._began_at + (inf if options.limit_s is None else options.limit_s)
        self._asked_to_stop = stopped
        self._results: list[CaseResult] = []
        self._rescues: list[Rescue] = []
        self._stopped = ""
        self._adapter_failed = False
        self._not_upgradable = ""
        self._killed_by = ""
        self._final_image = ""

    def go(self) -> Report:
        """Run all that is selected."""
        chosen = [
            case_id
            for case_id in choosing.in_order((*CASES, *NOT_IMPLEMENTED))
            if self._selection.has(case_id, CASES[case_id].requires if case_id in CASES else ())
        ]
        turns: list[_Turn] = []
        for case_id in chosen:
            turns += self._turns(case_id)
        self._listener.run_began(len(turns))
        if turns:
            self._go_over(turns)
        return self.report(chosen)

    def report(self, chosen: Sequence[str] | None = None) -> Report:
        """What came of it so far; `chosen` are the ids of the cases that belong to the run, else
        those that have a result.
        """
        if chosen is None:
            chosen = choosing.in_order({result.case_id for result in self._results})
        order = {case_id: index for index, case_id in enumerate(chosen)}
        self._results.sort(key=lambda result: (result.repeat, order[result.case_id]))
        port = self._subject.port
        return Report(
            subject=self._subject.name,
            target=self._subject.target,
            bitrate_bps=port.bitrate_bps,
            timestamp_source=port.timestamp_source,
            uncertainty_s=port.uncertainty_s,
            profile_source=self._profile.source,
            profile={key.path: self._profile.value(key.path) for key in KEYS},
            seed=self._options.seed,
            strict=self._options.strict,
            cases=tuple(case_text(case_id, self._profile) for case_id in chosen),
            results=tuple(self._results),
            not_selected=tuple(choosing.in_order({*CASES, *NOT_IMPLEMENTED}.difference(chosen))),
            host_cases=HOST_CASES,
            stopped=self._stopped,
            adapter_failed=self._adapter_failed,
            not_upgradable=self._not_upgradable,
            killed_by=self._killed_by,
            rescues=tuple(self._rescues),
            final_image=self._final_image,
            duration_s=port.now() - self._began_at,
        )

    # -- the run ----------------------------------------------------------------------------------

    def _turns(self, case_id: str) -> list[_Turn]:
        """The runs of a case; one that this bench cannot run has its result at once."""
        case = CASES.get(case_id)
        missing = (
            NOT_IMPLEMENTED[case_id]
            if case is None
            else choosing.what_is_missing(case, self._subject, self._profile)
        )
        if case is not None and not missing:
            return [_Turn(case, repeat) for repeat in range(1, self._options.repeat + 1)]
        self._add(CaseResult(case_id, Status.UNSUPPORTED, note=missing))
        return []

    def _go_over(self, turns: Sequence[_Turn]) -> None:
        turns = sorted(turns, key=lambda turn: turn.repeat)
        self.begin()
        for turn in turns:
            self.take(turn.case, turn.repeat)
        self.finish()

    def begin(self) -> None:
        """Flash the good image, so that the first case finds the known state."""
        self.restore("before the first case", flash=True)

    @property
    def stopped(self) -> str:
        """Why no further case is run; empty while the run goes on."""
        return self._stopped

    def take(self, case: Case, repeat: int = 1) -> CaseResult:
        """Run a case, unless the run has come to its end before."""
        if not self._stopped and self._subject.port.now() >= self._ends_at:
            self._stopped = "the run's own time limit is over"
        if not self._stopped and self._asked_to_stop():
            self._stopped = "the run was stopped"
        if self._stopped:
            return self._add(CaseResult(case.id, Status.NOT_RUN, repeat, note=self._stopped))
        return self._run_turn(_Turn(case, repeat))

    def _run_turn(self, turn: _Turn) -> CaseResult:
        case = turn.case
        self._listener.case_began(case, turn.repeat)
        seed = f"{self._options.seed}/{case.id}/{turn.repeat}"
        bench = Bench.for_case(case, self._subject, self._profile, seed, self._must_stop)
        status, note, stop = execute(case, bench)
        self._stopped = stop
        self._adapter_failed = bool(stop) and status is Status.ERROR
        checks = list(bench.findings.checks)
        duration_s = bench.elapsed_s
        if not self._stopped:
            erased = bench.update_was_sent or Requirement.DESTRUCTIVE in case.requires
            trouble = self.restore_after(case.id, bench, flash=erased)
            if trouble:
                checks.append(
                    Check(
                        "", Outcome.FAIL, "the device is reachable afterwards", trouble, duration_s
                    )
                )
                status = Status.FAIL
        is_known = case.id in self._profile.deviations
        if status is Status.FAIL and is_known:
            status, note = Status.DEVIATION, self._profile.deviations[case.id]
        return self._add(
            CaseResult(
                case.id,
                status,
                turn.repeat,
                seed,
                note,
                tuple(checks),
                tuple(bench.findings.measurements),
                tuple(bench.findings.infos),
                duration_s,
                bench.trace,
                bench.trace_dropped,
                deviation_resolved=is_known and status is Status.PASS,
            )
        )

    def _must_stop(self) -> bool:
        return self._asked_to_stop() or self._subject.port.now() >= self._ends_at

    # -- the known state --------------------------------------------------------------------------

    def restore_after(self, case_id: str, bench: Bench, *, flash: bool) -> str:
        """Bring the device back after a case, or a test of somebody else; as `restore`."""
        return self.restore(f"after {case_id}", flash=flash, case_id=case_id, is_off=bench.is_off)

    def restore(
        self, when: str, *, flash: bool, case_id: str | None = None, is_off: bool = False
    ) -> str:
        """Bring the device back; returns what was wrong with it, "" when nothing was."""
        self._listener.preparing(when)
        try:
            if is_off:
                self._subject.power(on=True)
            done = self._bring_back(flash=flash, at_first=case_id is None)
        except (BusError, CaseEnded) as error:
            self._adapter_failed = isinstance(error, BusError)
            self._stopped = f"{when}: {error.what if isinstance(error, BusError) else error}"
            return ""
        if not done.ok:
            self._stopped = f"{when}, the device could not be brought back: {done.reason}"
            self._killed_by = case_id or ""
            return done.reason
        if case_id is not None and done.how == BY_POWER and not needs_power(self._profile):
            self._rescues.append(Rescue(case_id, done.how))
            return "not by the protocol; a power cycle brought it back"
        return ""

    def _bring_back(self, *, flash: bool, at_first: bool) -> Restored:
        """The known state; of a device that could not even be upgraded at first, to be reachable
        is all that is asked. Raises BusError and RunStopped.
        """
        subject, profile, stopped = self._subject, self._profile, self._asked_to_stop
        if self._not_upgradable:
            is_there = is_reachable(subject, profile, stopped)
            return Restored("reset" if is_there else "", "no boot version")
        done = restore(subject, profile, flash=flash, stopped=stopped)
        if not done.ok and at_first and is_reachable(subject, profile, stopped):
            self._not_upgradable = done.reason
            return Restored("reset", done.reason)
        return done

    def finish(self) -> None:
        """Flash the good image once more and verify it: by its version, and by readback."""
        if self._killed_by:
            self._final_image = "not flashed: the device could not be brought back"
            return
        self._listener.preparing("at the end")
        try:
            done = restore(self._subject, self._profile, flash=True)
            self._final_image = FINAL_IMAGE_OK if done.ok else done.reason
            if done.ok and self._subject.has_readback:
                image = self._subject.good_image
                if self._subject.readback()[: len(image)] != image:
                    self._final_image = "the flash does not hold the good image"
        except (BusError, CaseEnded) as error:
            self._final_image = error.what if isinstance(error, BusError) else str(error)

    # -- results ----------------------------------------------------------------------------------

    def _add(self, result: CaseResult) -> CaseResult:
        self._results.append(result)
        self._listener.case_ended(result)
        return result
