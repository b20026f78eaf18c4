"""A wire between two engines on a virtual clock: every frame takes the same time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

FRAME_S: Final = 0.0005


class Engine(Protocol):
    """What the wire asks of both ends."""

    @property
    def done(self) -> bool: ...
    def receive(self, frame: Any, now: float) -> None: ...
    def tick(self, now: float) -> None: ...
    def deadline(self) -> float | None: ...
    def next_frame(self, now: float) -> Any: ...
    def frame_sent(self, now: float) -> None: ...


def run(
    left: Engine,
    right: Engine,
    *,
    start_s: float = 0.0,
    linger_s: float = 0.0,
    until_s: float = 3600.0,
    passes: Callable[[Any], bool] = lambda _frame: True,
) -> float:
    """Run until either end is done and `linger_s` more, or nothing is left to wait for.

    A frame that `passes` refuses is lost. Returns the time.
    """
    now, stop_s = start_s, until_s
    while now < stop_s:
        moved = False
        for sender, hearer in ((left, right), (right, left)):
            if (frame := sender.next_frame(now)) is not None:
                sender.frame_sent(now)
                now, moved = now + FRAME_S, True
                if passes(frame):
                    hearer.receive(frame, now)
        if stop_s == until_s and (left.done or right.done):
            stop_s = min(until_s, now + linger_s)
        times = [time for time in (left.deadline(), right.deadline()) if time is not None]
        if not moved:
            if not times:
                break
            now = max(now, min(times))
        if times and min(times) <= now < stop_s:
            left.tick(now)
            right.tick(now)
    return now
