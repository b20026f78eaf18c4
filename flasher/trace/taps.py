"""Taps of the driver: the flight recorder, and what keeps echoes from other taps.

The flight recorder keeps the last frames in both directions, always, at the price of a few
megabytes. Nothing is written until somebody asks for it (`bundle`); memory is bounded whatever a
bus carries.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple, Protocol

from flasher.protocol.frame import Frame

RING_FRAMES: Final = 20_000
"""About 9 s of a bus at full load, or 1,000 packets with their ACKs."""


class Entry(NamedTuple):
    """One frame: `at_s` on the driver's clock, and whether we sent it."""

    at_s: float
    frame: Frame
    sent: bool


class FlightRecorder:
    """A driver's tap that keeps the last `limit` frames, and counts all of them.

    `wall_offset_s` turns times of the driver's clock into seconds since 1970. It is taken once, at
    the first frame, so that a jump of the wall clock leaves no gap.
    """

    def __init__(
        self, limit: int = RING_FRAMES, *, wall_clock: Callable[[], float] = time.time
    ) -> None:
        self._entries: deque[Entry] = deque(maxlen=limit)
        self._wall_clock = wall_clock
        self.frames = 0
        """All frames so far, also those that the ring has forgotten."""
        self.wall_offset_s: float | None = None
        """None before the first frame."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if self.wall_offset_s is None:
            self.wall_offset_s = self._wall_clock() - now
        self.frames += 1
        self._entries.append(Entry(now, frame, sent))

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries)

    @property
    def last(self) -> Entry | None:
        """The latest frame; None before the first."""
        return self._entries[-1] if self._entries else None


class _Tap(Protocol):
    """As `flasher.driver.Tap`."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None: ...


class Unechoed:
    """A driver's tap in front of others, which keeps an adapter's echoes from them: a frame that
    was sent stands in a trace once. `taps` is asked at each frame: more may come later.
    """

    def __init__(self, taps: Callable[[], Sequence[_Tap]]) -> None:
        self._taps = taps

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Hand on one frame, unless it is an echo."""
        if frame.is_echo:
            return
        for tap in self._taps():
            tap(frame, sent=sent, now=now)
