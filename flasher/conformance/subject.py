"""What the suite asks of a device under test and of the way to it; `mock` and `real` have both."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from flasher.conformance.wire import RawFrame


class Arrival(NamedTuple):
    """A frame on the bus: when its last bit was there (seconds), and whether it is an own one."""

    frame: RawFrame
    at: float
    is_echo: bool


class Port(Protocol):
    """The bus as the bench sees it. Methods raise BusError when the adapter fails."""

    @property
    def bitrate_bps(self) -> int:
        """Bits a second on the wire."""
        ...

    @property
    def echoes(self) -> bool:
        """True when own frames come back from `receive` once they have left."""
        ...

    @property
    def timestamp_source(self) -> str:
        """Who stamps the frames: "simulated bus", "hardware", "kernel" or "host"."""
        ...

    @property
    def uncertainty_s(self) -> float:
        """How far a time stamp may be off, in seconds."""
        ...

    def now(self) -> float:
        """Seconds that only go forward."""
        ...

    def send(self, frame: RawFrame) -> None:
        """Hand a frame over; returns when it is accepted."""
        ...

    def receive(self, deadline: float) -> Arrival | None:
        """The next frame, None when `deadline` passed first."""
        ...

    def drain(self) -> int:
        """Throw away what arrived so far; returns how many frames."""
        ...


class Subject(Protocol):
    """The device under test. What it cannot do raises `Unsupported`."""

    @property
    def name(self) -> str:
        """What it is and where, for the report."""
        ...

    @property
    def target(self) -> str:
        """wmc, bms or obc."""
        ...

    @property
    def port(self) -> Port:
        """The way to it."""
        ...

    @property
    def good_image(self) -> bytes:
        """An image that runs on it."""
        ...

    @property
    def second_image(self) -> bytes | None:
        """Another image that runs on it, smaller, of another version."""
        ...

    @property
    def has_power(self) -> bool:
        """True when `power` works."""
        ...

    @property
    def has_readback(self) -> bool:
        """True when `readback` works."""
        ...

    @property
    def has_bus_off(self) -> bool:
        """True when `bus_off` works."""
        ...

    @property
    def has_timed_cuts(self) -> bool:
        """True when `cut_in_operation` works."""
        ...

    def power(self, *, on: bool) -> None:
        """Switch the device on or off."""
        ...

    def readback(self) -> bytes:
        """The application area from its first byte on: at least the bytes of the image in it."""
        ...

    def bus_off(self, for_s: float) -> None:
        """Take the device's CAN controller off the bus; it comes back after `for_s` seconds."""
        ...

    def cut_in_operation(self, operation: int, share: float, off_s: float) -> None:
        """Cut the power when `share` (0 to 1) is done of the flash operation number `operation`
        (from 0) that begins from now on; it comes back after `off_s` seconds. One cut at a time.
        """
        ...

    def take_cut(self) -> bool:
        """Whether the cut that was set last has happened; one that has not never will."""
        ...
