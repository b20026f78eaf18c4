"""Events of a running station, published in order.

The terminal's table, JSON lines and web pages show nothing else. Only `RunEnded` reports a PASS; it
is published after the outcome is in the records on disk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from flasher.station.records.model import (
    Figures,
    RunId,
    RunKind,
    RunRecord,
    StepName,
    StepState,
    TargetRecord,
)
from flasher.validation import LowerCaseInJson, json_keys


class SocketState(LowerCaseInJson, StrEnum):
    """State of a socket, as screens show it."""

    STARTING = "STARTING"
    """The process of the socket is opening the adapter."""
    EMPTY = "EMPTY"
    """No unit, and no label that waits for one."""
    SILENT = "SILENT"
    """No frames are received: no unit, or a sleeping one."""
    SCAN = "SCAN"
    """A unit waits for its label, or a label for its unit: see `SocketChanged.text`."""
    RUNNING = "RUNNING"
    SAVING = "SAVING"
    """The run has ended, but its outcome is not on disk yet: not a PASS."""
    PASS = "PASS"  # noqa: S105  the word is no password
    FAIL = "FAIL"
    RECHECK = "RECHECK"
    """The run ended without a verdict: scan the unit again."""
    ERROR = "ERROR"
    """The socket cannot work: its adapter or process failed, or an outcome is not saved."""
    STOPPED = "STOPPED"
    """The line is stopped; `LineStopped` has the reason."""

    @property
    def is_verdict(self) -> bool:
        """True while a finished unit is still in the socket."""
        return self in (SocketState.PASS, SocketState.FAIL, SocketState.RECHECK)


@dataclass(frozen=True)
class StationEvent:
    """Base of all events."""

    at: str = field(default="", kw_only=True, compare=False)
    """UTC, such as 2026-05-17T09:00:00.123Z; set when the event is published."""


@dataclass(frozen=True)
class StationStarted(StationEvent):
    """The station is ready. `recovered`: runs that were active when the station died; they are
    INTERRUPTED now, and their units RECHECK.
    """

    station: str
    recipe: str
    revision: str
    part: str
    sockets: tuple[str, ...]
    recovered: tuple[RunId, ...]
    virtual_sockets: tuple[str, ...] = ()
    """Sockets with virtual units."""
    has_badges: bool = False
    """The station has a badge table: roles decide who may override it."""


@dataclass(frozen=True)
class RecipeChanged(StationEvent):
    """A socket uses another recipe from its next unit on."""

    socket: str
    recipe: str
    revision: str
    part: str
    digest: str
    """Digest of the recipe with its files, as the plant gave it."""


@dataclass(frozen=True)
class OfferedRecipe:
    """A recipe from the plant that waits for a supervisor, or that cannot be used."""

    recipe: str
    """Name and revision; "" if it cannot be loaded."""
    digest: str
    sockets: tuple[str, ...]
    published_at: str
    published_by: str
    changes: tuple[str, ...] = ()
    """Differences from the recipe in use, as sentences."""
    scan: str = ""
    """The scan that approves it."""
    problem: str = ""
    """Why it cannot be used; "" if it can."""


@dataclass(frozen=True)
class RecipesOffered(StationEvent):
    """The recipes that the plant offers, and those in use that it has withdrawn, changed."""

    offered: tuple[OfferedRecipe, ...]
    withdrawn: tuple[str, ...] = ()
    """Sockets that begin no unit, since their recipe was withdrawn."""


@dataclass(frozen=True)
class SocketChanged(StationEvent):
    """The state or text of a socket changed."""

    socket: str
    state: SocketState
    serial: str = ""
    text: str = ""
    """A sentence: what the socket waits for, or its error."""


@dataclass(frozen=True)
class UnitArrived(StationEvent):
    """A unit was put into the socket. `label`: label of a virtual unit; "" for a real one."""

    socket: str
    how: str
    label: str = ""


@dataclass(frozen=True)
class UnitRemoved(StationEvent):
    """The unit was removed: it has sent nothing for the configured time."""

    socket: str


@dataclass(frozen=True)
class ScanAccepted(StationEvent):
    """A scan was accepted: a label or a command."""

    text: str
    meaning: str
    socket: str = ""
    """Socket that the scan applies to; "" while none is chosen."""
    source: str = ""
    """Scanner or page of the scan, for example "scanner left"."""


@dataclass(frozen=True)
class ScanRefused(StationEvent):
    """A scan was refused without effect, or an accepted scan was dropped while it waited. `code` is
    stable; `remedy` is one action.
    """

    text: str
    code: str
    reason: str
    remedy: str
    socket: str = ""
    source: str = ""
    """Scanner or page of the scan."""


@dataclass(frozen=True)
class ScannerChanged(StationEvent):
    """A scanner was connected or lost."""

    scanner: str
    is_ready: bool
    reason: str = ""


@dataclass(frozen=True)
class PinAwaited(StationEvent):
    """The next scan or typed line is this person's PIN: it must not be displayed."""

    person: str
    text: str
    """Scan that needs the PIN."""
    limit_s: float


@dataclass(frozen=True)
class PinEnded(StationEvent):
    """The station no longer waits for a PIN."""

    person: str
    is_right: bool
    """False after a wrong PIN, CANCEL or the time limit."""


@dataclass(frozen=True)
class OperatorPrompted(StationEvent):
    """The operator has to act within `limit_s`, for example switch the unit off and on."""

    socket: str
    text: str
    limit_s: float | None = None
    source: str = ""
    """Source of the label concerned; "" if no scan is."""


@dataclass(frozen=True)
class RunStarted(StationEvent):
    """A run was claimed and is in the records."""

    socket: str
    serial: str
    run_id: RunId
    kind: RunKind
    is_virtual: bool = False
    """True for a virtual unit."""


@dataclass(frozen=True)
class StepStarted(StationEvent):
    """A step of the run begins. Tries count from 1; `target` is empty for a step of all targets."""

    socket: str
    serial: str
    step: StepName
    try_number: int
    target: str = ""


@dataclass(frozen=True)
class Progressed(StationEvent):
    """Progress of a step: `share` from 0 to 1; `left_s` is None when unknown."""

    socket: str
    serial: str
    step: StepName
    share: float
    left_s: float | None = None
    target: str = ""


@dataclass(frozen=True)
class StepEnded(StationEvent):
    """One try of a step ended, and is in the records."""

    socket: str
    serial: str
    step: StepName
    try_number: int
    state: StepState
    duration_s: float
    code: str = ""
    text: str = ""
    target: str = ""

    @property
    def name(self) -> str:
        """Name in the records: the step, with the target if it has one."""
        return f"{self.step.value} {self.target}".strip()


@json_keys("at socket serial run targets action")
@dataclass(frozen=True)
class RunEnded(StationEvent):
    """A run has ended **and its outcome is on disk**: run and targets were read from there."""

    run: RunRecord
    action: str
    """The operator's next action."""
    targets: tuple[TargetRecord, ...] = ()

    @property
    def socket(self) -> str:
        return self.run.socket

    @property
    def serial(self) -> str:
        return self.run.serial


@dataclass(frozen=True)
class LabelPrinted(StationEvent):
    """The label of a passed unit was sent to the printer."""

    socket: str
    serial: str
    is_reprint: bool = False


@dataclass(frozen=True)
class LabelFailed(StationEvent):
    """The label of a unit was not printed. The unit is still a PASS."""

    socket: str
    serial: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class RecordNotSaved(StationEvent):
    """The outcome could not be saved: do not show a PASS. RESUME tries again."""

    socket: str
    serial: str
    run_id: RunId | None
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineStopped(StationEvent):
    """The line was stopped: active runs are completed, and no run starts before RESUME."""

    code: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineResumed(StationEvent):
    """The line was resumed by RESUME."""


@dataclass(frozen=True)
class WorkerFailed(StationEvent):
    """The process of a socket ended or hung; a new one starts after `restart_in_s`."""

    socket: str
    reason: str
    restart_in_s: float | None
    """Seconds until the process is restarted; None: not before the station is."""


@dataclass(frozen=True)
class FiguresChanged(StationEvent):
    """Totals of the recipe and lot since the station started."""

    figures: Figures


@dataclass(frozen=True)
class StationStopped(StationEvent):
    """The station and all of its processes have ended."""

    station: str
