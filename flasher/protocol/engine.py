"""What every engine is, host or device: a pure machine that is told frames and the time.

`now` is seconds on a monotonic clock, given from outside; an engine never sleeps and never reads a
clock. `Transmitter` is the part that all engines share: messages out, one frame at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Final, NamedTuple, Protocol

from flasher.protocol.bittime import frame_bits, message_bits
from flasher.protocol.frame import Frame

WELL_BEYOND: Final = 1.5
"""Silence after a message that was cut short, as a multiple of the time after which its receiver
drops it (R12)."""


class Engine(Protocol):
    """The interface between a machine and the one loop that connects it to the world."""

    @property
    def done(self) -> bool:
        """True when the engine has nothing left to do."""
        ...

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        ...

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        ...

    def deadline(self) -> float | None:
        """When the engine next wants `tick`, or a frame of its own to be asked for."""
        ...

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send; the same one until `frame_sent` is called."""
        ...

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted the frame that `next_frame` gave."""
        ...

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        ...

    def take_events(self) -> Sequence[object]:
        """What happened since the last call: frozen dataclasses of `flasher.events`."""
        ...


class _Outgoing(NamedTuple):
    frames: Sequence[Frame]
    wire_s: float
    not_before: float
    tag: object


class Transmitter:
    """Messages waiting to be sent, whole and in order: a message is finished before the next one
    starts, so it is never interleaved with its own repetition.

    `frame_gap_s` keeps frames of one message apart for receivers that cannot take them at once.
    Where a computer paused for longer than `dropped_after_s` between two frames, their receiver has
    dropped the message (R12): it is sent anew after a silence that is longer than that.
    """

    def __init__(
        self, bitrate_bps: int, frame_gap_s: float = 0.0, dropped_after_s: float = inf
    ) -> None:
        self._bitrate_bps = bitrate_bps
        self._frame_gap_s = frame_gap_s
        self._dropped_after_s = dropped_after_s
        self._queue: deque[_Outgoing] = deque()
        self._sent_frames = 0
        self._quiet_until = -inf
        self._message_began_at = 0.0
        self._asked_at = 0.0
        self._frame_sent_at = 0.0
        self.due_at = inf
        """When `next_frame` has something to give; infinite while nothing waits."""
        self.left_at = -inf
        """When the last frame of the last message has left: accepted by the adapter plus its time
        on the wire (R12)."""
        self.left_tag: object = None
        """The tag of that message."""
        self.on_left: Callable[[float], None] | None = None
        """Called when the last frame of a message is accepted, with the time."""

    @property
    def idle(self) -> bool:
        """True when nothing waits to be sent."""
        return not self._queue

    @property
    def begun(self) -> bool:
        """True while a message is half sent."""
        return self._sent_frames > 0

    def queue(
        self,
        frames: Sequence[Frame],
        *,
        wire_s: float | None = None,
        not_before: float = 0.0,
        tag: object = None,
    ) -> None:
        """Send a message after those before it, its first frame not sooner than `not_before`.

        `wire_s` is its time on the wire where the caller knows it, else it is computed; `tag` is
        for the caller to know it again when it has left.
        """
        if wire_s is None:
            wire_s = message_bits(frames) / self._bitrate_bps
        not_before = max(not_before, self._quiet_until)
        if not self._queue:
            self.due_at = not_before
        self._queue.append(_Outgoing(frames, wire_s, not_before, tag))

    def drop_unstarted(self) -> None:
        """Forget the messages of which no frame was accepted yet."""
        if self._sent_frames:
            started = self._queue[0]
            self._queue.clear()
            self._queue.append(started)
        else:
            self._queue.clear()
            self.due_at = inf

    def hurry(self) -> None:
        """Send the rest of a message that is half sent without gaps: nothing comes after it."""
        self._frame_gap_s = 0.0
        if self._sent_frames:
            self.due_at = 0.0

    def all_left(self, now: float) -> None:
        """What was sent has left by `now`, since it was answered: a bus in one computer is faster
        than the bit rate says.
        """
        self.left_at = min(self.left_at, now)

    def abandon(self, quiet_until: float) -> None:
        """Forget everything, a message that is half sent included; what is queued from now on waits
        until `quiet_until`, so that the receiver drops the half (R12).
        """
        self._queue.clear()
        self._sent_frames = 0
        self._quiet_until = quiet_until
        self.due_at = inf

    def deadline(self) -> float | None:
        """When `next_frame` has something to give; None when nothing waits."""
        return None if self.due_at == inf else self.due_at

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send, or None while a gap lasts or nothing waits."""
        if now < self.due_at:
            return None
        if self._sent_frames and now - self._frame_sent_at > self._dropped_after_s:
            self._sent_frames = 0
            self.due_at = now + self._dropped_after_s * WELL_BEYOND
            return None
        self._asked_at = now
        return self._queue[0].frames[self._sent_frames]

    def frame_sent(self, now: float) -> bool:
        """The adapter has accepted the frame; True when it was the last one of its message."""
        if not self._queue:
            return False
        frames = self._queue[0].frames
        if not self._sent_frames:
            self._message_began_at = max(now, self.left_at)
        self._sent_frames += 1
        if self._sent_frames < len(frames):
            # A pause while it was handed over came before it or after it, which is not known.
            was_paused = now - self._asked_at > self._dropped_after_s
            self._frame_sent_at = -inf if was_paused else now
            if self._frame_gap_s:
                self.due_at = now + self._frame_gap_s
            return False
        message = self._queue.popleft()
        self._sent_frames = 0
        # An adapter may take a message at once and send it at the bus's pace, or take each frame
        # when it sends it: the later of the two tells when the last frame is gone.
        last_frame_s = frame_bits(frames[-1]) / self._bitrate_bps
        self.left_tag = message.tag
        self.left_at = max(self._message_began_at + message.wire_s, now + last_frame_s)
        self.due_at = self._queue[0].not_before if self._queue else inf
        if self.on_left is not None:
            self.on_left(now)
        return True
