"""Applications of WMC, OBC and HMI: their queries to the BMS, and their shutdown.

The documents describe the messages, not their timing: queries follow the tool's rule (3.4: every
200 ms, up to 1 s); the intervals between them are assumptions. No node queries these nodes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from flasher.mock.application import Application, due_again, due_until, ids_received_by
from flasher.protocol import contents
from flasher.protocol.catalogue import ITEMS, Item, answer_of, decode, encode
from flasher.protocol.spec import Dialect, Node
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Message

RUNNING_INFORMATION_PERIOD_S: Final = 1.0
"""Interval of an OBC's queries for running information."""
CELL_VOLTAGES_PERIOD_S: Final = 5.0
"""Interval of an HMI's queries for cell voltages."""
PAUSE_S: Final = 1.0
"""Pause before an unanswered query that needs an answer is repeated."""


@dataclass(frozen=True)
class RoutineQuery:
    """Query of a node after its start: once, every `period_s`, or until answered (`insists`)."""

    title: str
    period_s: float | None = None
    insists: bool = False


_VERSIONS: Final = (
    RoutineQuery("read version information"),
    RoutineQuery("read design information"),
)
ROUTINES: Final[Mapping[Node, Sequence[RoutineQuery]]] = {
    Node.WMC: (
        RoutineQuery("handshake", insists=True),
        RoutineQuery("read physical id"),
        RoutineQuery("read check code"),
        RoutineQuery("read design information"),
    ),
    Node.OBC: (
        *_VERSIONS,
        RoutineQuery("read cell voltages"),
        RoutineQuery("read running information", RUNNING_INFORMATION_PERIOD_S),
    ),
    Node.HMI: (*_VERSIONS, RoutineQuery("read cell voltages", CELL_VOLTAGES_PERIOD_S)),
}


class ClientApplication(Application):
    """Application that queries the BMS, one query after the other, and answers its SHUTDOWN. Then
    it is silent until it starts again.
    """

    def __init__(self, node: Node, dialect: Dialect, timings: Timings = DEFAULT_TIMINGS) -> None:
        super().__init__(node, dialect)
        self._timings = timings
        rows = {
            item.title: item for item in ITEMS if item.sender is node and dialect in item.dialects
        }
        self._queries = [(routine, rows[routine.title]) for routine in ROUTINES[node]]
        self._ready = next(item for item in rows.values() if item.content is contents.Ready)
        self._shutdown_item = next(
            (i for i in rows.values() if i.content is contents.Shutdown), None
        )
        self._waiting: deque[tuple[RoutineQuery, Item]] = deque()
        self._current: tuple[RoutineQuery, Item] | None = None
        self._due_at = inf
        self._give_up_at = 0.0
        self._periodic: dict[str, float] = {}
        self._is_asleep = True
        self._has_sent_shutdown = False
        self.answers: dict[str, int] = {}
        """Number of answers to each query, by title."""

    # -- the machine's side -----------------------------------------------------------------------

    @property
    def received_ids(self) -> frozenset[int]:
        return ids_received_by(self.node, self.dialect)

    def start(self, firmware: str, now: float) -> None:
        self._is_asleep = self._has_sent_shutdown = False
        self._waiting = deque(self._queries)
        self._current = None
        self._periodic = {
            item.title: now + routine.period_s
            for routine, item in self._queries
            if routine.period_s
        }
        self._due_at = now

    def stop(self) -> None:
        self._is_asleep = True

    @property
    def due_at(self) -> float:
        return inf if self._is_asleep else min((self._due_at, *self._periodic.values()))

    def tick(self, now: float) -> None:
        if self._is_asleep:
            return
        self._queue_periodic(now)
        if now < self._due_at:
            return
        if self._current is not None and now >= self._give_up_at:
            if self._current[0].insists:
                self._waiting.appendleft(self._current)
                self._current, self._due_at = None, now + PAUSE_S
            else:
                self._ask_next(now)
        elif self._current is not None:
            self._send_query(self._current[1])
            repeat_s = self._timings.command_repeat_s
            self._due_at = due_until(self._due_at, repeat_s, self._give_up_at, now)
        else:
            self._ask_next(now)

    # -- questions --------------------------------------------------------------------------------

    def _queue_periodic(self, now: float) -> None:
        """Queue each periodic query that is due, once."""
        for question in self._queries:
            routine, item = question
            due = self._periodic.get(item.title)
            if routine.period_s is None or due is None or due > now:
                continue
            self._periodic[item.title] = due_again(due, routine.period_s, now)
            if question not in self._waiting and question != self._current:
                self._waiting.append(question)
                if self._due_at == inf:
                    self._due_at = now

    def _ask_next(self, now: float) -> None:
        self._current = self._waiting.popleft() if self._waiting else None
        self._due_at = inf
        if self._current is not None:
            self._send_query(self._current[1])
            self._give_up_at = now + self._timings.command_timeout_s
            self._due_at = now + self._timings.command_repeat_s

    def _send_query(self, item: Item) -> None:
        # At most one copy unsent: otherwise a blocked bus would get all of them at once.
        if self.port.is_idle:
            self.port.send(encode(item, item.content()))

    # -- messages ---------------------------------------------------------------------------------

    def take(self, message: Message, now: float) -> None:
        """End a query by its answer, and all queries by a SHUTDOWN of the BMS."""
        decoded = decode(message, self.dialect)
        if decoded is None or self._is_asleep:
            return
        if decoded.item.sender is Node.BMS and decoded.content == contents.Shutdown():
            # Every announcement is answered.
            self._waiting.clear()
            self._periodic.clear()
            self._current = None
            self._due_at = inf
            self.port.send(encode(self._ready, contents.Ready()))
            if self._shutdown_item is not None and not self._has_sent_shutdown:
                self._has_sent_shutdown = True
                self.port.send(encode(self._shutdown_item, contents.Shutdown()))
        elif self._current is not None and answer_of(self._current[1]) is decoded.item:
            title = self._current[1].title
            self.answers[title] = self.answers.get(title, 0) + 1
            self._ask_next(now)
