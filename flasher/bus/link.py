"""The interface between engine and bus: `Link`, and the clocks that belong to it.

Deadlines of a link are times of its clock. A real adapter uses `MonotonicClock`; a simulated bus
creates its own time.
"""

from __future__ import annotations

import time
from typing import Final, Protocol, runtime_checkable

from flasher.bus.health import LinkHealth
from flasher.protocol.frame import Frame

SEND_LIMIT_S: Final = 2.0
"""How long a link waits for room in a full transmit queue. A packet takes 10 ms on a free bus."""


AT_ONCE: Final = float("-inf")
"""A deadline in the past: receive only what is already there."""
_AWAKE_S: Final = 0.0001
"""Real time for which a paced clock busy-waits."""


_MADE_UP_S: Final = 0.1
"""Maximum pause, in real seconds, that a steady clock makes up for."""


class Clock(Protocol):
    """Seconds that only increase."""

    def now(self) -> float: ...

    def wait_until(self, moment: float) -> None:
        """Return at `moment`; at once if it has passed."""
        ...

    @property
    def speed(self) -> float:
        """Its seconds per real second."""
        ...


class Link(Protocol):
    """Sends and receives single CAN frames. Methods raise BusError if the adapter fails."""

    def send(self, frame: Frame) -> None:
        """Pass a frame to the adapter; return when it is accepted.

        Waits for room in a full transmit queue up to the link's limit; then raises
        TransmitBlockedError.
        """
        ...

    def receive(self, deadline: float) -> Frame | None:
        """Return the next received frame; None at `deadline`. A deadline in the past returns only
        what is already there.
        """
        ...

    def drain(self) -> int:
        """Discard received frames; return their number."""
        ...

    def close(self) -> None:
        """Release the adapter; may be repeated."""
        ...

    def reopen(self) -> None:
        """Close the adapter and open it again with the same settings, after it was lost.

        Raises BusError while it is not back; call it again at most every 100 ms.
        """
        ...

    @property
    def is_off(self) -> bool:
        """True while the adapter reports bus-off, as last seen."""
        ...

    @property
    def is_physical(self) -> bool:
        """True unless the bus is known to be virtual. Takes 2 s at most."""
        ...

    def health(self) -> LinkHealth:
        """Return the health of adapter and bus. Sends nothing, never raises."""
        ...


@runtime_checkable
class StampingLink(Link, Protocol):
    """Link that may know the arrival time of a frame better than its reader."""

    @property
    def stamp_source(self) -> str:
        """Source of the time stamps ("kernel"); empty without any."""
        ...

    @property
    def received_at(self) -> float | None:
        """Arrival time of the last frame on the link's clock; None if not reliable."""
        ...


class MonotonicClock:
    """The finest clock, `time.perf_counter`; unaffected by changes of the wall clock."""

    speed: Final = 1.0
    now = staticmethod(time.perf_counter)

    def wait_until(self, moment: float) -> None:
        """Sleep until `moment`."""
        remaining_s = moment - time.perf_counter()
        if remaining_s > 0:
            time.sleep(remaining_s)


class PacedClock:
    """Real time multiplied by `speed`, for realistic demonstrations.

    A sleep ends about 0.1 ms late, so the last part is waited for actively.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._origin = time.perf_counter()

    def now(self) -> float:
        """Simulated seconds since the clock was made."""
        return (time.perf_counter() - self._origin) * self.speed

    def wait_until(self, moment: float) -> None:
        """Sleep until the simulated `moment`."""
        until = self._origin + moment / self.speed
        remaining_s = until - time.perf_counter()
        if remaining_s > _AWAKE_S:
            time.sleep(remaining_s - _AWAKE_S)
        while time.perf_counter() < until:
            pass


class SteadyClock:
    """Virtual time at the pace of real time, or `speed` times as fast. It advances only during
    waits, so that a pause of this computer also pauses the simulation.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._now = 0.0
        self._reached_at = time.perf_counter()
        """Real time at which it should have reached this time."""

    def now(self) -> float:
        """Simulated seconds since the clock was made."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Sleep until the simulated `moment`; makes up for a short pause."""
        if moment <= self._now:
            return
        real = time.perf_counter()
        from_s = max(self._reached_at, real - _MADE_UP_S)
        self._reached_at = from_s + (moment - self._now) / self.speed
        if self._reached_at > real:
            time.sleep(self._reached_at - real)
        self._now = moment


class VirtualClock:
    """Time that advances only by waiting."""

    speed: Final = 1.0

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Simulated seconds."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Advance to `moment`."""
        self._now = max(self._now, moment)
