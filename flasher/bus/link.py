"""The edge between an engine and a bus: eight methods, and a clock to go with them.

A link and its clock belong together: the deadlines that a link is given are times of that clock. A
real adapter goes with `MonotonicClock`; a simulated bus makes the time itself.
"""

from __future__ import annotations

import time
from typing import Final, Protocol, runtime_checkable

from flasher.bus.health import LinkHealth
from flasher.protocol.frame import Frame

SEND_LIMIT_S: Final = 2.0
"""How long a link waits for room in a full transmit queue. A packet takes 10 ms on a free bus."""


AT_ONCE: Final = float("-inf")
"""A deadline in the past: only what is there already."""
_AWAKE_S: Final = 0.0001
"""Real seconds that a paced clock waits awake."""


_MADE_UP_S: Final = 0.1
"""The longest pause in real seconds after which a steady clock hurries to keep its pace."""


class Clock(Protocol):
    """Seconds that only go forward."""

    def now(self) -> float:
        """The time."""
        ...

    def wait_until(self, moment: float) -> None:
        """Return when `moment` has come; at once when it has passed."""
        ...

    @property
    def speed(self) -> float:
        """Its seconds in one second of a person who waits."""
        ...


class Link(Protocol):
    """Sends and receives single CAN frames. Methods raise BusError when the adapter fails."""

    def send(self, frame: Frame) -> None:
        """Hand a frame to the adapter; returns when it is accepted.

        A full transmit queue is waited for, within the link's own limit; then
        TransmitBlockedError.
        """
        ...

    def receive(self, deadline: float) -> Frame | None:
        """The next frame received; None when `deadline` passed first. A deadline in the past
        takes only what is there already.
        """
        ...

    def drain(self) -> int:
        """Throw away what was received so far; returns how many frames."""
        ...

    def close(self) -> None:
        """Release the adapter; harmless when repeated."""
        ...

    def reopen(self) -> None:
        """Close the adapter and open it again as it was, for one that was lost and may be back.

        Raises BusError while it is not; may be called again, not more often than every 100 ms.
        """
        ...

    @property
    def is_off(self) -> bool:
        """True while the adapter is bus-off by its own report. Asks nobody."""
        ...

    @property
    def is_physical(self) -> bool:
        """True unless the bus is known to exist in computers alone. Takes 2 s at most."""
        ...

    def health(self) -> LinkHealth:
        """What is known of the adapter and its bus. Sends nothing, never raises."""
        ...


@runtime_checkable
class StampingLink(Link, Protocol):
    """A link that may know better than its reader when a frame arrived."""

    @property
    def stamp_source(self) -> str:
        """Who stamps the frames ("kernel"); empty where nobody does."""
        ...

    @property
    def received_at(self) -> float | None:
        """When the frame that `receive` returned last was there, in seconds on the link's clock;
        None without a stamp that can be trusted.
        """
        ...


class MonotonicClock:
    """The computer's finest clock, `time.perf_counter`: jumps of the wall clock do not touch it."""

    speed: Final = 1.0
    now = staticmethod(time.perf_counter)

    def wait_until(self, moment: float) -> None:
        """Sleep until `moment`."""
        remaining_s = moment - time.perf_counter()
        if remaining_s > 0:
            time.sleep(remaining_s)


class PacedClock:
    """Real time, but `speed` times as fast: what makes a demonstration look like the real thing.

    A sleep ends some 0.1 ms late, which a line would not do: the last of it is waited for awake.
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
    """Virtual time at the pace of real time, or `speed` times as fast: it passes only while
    somebody waits for it. A pause of this computer pauses what is simulated as well.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._now = 0.0
        self._reached_at = time.perf_counter()
        """When it should have been this time."""

    def now(self) -> float:
        """Simulated seconds since the clock was made."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Sleep until the simulated `moment`. What a short pause has cost is made up for."""
        if moment <= self._now:
            return
        real = time.perf_counter()
        from_s = max(self._reached_at, real - _MADE_UP_S)
        self._reached_at = from_s + (moment - self._now) / self.speed
        if self._reached_at > real:
            time.sleep(self._reached_at - real)
        self._now = moment


class VirtualClock:
    """Time that passes only when somebody waits for it."""

    speed: Final = 1.0

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        """Simulated seconds."""
        return self._now

    def wait_until(self, moment: float) -> None:
        """Make it that time."""
        self._now = max(self._now, moment)
