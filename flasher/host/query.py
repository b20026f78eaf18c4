"""Queries and writes (chapter 3): send a request and wait for its answer.

A request is sent every 200 ms until the answer arrives or 1 s has passed. A copy is sent only after
the previous one was on the wire: a sleeping device acknowledges nothing, and the first frames may
only wake it.

A repeated request may be answered several times. After the answer it waits briefly for answers to
the other copies, so that none is mistaken for the answer to the next request: two writes are
confirmed by the same message (R10 applies the same rule to the upgrade).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from math import inf
from typing import Any, Final

from flasher import events
from flasher.errors import UsageError
from flasher.host.runner import Runner, Signal, Stage, StageInput
from flasher.host.table import Reason
from flasher.protocol import catalogue
from flasher.protocol.catalogue import BY_KEY, Item
from flasher.protocol.contents import MEMORY_PIECE_SIZE, Empty, Memory, ReadMemory
from flasher.protocol.fields import Content
from flasher.protocol.spec import BMS, Node, data_size
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message, encode, split

ADDRESS_MAX: Final = 0xFFFF_FFFF
READ_MEMORY: Final = BY_KEY[BMS.request_id, 0x4308]
_EMPTY: Final = Empty()


@dataclass(frozen=True)
class Request:
    """Query or write of the catalogue, with its content.

    `accepts` can reject an answer that belongs to another request; the answer to a memory read must
    contain the requested addresses. `answer` is the answer's catalogue row if the catalogue does
    not contain it (a product's own query).
    """

    item: Item
    content: Content = _EMPTY
    accepts: Callable[[Content], bool] | None = None
    answer: Item | None = None

    @property
    def answer_item(self) -> Item:
        """Catalogue row of the answer. Raises ValueError for a message without answer."""
        found = self.answer or catalogue.answer_of(self.item)
        if found is None:
            raise ValueError(f"{self.item.name} ({self.item.title}) has no answer")
        return found

    def is_answered_by(self, answer: Content) -> bool:
        """Return False for an answer that belongs to another request."""
        if self.accepts is not None:
            return self.accepts(answer)
        if isinstance(self.content, ReadMemory) and isinstance(answer, Memory):
            return (answer.start, answer.end) == (self.content.start, self.content.end)
        return True


class Query:
    """State and result of a request that `ask` sends; `quiet` suppresses its events.

    Raises ValueError if the content does not fit or the message has no answer.
    """

    def __init__(self, request: Request, *, quiet: bool = False) -> None:
        self.request = request
        self.quiet = quiet
        self.answer: Content | None = None
        """Answer; None until it arrives."""
        self.tries = 0
        """Number of transmissions, with a current one."""
        self.misformatted: Message | None = None
        """Last message with the serial number of the answer but another mode or size."""
        self.copies_sent = 0
        """Number of copies of the request that were sent."""
        self.answers = 0
        self.is_settled = False
        """Every sent copy was answered."""
        self.repeat_at = inf
        self.ends_at = inf
        self.cancelled = False
        """The query was cancelled before its answer arrived."""
        self.answer_item = request.answer_item
        message = catalogue.encode(request.item, request.content)
        self.frames = split(message.can_id, encode(message))

    def is_answer(self, message: Message) -> bool:
        """Process a message received after the request was sent; True for the answer."""
        expected = self.answer_item
        if (message.can_id, message.mode, message.command) != (
            expected.can_id,
            expected.mode,
            expected.command,
        ):
            return False
        if data_size(message.command) != expected.content.SIZE_BYTES:
            return False
        content = expected.content.from_data(message.data)
        if not self.request.is_answered_by(content):
            return False
        if self.answer is None:
            self.answer = content
        return True

    def keep_misformatted(self, message: Message) -> None:
        """Keep a message with the serial number of the answer but another mode or size."""
        expected = self.answer_item
        if message.can_id != expected.can_id:
            return
        if (message.mode, message.command) == (expected.mode, expected.command):
            return
        # The serial number is the command's first byte; the second is a size (2.2.1).
        if message.command >> 8 == expected.command >> 8:
            self.misformatted = message


def ask(run: Runner[Any], query: Query) -> Stage[Query]:
    """Send a request until it is answered, by the times at the top of this module."""
    title = query.request.item.title
    run.tx.limit_left_at(run.now)
    run.also_listen_on(query.answer_item.can_id, *_other_request_ids(query))
    query.repeat_at = run.now
    query.ends_at = run.now + run.timings.command_timeout_s
    came: StageInput = Signal.TIME
    while not query.is_settled:
        match came:
            case Signal.CANCEL:
                query.cancelled = query.answer is None
                break
            case Signal.TIME if run.now >= query.ends_at:
                if query.copies_sent or run.now >= run.tx.due_at:
                    break
                # This computer paused in the first copy, which is about to be sent again.
                query.ends_at = run.now + run.timings.command_timeout_s
            case Signal.TIME if run.now >= query.repeat_at:
                query.repeat_at = inf  # it starts when the message was sent
                query.tries += 1
                run.send(query.frames)
                if query.tries > 1 and not query.quiet:
                    why = Reason.QUERY_UNANSWERED.value
                    run.emit(events.MessageRepeated(title, why, query.tries))
            case Signal.LEFT:
                _copy_sent(run, query)
            case Message():
                _take(run, query, came)
            case Damage() if came.can_id == query.answer_item.can_id and not query.quiet:
                run.emit_damage(came)
        if not query.is_settled:
            came = yield min(query.ends_at, query.repeat_at)
    if query.answer is None and not query.cancelled and not query.quiet:
        run.emit(events.QueryUnanswered(title, query.tries))
    yield from run.finish_message()
    return query


def _other_request_ids(query: Query) -> set[int]:
    """CAN ids on which other nodes send the same request."""
    return {
        item.can_id
        for item in catalogue.ITEMS
        if item.sender is not Node.CDL and catalogue.answer_of(item) is query.answer_item
    }


def _copy_sent(run: Runner[Any], query: Query) -> None:
    timings, left_at = run.timings, run.tx.left_at
    run.duplicates.request_sent(query.answer_item.key, run.now, query.answer_item)
    query.copies_sent += 1
    if query.answer is not None:
        query.ends_at = left_at + timings.quiet_after_repeat_s
        return
    if query.copies_sent == 1:
        query.ends_at = left_at + timings.command_timeout_s
    query.repeat_at = left_at + timings.command_repeat_s


def _take(run: Runner[Any], query: Query, message: Message) -> None:
    """Process a message; after an answer, wait for answers to the other copies."""
    query.keep_misformatted(message)
    # Before the request was sent, it answers another node.
    if not query.copies_sent or not query.is_answer(message):
        return
    query.answers += 1
    if query.answers == 1 and query.answer is not None and not query.quiet:
        title = query.request.item.title
        run.emit(events.QueryAnswered(title, query.answer, query.tries))
    query.repeat_at = inf
    run.tx.drop_unstarted()
    query.is_settled = run.tx.idle and query.answers >= query.copies_sent
    query.ends_at = max(run.now, run.tx.left_at) + run.timings.quiet_after_repeat_s


def ask_all(
    run: Runner[Any],
    requests: Iterable[Request],
    queries: list[Query],
    *,
    stop_at_silence: bool = False,
) -> Stage[None]:
    """Run queries one after the other, and append each to `queries` when it begins.

    `requests` may be a generator. With `stop_at_silence` the first query without an answer is the
    last one.
    """
    for request in requests:
        query = Query(request)
        queries.append(query)
        yield from ask(run, query)
        if run.is_cancelled or query.cancelled or (stop_at_silence and query.answer is None):
            return


def count_answers(run: Runner[Any], queries: Sequence[Query]) -> Stage[None]:
    """Wait for answers of a second device, and repeat queries with too many answers (R27)."""
    if not any(query.answers for query in queries):
        return
    if (yield from run.await_second_device()):
        return
    for query in queries:
        if query.answer_item in run.duplicates.ambiguous_queries:
            yield from ask(run, Query(query.request, quiet=True))
            if (yield from run.await_second_device()):
                return


def report_two_devices(run: Runner[Any]) -> None:
    """Emit an event if a second device was detected."""
    if run.duplicates.evidence:
        run.emit(events.TwoDevicesSeen(run.duplicates.evidence))


class Queries(Runner[None]):
    """Engine that runs several queries (`ask_all`), then `count_answers` if `counts` is set."""

    def __init__(
        self,
        requests: Iterable[Request],
        *,
        bitrate_bps: int,
        timings: Timings = DEFAULT_TIMINGS,
        stop_at_silence: bool = False,
        counts: bool = False,
    ) -> None:
        self.queries: list[Query] = []
        """Queries sent so far, in order."""
        iterator = iter(requests)
        first = list(islice(iterator, 1))
        self._requests = chain(first, iterator)
        self._stops_at_silence, self._counts = stop_at_silence, counts
        super().__init__(self._ask, bitrate_bps=bitrate_bps, timings=timings)
        self.done = not first

    def _ask(self, run: Runner[None]) -> Stage[None]:
        stops = self._stops_at_silence
        yield from ask_all(run, self._requests, self.queries, stop_at_silence=stops)
        if self._counts:
            yield from count_answers(run, self.queries)
            report_two_devices(run)

    @property
    def answers(self) -> list[Content | None]:
        """Answers of the queries sent so far; None for a missing one."""
        return [query.answer for query in self.queries]


# -- memory (0x4308) ------------------------------------------------------------------------------


def memory_requests(start: int, end: int) -> Iterator[Request]:
    """Yield memory reads of at most 128 bytes from `start` up to `end`, exclusive (R5)."""
    for at in range(start, end, MEMORY_PIECE_SIZE):
        yield Request(READ_MEMORY, ReadMemory(at, min(at + MEMORY_PIECE_SIZE, end)))


def memory_bytes(answer: Memory) -> bytes:
    """Memory contents in an answer, without filler (R5)."""
    return answer.content[: answer.end - answer.start]


def check_range(start: int, end: int) -> None:
    """Raise UsageError for an address range that a memory read cannot encode."""
    if not 0 <= start < end <= ADDRESS_MAX:
        raise UsageError(
            f"0x{start:08X} to 0x{end:08X} is not a valid memory range.",
            remedy=f"The end is exclusive, above the start, and at most 0x{ADDRESS_MAX:08X}.",
        )
