"""The one loop: runs an engine on a link against a clock until it is done.

Its rules: everything that waits is received before `tick`, so that a stall of the computer does not
become a timeout of the device; frames go out one at a time and the engine is told when each was
accepted; waiting is a blocking receive with a deadline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

from flasher.bus.link import Clock, Link
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame

MAX_WAIT_S: Final = 0.1
"""Longest blocking receive, in real seconds: the time after which a cancellation is seen at the
latest."""
_AT_ONCE: Final = float("-inf")
"""A deadline in the past: only what is there already."""
_CATCH_UP_FRAMES: Final = 10_000
"""Frames received before a due `tick` at the most: a babbling bus must not stop the timers."""


class Tap(Protocol):
    """Sees every frame in both directions and changes nothing."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """One frame, with the time on the driver's clock."""
        ...


def drive(
    engine: Engine,
    link: Link,
    clock: Clock,
    *,
    taps: Sequence[Tap] = (),
    on_event: Callable[[object], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> None:
    """Run `engine` until it is done.

    `on_event` gets every event the engine reports; `cancelled` is asked between frames, and ends
    the engine at its next message boundary. Raises BusError when the link fails.
    """
    link.drain()
    cancel_seen = False
    while True:
        now = clock.now()
        if cancelled is not None and not cancel_seen and cancelled():
            cancel_seen = True
            engine.cancel(now)
        wanted = engine.deadline()
        if wanted is not None and now >= wanted:
            _receive_on(link.receive(_AT_ONCE), engine, link, clock, taps)
            engine.tick(clock.now())
        _send_all(engine, link, clock, taps)
        for event in engine.take_events():
            if on_event is not None:
                on_event(event)
        if engine.done:
            return
        wanted = engine.deadline()
        latest = clock.now() + MAX_WAIT_S * clock.speed
        frame = link.receive(latest if wanted is None else min(wanted, latest))
        _receive_on(frame, engine, link, clock, taps)


def _receive_on(
    frame: Frame | None, engine: Engine, link: Link, clock: Clock, taps: Sequence[Tap]
) -> None:
    """Hand on a frame and all that wait behind it: what is sent next must not look like the cause
    of what had come before.
    """
    for _ in range(_CATCH_UP_FRAMES):
        if frame is None:
            return
        now = clock.now()
        for tap in taps:
            tap(frame, sent=False, now=now)
        engine.receive(frame, now)
        frame = link.receive(_AT_ONCE)


def _send_all(engine: Engine, link: Link, clock: Clock, taps: Sequence[Tap]) -> None:
    """Send what the engine has to send now."""
    now = clock.now()
    while (frame := engine.next_frame(now)) is not None:
        link.send(frame)
        now = clock.now()
        engine.frame_sent(now)
        for tap in taps:
            tap(frame, sent=True, now=now)
