"""Subjects and shortcuts for the tests of the suite."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import pytest

from flasher.conformance import init
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import CASES, Case, Requirement, Selection
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, device_maker, profile_of_mock
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.results import CaseResult, CaseVerdict, InitResult, RunReport
from flasher.conformance.runner import RunObserver, SuiteOptions, run
from flasher.conformance.subject import Subject
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame

PROFILE = profile_of_mock()
NOTHING_STATED = ConformanceProfile()


class DeafDevice(MockDevice):
    """Ignores all frames once `hangs`; with `hangs_for_good` even after a power cycle."""

    hangs = False
    hangs_for_good = False

    def receive(self, frame: Frame, now: float) -> None:
        if not self.hangs:
            super().receive(frame, now)

    def deadline(self) -> float | None:
        return None if self.hangs else super().deadline()

    def next_frame(self, now: float) -> Frame | None:
        return None if self.hangs else super().next_frame(now)

    def power_cut(self, now: float) -> None:
        self.hangs = self.hangs_for_good
        super().power_cut(now)


class RestlessDevice(MockDevice):
    """Loses its power briefly after every 60th received frame."""

    heard = 0

    def receive(self, frame: Frame, now: float) -> None:
        super().receive(frame, now)
        self.heard += 1
        if self.heard % 60 == 0:
            self.power_cut(now)
            self.power_on(now)


class Babbler:
    """An engine that sends a frame of the highest priority every `period_s`."""

    done = False

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._due = 0.0

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        pass

    def deadline(self) -> float | None:
        return self._due

    def next_frame(self, now: float) -> Frame | None:
        return Frame(0x001, bytes(8)) if now >= self._due else None

    def frame_sent(self, now: float) -> None:
        self._due = now + self._period_s

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> Sequence[object]:
        return ()


def subject(
    kind: type[MockDevice] = MockDevice, profile: DeviceProfile = MOCK_PROFILE, target: str = "bms"
) -> MockSubject:
    return MockSubject(target, profile=profile, make_device=device_maker(kind))


def one(report: RunReport, case_id: str) -> CaseResult:
    """The result of a case that ran once."""
    (result,) = (result for result in report.results if result.case_id == case_id)
    return result


@dataclass
class Log(RunObserver):
    """An observer that logs its calls."""

    lines: list[str] = field(default_factory=list)

    def run_began(self, count: int) -> None:
        self.lines.append(f"run of {count}")

    def preparing(self, what: str) -> None:
        self.lines.append(f"preparing {what}")

    def case_began(self, case: Case, repeat: int) -> None:
        self.lines.append(f"begins {case.id} {repeat}")

    def case_ended(self, result: CaseResult) -> None:
        self.lines.append(f"ends {result.case_id} {result.verdict.text}")


def run_case(
    action: Callable[[Bench], None],
    *,
    device: Subject | None = None,
    profile: ConformanceProfile = PROFILE,
    requires: frozenset[Requirement] = frozenset(),
    limit_s: float = 300.0,
    strict: bool = False,
    before_others: bool = False,
    log: Log | None = None,
) -> RunReport:
    """Run one case, FR-00, that performs `action`; with `before_others`, RS-04 too."""
    CASES["FR-00"] = Case(
        "FR-00",
        "a test",
        "R12",
        "something",
        "something",
        action,
        requires,
        limit_s=limit_s,
        upgrades=0,
    )
    try:
        return run(
            device or subject(),
            profile,
            selection=Selection(cases=("FR-00", "RS-04") if before_others else ("FR-00",)),
            options=SuiteOptions(strict=strict),
            observer=log,
        )
    finally:
        del CASES["FR-00"]


def questions(*keys: str) -> list[tuple[init.Question, tuple[str, ...]]]:
    """The questions of `init` that answer these keys."""
    return [each for each in init.QUESTIONS if not {*keys}.isdisjoint(each[1])]


def interview(
    subject: Subject, *keys: str, start: ConformanceProfile = NOTHING_STATED
) -> InitResult:
    """What `init` finds by the questions of these keys alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(init, "QUESTIONS", questions(*keys))
        found = init.ask_device(subject, start)
    assert found.stopped == ""
    return found


def answers(
    subject: Subject, wanted: Collection[str], given: Mapping[str, Value]
) -> dict[str, Value | None]:
    """What `init` finds for these keys by their own questions alone; `given` answers the others."""
    start = {key: value for key, value in given.items() if key not in wanted}
    if "device.largest_image_bytes" in wanted:  # it would know the most that could be
        start.pop("device.application_bytes", None)
    found = interview(subject, *wanted, start=ConformanceProfile(start))
    return {one.key: one.value for one in found.answers if one.key in wanted}


def status_of(action: Callable[[Bench], None]) -> CaseVerdict:
    return one(run_case(action), "FR-00").verdict


def passes_once(bench: Bench) -> None:
    """A case with one check that passes."""
    bench.check(True, "something", "something")


def fails_once(bench: Bench) -> None:
    """A case with one check that fails."""
    bench.check(False, "one", "two")
