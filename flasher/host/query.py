"""Asking a device for something and waiting for its answer (chapter 3), as engines.

`Query` is one question: sent every 200 ms until the answer comes or 1 s has passed. A copy follows
only when the one before has left, for a sleeping device acknowledges nothing and the first frames
may do no more than wake it. `Queries` asks several questions, one after the other.

A repeated question may be answered several times. A query that has its answer stays a moment longer
while answers to other copies may still come, so that none of them is taken for the answer to the
next question: two writes are confirmed by the same words (R10 reads the upgrade the same way).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from flasher import events
from flasher.protocol import catalogue
from flasher.protocol.catalogue import Item
from flasher.protocol.contents import Empty, Memory, ReadMemory
from flasher.protocol.engine import Transmitter
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import data_size
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message, Reassembler, encode, split

_EMPTY = Empty()


@dataclass(frozen=True)
class Request:
    """A question: which row of the catalogue, with which content.

    `accepts` may refuse an answer that is another question's; an answer to a memory read must name
    the addresses that were asked for. `answer` is the row that answers where the catalogue does not
    know it (a product's own query).
    """

    item: Item
    content: Content = _EMPTY
    accepts: Callable[[Content], bool] | None = None
    answer: Item | None = None

    @property
    def answer_item(self) -> Item:
        """The row that answers. Raises ValueError for a message that nothing answers."""
        found = self.answer or catalogue.answer_of(self.item)
        if found is None:
            raise ValueError(f"{self.item.name} ({self.item.title}) has no answer")
        return found

    def is_answered_by(self, answer: Content) -> bool:
        """False when the answer is one to another question."""
        if self.accepts is not None:
            return self.accepts(answer)
        if isinstance(self.content, ReadMemory) and isinstance(answer, Memory):
            return (answer.start, answer.end) == (self.content.start, self.content.end)
        return True


class Query:
    """One question, an engine (`flasher.protocol.engine`); it begins at its first `tick`.

    Raises ValueError when the content does not fit or nothing answers the message.
    """

    def __init__(
        self, request: Request, *, bitrate_bps: int, timings: Timings = DEFAULT_TIMINGS
    ) -> None:
        self.request = request
        self.answer: Content | None = None
        """The answer's content; None until it came, and for ever if it does not."""
        self.tries = 0
        """How often the question was sent, or is being sent."""
        self.misfit: Message | None = None
        """The last message that has the answer's serial number but not its form."""
        self.cancelled = False
        self._answer_item = request.answer_item
        message = catalogue.encode(request.item, request.content)
        self._frames = split(message.can_id, encode(message))
        self._timings = timings
        self._tx = Transmitter(bitrate_bps)
        self._rx = Reassembler(self._answer_item.can_id, timings.inter_frame_timeout_s)
        self._events: list[object] = []
        self._begun = False
        self._is_over = False
        self._done = False
        self._copies_left = 0
        self._answers = 0
        self._repeat_at: float | None = None
        self._ends_at: float | None = None

    @property
    def done(self) -> bool:
        """True when there is nothing left to do."""
        return self._done

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        if frame.can_id == self._rx.can_id and frame.is_payload and not self._done:
            for found in self._rx.feed(frame.data, now):
                self._take(found, now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._done:
            return
        if not self._begun:
            self._begun = True
            self._ends_at = now + self._timings.command_timeout_s
            self._send()
            return
        for found in self._rx.tick(now):
            self._take(found, now)
        if self._ends_at is not None and now >= self._ends_at:
            self._end(now)
        elif self._repeat_at is not None and now >= self._repeat_at:
            self._send()

    def deadline(self) -> float | None:
        """When `tick` or `next_frame` is wanted next; at once before the beginning."""
        if self._done:
            return None
        if not self._begun:
            return 0.0
        times = (self._ends_at, self._repeat_at, self._tx.deadline(), self._rx.deadline())
        return min((time for time in times if time is not None), default=None)

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        return self._tx.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted the frame."""
        if not self._tx.frame_sent(now):
            return
        self._copies_left += 1
        left_at = self._tx.left_at
        if self._is_over:
            self._end(now)
        elif self.answer is not None:
            self._ends_at = left_at + self._timings.quiet_after_repeat_s
        else:
            if self._copies_left == 1:
                self._ends_at = left_at + self._timings.command_timeout_s
            self._repeat_at = left_at + self._timings.command_repeat_s

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        if not self._done:
            self._begun = True
            self.cancelled = self.answer is None
            self._end(now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        taken, self._events = self._events, []
        return taken

    def _send(self) -> None:
        self._repeat_at = None  # it starts when the message has left
        self.tries += 1
        self._tx.queue(self._frames)
        if self.tries > 1:
            title = self.request.item.title
            self._events.append(events.MessageRepeated(title, "no answer came", self.tries))

    def _take(self, found: Message | Damage, now: float) -> None:
        if isinstance(found, Damage):
            told = events.BytesDamaged(found.can_id, found.reason.value, found.data)
            self._events.append(told)
            return
        if self._is_over:
            return
        expected = self._answer_item
        if (found.mode, found.command) != (expected.mode, expected.command):
            # The serial number is the command's first byte; the second is a size (2.2.1).
            if found.command >> 8 == expected.command >> 8:
                self.misfit = found
            return
        if data_size(found.command) != expected.content.SIZE_BYTES or not self._copies_left:
            return  # before the question has left it is somebody else's answer
        content = expected.content.from_data(found.data)
        if not self.request.is_answered_by(content):
            return
        self._answers += 1
        if self.answer is None:
            self.answer = content
            told_answer = events.QueryAnswered(self.request.item.title, content, self.tries)
            self._events.append(told_answer)
        self._settle(now)

    def _settle(self, now: float) -> None:
        """The answer is there: wait for those that other copies may still bring."""
        self._repeat_at = None
        self._tx.drop_unstarted()
        if self._tx.idle and self._answers >= self._copies_left:
            self._end(now)
        else:
            self._ends_at = max(now, self._tx.left_at) + self._timings.quiet_after_repeat_s

    def _end(self, now: float) -> None:
        """Finish a message that is half sent, then be done."""
        if not self._is_over:
            self._is_over = True
            self._repeat_at = self._ends_at = None
            self._tx.drop_unstarted()
            if self.answer is None and not self.cancelled:
                told = events.QueryUnanswered(self.request.item.title, self.tries)
                self._events.append(told)
        if self._tx.idle:
            self._done = True
        elif self._ends_at is None:
            # An adapter that takes nothing any more must not hold us up for ever.
            self._ends_at = now + self._timings.command_timeout_s
        elif now >= self._ends_at:
            self._done = True


class Queries:
    """Several questions, one after the other; an engine of its own.

    `requests` is taken from as needed, so it may be a generator. With `stop_at_silence` the first
    question without an answer is the last one.
    """

    def __init__(
        self,
        requests: Iterable[Request],
        *,
        bitrate_bps: int,
        timings: Timings = DEFAULT_TIMINGS,
        stop_at_silence: bool = False,
    ) -> None:
        self.queries: list[Query] = []
        """Those that were begun, in order."""
        self._requests = iter(requests)
        self._bitrate_bps = bitrate_bps
        self._timings = timings
        self._stop_at_silence = stop_at_silence
        self._events: list[object] = []
        self._current: Query | None = None
        self._next()

    @property
    def answers(self) -> list[Content | None]:
        """One for each question begun, in order."""
        return [query.answer for query in self.queries]

    @property
    def cancelled(self) -> bool:
        """True when it was ended from outside before its end."""
        return any(query.cancelled for query in self.queries)

    @property
    def done(self) -> bool:
        """True when nothing is left to ask."""
        return self._current is None

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        if self._current is not None:
            self._current.receive(frame, now)
            self._go_on()

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._current is not None:
            self._current.tick(now)
            self._go_on()

    def deadline(self) -> float | None:
        """When `tick` or `next_frame` is wanted next."""
        return None if self._current is None else self._current.deadline()

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        return None if self._current is None else self._current.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted the frame."""
        if self._current is not None:
            self._current.frame_sent(now)
            self._go_on()

    def cancel(self, now: float) -> None:
        """End at the next message boundary; nothing more is asked."""
        self._requests = iter(())
        if self._current is not None:
            self._current.cancel(now)
            self._go_on()

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        if self._current is not None:
            self._events += self._current.take_events()
        taken, self._events = self._events, []
        return taken

    def _go_on(self) -> None:
        current = self._current
        if current is None or not current.done:
            return
        self._events += current.take_events()
        if self._stop_at_silence and current.answer is None:
            self._current = None
        else:
            self._next()

    def _next(self) -> None:
        request = next(self._requests, None)
        if request is None:
            self._current = None
            return
        self._current = Query(request, bitrate_bps=self._bitrate_bps, timings=self._timings)
        self.queries.append(self._current)
