"""Interface of all engines (host and device), and the message transmitter that they share.

An engine is pure: it receives frames and the time as arguments. `now` is seconds on a monotonic
clock; an engine never sleeps and never reads a clock. `Transmitter` sends messages frame by frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from math import inf
from typing import Final, NamedTuple, Protocol

from flasher.protocol.bittime import frame_bits, message_bits
from flasher.protocol.frame import Frame

DROP_MARGIN: Final = 1.5
"""Silence after an abandoned message, as a multiple of the receiver's inter-frame timeout (R12)."""


class Tap(Protocol):
    """Observer of every frame in both directions."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Process a frame; `now` is on the driver's clock."""
        ...


class Engine(Protocol):
    """Interface between a protocol engine, host or device, and the driver loop."""

    @property
    def done(self) -> bool:
        """True when the engine has nothing left to do."""
        ...

    def receive(self, frame: Frame, now: float) -> None:
        """Process a received frame."""
        ...

    def tick(self, now: float) -> None:
        """Process the timeouts that are due at `now`."""
        ...

    def deadline(self) -> float | None:
        """Time of the next call of `tick` or `next_frame`; None for never."""
        ...

    def next_frame(self, now: float) -> Frame | None:
        """Return the next frame to send; the same one until `frame_sent` is called."""
        ...

    def frame_sent(self, now: float) -> None:
        """Record that the adapter accepted the frame of `next_frame`."""
        ...

    def cancel(self, now: float) -> None:
        """Stop at the next message boundary."""
        ...

    def take_events(self) -> Sequence[object]:
        """Return the events since the last call: frozen dataclasses of `flasher.events`."""
        ...


class _Outgoing(NamedTuple):
    frames: Sequence[Frame]
    wire_s: float
    not_before: float
    tag: object


class Transmitter:
    """Transmit queue of an engine: sends each message whole and in order, never mixed with its
    repetition.

    `frame_gap_s` is the minimum time between frames of a message, for slow receivers. If the
    computer pauses between two frames for longer than `dropped_after_s`, the receiver has dropped
    the message (R12): it is sent again after a longer silence.
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
        """Time of the next frame to send; infinite while the queue is empty."""
        self.left_at = -inf
        """Time at which the last sent message ended on the wire: its last frame was accepted by the
        adapter, plus its time on the wire (R12)."""
        self.left_tag: object = None
        """`tag` of that message."""
        self.on_message_sent: Callable[[float], None] | None = None
        """Called with the time when the adapter accepts the last frame of a message."""
        self.on_message_dropped: Callable[[], None] | None = None
        """Called when a message is sent again because this computer paused in it."""

    @property
    def idle(self) -> bool:
        """True when the queue is empty."""
        return not self._queue

    @property
    def begun(self) -> bool:
        """True while a message is partly sent."""
        return self._sent_frames > 0

    def queue(
        self,
        frames: Sequence[Frame],
        *,
        wire_s: float | None = None,
        not_before: float = 0.0,
        tag: object = None,
    ) -> None:
        """Queue a message; its first frame is not sent before `not_before`.

        `wire_s` is its time on the wire in seconds, computed if None. `left_tag` becomes `tag` when
        it has been sent.
        """
        if wire_s is None:
            wire_s = message_bits(frames) / self._bitrate_bps
        not_before = max(not_before, self._quiet_until)
        if not self._queue:
            self.due_at = not_before
        self._queue.append(_Outgoing(frames, wire_s, not_before, tag))

    def drop_unstarted(self) -> None:
        """Drop queued messages, except one that is partly sent."""
        if self._sent_frames:
            started = self._queue[0]
            self._queue.clear()
            self._queue.append(started)
        else:
            self._queue.clear()
            self.due_at = inf

    def send_without_gaps(self) -> None:
        """Send the remaining frames of a message without gaps, because no message follows it."""
        self._frame_gap_s = 0.0
        if self._sent_frames:
            self.due_at = 0.0

    def limit_left_at(self, now: float) -> None:
        """Limit `left_at` to `now`: an answer came sooner than the estimate, as in-process."""
        self.left_at = min(self.left_at, now)

    def abandon(self, quiet_until: float) -> None:
        """Drop all messages, even one that is partly sent. New messages wait until `quiet_until`,
        so that the receiver drops the partial one (R12).
        """
        self._queue.clear()
        self._sent_frames = 0
        self._quiet_until = quiet_until
        self.due_at = inf

    def drop_stalled(self, now: float) -> bool:
        """Send a partly sent message again if this computer paused in it; return True if so. The
        receiver has dropped its first part, or refuses it (R12).
        """
        is_stalled = self._sent_frames > 0 and now - self._frame_sent_at > self._dropped_after_s
        if is_stalled:
            self._sent_frames = 0
            self.due_at = now + self._dropped_after_s * DROP_MARGIN
            if self.on_message_dropped is not None:
                self.on_message_dropped()
        return is_stalled

    def next_frame(self, now: float) -> Frame | None:
        """Return the next frame to send; None during a gap and while the queue is empty."""
        if now < self.due_at:
            return None
        if self._sent_frames and self.drop_stalled(now):
            return None
        self._asked_at = now
        return self._queue[0].frames[self._sent_frames]

    def frame_sent(self, now: float) -> bool:
        """Record that the adapter accepted a frame; return True for the last one of its message."""
        if not self._queue:
            return False
        frames = self._queue[0].frames
        if not self._sent_frames:
            self._message_began_at = max(now, self.left_at)
        self._sent_frames += 1
        if self._sent_frames < len(frames):
            # Whether a pause came before or after the hand-over is unknown.
            was_paused = now - self._asked_at > self._dropped_after_s
            self._frame_sent_at = -inf if was_paused else now
            if self._frame_gap_s:
                self.due_at = now + self._frame_gap_s
            return False
        message = self._queue.popleft()
        self._sent_frames = 0
        # An adapter may buffer a whole message or take each frame only when it sends it: the later
        # estimate applies.
        last_frame_s = frame_bits(frames[-1]) / self._bitrate_bps
        self.left_tag = message.tag
        self.left_at = max(self._message_began_at + message.wire_s, now + last_frame_s)
        self.due_at = self._queue[0].not_before if self._queue else inf
        if self.on_message_sent is not None:
            self.on_message_sent(now)
        return True
