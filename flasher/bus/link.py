"""Interface between protocol engine and CAN bus: `Link` and its clocks.

Deadlines of a link are times of its clock. A real adapter uses `MonotonicClock`, a simulated bus
its own time.
"""

from __future__ import annotations

import time
from typing import Final, Protocol, runtime_checkable

from flasher.bus.health import LinkHealth
from flasher.protocol.frame import Frame

SEND_LIMIT_S: Final = 2.0
"""Maximum wait for room in a full transmit queue. A packet takes 10 ms on a free bus."""


AT_ONCE: Final = float("-inf")
"""Deadline in the past: receive only frames that have already arrived."""


_CATCH_UP_S: Final = 0.1
"""Longest pause of this computer, in real seconds, that a steady clock makes up for."""


class Clock(Protocol):
    """Time in seconds, which only increases."""

    def now(self) -> float: ...

    def wait_until(self, moment: float) -> None:
        """Return at `moment`; at once if it has passed."""
        ...

    @property
    def speed(self) -> float:
        """Seconds of this clock per real second."""
        ...


class Link(Protocol):
    """Sends and receives single CAN frames. Methods raise BusError if the adapter fails."""

    def send(self, frame: Frame) -> None:
        """Pass a frame to the adapter; return when it is accepted.

        Waits up to `SEND_LIMIT_S` for room in a full transmit queue; then raises
        TransmitBlockedError.
        """
        ...

    def receive(self, deadline: float) -> Frame | None:
        """Return the next received frame; None at `deadline`. A deadline in the past returns only
        frames that have already arrived.
        """
        ...

    def drain(self) -> int:
        """Discard received frames; return their number."""
        ...

    def close(self) -> None:
        """Release the adapter; may be called again."""
        ...

    def reopen(self) -> None:
        """Close the adapter and open it again with the same settings, after it was unplugged.

        Raises BusError while the adapter is gone; call it again at most every 100 ms.
        """
        ...

    @property
    def is_off(self) -> bool:
        """True while the adapter's last report is bus-off."""
        ...

    @property
    def is_physical(self) -> bool:
        """True unless the bus is known to be virtual. Takes up to 2 s."""
        ...

    def health(self) -> LinkHealth:
        """Return the health of adapter and bus. Sends nothing, never raises."""
        ...


@runtime_checkable
class StampingLink(Link, Protocol):
    """Link whose adapter or driver time-stamps received frames."""

    @property
    def stamp_source(self) -> str:
        """Origin of the time stamps ("kernel"); empty without any."""
        ...

    @property
    def received_at(self) -> float | None:
        """Arrival time of the last frame on the link's clock; None if not reliable."""
        ...


def _clocks() -> tuple[int, int] | None:
    for names in (("CLOCK_BOOTTIME", "CLOCK_MONOTONIC"), ("CLOCK_MONOTONIC", "CLOCK_UPTIME_RAW")):
        if all(hasattr(time, name) for name in names):
            return getattr(time, names[0]), getattr(time, names[1])
    return None


_CLOCKS: Final = _clocks()
"""A clock that counts the time in which this computer is suspended, and one that does not; None on
Windows, where `time.perf_counter` counts it."""


def suspended_s() -> float:
    """Total time for which this computer was suspended and `time.perf_counter` stood still."""
    if _CLOCKS is None:
        return 0.0
    with_it, without_it = _CLOCKS
    # A pause of this process between two readings makes their difference smaller.
    return max(time.clock_gettime(with_it) - time.clock_gettime(without_it) for _ in range(2))


class MonotonicClock:
    """Real time: `time.perf_counter`, unaffected by changes of the wall clock."""

    speed: Final = 1.0
    now = staticmethod(time.perf_counter)

    def wait_until(self, moment: float) -> None:
        """Sleep until `moment`."""
        remaining_s = moment - time.perf_counter()
        if remaining_s > 0:
            time.sleep(remaining_s)


class SteadyClock:
    """Real time multiplied by `speed`, which stops while this computer stalls: it advances only
    during waits. So durations and time limits of a simulated device do not depend on this computer.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._now = 0.0
        self._reached_at = time.perf_counter()
        """Real time at which the current simulated time was due."""

    def now(self) -> float:
        """Simulated seconds since the clock was created."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Sleep until the simulated `moment`; makes up for a short pause of this computer."""
        if moment <= self._now:
            return
        real = time.perf_counter()
        from_s = max(self._reached_at, real - _CATCH_UP_S)
        self._reached_at = from_s + (moment - self._now) / self.speed
        if self._reached_at > real:
            time.sleep(self._reached_at - real)
        self._now = moment


class VirtualClock:
    """Simulated time that advances by waiting, without sleeping."""

    speed: Final = 1.0

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Simulated seconds."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Advance to `moment`."""
        if moment > self._now:  # noqa: PLR1730  called for each frame of a simulation
            self._now = moment
