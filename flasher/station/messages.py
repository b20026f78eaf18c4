"""Messages between a station and the processes of its sockets; all of them can be pickled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from flasher.errors import FlasherError
from flasher.station.config import MockUnits
from flasher.station.events import OperatorPrompted, Progressed, StepEnded, StepStarted
from flasher.station.records.model import Claim, Measurement, RunState, Verified, WriteId

# -- a run --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RunResult:
    """Outcome of a run, not saved yet."""

    outcome: RunState
    code: str
    text: str
    duration_s: float
    verified: Mapping[str, Verified] = field(default_factory=dict)
    trace_sha256: str | None = None
    """Of the closed trace (`packed`); None where it could not be written."""


@dataclass(frozen=True)
class Write:
    """A write to a device, which is recorded before it is done, and again when it is."""

    target: str
    what: str
    value: str
    write_id: WriteId | None = None
    """Once it is recorded."""
    read_back: str | None = None
    """None when nothing could be read back."""


class JournalError(FlasherError):
    """A write could not be recorded: it must not be done."""


class Journal(Protocol):
    """Records on disk when a method returns; each method raises JournalError when not."""

    def intent(self, target: str, what: str, value: str) -> Write:
        """Before a write to the device."""

    def verified(self, write: Write, read_back: str | None) -> None:
        """After it; `read_back` is None when nothing could be read back."""

    def step(self, ended: StepEnded, measurements: Sequence[Measurement] = ()) -> None:
        """A try of a step ended."""


def packed(trace: Path) -> Path:
    """Where the closed trace of a run is."""
    return trace.with_name(f"{trace.name}.gz")


def write_key(target: str, item: str) -> str:
    """The name of something written, as `Claim.written_before` has it."""
    return f"{target} {item}"


def flash_value(version: str, sha256: str) -> str:
    """What the records say of a flash: enough to know the same image again."""
    return f"{version or 'no version'}, sha256 {sha256}"


# -- how a process is set up ----------------------------------------------------------------------


@dataclass(frozen=True)
class VirtualUnits:
    """Virtual units of a socket, and their serial numbers."""

    units: MockUnits
    first_number: int = 1
    number_step: int = 1
    speed: float = 1.0
    """Times as fast as a real bus; 0 takes no time at all."""
    arrive_after_s: float = 1.0
    """From an empty socket to the next unit."""
    leave_after_s: float = 1.0
    """From the end of a run to the unit's leaving."""
    count: int | None = None
    """Units in all; None: without end."""


@dataclass(frozen=True)
class WorkerSetup:
    """Everything that the process of a socket needs; nothing of it changes while it lives."""

    socket: str
    recipe: Path
    files: Mapping[str, str]
    """The recipe's files, each with its SHA-256: the process must work with the very same."""
    bus: Mapping[str, Any] | None
    """python-can's keywords; None: virtual units."""
    virtual: VirtualUnits | None = None
    power: str = ""


# -- from the station -----------------------------------------------------------------------------


@dataclass(frozen=True)
class WriteReply:
    """The answer to an `Ask`. `error` is empty when it is on disk."""

    number: int
    write_id: WriteId | None = None
    error: str = ""


@dataclass(frozen=True)
class Abort:
    """A person stops the run."""


@dataclass(frozen=True)
class Quit:
    """End; a run that goes on is stopped first."""


ToWorker = Claim | WriteReply | Abort | Quit

# -- from the process -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Ready:
    """The adapter is open. `sees_units` is False when a unit that is there may say nothing."""

    adapter: str
    sees_units: bool


@dataclass(frozen=True)
class Beat:
    """Heartbeat."""


@dataclass(frozen=True)
class AdapterDown:
    """The adapter failed, or the process is gone; it is opened again."""

    reason: str


@dataclass(frozen=True)
class PresenceChanged:
    """A unit came or went, or reported its serial number; sent again after each run and opening."""

    is_there: bool
    how: str = ""
    label: str = ""
    """The label that a virtual unit bears."""
    serial: str | None = None
    """The serial number that the unit itself says; empty: it has none; None: not said yet."""
    is_certain: bool = False
    """Nothing is in the socket; else nothing is heard, which may be a unit that sleeps."""
    is_power_up: bool = False
    """A bootloader announced that its power came, or a unit that had only announced itself has an
    application now: of a unit that was put in, which may be another one than was heard before.
    """
    was_missed: bool = False
    """Nobody has listened for a while to a unit that only announces itself: another one may have
    been put in.
    """
    is_in_bootloader: bool = False
    """Only announcements of a bootloader are heard, and no application."""
    number: int = 0
    """Changes are numbered; 0 of a virtual unit."""


@dataclass(frozen=True)
class Ask:
    """Save this and reply; the process waits for the reply."""

    number: int
    what: Write | StepEnded
    measurements: tuple[Measurement, ...] = ()
    """Of a step."""


@dataclass(frozen=True)
class CannotWork:
    """The process ends and must not be restarted: the recipe changed, or a setting is wrong."""

    reason: str


RunEvent = StepStarted | Progressed | OperatorPrompted
"""Progress of a run, for display only. The station adds the socket."""
FromWorker = Ready | Beat | AdapterDown | PresenceChanged | Ask | RunEvent | RunResult | CannotWork
