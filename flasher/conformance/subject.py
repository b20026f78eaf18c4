"""The interfaces of a device under test and of the bus to it; `mock` and `real` implement both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from flasher.conformance.wire import Encoder, RawFrame

if TYPE_CHECKING:  # the profile needs the validation library, which the list of cases does not
    from flasher.conformance.profile import ConformanceProfile

READBACK: Final = "readback"
BY_BUS: Final = "memory over the bus"


class Arrival(NamedTuple):
    """A frame on the bus: when its last bit was there (seconds), and whether it is an own one."""

    frame: RawFrame
    at: float
    is_echo: bool


class BusPort(Protocol):
    """The bus as the bench sees it. Methods raise BusError when the adapter fails."""

    bitrate_bps: int
    echoes: bool
    """True when own frames come back from `receive` once they have left."""
    timestamp_source: str
    """Who stamps the frames: "simulated bus", "hardware", "kernel" or "host"."""
    uncertainty_s: float
    """How far a time stamp may be off."""
    sends_error_frames: bool
    """True when `send` takes error frames too."""

    def now(self) -> float:
        """The time in seconds; it never goes back."""

    def send(self, frame: RawFrame) -> None:
        """Hand a frame over; returns when it is accepted."""

    def receive(self, deadline: float) -> Arrival | None:
        """The next frame, None when `deadline` passed first."""


class Subject(Protocol):
    """The device under test. What it cannot do raises `Unsupported`."""

    name: str
    """What it is and where, for the report."""
    target: str
    """wmc, bms or obc."""
    good_image: bytes
    """An image that runs on it."""
    second_image: bytes | None
    """Another image that runs on it, smaller, of another version."""
    has_power: bool
    """True when `power` works; the same for those below."""
    has_readback: bool
    has_bus_off: bool
    has_timed_cuts: bool

    @property
    def port(self) -> BusPort:
        """The way to it."""

    def power(self, *, on: bool) -> None:
        """Switch the device on or off."""

    def readback(self) -> bytes:
        """The application area from its first byte on: at least the bytes of the image in it."""

    def bus_off(self, for_s: float) -> None:
        """Take the device's CAN controller off the bus; it comes back after `for_s` seconds."""

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        """Cut the power when `share` (0 to 1) is done of the flash operation number `operation`
        (from 0) that begins from now on; it comes back after `off_s` seconds. One cut at a time.
        """

    def take_cut(self) -> bool:
        """True when the cut that was set last has happened; one that has not is cancelled."""


def readback_source(subject: Subject, profile: ConformanceProfile) -> str:
    """By what the flash is compared: `READBACK` past the protocol, or `BY_BUS`, the memory query of
    a running BMS, where the profile knows the address; "" where it is not.
    """
    if subject.has_readback:
        return READBACK
    is_known = Encoder(subject.target).has_version_query and profile.number("application_address")
    return BY_BUS if is_known else ""
