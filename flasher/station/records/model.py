"""Types of the station's records: claims, ends of runs, runs with their steps, and filters."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from enum import IntEnum, StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NewType, Protocol

from flasher.validation import LowerCaseInJson, json_keys

if TYPE_CHECKING:
    from pydantic_core import CoreSchema

RunId = NewType("RunId", int)
WriteId = NewType("WriteId", int)
DEFAULT_LOCK_TIMEOUT_S: Final = 5.0
"""Time that a write waits for another program's lock on the database."""
CLOCK_TOLERANCE: Final = timedelta(minutes=5)
"""Network time may set the clock back this far."""


class StationClock(Protocol):
    """Source of time for the records; tests pass their own."""

    def utc(self) -> datetime:
        """The current time in UTC."""

    def monotonic_s(self) -> float:
        """Seconds that never go backward; comparable until the computer restarts."""


def utc_text(moment: datetime) -> str:
    """Format a time for the records: UTC with a constant length, so that texts sort by time.

    Raises ValueError for a time without a time zone.
    """
    if moment.tzinfo is None:
        raise ValueError("the time has no time zone")
    # isoformat: a report formats tens of thousands, and strftime takes twenty times as long.
    return moment.astimezone(UTC).isoformat(timespec="microseconds").removesuffix("+00:00") + "Z"


def local_moment(time: datetime) -> datetime:
    """The moment of a time, which without a time zone is one of this computer's clock. A time that
    the clock leaves out, since summer time begins, counts from the hour before: `astimezone` takes
    it for an earlier moment, and for a midnight that is one of the day before.
    """
    if time.tzinfo is None:
        time = datetime.fromtimestamp(time.timestamp(), UTC)
    return time.astimezone()


class UtcTextInJson:
    """Writes a time as `utc_text` in JSON: a time without microseconds is no shorter."""

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: Callable[[Any], CoreSchema]
    ) -> CoreSchema:
        from pydantic_core import core_schema  # noqa: PLC0415

        schema: Any = handler(source)
        written = core_schema.plain_serializer_function_ser_schema(utc_text, when_used="json")
        return {**schema, "serialization": written}

    @classmethod
    def __get_pydantic_json_schema__(cls, _schema: Any, _handler: Any) -> dict[str, Any]:
        return {"type": "string", "format": "date-time"}


Moment = Annotated[datetime, UtcTextInJson]


def utc_moment(text: str) -> datetime:
    """Parse a text of `utc_text`."""
    return datetime.fromisoformat(text)


class RunState(LowerCaseInJson, StrEnum):
    """State of a run: RUNNING, or how it ended."""

    RUNNING = "RUNNING"
    PASS = "PASS"  # noqa: S105  the word is no password
    FAIL = "FAIL"
    """A test failed: the unit is bad."""
    ERROR = "ERROR"
    """No verdict on the unit: its adapter, power or files failed."""
    ABORTED = "ABORTED"
    """A person stopped it."""
    INTERRUPTED = "INTERRUPTED"
    """The station's process ended during the run; `recover` set this state."""


OUTCOMES: Final = (RunState.PASS, RunState.FAIL, RunState.ERROR, RunState.ABORTED)
"""The states that `Store.finish` accepts."""


class RunKind(StrEnum):
    """Reason for a run."""

    PRODUCTION = "production"
    RECHECK = "recheck"
    """The unit's last run ended without a verdict: the run asks the device which steps remain."""
    VERIFY_ONLY = "verify-only"
    """A unit that passed before; nothing is flashed or written."""
    REFLASH = "reflash"
    """A unit that passed before is flashed again, for the reason given."""
    GOLDEN = "golden"
    """A known good unit that tests the station; figures exclude it."""


class AuditEvent(StrEnum):
    """Actions of people at the station, which `Store.note` appends to the audit trail."""

    OPERATOR = "operator"
    """The operator changed."""
    RESUME = "resume"
    """A stopped line was resumed."""
    ABORT = "abort"
    """A run was aborted."""
    REASON = "reason"
    """The reason for flashing a unit again."""
    REPRINT = "reprint"
    """A person asked for the label of a unit again."""
    LABELLED = "labelled"
    """The label of a run was sent to the printer."""
    RECIPE_APPROVED = "recipe approved"
    """A supervisor approved a recipe that the plant has given, for some sockets."""
    RECIPE_USED = "recipe in use"
    """A socket uses another recipe than before."""
    RELEASED = "released"
    """A golden unit passed with this version of flasher and this recipe."""
    CLAIM_RELEASED = "claim released"
    """The plant had released the claim of a unit before the end of its run arrived there."""
    REFUSED_SCAN = "refused scan"
    SIGN_IN = "sign-in"
    """A person signed in on a page."""
    SIGN_IN_REFUSED = "refused sign-in"
    """A wrong badge, PIN or password was entered on a page."""
    SIGN_OUT = "sign-out"
    SIGN_IN_ENDED = "ended sign-in"
    """Ended by a supervisor, by the same person in another browser, or by a timeout."""


class UnitState(LowerCaseInJson, StrEnum):
    """The state of a unit, derived from its last run."""

    NEW = "NEW"
    RUNNING = "RUNNING"
    PASS = "PASS"  # noqa: S105
    FAIL = "FAIL"
    RECHECK = "RECHECK"
    """The last run ended without a verdict: ask the device for its state."""

    @classmethod
    def after(cls, last: RunState | None) -> UnitState:
        """State of a unit after a last run with the state `last`; None: no run yet."""
        if last is None:
            return cls.NEW
        if last in (RunState.RUNNING, RunState.PASS, RunState.FAIL):
            return cls(last.value)
        return cls.RECHECK


class StepName(StrEnum):
    """Steps of a run, in order."""

    PLANT = "plant"
    """What the plant answered before the run."""
    CONNECT = "connect"
    IDENTIFY = "identify"
    CHECK = "check"
    FLASH = "flash"
    WRITE = "write"
    RESTART = "restart"
    VERIFY = "verify"
    SAVE = "save"


class Verified(LowerCaseInJson, IntEnum):
    """Verification level of a target; a stricter level is greater."""

    COMPLETED = 0
    """The device confirmed the complete image; nothing was read back."""
    VERSION = 1
    """The new application runs and reports the version of the image."""
    MEMORY = 2
    """Version, and every byte of the image, read back."""

    @property
    def words(self) -> str:
        """Name of the level for people."""
        return ("completed, not read back", "version read back", "memory read back")[self]


class StepState(LowerCaseInJson, StrEnum):
    """State of a step, or how one try of it ended."""

    PASS = "PASS"  # noqa: S105
    FAIL = "FAIL"
    ERROR = "ERROR"
    SKIPPED = "SKIPPED"
    """Not done: not needed, as in a verify-only run, or not possible, which its text states."""


DUPLICATES: Final = "duplicates"
"""Measurement of the step `plant`: `CHECKED`, or "not checked: " and why it is not known whether
the unit has passed at another station."""
CHECKED: Final = "checked"
RELEASED_MARK: Final = f"not {CHECKED}: its claim was released"
"""Instead of that measurement, for a run that reached the plant after the claim of its unit was
released; as `RunRecord.duplicates`."""
PLANT_CLAIM: Final = "plant claim"
"""Measurement of the step `plant`: the claim of the unit in the plant's database."""
PLANT_ANSWER: Final = "plant answer"
"""Measurement of the step `plant`: the answer to the question whether the unit may be here."""
CLOCK_OFFSET: Final = "clock offset"
"""Measurement of the step `plant`: this computer's clock minus that of the plant's database."""


class ElsewhereState(StrEnum):
    """State of a unit at another station of the plant."""

    RUNNING = "running"
    UNKNOWN = "unknown"
    """A station claimed it, and has not sent the end of that run in time: it may have passed."""
    PASSED = "passed"


@dataclass(frozen=True)
class Elsewhere:
    """What the plant's database has about a unit at another station."""

    state: ElsewhereState
    station: str
    socket: str
    at: str
    """Time of the claim, or of the begin of the run that passed, in UTC."""
    run: int | None = None
    """Number of that run in its station's records; None before its end was sent."""

    @property
    def moment(self) -> str:
        """The time, for people."""
        return f"{self.at[:19].replace('T', ' ')} UTC"


@dataclass(frozen=True)
class Answer:
    """Answer to the question whether a unit may be here, or the rule for none."""

    may_begin: bool
    text: str
    is_answered: bool = True


@dataclass(frozen=True)
class Admission:
    """What a plant answered about a unit before its run. The recipe decides what follows."""

    claim: str = ""
    """The claim in the plant's database; "" if none was asked for."""
    unchecked: str = ""
    """Why the plant's database did not answer; "" if it did."""
    elsewhere: Elsewhere | None = None
    answer: Answer | None = None
    clock_offset_s: float | None = None
    """This computer's clock minus that of the plant's database; None: not known."""
    duration_s: float = 0.0
    """Time that the plant took."""

    @property
    def doubt(self) -> str:
        """Why it is not known whether the unit has passed at another station; "" if it is."""
        other = self.elsewhere
        if self.unchecked or other is None or other.state is not ElsewhereState.UNKNOWN:
            return self.unchecked
        return f"{other.station} claimed it at {other.moment}, and has not sent the end of its run"


@dataclass(frozen=True)
class Order:
    """Request for a run: the argument of `Store.claim`."""

    serial: str
    socket: str
    operator: str
    lot: str = ""
    reason: str = ""
    is_virtual: bool = False
    admission: Admission | None = None
    """None: the station does not ask a plant."""


SIGNATURE: Final = "signature"
"""Measurement of a target: what was found about the signatures of its image."""
COUNTER: Final = "release counter"
"""Measurement of a target: counter of its signed release."""
PRODUCT: Final = "release product"
"""Measurement of a target: product whose releases share the counter."""


@dataclass(frozen=True)
class Signature:
    """Result of checking the signatures of an image before a run."""

    text: str
    """The result as a sentence."""
    product: str = ""
    counter: int | None = None
    """Counter of the release; None if no trusted key signed it."""


@dataclass(frozen=True)
class Claim:
    """A started run, on disk; it is sent to the process of its socket."""

    run_id: RunId
    kind: RunKind
    serial: str
    day: date
    lot: str = ""
    # The station adds the following for the process of the socket.
    known_before: Mapping[str, str] = field(default_factory=dict)
    """Values that must not change, by measurement, as earlier runs first read them."""
    flashed_before: frozenset[str] = frozenset()
    """Targets whose last flash wrote this same image and was read back."""
    written_before: Mapping[str, str] = field(default_factory=dict)
    """Values that the unit's last PASS wrote, by target and item ("bms serial-number")."""
    counters_before: Mapping[str, int] = field(default_factory=dict)
    """Highest counter of a release of the same product that the records have for this serial
    number, by target."""
    trace: Path = Path()
    """File in which the bus trace is recorded."""
    presence: int = 0
    """`PresenceChanged.number` of the labelled unit: another unit in the socket ends the run."""
    has_card: bool = True
    """The socket's card was scanned with the label, or the unit is virtual. Only then a unit that
    cannot identify itself may be flashed."""
    signatures: Mapping[str, Signature] = field(default_factory=dict)
    """Signatures of the images, by target, checked when the unit was claimed; without a target for
    which neither recipe nor trust file asks for any."""
    unchecked: str = ""
    """Why it is not known whether the unit has passed at another station; "" if it was checked, or
    the station belongs to no plant."""


@dataclass(frozen=True)
class Measurement:
    """A measured number with limits, or a text with the expected one; exactly one of both."""

    name: str
    value: float | None = None
    unit: str = ""
    low: float | None = None
    high: float | None = None
    text: str | None = None
    expected: str | None = None

    @property
    def is_within(self) -> bool:
        """True if the value is within its limits, or the text equals the expected one."""
        if self.value is None:
            return self.expected is None or self.text == self.expected
        return (self.low is None or self.value >= self.low) and (
            self.high is None or self.value <= self.high
        )


FLASH: Final = "flash"
"""`WriteRecord.what` of an image transfer."""
SERIAL_NUMBER: Final = "serial-number"
"""`WriteRecord.what` of a serial number: the name of its item."""
BY_POWER: Final = "by power"
"""`StepRecord.text` of a restart by switching the unit's power off and on."""
AFTER_RESTART: Final = "after restart"
"""Measurement of a run that continued after a restart of the unit that it did not cause."""
POWER_CYCLES: Final = "power cycles"
"""Measurement: number of power cycles that the run made."""
TRACE: Final = "trace"
"""Kind of attachment: the complete bus trace."""
TORN_TRACE: Final = "torn-trace"
"""Kind of attachment: the bus trace of a process that died, without its end."""


@dataclass(frozen=True)
class AttachmentFile:
    """A file of a run, stored under its hash."""

    kind: str
    name: str
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class RunResult:
    """Outcome of a run: reported by its process, and saved by `Store.finish` in one transaction."""

    outcome: RunState
    code: str
    """Stable code of the cause, for example "NO_ANSWER"; "OK" for a PASS."""
    text: str
    """Message for people: what happened; when it is saved, also what to do."""
    duration_s: float
    verified: Mapping[str, Verified] = field(default_factory=dict)
    """Verification level reached, by target name."""
    trace_sha256: str | None = None
    """SHA-256 of the compressed trace of the bus, also an attachment; None if it could not be
    written."""
    attachments: Sequence[AttachmentFile] = ()


@dataclass(frozen=True)
class StepRecord:
    """One try of a step as recorded."""

    position: int
    name: str
    try_number: int
    state: StepState
    begun_at: Moment
    duration_s: float
    code: str
    text: str
    measurements: tuple[Measurement, ...] = ()


@dataclass(frozen=True)
class WriteRecord:
    """A write to a device, recorded before it (intended) and after it (verified)."""

    write_id: WriteId
    target: str
    what: str
    value: str
    intended_at: Moment
    verified_at: Moment | None
    read_back: str | None
    """Value read back; None if it was not or cannot be read."""


@dataclass(frozen=True)
class TargetRecord:
    """A target of a run: its image, and the verification level required and reached."""

    target: str
    image: str
    image_sha256: str
    version: str
    required: Verified
    reached: Verified | None
    signature: str | None = None
    """Result of checking its signatures before the run; null if nothing asked for any."""


@dataclass(frozen=True)
class RunRecord:
    """A recorded run, without its targets, steps, writes and attachments. Times are in UTC."""

    run_id: RunId
    serial: str
    part: str
    lot: str | None
    kind: RunKind
    is_virtual: bool
    """True for a run of a virtual unit."""
    state: RunState
    code: str
    text: str
    begun_at: Moment
    ended_at: Moment | None
    duration_s: float | None
    """null for an active run, and for an interrupted one, whose end is unknown."""
    station: str
    socket: str
    operator: str
    recipe: str
    recipe_revision: str
    recipe_sha256: str
    verified: Verified | None
    """Lowest level of its targets; null if unknown."""
    log_sha256: str | None
    reason: str
    duplicates: str | None = None
    """Whether the unit has passed at another station was "checked", or "not checked" with the
    reason; null: the station belongs to no plant."""

    @property
    def is_unchecked(self) -> bool:
        """True if it was not checked whether the unit has passed at another station."""
        return self.duplicates not in (None, CHECKED)

    def marked(self, released: Collection[int]) -> RunRecord:
        """The run with `RELEASED_MARK` if it is one of these."""
        return replace(self, duplicates=RELEASED_MARK) if self.run_id in released else self


@dataclass(frozen=True)
class RunDetails:
    """A run with its targets, steps, writes and attachments."""

    run: RunRecord
    targets: tuple[TargetRecord, ...]
    steps: tuple[StepRecord, ...]
    writes: tuple[WriteRecord, ...]
    attachments: tuple[AttachmentFile, ...]


@dataclass(frozen=True)
class UnitLife:
    """A unit with all its runs, oldest first."""

    serial: str
    part: str
    state: UnitState
    runs: tuple[RunDetails, ...]

    @property
    def is_virtual(self) -> bool:
        """True for a virtual unit; a serial number belongs to units of one kind."""
        return any(details.run.is_virtual for details in self.runs)

    @property
    def last(self) -> RunDetails | None:
        """The last run; None without runs."""
        return self.runs[-1] if self.runs else None


@json_keys("serial part is_virtual first second")
@dataclass(frozen=True)
class PassedTwice:
    """A unit that passed at two stations of a plant, without a recipe that asked for it."""

    first: RunRecord
    """The PASS that the plant's database had first."""
    second: RunRecord

    @property
    def serial(self) -> str:
        return self.second.serial

    @property
    def part(self) -> str:
        return self.second.part

    @property
    def is_virtual(self) -> bool:
        return self.second.is_virtual


@dataclass(frozen=True)
class RunFilter:
    """Selects runs by their properties; null means any."""

    lot: str | None = None
    recipe: str | None = None
    since: Moment | None = None
    """Earliest start of a run."""
    until: Moment | None = None
    """Runs start before this time."""
    serial: str | None = None
    part: str | None = None
    search: str | None = None
    """Part of the serial number; ignores case."""
    state: RunState | None = None
    code: str | None = None
    socket: str | None = None
    station: str | None = None


@json_keys("units passed first_passed yield_share first_pass_share")
@dataclass
class Units:
    """Counts of units, without golden ones."""

    units: int = 0
    """Number of units with a run that ended in PASS or FAIL."""
    passed: int = 0
    """Number of units whose last such run is a PASS."""
    first_passed: int = 0
    """Number of units whose first such run is a PASS."""

    @property
    def yield_share(self) -> float | None:
        """Yield: `passed` divided by `units`, from 0 to 1; null without units."""
        return self.passed / self.units if self.units else None

    @property
    def first_pass_share(self) -> float | None:
        """First-pass yield: `first_passed` divided by `units`, from 0 to 1; null without units."""
        return self.first_passed / self.units if self.units else None


class UnitTally:
    """Counts the units of runs that are added one by one, those of a unit in order."""

    def __init__(self) -> None:
        self.units = Units()
        self._is_passed: dict[object, bool] = {}
        """The last run of each unit."""

    def add(self, unit: object, *, is_passed: bool) -> None:
        before = self._is_passed.get(unit)
        if before is None:
            self.units.units += 1
            self.units.first_passed += is_passed
        self.units.passed += is_passed - bool(before)
        self._is_passed[unit] = is_passed


@json_keys(
    "runs units passed first_passed yield_share first_pass_share by_state failures"
    " duration_median_s duration_longest_s virtual_runs"
)
@dataclass
class Figures(Units):
    """Figures of runs, without golden units."""

    runs: int = 0
    by_state: Mapping[RunState, int] = field(default_factory=dict)
    failures: Mapping[str, int] = field(default_factory=dict)
    """Number of runs that ended without PASS, by code, most frequent first."""
    duration_median_s: float | None = None
    """Median over runs that passed."""
    duration_longest_s: float | None = None
    virtual_runs: int = 0
    """Number of runs of virtual units, included in the counts above."""


@dataclass(frozen=True)
class Problem:
    """A damage, contradiction or forgery found in the records."""

    where: str
    what: str
    runs: tuple[int, ...] = ()
    """The numbers of the runs concerned; empty: all of them."""


@dataclass(frozen=True)
class KeptHeads:
    """The copies of a station's chain heads in one place, which its chain was compared with."""

    station: str
    place: str
    """A folder, or a database server."""
    first: int
    """Number of the first audit row whose head is stored there; 1 when all are."""
    last: int
    rows: int
    """Audit rows of the chain; heads of the newest may not be stored there yet."""
    is_elsewhere: bool
    """False beside the station's key: whoever can write there can forge records and heads."""

    @property
    def is_whole(self) -> bool:
        """True if the heads cover every audit row."""
        return self.first == 1 and self.last >= self.rows


@json_keys("problems remarks kept unkept unreached since traces is_checked_elsewhere")
@dataclass(frozen=True)
class Examination:
    """Result of an examination of the records."""

    problems: tuple[Problem, ...]
    remarks: tuple[str, ...]  # for people: notable, but no problem
    kept: tuple[KeptHeads, ...]
    unkept: tuple[str, ...]
    """Stations whose heads are stored only beside their key: records forged together with key and
    heads could not be detected."""
    traces: int
    """Number of passed runs that were compared with their traces."""
    unreached: tuple[str, ...] = ()
    """Places of heads that could not be reached, each with the reason."""
    since: str | None = None
    """The time of the complete examination that this one continues: only newer records were
    examined; null: all were."""

    @property
    def is_checked_elsewhere(self) -> bool:
        """True if every audit trail was compared completely with heads apart from its key."""
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
    """Result of an examination of one run with its audit rows."""

    problems: tuple[Problem, ...]
    elsewhere: tuple[str, ...]
    """Places that hold the head of its last audit row, without the one beside the key."""
    is_beside: bool
    """The head of its last audit row is stored beside the key."""
    examined_at: str | None
    """When all records up to its last audit row were last examined; None: never."""


@dataclass(frozen=True)
class Backup:
    """A completed backup of the records."""

    path: Path
    sha256: str
    size_bytes: int
