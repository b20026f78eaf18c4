"""Runner: a protocol engine that runs a dialogue with a device, written as generators; pure.

A stage is a generator. It yields the time until which it waits (None: indefinitely), and receives
the next input:

    def ask_for_version(run: Runner) -> Stage[Message | None]:
        run.listen(0x720)
        run.send(frames)
        came = yield run.now + 1.0
        return came if isinstance(came, Message) else None

Stages are combined by `yield from`. `Runner` is the engine (`flasher.protocol.engine`) around the
outermost stage: the only place that reassembles messages and keeps the deadline.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from enum import Enum
from math import inf
from typing import Any, Generic, TypeVar

from flasher.events import BytesDamaged
from flasher.host.duplicates import SECOND_DEVICE_WAIT_S, DuplicateDetector
from flasher.protocol.engine import Transmitter
from flasher.protocol.frame import Frame
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message, Reassembler


class Signal(Enum):
    """Inputs of a stage besides messages and damage."""

    TIME = "the time limit of the stage was reached"
    LEFT = "the last frame of a message was sent"
    CANCEL = "end at the next message boundary"


T = TypeVar("T")
StageInput = Message | Damage | Signal
Stage = Generator[float | None, StageInput, T]


class Runner(Generic[T]):
    """Engine that runs a stage from its first `tick` to its result."""

    def __init__(
        self,
        stage: Callable[[Runner[T]], Stage[T]],
        *,
        bitrate_bps: int,
        timings: Timings = DEFAULT_TIMINGS,
        frame_gap_s: float = 0.0,
    ) -> None:
        self.timings = timings
        self.bitrate_bps = bitrate_bps
        self.tx = Transmitter(bitrate_bps, frame_gap_s, timings.inter_frame_timeout_s)
        self.send = self.tx.queue
        """Send a message; `Signal.LEFT` follows when it was sent (`tx.left_at`, `tx.left_tag`)."""
        self.next_frame: Callable[[float], Frame | None] = self.tx.next_frame
        self.frame_sent: Callable[[float], Any] = self.tx.frame_sent
        self.tx.on_message_sent = self._message_left
        self.now = 0.0
        """Time of the current input, in seconds."""
        self.is_cancelled = False
        """The engine was cancelled before its end."""
        self.limit_at = inf
        """Time at which the stage is cancelled unless it has ended."""
        self.watch: Callable[[Frame], bool] | None = None
        """Called with every received frame; if it returns True, the stage does not get it."""
        self.duplicates = DuplicateDetector(timings)
        """Detects a second device."""
        self.tx.on_message_dropped = self.duplicates.message_dropped
        self._make_stage = stage
        self._stage: Stage[T] | None = None
        self._wake_at = 0.0  # at once
        self._always: dict[int, Reassembler] = {}
        self._listening: dict[int, Reassembler] = {}
        self._events: list[object] = []
        self._result: T | None = None
        self.done = False

    @property
    def result(self) -> T:
        """Result of the stage. Raises RuntimeError while it is running."""
        if not self.done:
            raise RuntimeError("the stage has not ended yet")
        return self._result  # type: ignore[return-value]  # it is T when it is done

    # -- for the stage ---------------------------------------------------------------------------

    def listen(self, *can_ids: int) -> None:
        """Receive messages on these CAN ids, besides those of `listen_always`."""
        fresh = {can_id: self._reassembler(can_id) for can_id in can_ids}
        self._listening = fresh | self._always

    def listen_always(self, *can_ids: int) -> None:
        """Receive messages on these CAN ids until the next call."""
        self._always = {can_id: self._reassembler(can_id) for can_id in can_ids}
        self._listening = dict(self._always)

    def also_listen_on(self, *can_ids: int) -> None:
        """Receive messages on these CAN ids as well."""
        for can_id in can_ids:
            if can_id not in self._always:
                self._always[can_id] = self._listening[can_id] = self._reassembler(can_id)

    def _reassembler(self, can_id: int) -> Reassembler:
        """Return that of this CAN id, which may hold the first part of a message, or a new one."""
        known = self._listening.get(can_id)
        return known or Reassembler(can_id, self.timings.inter_frame_timeout_s)

    def emit(self, event: object) -> None:
        """Report an event."""
        self._events.append(event)

    def emit_damage(self, damage: Damage) -> None:
        """Report damaged bytes as an event."""
        self._events.append(BytesDamaged(damage.can_id, damage.reason.value, damage.data))

    def listen_for(
        self, seconds: float, look: Callable[[StageInput], object] | None = None
    ) -> Stage[bool]:
        """Wait, and call `look` with each input; return True if cancelled. After a pause of this
        computer all that was received meanwhile comes before the end.
        """
        until = self.now + seconds
        came: StageInput | None = None
        while came not in (Signal.TIME, Signal.CANCEL):
            came = yield until
            if look is not None:
                look(came)
        return came is Signal.CANCEL

    def await_second_device(self) -> Stage[bool]:
        """Wait for late answers of a second device; return True if cancelled."""
        return self.listen_for(SECOND_DEVICE_WAIT_S)

    def finish_message(self) -> Stage[None]:
        """Send the rest of a partly sent message, unless the adapter accepts no more frames."""
        self.tx.drop_unstarted()
        give_up_at = self.now + self.timings.command_timeout_s
        while not self.tx.idle and self.now < give_up_at:
            yield give_up_at

    # -- the engine interface --------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        if self.done:
            return
        self.now = now
        self.tx.drop_stalled(now)  # before its refusal, which was sent during the pause
        self.duplicates.frame_received(frame, now)
        if self.watch is not None and self.watch(frame):
            return
        reassembler = self._listening.get(frame[0])
        if reassembler is None or not frame.is_payload:
            return
        for found in reassembler.feed(frame[1], now):
            self.duplicates.received(found, now)
            self._resume(found)

    def tick(self, now: float) -> None:
        self.now = now
        if self.done:
            return
        if self._stage is None:
            self._begin()
            return
        for reassembler in tuple(self._listening.values()):
            if now >= reassembler.due_at:
                for found in reassembler.tick(now):
                    self.duplicates.received(found, now)
                    self._resume(found)
        if now >= self.limit_at:
            self.cancel(now)
        elif now >= self._wake_at:
            self._resume(Signal.TIME)

    def deadline(self) -> float | None:
        if self.done:
            return None
        # Asked after every frame: calls of `min` take most of its time.
        due_at = self._wake_at
        if self.tx.due_at < due_at:  # noqa: PLR1730
            due_at = self.tx.due_at
        if self.limit_at < due_at:  # noqa: PLR1730
            due_at = self.limit_at
        for reassembler in self._listening.values():
            if reassembler.due_at < due_at:  # noqa: PLR1730
                due_at = reassembler.due_at
        return None if due_at == inf else due_at

    def _message_left(self, now: float) -> None:
        self.now = now
        self._resume(Signal.LEFT)

    def cancel(self, now: float) -> None:
        self.now = now
        self.is_cancelled = True
        self.limit_at = inf
        if not self.done and self._stage is None:
            self._begin()
        self._resume(Signal.CANCEL)

    def take_events(self) -> Sequence[object]:
        if not self._events:
            return []
        taken, self._events = self._events, []
        return taken

    def interrupt(self, interruption: Exception) -> None:
        """Raise an exception inside the stage."""
        if self._stage is not None and not self.done:
            try:
                self._wait(self._stage.throw(interruption))
            except StopIteration as end:
                self._end(end.value)

    def _begin(self) -> None:
        self._stage = self._make_stage(self)
        try:
            self._wait(next(self._stage))
        except StopIteration as end:
            self._end(end.value)

    def _resume(self, came: StageInput) -> None:
        if self.done or self._stage is None:
            return
        try:
            until = self._stage.send(came)
        except StopIteration as end:
            self._end(end.value)
        else:
            self._wake_at = inf if until is None else until

    def _wait(self, until: float | None) -> None:
        self._wake_at = inf if until is None else until

    def _end(self, result: T) -> None:
        self._result = result
        self.done = True
        self._listening = {}
        self.tx.abandon(self.now)


def filtered(stage: Stage[T], look: Callable[[StageInput], StageInput]) -> Stage[T]:
    """Run a stage whose inputs first pass through the function `look`."""
    try:
        until = next(stage)
        while True:
            until = stage.send(look((yield until)))
    except StopIteration as end:
        result: T = end.value
        return result
