"""Messages between a station and the processes of its sockets; all can be pickled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from flasher.errors import FlasherError
from flasher.station.config import MockUnits, SocketConfig
from flasher.station.events import OperatorPrompted, Progressed, StepEnded, StepStarted
from flasher.station.records.model import Claim, Measurement, RunResult, WriteId

# -- a run --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JournalWrite:
    """A write to a device, recorded before it is done and again after it."""

    target: str
    what: str
    value: str
    write_id: WriteId | None = None
    """None until the intent is recorded."""
    read_back: str | None = None
    """None if nothing could be read back."""


class JournalError(FlasherError):
    """A write could not be recorded, so it must not be sent."""


class Journal(Protocol):
    """Records the steps and writes of a run, on disk on return. Raises JournalError."""

    def intent(self, target: str, what: str, value: str) -> JournalWrite:
        """Record a write before it is sent to the device."""

    def verified(self, write: JournalWrite, read_back: str | None) -> None:
        """Record that the write is done; `read_back` is None if nothing could be read back."""

    def step(self, ended: StepEnded, measurements: Sequence[Measurement] = ()) -> None:
        """Record the end of one try of a step."""


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
    """Settings of a socket's virtual units."""

    units: MockUnits
    first_number: int = 1
    number_step: int = 1
    speed: float = 1.0
    """Speed of the simulated bus relative to a real one; 0: transfers take no time."""
    arrive_after_s: float = 1.0
    """Time from an empty socket to the next unit."""
    leave_after_s: float = 1.0
    """Time from the end of a run to the removal of its unit."""
    count: int | None = None
    """Number of units; None: no limit."""


@dataclass(frozen=True)
class WorkerSetup:
    """Settings of a socket's process, constant while it runs."""

    socket: str
    recipe: Path
    files: Mapping[str, str]
    """SHA-256 of each file of the recipe: the process refuses other files."""
    adapter: SocketConfig | None
    """Adapter, which is looked for whenever it is opened; None: virtual units."""
    virtual: VirtualUnits | None = None
    power: str = ""
    is_from_plant: bool = False
    """The recipe is a copy of the plant's: it may waive no signature, and a damaged one is fetched
    again."""


# -- from the station -----------------------------------------------------------------------------


@dataclass(frozen=True)
class WriteReply:
    """Reply to an `Ask`. `error` is "" if the record is on disk."""

    number: int
    write_id: WriteId | None = None
    error: str = ""


@dataclass(frozen=True)
class Stop:
    """Stop the run."""

    ends_process: bool = False
    """End the process after that."""


ToWorker = Claim | WriteReply | Stop

# -- from the process -----------------------------------------------------------------------------


@dataclass(frozen=True)
class AdapterReady:
    """The adapter is open. `sees_units` is False if a present unit may send nothing."""

    sees_units: bool


@dataclass(frozen=True)
class Beat:
    """Heartbeat."""


@dataclass(frozen=True)
class AdapterDown:
    """The adapter failed, the process died, or the recipe cannot be used."""

    reason: str
    is_final: bool = False
    """It is not tried again, and the process ends: a local recipe changed or a setting is wrong."""


@dataclass(frozen=True)
class PresenceChanged:
    """A unit was put in or taken out, or reported its serial number. Repeated after each run and
    after the adapter was opened.
    """

    is_there: bool
    how: str = ""
    label: str = ""
    """Label of a virtual unit."""
    serial: str | None = None
    """Serial number that the unit reports; "": it has none; None: not reported yet."""
    is_certain: bool = False
    """With `is_there` False: the socket is empty; otherwise a sleeping unit may be in it."""
    is_power_up: bool = False
    """A bootloader announced its power-up, or an application started of which only the bootloader
    had been received: another unit may have been put in."""
    was_missed: bool = False
    """The process did not receive for a while, and only bootloader announcements arrive: another
    unit may have been put in."""
    is_in_bootloader: bool = False
    """Only bootloader announcements are received, no frames of an application."""
    unobserved_s: float = 0.0
    """The unit may have been in the socket for so long already: the process did not receive."""
    number: int = 0
    """Number of this change, counting up; always 0 for virtual units."""


@dataclass(frozen=True)
class Ask:
    """A request to save a write or step; the process waits for the `WriteReply`."""

    number: int
    what: JournalWrite | StepEnded
    measurements: tuple[Measurement, ...] = ()


RunEvent = StepStarted | Progressed | OperatorPrompted
"""Progress of a run, for display. The station adds the socket."""
FromWorker = AdapterReady | Beat | AdapterDown | PresenceChanged | Ask | RunEvent | RunResult
