"""What the records hand out and take: outcomes, what a run is claimed with, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import Final, NewType, Protocol

from flasher.validation import LowerCaseInJson, json_keys

RunId = NewType("RunId", int)
WriteId = NewType("WriteId", int)
DEFAULT_LOCK_TIMEOUT_S: Final = 5.0
"""How long a write waits for another program that holds the database."""


class Clock(Protocol):
    """Where the records take the time from."""

    def utc(self) -> datetime:
        """Now, with the time zone UTC."""

    def monotonic_s(self) -> float:
        """Seconds that only go forward; comparable within one start of the computer."""


def utc_text(moment: datetime) -> str:
    """A moment as it stands in the records: UTC, of one length, so that text order is time order.

    Raises ValueError for a moment without a time zone.
    """
    if moment.tzinfo is None:
        raise ValueError("a time without a zone is no moment")
    # isoformat: a report has ten thousands of them, and strftime takes twenty times as long.
    return moment.astimezone(UTC).isoformat(timespec="microseconds").removesuffix("+00:00") + "Z"


def utc_moment(text: str) -> datetime:
    """The moment that `utc_text` wrote."""
    return datetime.fromisoformat(text)


class RunState(LowerCaseInJson, StrEnum):
    """Where a run is, or how it ended."""

    RUNNING = "RUNNING"
    PASS = "PASS"  # noqa: S105  the word is no password
    FAIL = "FAIL"
    """The unit is bad."""
    ERROR = "ERROR"
    """The station could not tell: adapter, power, files."""
    ABORTED = "ABORTED"
    """A person stopped it."""
    INTERRUPTED = "INTERRUPTED"
    """The station died under it; `recover` found it."""


OUTCOMES: Final = (RunState.PASS, RunState.FAIL, RunState.ERROR, RunState.ABORTED)
"""What `finish` takes."""


class RunKind(StrEnum):
    """Why a run is made."""

    PRODUCTION = "production"
    RECHECK = "recheck"
    """The last run of this unit ended in the open: the device decides what is still to do."""
    VERIFY_ONLY = "verify-only"
    """The unit has passed: nothing is flashed or written."""
    REFLASH = "reflash"
    """The unit has passed, and is done again for the reason given."""
    GOLDEN = "golden"
    """A known unit tests the station; it counts in no figure."""


class AuditEvent(StrEnum):
    """What a person did at the station, noted in the audit trail by `Store.note`."""

    OPERATOR = "operator"
    """Another person works from now on."""
    RESUME = "resume"
    """The line was stopped, and goes on."""
    ABORT = "abort"
    """A run was stopped by hand."""
    REASON = "reason"
    """Why a unit is done again."""
    REPRINT = "reprint"
    """The label of a unit is printed once more."""
    REFUSED_SCAN = "refused scan"
    SIGN_IN = "sign-in"
    """Somebody signed in at a page."""
    SIGN_IN_REFUSED = "refused sign-in"
    """A wrong badge, PIN or password was given at a page."""
    SIGN_OUT = "sign-out"
    SIGN_IN_ENDED = "ended sign-in"
    """By a supervisor, by its own person at another browser, or by its limits."""


class UnitState(LowerCaseInJson, StrEnum):
    """What is known of a unit: derived from its last run."""

    NEW = "NEW"
    RUNNING = "RUNNING"
    PASS = "PASS"  # noqa: S105
    FAIL = "FAIL"
    RECHECK = "RECHECK"
    """The last run ended in the open. The device has to be asked."""

    @classmethod
    def after(cls, last: RunState | None) -> UnitState:
        """The state of a unit whose last run is in this state; None: it had none."""
        if last is None:
            return cls.NEW
        if last in (RunState.RUNNING, RunState.PASS, RunState.FAIL):
            return cls(last.value)
        return cls.RECHECK


class StepName(StrEnum):
    """A step of a run, in the order in which they come."""

    CONNECT = "connect"
    IDENTIFY = "identify"
    CHECK = "check"
    FLASH = "flash"
    WRITE = "write"
    RESTART = "restart"
    VERIFY = "verify"
    SAVE = "save"


class Verified(IntEnum):
    """How far a target was verified; more is greater."""

    COMPLETED = 0
    """The device confirmed the complete image; nothing was read back."""
    VERSION = 1
    """The new application runs and names the version of the image."""
    MEMORY = 2
    """Version, and every byte of the image read back."""

    @property
    def words(self) -> str:
        """As a person reads it."""
        return ("completed, not read back", "version read back", "memory read back")[self]


class StepState(LowerCaseInJson, StrEnum):
    """How one try of a step ended."""

    PASS = "PASS"  # noqa: S105
    FAIL = "FAIL"
    ERROR = "ERROR"
    SKIPPED = "SKIPPED"
    """Not needed, as in a run that only verifies."""


@dataclass(frozen=True)
class Order:
    """A run to be claimed."""

    serial: str
    socket: str
    operator: str
    lot: str = ""
    reason: str = ""
    is_virtual: bool = False


@dataclass(frozen=True)
class Claim:
    """A run that has begun; it is on disk. The process of its socket works on it."""

    run_id: RunId
    kind: RunKind
    serial: str
    day: date
    lot: str = ""
    # The station adds the following for the process of the socket.
    known_before: Mapping[str, str] = field(default_factory=dict)
    """What must not change, as earlier runs read it first, by the name of its measurement."""
    flashed_before: frozenset[str] = frozenset()
    """Targets whose last flash, of this very image, was read back."""
    written_before: Mapping[str, str] = field(default_factory=dict)
    """What the unit's last PASS wrote, by target and item ("bms serial-number")."""
    trace: Path = Path()
    """Where the trace goes."""
    presence: int = 0
    """The number of the last change of presence that the station knows: the label was given to
    the unit of which that is true.
    """


@dataclass(frozen=True)
class Measurement:
    """A number with its limits, or a text with what was expected; exactly one of the two."""

    name: str
    value: float | None = None
    unit: str = ""
    low: float | None = None
    high: float | None = None
    text: str | None = None
    expected: str | None = None

    @property
    def is_within(self) -> bool:
        """True when nothing speaks against it."""
        if self.value is None:
            return self.expected is None or self.text == self.expected
        return (self.low is None or self.value >= self.low) and (
            self.high is None or self.value <= self.high
        )


FLASH: Final = "flash"
"""What the transfer of an image is called among the writes to a target."""
SERIAL_NUMBER: Final = "serial-number"
"""What a write of the serial number is called: that of its item."""
BY_POWER: Final = "by power"
"""What a step says that restarted the unit by its power."""
AFTER_RESTART: Final = "after restart"
"""What is measured where the recipe lets a run go on after a restart that it did not cause."""
POWER_CYCLES: Final = "power cycles"
"""What the count of a run's own power cycles is called among its measurements."""
TRACE: Final = "trace"
"""Kind of the attachment: the whole trace of the bus."""
TORN_TRACE: Final = "torn-trace"
"""Of a process that died: its end is missing."""


@dataclass(frozen=True)
class AttachmentFile:
    """A file that belongs to a run, already stored by its hash."""

    kind: str
    name: str
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class Ending:
    """How a run ended: all that `Store.finish` saves in its one transaction."""

    state: RunState
    code: str
    """A short stable word for the cause, as "NO_ANSWER"; "OK" for a PASS."""
    text: str
    """What happened and what to do, for a person."""
    verified: Mapping[str, Verified] = field(default_factory=dict)
    """How far each target was verified, by the target's name."""
    log_sha256: str | None = None
    """The hash of the bus trace, which is one of the attachments."""
    attachments: Sequence[AttachmentFile] = ()


@dataclass(frozen=True)
class StepRecord:
    """One try of a step as recorded."""

    position: int
    name: str
    try_number: int
    state: StepState
    begun_at: datetime
    duration_s: float
    code: str
    text: str
    measurements: tuple[Measurement, ...] = ()


@dataclass(frozen=True)
class WriteRecord:
    """An act that cannot be taken back: what was intended, and what is known of it."""

    write_id: WriteId
    target: str
    what: str
    value: str
    intended_at: datetime
    verified_at: datetime | None
    read_back: str | None
    """What was read back; None where nothing was, or could be."""


@dataclass(frozen=True)
class TargetRecord:
    """A target of a run: the image, how far it had to be verified and how far it was."""

    target: str
    image: str
    image_sha256: str
    version: str
    required: Verified
    reached: Verified | None


@dataclass(frozen=True)
class RunRecord:
    """A run as recorded, without its parts."""

    run_id: RunId
    serial: str
    part: str
    lot: str | None
    kind: RunKind
    is_virtual: bool
    """The unit was a virtual one, made by the program: no product."""
    reason: str
    state: RunState
    code: str
    text: str
    begun_at: datetime
    ended_at: datetime | None
    duration_s: float | None
    """None for a run that goes on or was interrupted: its end is not known."""
    station: str
    socket: str
    operator: str
    recipe: str
    recipe_revision: str
    recipe_sha256: str
    verified: Verified | None
    """The weakest of its targets; None where nothing is known."""
    log_sha256: str | None


@dataclass(frozen=True)
class ReportedRun:
    """A run. Times are in UTC."""

    run_id: int
    serial: str
    part: str
    lot: str | None
    kind: RunKind
    is_virtual: bool
    """The unit was a virtual one: no product."""
    state: RunState
    code: str
    text: str
    begun_at: str
    ended_at: str | None
    duration_s: float | None
    station: str
    socket: str
    operator: str
    recipe: str
    recipe_revision: str
    recipe_sha256: str
    verified: str | None
    """The weakest of its targets: completed, version or memory."""
    log_sha256: str | None
    reason: str


@dataclass(frozen=True)
class RunDetails:
    """A run with all its parts."""

    run: RunRecord
    targets: tuple[TargetRecord, ...]
    steps: tuple[StepRecord, ...]
    writes: tuple[WriteRecord, ...]
    attachments: tuple[AttachmentFile, ...]


@dataclass(frozen=True)
class UnitLife:
    """A unit and everything that was ever done to it, the oldest run first."""

    serial: str
    part: str
    state: UnitState
    runs: tuple[RunDetails, ...]

    @property
    def is_virtual(self) -> bool:
        """True for a unit that the program made; a unit is never both."""
        return any(details.run.is_virtual for details in self.runs)

    @property
    def last(self) -> RunDetails | None:
        """The last run; None for a unit without any."""
        return self.runs[-1] if self.runs else None


@dataclass(frozen=True)
class RunFilter:
    """Which runs a report is about; None is no bound."""

    lot: str | None = None
    recipe: str | None = None
    since: datetime | None = None
    """Begun at this moment or later."""
    until: datetime | None = None
    """Begun before this moment."""
    serial: str | None = None
    part: str | None = None
    search: str | None = None
    """Part of the serial number; large and small letters are one."""
    state: RunState | None = None
    code: str | None = None
    socket: str | None = None


@dataclass(frozen=True)
class Figures:
    """The figures of a report. Golden units count in none of them."""

    runs: int
    units: int
    """Units with a run that told PASS from FAIL."""
    passed: int
    """Units whose last such run is a PASS."""
    first_passed: int
    """Units whose first such run is a PASS."""
    by_state: Mapping[str, int]
    failures: Mapping[str, int]
    """Runs that are no PASS, by code; the most frequent first."""
    duration_median_s: float | None
    """Of runs that passed."""
    duration_longest_s: float | None
    virtual_runs: int = 0
    """Runs of virtual units among all of these; none of them made a product."""

    @property
    def yield_share(self) -> float | None:
        """Units passed in the end, as a share of 1; None without units."""
        return self.passed / self.units if self.units else None

    @property
    def first_pass_share(self) -> float | None:
        """Units passed at the first try, as a share of 1; None without units."""
        return self.first_passed / self.units if self.units else None


@dataclass(frozen=True)
class Problem:
    """Something in the records that is not as it has to be."""

    where: str
    what: str
    runs: tuple[int, ...] = ()
    """The runs that it is about; empty when it is about all of them."""


@dataclass(frozen=True)
class KeptHeads:
    """The heads that a station's chain was compared with."""

    station: str
    place: str
    """A folder, or a database server."""
    first: int
    """Number of the first audit row whose head is kept there: from 1 where all of them are."""
    last: int
    rows: int
    """Of the chain; the last of them may not be kept there yet."""
    is_elsewhere: bool
    """False beside the key of the station: whoever can write there can make all of it anew."""

    @property
    def is_whole(self) -> bool:
        """True when it vouches for every row."""
        return self.first == 1 and self.last >= self.rows


@json_keys("problems remarks kept unkept unreached since traces is_checked_elsewhere")
@dataclass(frozen=True)
class Examination:
    """What was found in the records, and what they could be compared with."""

    problems: tuple[Problem, ...]
    remarks: tuple[str, ...]  # what a person should know, though nothing is wrong with it
    kept: tuple[KeptHeads, ...]
    unkept: tuple[str, ...]
    """Stations of which no heads are kept elsewhere than beside their key: records made anew with
    key and heads would look the same."""
    traces: int
    """Runs that passed and were compared with their own traces."""
    unreached: tuple[str, ...] = ()
    """Places of heads that could not be reached, each with why."""
    since: str | None = None
    """When everything before was examined, where only what came after that was now; null:
    everything was."""

    @property
    def is_checked_elsewhere(self) -> bool:
        """Every audit trail was compared, from its first row to its last, with heads that are kept
        in another place than beside the key.
        """
        stations = {each.station for each in self.kept}
        return (
            not self.unkept
            and all(
                any(
                    each.is_whole and each.is_elsewhere
                    for each in self.kept
                    if each.station == name
                )
                for name in stations
            )
            and bool(stations)
        )


@dataclass(frozen=True)
class RunExamination:
    """What was found about one run, its audit rows, and the heads of them that are kept."""

    problems: tuple[Problem, ...]
    elsewhere: tuple[str, ...]
    """Places in which the head of its last row is kept; not the one beside the key."""
    is_beside: bool
    """It is kept beside the key."""
    examined_at: str | None
    """When all records up to its last row were examined; None where they were not since."""


@dataclass(frozen=True)
class Backup:
    """A copy that was made."""

    path: Path
    sha256: str
    size_bytes: int
