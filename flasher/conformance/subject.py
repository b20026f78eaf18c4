"""Interfaces of the device under test (`Subject`) and of its bus (`BusPort`).

Implemented by `mock`, `real` and `dut`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from flasher.conformance.firmware import Firmware
from flasher.conformance.wire import Encoder, RawFrame

if TYPE_CHECKING:  # the profile needs the validation library, which the list of cases does not
    from flasher.conformance.profile import ConformanceProfile

SIMULATED_BUS: Final = "simulated bus"
"""Source of time stamps on a bus in virtual time."""
READBACK: Final = "readback"
BY_BUS: Final = "memory over the bus"


class Arrival(NamedTuple):
    """A frame on the bus, with the time of its last bit in seconds; `is_echo` for a sent frame."""

    frame: RawFrame
    at: float
    is_echo: bool


class BusPort(Protocol):
    """The bus as the bench sees it. Methods raise BusError when the adapter fails."""

    bitrate_bps: int
    echoes: bool
    """True when `receive` returns sent frames too, once they have left."""
    timestamp_source: str
    """Source of the time stamps: "simulated bus", "hardware", "kernel" or "host"."""
    uncertainty_s: float
    """Uncertainty of a time stamp."""
    sends_error_frames: bool
    """True when `send` supports error frames."""

    def now(self) -> float:
        """Monotonic time in seconds."""

    def send(self, frame: RawFrame) -> None:
        """Hand a frame over; returns when it is accepted."""

    def receive(self, deadline: float) -> Arrival | None:
        """The next frame, or None at `deadline`."""


class FlashCall(Enum):
    """A call of the flash driver."""

    READ = "read"
    ERASE = "erase"
    WRITE = "write"


class FlashEffect(Enum):
    """What is wrong with a call of the flash driver."""

    ERROR = "reports an error, once"
    WORN_SECTOR = "reports an error, as do all later ones of its sector"
    WRONG_BIT = "has a wrong bit, without an error"
    """A bit that stays 1 in each write, or is read wrong once."""


class FlashFault(NamedTuple):
    """Call number `number` (from 0, of its kind) of the flash driver fails."""

    call: FlashCall
    number: int
    effect: FlashEffect


class FlashFaults(Protocol):
    """Makes the flash memory of a device fail."""

    failed_at: float | None
    """Time of the call that failed first; None before it."""

    @property
    def calls(self) -> Mapping[FlashCall, int]:
        """Calls since `fail`."""

    def fail(self, fault: FlashFault | None) -> None:
        """Make one call fail, or none; calls are counted from now on."""


class Subject(Protocol):
    """The device under test. Unavailable operations raise `Unsupported`."""

    name: str
    """Name and location for the report."""
    target: str
    """wmc, bms or obc."""
    good_image: bytes
    """An image that runs on the device."""
    second_image: bytes | None
    """Another such image, smaller and of another version."""
    firmware: Firmware
    """Images for cases about content and size: larger ones, else the two above."""
    has_own_clock: bool
    """True when the device counts time by itself, so that its counters can overflow."""
    has_power: bool
    """True when `power` works; likewise the following."""
    has_readback: bool
    has_bus_off: bool
    has_timed_cuts: bool
    flash_faults: FlashFaults | None
    """None when its flash cannot be made to fail."""

    @property
    def port(self) -> BusPort:
        """The bus of the device."""

    def power(self, *, on: bool) -> None:
        """Switch the device on or off."""

    def readback(self) -> bytes:
        """Read the application area from its first byte on, at least as much as the image in it."""

    def bus_off(self, for_s: float) -> None:
        """Take the device's CAN controller off the bus for `for_s` seconds."""

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        """Cut the power for `off_s` seconds when `share` (0 to 1) of flash operation number
        `operation` (counted from now, from 0) is done. Only one cut can be pending.
        """

    @property
    def is_cut_pending(self) -> bool:
        """True until the cut has happened or is cancelled."""

    def take_cut(self) -> bool:
        """True when the cut has happened; otherwise cancels it."""


def readback_source(subject: Subject, profile: ConformanceProfile) -> str:
    """How the flash can be compared: `READBACK`, `BY_BUS` (memory queries to a running BMS at the
    address in the profile), or "".
    """
    if subject.has_readback:
        return READBACK
    is_known = Encoder(subject.target).has_version_query and profile.number("application_address")
    return BY_BUS if is_known else ""
