"""What a running station tells: frozen dataclasses, in the order in which things happened.

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


class SocketState(StrEnum):
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
    """The line stands; `LineStopped` said why."""

    @property
    def is_verdict(self) -> bool:
        """True while a unit that is done waits to be taken out."""
        return self in (SocketState.PASS, SocketState.FAIL, SocketState.RECHECK)


@dataclass(frozen=True)
class Timed:
    """What all events have."""

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


@dataclass(frozen=True)
class SocketChanged(Timed):
    """A socket shows another state, or another text beside it."""

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
    """Nothing was heard from the unit for long enough: it is out."""

    socket: str


@dataclass(frozen=True)
class ScanAccepted(Timed):
    """What was scanned is understood: a label, or a command (`flasher.station.scans`)."""

    text: str
    meaning: str
    socket: str = ""
    """The socket that it is for; empty while none is chosen."""


@dataclass(frozen=True)
class ScanRefused(Timed):
    """What was scanned changes nothing. `code` is a stable word, `remedy` one action."""

    text: str
    code: str
    reason: str
    remedy: str
    socket: str = ""


@dataclass(frozen=True)
class OperatorPrompted(Timed):
    """Somebody has to do something now, as to switch the unit off and on; within `limit_s`."""

    socket: str
    text: str
    limit_s: float | None = None


@dataclass(frozen=True)
class RunStarted(Timed):
    """A unit is claimed; the run is in the records."""

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
    """How far the step is: `share` from 0 to 1; `left_s` is None where nobody can tell."""

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


@dataclass(frozen=True)
class RunEnded(Timed):
    """A run is over **and its outcome is on disk**. `action` is what the operator does now."""

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
class RecordNotSaved(Timed):
    """The outcome is not on disk: nothing may be shown green. It is tried again on RESUME."""

    socket: str
    serial: str
    run_id: RunId | None
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineStopped(Timed):
    """No unit is begun any more until RESUME; runs that go on are ended properly."""

    code: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class LineResumed(Timed):
    """What stopped the line is over."""


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
    | OperatorPrompted
    | RunStarted
    | StepStarted
    | Progressed
    | StepEnded
    | RunEnded
    | RecordNotSaved
    | LineStopped
    | LineResumed
    | WorkerFailed
    | FiguresChanged
    | StationStopped
)
"""Every event of a station."""
