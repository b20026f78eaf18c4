"""What the suite consists of and what it yields: cases, checks, verdicts, results.

A case registers itself with `@case(...)`; how to write one stands in `flasher.conformance.cases`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final

from flasher.conformance.wire import RawFrame

if TYPE_CHECKING:
    from flasher.conformance.bench import Bench


class Requirement(Enum):
    """What a case needs, or does; the value is how reports and options name it."""

    POWER = "power"
    """Switches the device off and on."""
    READBACK = "readback"
    """Reads the flash back past the protocol."""
    BUS_OFF = "bus-off"
    """Makes the device's CAN controller go off the bus."""
    TIMED_CUT = "timed-cut"
    """Cuts the power at the very moment of a flash operation or a frame."""
    SECOND_IMAGE = "second-image"
    """Needs a second good image, smaller than the first one."""
    CHECKSUM = "checksum"
    """Needs a product whose images carry a checksum of their own (profile, en_04)."""
    DESTRUCTIVE = "destructive"
    """Erases the application, or may; it is put back after the case."""
    LONG = "long"
    """Takes more than some seconds on a real bus."""
    TIMING = "timing"
    """Judges times: what the adapter's time stamps are worth decides."""


class Status(Enum):
    """The verdict on a case."""

    PASS = "pass"  # noqa: S105  no password
    FAIL = "fail"
    DEVIATION = "deviation"
    """Failed, as the profile says that it does."""
    UNSUPPORTED = "unsupported"
    """Cannot be judged on this bench, for the reason in the note."""
    INCONCLUSIVE = "inconclusive"
    """The uncertainty of the measurement is greater than the margin."""
    INFO = "info"
    """Nothing to judge, only measured or observed."""
    ERROR = "error"
    """The case itself went wrong: the suite or the adapter, not the device."""
    NOT_RUN = "not run"
    """The run stopped before it."""


class Outcome(Enum):
    """How one check of a case ended."""

    PASS = "pass"  # noqa: S105  no password
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"
    UNSUPPORTED = "unsupported"


@dataclass(frozen=True)
class Check:
    """One thing looked at: the step of the case, what was expected and what was got."""

    step: str
    outcome: Outcome
    expected: str
    got: str
    at_s: float
    """Seconds since the case began."""


@dataclass(frozen=True)
class Measurement:
    """One time measured: its name ("packet to ACK") and value in seconds."""

    name: str
    value_s: float
    uncertainty_s: float


@dataclass(frozen=True)
class TraceEntry:
    """One frame of a case, in seconds since the case began; `sent` by the suite or received."""

    at_s: float
    sent: bool
    frame: RawFrame


@dataclass(frozen=True)
class Case:
    """One case of the catalogue. `choices` are the keys of the profile it is judged by."""

    id: str
    title: str
    clause: str
    stimulus: str
    expectation: str
    run: Callable[[Bench], None]
    requires: frozenset[Requirement] = frozenset()
    choices: tuple[str, ...] = ()
    limit_s: float = 300.0
    """The case is ended after this time on the bench's clock."""

    @property
    def group(self) -> str:
        """The first part of the id: "TX" of "TX-03"."""
        return self.id.partition("-")[0]


@dataclass(frozen=True)
class CaseResult:
    """What came of a case. Times are in seconds; `case_id` and `repeat` (from 1) name it."""

    case_id: str
    status: Status
    repeat: int = 1
    seed: str = ""
    note: str = ""
    checks: tuple[Check, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    infos: tuple[str, ...] = ()
    """What was observed without being judged."""
    duration_s: float = 0.0
    trace: tuple[TraceEntry, ...] = ()
    trace_dropped: int = 0
    """Frames that were not kept, as there were too many; the newest ones are kept."""
    deviation_resolved: bool = False
    """The profile documents a deviation, but the case passes."""

    @property
    def first_failure(self) -> Check | None:
        """The first check that failed, else the first that was inconclusive; None without any."""
        for outcome in (Outcome.FAIL, Outcome.INCONCLUSIVE):
            for check in self.checks:
                if check.outcome is outcome:
                    return check
        return None


CASES: Final[dict[str, Case]] = {}
"""All cases by id; filled by importing `flasher.conformance.cases`."""


def case(
    case_id: str,
    title: str,
    *,
    clause: str,
    stimulus: str,
    expectation: str,
    requires: frozenset[Requirement] | set[Requirement] = frozenset(),
    choices: tuple[str, ...] = (),
    limit_s: float = 300.0,
) -> Callable[[Callable[[Bench], None]], Callable[[Bench], None]]:
    """Register the function below as a case. Raises ValueError for an id that is taken."""

    def register(run: Callable[[Bench], None]) -> Callable[[Bench], None]:
        if case_id in CASES:
            raise ValueError(f"there are two cases {case_id}")
        CASES[case_id] = Case(
            case_id,
            title,
            clause,
            stimulus,
            expectation,
            run,
            frozenset(requires),
            choices,
            limit_s,
        )
        return run

    return register


# -- how a case ends early ------------------------------------------------------------------------


class CaseEnded(Exception):  # noqa: N818  most of them are no errors
    """Base of what ends a case before its last line; the text is the reason."""


class CaseStopped(CaseEnded):
    """A check failed, and what follows would judge nothing; the check is recorded."""


class Unsupported(CaseEnded):
    """This bench cannot do what the case needs."""


class CaseLimitReached(CaseEnded):
    """The case took longer than it may."""


class DeviceCrashed(CaseEnded):
    """The device model stopped at something that a real part does not allow."""


class RunStopped(CaseEnded):
    """Somebody wants the run to end."""


@dataclass
class Findings:
    """What a case has found so far; the bench fills it."""

    checks: list[Check] = field(default_factory=list)
    measurements: list[Measurement] = field(default_factory=list)
    infos: list[str] = field(default_factory=list)
    inconclusive: str = ""

    def status(self) -> Status:
        """The verdict that follows from it."""
        outcomes = {check.outcome for check in self.checks}
        if Outcome.FAIL in outcomes:
            return Status.FAIL
        if Outcome.INCONCLUSIVE in outcomes:
            return Status.INCONCLUSIVE
        if Outcome.PASS in outcomes:
            return Status.PASS
        if Outcome.UNSUPPORTED in outcomes:
            return Status.UNSUPPORTED
        return Status.INFO if self.infos or self.measurements else Status.ERROR
