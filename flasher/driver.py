"""Driver loop: runs a protocol engine on a CAN link against a clock until it is done.

All waiting frames are received before `tick`, which gets the earlier time, so that a stall of the
computer does not become a timeout of the device. Frames are sent one at a time, and the engine is
notified when each was accepted. Waiting is a blocking receive with a deadline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from flasher import events
from flasher.bus.link import AT_ONCE, Clock, Link
from flasher.protocol.engine import Engine, Tap
from flasher.protocol.frame import Frame

MAX_WAIT_S: Final = 0.1
"""Maximum blocking receive, in real seconds; also the maximum delay of a cancellation."""
STALL_S: Final = 0.25
"""Minimum pause of this computer that is reported, in real seconds: half the time that a device has
for an ACK (R12)."""
_CATCH_UP_FRAMES: Final = 10_000
"""Maximum number of frames received before a due `tick`: a babbling bus must not stop the
timers."""


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

    `on_event` gets every event of the engine, and HostStalled if this computer paused the loop for
    more than `STALL_S`. `cancelled` is called between frames, and ends the engine at its next
    message boundary. Raises BusError if the link fails.
    """
    link.drain()
    # Called for each frame, thousands of times in a simulation.
    now_of, send, receive = clock.now, link.send, link.receive
    deadline_of, next_frame, frame_sent = engine.deadline, engine.next_frame, engine.frame_sent
    max_wait_s = MAX_WAIT_S * clock.speed
    cancel_seen = False
    came = None
    late_s = 0.0
    """Delay of the end of the last wait, plus the time of callbacks before it."""
    while True:
        received_until = _receive_waiting(came, engine, link, clock, taps)
        sending_s = 0.0
        if cancelled is not None and not cancel_seen and cancelled():
            cancel_seen = True
            engine.cancel(now_of())
        wanted = deadline_of()
        if wanted is not None and received_until >= wanted:
            engine.tick(received_until)
        now = now_of()
        while (frame := next_frame(now)) is not None:
            send(frame)
            asked_at, now = now, now_of()
            sending_s += now - asked_at
            frame_sent(now)
            for tap in taps:
                tap(frame, sent=True, now=now)
        stalled_s = (late_s + now - received_until - sending_s) / clock.speed
        if stalled_s > STALL_S and on_event is not None:
            on_event(events.HostStalled(round(stalled_s, 3)))
        for event in engine.take_events():
            if on_event is not None:
                on_event(event)
        if engine.done:
            return
        rests_at = now_of()
        wanted = deadline_of()
        until = rests_at + max_wait_s
        if wanted is not None and wanted < until:
            until = wanted
        came = receive(until)
        late_s = rests_at - now + max(0.0, now_of() - max(until, rests_at))


def _receive_waiting(
    frame: Frame | None, engine: Engine, link: Link, clock: Clock, taps: Sequence[Tap]
) -> float:
    """Pass on a frame and all that wait after it, so that the next message sent does not look like
    their cause. Return the time up to which frames were received.
    """
    now_of, process_frame, receive = clock.now, engine.receive, link.receive
    now = now_of()
    for _ in range(_CATCH_UP_FRAMES):
        if frame is None and (frame := receive(AT_ONCE)) is None:
            break
        for tap in taps:
            tap(frame, sent=False, now=now)
        process_frame(frame, now)
        frame, now = None, now_of()
    return now
