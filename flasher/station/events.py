"""The events of a running station: frozen dataclasses, in the order in which they happened.

A view (a table on a terminal, JSON lines, a web page) needs nothing else. `RunEnded` is the one
event that says PASS, and it leaves only after the outcome is in the records, on disk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from flasher.station.records.model import (
    Figures,
    RunId,
    RunKind,
    RunState,
    StepName,
    StepState,
    Verified,
)
from flasher.validation import LowerCaseInJson


class SocketState(LowerCaseInJson, StrEnum):
    """What a socket shows; the word is for people."""

    STARTING = "STARTING"
    """Its process opens the adapter."""
    EMPTY = "EMPTY"
    """No unit is in it, and no label is meant for it."""
    SILENT = "SILENT"
    """Nothing is heard: no unit is in it, or one that sleeps."""
    SCAN = "SCAN"
    """A unit waits for its label, or a label for its unit; `SocketChanged.text` says which."""
    RUNNING = "RUNNING"
    SAVING = "SAVING"
    """The run is over, its outcome is not on disk yet: not a PASS."""
    PASS = "PASS"  # noqa: S105  the word is no password
    FAIL = "FAIL"
    RECHECK = "RECHECK"
    """The run ended without a verdict: the unit has to be scanned again."""
    ERROR = "ERROR"
    """The socket cannot work: adapter, process, or a record that is not saved."""
    STOPPED = "STOPPED"
    """The line is stopped; `LineStopped` gave the reason."""

    @property
    def is_verdict(self) -> bool:
        """True while a unit that is done waits to be taken out."""
        return self in (SocketState.PASS, SocketState.FAIL, SocketState.RECHECK)


@dataclass(frozen=True)
class Timed:
    """Base of all events."""

    at: str = field(default="", kw_only=True, compare=False)
    """UTC, as 2026-05-17T09:00:00.123Z; given when the event leaves the station."""


@dataclass(frozen=True)
class StationStarted(Timed):
    """The station is ready. `recovered` are runs that a dead station left: INTERRUPTED now, their
    units RECHECK.
    """

    station: str
    recipe: str
    revision: str
    part: str
    sockets: tuple[str, ...]
    recovered: tuple[RunId, ...]
    virtual_sockets: tuple[str, ...] = ()
    """Sockets whose units are virtual: no product comes out of them."""
    has_badges: bool = False
    """People scan badges, and their roles say what they may override."""


@dataclass(frozen=True)
class SocketChanged(Timed):
    """The state of a socket changed, or the text beside it."""

    socket: str
    state: SocketState
    serial: str = ""
    text: str = ""
    """What is awaited, or what is wrong; one sentence."""


@dataclass(frozen=True)
class UnitArrived(Timed):
    """A unit is in the socket. `label` is the label that only virtual units bring along."""

    socket: str
    how: str
    label: str = ""


@dataclass(frozen=True)
class UnitRemoved(Timed):
    """The unit is out: nothing was heard from it for the time set."""

    socket: str


@dataclass(frozen=True)
class ScanAccepted(Timed):
    """A scan was accepted: a label, or a command (`flasher.station.scans`)."""

    text: str
    meaning: str
    socket: str = ""
    """The socket that it is for; empty while none is chosen."""
    source: str = ""
    """Where it was scanned, as "scanner left"."""


@dataclass(frozen=True)
class ScanRefused(Timed):
    """A scan was refused and changed nothing, or what waited of it was dropped. `code` is a stable
    word, `remedy` one action.
    """

    text: str
    code: str
    reason: str
    remedy: str
    socket: str = ""
    source: str = ""
    """Where it was scanned."""


@dataclass(frozen=True)
class ScannerChanged(Timed):
    """A scanner of the station can be read, or cannot."""

    scanner: str
    is_ready: bool
    reason: str = ""


@dataclass(frozen=True)
class PinAwaited(Timed):
    """What is scanned or typed next is the PIN of this person: it must not be shown."""

    person: str
    text: str
    """The scan that needs it."""
    limit_s: float


@dataclass(frozen=True)
class PinEnded(Timed):
    """No PIN is awaited any more."""

    person: str
    is_right: bool
    """False when none came, the last try was wrong, or CANCEL was scanned."""


@dataclass(frozen=True)
class OperatorPrompted(Timed):
    """The operator has to act within `limit_s`, for example switch the unit off and on."""

    socket: str
    text: str
    limit_s: float | None = None
    source: str = ""
    """Where the label was scanned that it is about; empty: it is not about a scan."""


@dataclass(frozen=True)
class RunStarted(Timed):
    """A run was claimed and is in the records."""

    socket: str
    serial: str
    run_id: RunId
    kind: RunKind
    is_virtual: bool = False
    """The unit is a virtual one: no product."""


@dataclass(frozen=True)
class StepStarted(Timed):
    """A step of the run begins; tries count from 1. `target` is empty for steps of all targets."""

    socket: str
    serial: str
    step: StepName
    try_number: int
    target: str = ""


@dataclass(frozen=True)
class Progressed(Timed):
    """Progress of a step: `share` from 0 to 1; `left_s` is None when unknown."""

    socket: str
    serial: str
    step: StepName
    share: float
    left_s: float | None = None
    target: str = ""


@dataclass(frozen=True)
class StepEnded(Timed):
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
        """The name in the records: steps of one target name it, tries are counted by name."""
        return f"{self.step.value} {self.target}".strip()


@dataclass(frozen=True)
class RunEnded(Timed):
    """A run has ended **and its outcome is on disk**. `action` tells the operator what to do."""

    socket: str
    serial: str
    run_id: RunId
    kind: RunKind
    outcome: RunState
    code: str
    text: str
    action: str
    duration_s: float
    verified: tuple[tuple[str, Verified], ...] = ()
    """How far each target was verified, in the recipe's order."""
    is_virtual: bool = False
    """The unit was a virtual one: no product."""


@dataclass(frozen=True)
class LabelPrinted(Timed):
    """The label of a unit that has passed went to the printer."""

    socket: str
    serial: str
    is_reprint: bool = False


@dataclass(frozen=True)
class LabelFailed(Timed):
    """The label of a unit was not printed. Its PASS stands."""

    socket: str
    serial: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class RecordNotSaved(Timed):
    """The outcome could not be saved: PASS must not be shown. RESUME tries again."""

    socket: str
    serial: str
    run_id: RunId | None
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineStopped(Timed):
    """No run is started until RESUME; active runs are completed."""

    code: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineResumed(Timed):
    """The line goes on after RESUME."""


@dataclass(frozen=True)
class WorkerFailed(Timed):
    """A socket's process ended or hung; a new one is started after `restart_in_s`."""

    socket: str
    reason: str
    restart_in_s: float | None
    """None: it is not started again before the station is."""


@dataclass(frozen=True)
class FiguresChanged(Timed):
    """Totals of this recipe and lot since the station started."""

    figures: Figures


@dataclass(frozen=True)
class StationStopped(Timed):
    """The station has ended; nothing is running."""

    station: str


StationEvent = (
    StationStarted
    | SocketChanged
    | UnitArrived
    | UnitRemoved
    | ScanAccepted
    | ScanRefused
    | ScannerChanged
    | PinAwaited
    | PinEnded
    | OperatorPrompted
    | RunStarted
    | StepStarted
    | Progressed
    | StepEnded
    | RunEnded
    | LabelPrinted
    | LabelFailed
    | RecordNotSaved
    | LineStopped
    | LineResumed
    | WorkerFailed
    | FiguresChanged
    | StationStopped
)
"""Every event of a station."""
