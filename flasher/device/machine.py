"""The device's side of the engine interface: reception, sending, one timer. What to make of it is
the model's business.

One timer is enough, as in every state the device waits for one thing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final

from flasher.errors import UsageError
from flasher.events import BytesDamaged, DeviceReported
from flasher.protocol import messages
from flasher.protocol.engine import Transmitter
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Target
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Damage, Message, Reassembler, encode, split

_UNUSED_WIRE_S: Final = 0.0
"""Nothing here counts from when a message has left the wire, so its time there is not computed."""


class Machine(ABC):
    """An engine (`flasher.protocol.engine`) that answers on `target`'s ids; base of `Device`.

    Raises UsageError for timings that would make it announce without a pause.
    """

    def __init__(self, target: Target, *, bitrate_bps: int, timings: Timings) -> None:
        if timings.boot_version_spacing_s <= 0:
            raise UsageError("the time between two announcements is greater than 0")
        self.target = target
        self.timings = timings
        self._bitrate_bps = bitrate_bps
        self._request_id = target.request_id
        self._reassembler = Reassembler(target.request_id, timings.inter_frame_timeout_s)
        self._transmitter = Transmitter(bitrate_bps)
        self._events: list[object] = []
        self._due: float | None = None
        self._is_deaf = False
        self._is_cancelled = False

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True once it was cancelled and the message under way was sent."""
        return self._is_cancelled and self._transmitter.idle

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived. Only payload on this device's own id is looked at."""
        if frame.can_id != self._request_id or not frame.is_payload:
            return
        if self._is_cancelled or self._is_deaf:
            return
        for found in self._reassembler.feed(frame.data, now):
            self._take(found, now)

    def tick(self, now: float) -> None:
        """Let everything happen that is due by `now`."""
        if self._is_cancelled:
            return
        for found in self._reassembler.tick(now):
            self._take(found, now)
        self._run_timer(now)

    def deadline(self) -> float | None:
        """When it next wants `tick` or has a frame to send; None while it waits for the bus."""
        wanted = self._transmitter.deadline()
        if self._is_cancelled:
            return wanted
        for other in (self._due, self._reassembler.deadline()):
            if other is not None and (wanted is None or other < wanted):
                wanted = other
        return wanted

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send; the same one until `frame_sent` is called."""
        return self._transmitter.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted it. What a power cut made void meanwhile is not missed."""
        if not self._transmitter.idle:
            self._transmitter.frame_sent(now)

    def cancel(self, now: float) -> None:
        """Send the message under way to its end, then nothing more."""
        self._is_cancelled = True
        self._transmitter.drop_unstarted()

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        events, self._events = self._events, []
        return events

    # -- for the model ----------------------------------------------------------------------------

    @abstractmethod
    def _take_row(
        self, row: messages.Row | messages.Malformed | messages.Unknown, now: float
    ) -> None:
        """An intact message arrived."""

    @abstractmethod
    def _take_damage(self, damage: Damage, now: float) -> None:
        """Bytes arrived that were no message."""

    @abstractmethod
    def _expire(self, now: float) -> None:
        """The timer is over: set it anew, or stop it."""

    def _run_timer(self, now: float) -> None:
        """Let the timer expire as often as it is due; with times of 0 one leads to the next."""
        while self._due is not None and self._due <= now:
            self._expire(now)

    def _rearm(self, delay_s: float, now: float) -> None:
        """Count from when the timer was due, so that lateness does not add up, unless too late."""
        due = now if self._due is None else self._due + delay_s
        self._due = due if due > now else now + delay_s

    def _send(self, row: messages.Row, can_id: int | None = None) -> None:
        """Send a message after those before it, to the tool unless another id is given."""
        own_id = self.target.answer_id if can_id is None else can_id
        frames = split(own_id, encode(row.to_message(own_id)))
        self._transmitter.queue(frames, wire_s=_UNUSED_WIRE_S)

    def _report(self, what: str) -> None:
        self._events.append(DeviceReported(what))

    def _lose_memory(self) -> None:
        """Forget everything received, and everything to be sent at once, even half a message."""
        self._reassembler.reset()
        self._transmitter = Transmitter(self._bitrate_bps)
        self._due = None

    def _take(self, found: Message | Damage, now: float) -> None:
        # A message before this one may have restarted the device.
        if self._is_deaf:
            return
        due_before = self._due
        if isinstance(found, Damage):
            self._events.append(BytesDamaged(found.can_id, found.reason.value, found.data))
            self._take_damage(found, now)
        else:
            self._take_row(messages.decode(found), now)
        # What this message began is over at once with times of 0. A timer that ran before waits for
        # `tick`: messages that were held up somewhere are taken first.
        if self._due != due_before:
            self._run_timer(now)
