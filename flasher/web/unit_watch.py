"""Unit watch: engine that detects which unit is connected to the bench, and its exchange.

It requests the version twice a second, like an idle socket of the station (`Presence`). As a tap it
follows the frames of other engines too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Final

from flasher.protocol.frame import Frame
from flasher.settings.profile import Profile
from flasher.station.messages import PresenceChanged
from flasher.station.presence import BLIND_S, Presence

_TURN_S: Final = 0.1


class UnitWatch:
    """Follows the unit, and runs as an engine until a condition holds (`until`).

    `speed`: seconds of the connection's clock per real second.
    """

    def __init__(self, profiles: Sequence[Profile], speed: float) -> None:
        self._profiles = profiles
        self._blind_s = BLIND_S * speed if speed else inf
        self._frames: deque[Frame] = deque()
        self._is_enough: Callable[[float], bool] = lambda _now: True
        self._tick_at = -inf
        self._listened_at: float | None = None
        self.done = False
        self.start_over()

    def start_over(self) -> None:
        """Forget everything: the bus was not observed."""
        self._presence = Presence(self._profiles)
        self._frames.clear()
        self._listened_at = None
        self.is_there: bool | None = None
        """None while unknown."""
        self.serial: str | None = None
        """Serial number of the unit; "": it has none; None: not reported yet."""
        self.was_gone = False
        """Nothing was connected for a while."""
        self.changes = 0
        """Number of times that another unit may have been connected."""
        self.unchanged_since = -inf
        """Time of the last of them."""

    @property
    def answers(self) -> int:
        """Number of version answers of the unit that is there."""
        return sum(each.answers for each in self._presence.watchers)

    def until(self, is_enough: Callable[[float], bool]) -> UnitWatch:
        """Return this engine, to run until the condition holds; it gets the time."""
        self._is_enough, self.done = is_enough, False
        return self

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Process a frame of another engine's run."""
        self._listened(now)
        self._presence(frame, sent=sent, now=now)

    def _listened(self, now: float) -> None:
        if self._listened_at is not None and now - self._listened_at > self._blind_s:
            self._presence.miss(now - self._listened_at, now)
        self._listened_at = now

    def _take(self, change: PresenceChanged, now: float) -> None:
        is_other = (
            change.is_there != self.is_there
            or change.is_power_up
            or change.was_missed
            or (None not in (self.serial, change.serial) and self.serial != change.serial)
        )
        if is_other:
            self.changes += 1
            self.unchanged_since = now
        self.is_there, self.serial = change.is_there, change.serial
        self.was_gone |= not change.is_there

    # -- the engine interface ----------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        self(frame, sent=False, now=now)

    def tick(self, now: float) -> None:
        self._tick_at = now + _TURN_S
        self._listened(now)
        if not self._frames:
            self._frames.extend(self._presence.probe(now))
        change = self._presence.change(now)
        if change is not None:
            self._take(change, now)
        self.done = self.done or self._is_enough(now)

    def deadline(self) -> float:
        return self._tick_at

    def next_frame(self, now: float) -> Frame | None:
        return self._frames[0] if self._frames else None

    def frame_sent(self, now: float) -> None:
        self._frames.popleft()

    def cancel(self, now: float) -> None:
        self.done = True

    def take_events(self) -> Sequence[object]:
        return ()
