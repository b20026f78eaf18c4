"""Driver taps: the flight recorder of the last frames, and a filter that removes echoes.

The flight recorder always keeps the last frames in both directions, in a few megabytes. They are
written only on request (`bundle`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from flasher.protocol.engine import Tap
from flasher.protocol.frame import Frame

RING_FRAMES: Final = 20_000
"""About 9 s of a bus at full load, or 1,000 packets with their ACKs."""


class Entry(NamedTuple):
    """Recorded frame: `at_s` on the driver's clock, and whether this program sent it."""

    at_s: float
    frame: Frame
    sent: bool


class FlightRecorder:
    """Driver's tap that keeps the last `limit` frames, and counts all of them.

    `wall_offset_s` converts the driver's clock to seconds since 1970. It is measured once, at the
    first frame, so that a jump of the wall clock leaves no gap.
    """

    def __init__(
        self, limit: int = RING_FRAMES, *, wall_clock: Callable[[], float] = time.time
    ) -> None:
        self._entries: deque[Entry] = deque(maxlen=limit)
        self._wall_clock = wall_clock
        self.frames = 0
        """Number of frames so far, including those dropped from the ring."""
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
        """Latest frame; None before the first."""
        return self._entries[-1] if self._entries else None


class EchoFilter:
    """Driver's tap that hides an adapter's echoes from other taps, so that a trace shows each sent
    frame once. `taps` is called at each frame: more may be added later.
    """

    def __init__(self, taps: Callable[[], Sequence[Tap]]) -> None:
        self._taps = taps

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if frame.is_echo:
            return
        for tap in self._taps():
            tap(frame, sent=sent, now=now)
