"""Messages between a station and the processes of its sockets; all can be pickled."""

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
    """Outcome of a run, before it is saved."""

    outcome: RunState
    code: str
    text: str
    duration_s: float
    verified: Mapping[str, Verified] = field(default_factory=dict)
    trace_sha256: str | None = None
    """SHA-256 of the compressed trace (`packed`); None when it could not be written."""


@dataclass(frozen=True)
class JournalWrite:
    """A write to a device, recorded before it is done and again after it."""

    target: str
    what: str
    value: str
    write_id: WriteId | None = None
    """None until the intent is recorded."""
    read_back: str | None = None
    """None when nothing could be read back."""


class JournalError(FlasherError):
    """A write could not be recorded: it must not be done."""


class Journal(Protocol):
    """Records the steps and writes of a run. When a method returns, its record is on disk; each
    raises JournalError when it cannot be saved.
    """

    def intent(self, target: str, what: str, value: str) -> JournalWrite:
        """Records a write before it is sent to the device."""

    def verified(self, write: JournalWrite, read_back: str | None) -> None:
        """Records that it was done; `read_back` is None when nothing could be read back."""

    def step(self, ended: StepEnded, measurements: Sequence[Measurement] = ()) -> None:
        """Records the end of one try of a step."""


def packed(trace: Path) -> Path:
    """Path of a run's trace after it was closed and compressed."""
    return trace.with_name(f"{trace.name}.gz")


def write_key(target: str, item: str) -> str:
    """Key of a written item in `Claim.written_before`."""
    return f"{target} {item}"


def flash_value(version: str, sha256: str) -> str:
    """Value of a flash in the records; equal for equal images."""
    return f"{version or 'no version'}, sha256 {sha256}"


# -- set-up of a process --------------------------------------------------------------------------


@dataclass(frozen=True)
class VirtualUnits:
    """Settings of a socket with virtual units."""

    units: MockUnits
    first_number: int = 1
    number_step: int = 1
    speed: float = 1.0
    """Speed of the simulated bus relative to a real one; 0: transfers take no time."""
    arrive_after_s: float = 1.0
    """Time from an empty socket to the next unit."""
    leave_after_s: float = 1.0
    """Time from the end of a run until its unit is taken out."""
    count: int | None = None
    """Number of units; None: no limit."""


@dataclass(frozen=True)
class WorkerSetup:
    """Settings of the process of a socket, constant while it lives."""

    socket: str
    recipe: Path
    files: Mapping[str, str]
    """SHA-256 of each file of the recipe: the process refuses to work with others."""
    bus: Mapping[str, Any] | None
    """Keywords of python-can's bus; None: virtual units."""
    virtual: VirtualUnits | None = None
    power: str = ""


# -- from the station -----------------------------------------------------------------------------


@dataclass(frozen=True)
class WriteReply:
    """The reply to an `Ask`. `error` is empty when the record is on disk."""

    number: int
    write_id: WriteId | None = None
    error: str = ""


@dataclass(frozen=True)
class Abort:
    """Stop the run at the request of a person."""


@dataclass(frozen=True)
class Quit:
    """End the process, after stopping an active run."""


ToWorker = Claim | WriteReply | Abort | Quit

# -- from the process -----------------------------------------------------------------------------


@dataclass(frozen=True)
class AdapterReady:
    """The adapter is open. `sees_units` is False when present units may be silent."""

    adapter: str
    sees_units: bool


@dataclass(frozen=True)
class Beat:
    """Sign of life, sent regularly."""


@dataclass(frozen=True)
class AdapterDown:
    """The adapter failed, or the process died; the adapter is opened again."""

    reason: str


@dataclass(frozen=True)
class PresenceChanged:
    """A unit was put in or taken out, or reported its serial number. Sent again after each run and
    after each opening of the adapter.
    """

    is_there: bool
    how: str = ""
    label: str = ""
    """The label of a virtual unit."""
    serial: str | None = None
    """The serial number that the unit reports; empty: it has none; None: not reported yet."""
    is_certain: bool = False
    """With `is_there` False: the socket is empty; else a sleeping unit may be in it."""
    is_power_up: bool = False
    """A bootloader announced its power-up, or the application of a unit started that had only been
    announced by its bootloader: the unit may be another one than before.
    """
    was_missed: bool = False
    """The process did not listen for a while, and the unit is only announced by its bootloader: it
    may be another one than before.
    """
    is_in_bootloader: bool = False
    """Only announcements of a bootloader are received, and no frames of an application."""
    number: int = 0
    """Number of this change, counting up; always 0 for virtual units."""


@dataclass(frozen=True)
class Ask:
    """A request to save a write or step; the process waits for the `WriteReply`."""

    number: int
    what: JournalWrite | StepEnded
    measurements: tuple[Measurement, ...] = ()
    """The measurements of the step."""


@dataclass(frozen=True)
class CannotWork:
    """The process ends and must not be restarted: the recipe changed, or a setting is wrong."""

    reason: str


RunEvent = StepStarted | Progressed | OperatorPrompted
"""Progress of a run, only displayed. The station adds the socket."""
FromWorker = (
    AdapterReady | Beat | AdapterDown | PresenceChanged | Ask | RunEvent | RunResult | CannotWork
)
