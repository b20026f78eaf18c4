"""Applications of the device model, which its bootloader starts (R19), and their interface.

The base class is silent, because the documents describe no answers of WMC and OBC. `bms` answers
queries, `clients` send them.
"""

from __future__ import annotations

from math import inf
from typing import Protocol

from flasher.protocol.catalogue import ITEMS
from flasher.protocol.spec import Dialect, Node
from flasher.protocol.wire import Message


class ApplicationPort(Protocol):
    """Interface of a machine for its application."""

    @property
    def is_idle(self) -> bool:
        """True if the transmit queue is empty. Periodic messages are sent only then, so that they
        do not pile up on a blocked bus.
        """
        ...

    def send(self, message: Message) -> None: ...

    def emit(self, event: object) -> None: ...

    def power_cut(self, now: float) -> None: ...


class Application:
    """Application without messages; base class of the others."""

    def __init__(self, node: Node, dialect: Dialect) -> None:
        self.node = node
        self.dialect = dialect
        self._port: ApplicationPort | None = None

    @property
    def received_ids(self) -> frozenset[int]:
        """CAN ids of the messages that the application processes."""
        return frozenset()

    @property
    def port(self) -> ApplicationPort:
        """Machine on which the application runs. Raises LookupError before `attach`."""
        if self._port is None:
            raise LookupError("an application runs on a machine")
        return self._port

    def attach(self, port: ApplicationPort) -> None:
        self._port = port

    def start(self, firmware: str, now: float) -> None:
        """Start; `firmware` is the version text of the image."""

    def stop(self) -> None:
        """Stop at a restart or power loss; only stored data remain."""

    def note_traffic(self, now: float) -> None:
        """Process the time of a received frame of any node."""

    def take(self, message: Message, now: float) -> None:
        """Process an intact message on one of `received_ids`."""

    def hold_key(self, now: float) -> None:
        """Switch off, because the key was held long enough."""

    @property
    def due_at(self) -> float:
        """Time of the next `tick`; infinite for never."""
        return inf

    def tick(self, now: float) -> None:
        """Send periodic messages and check timeouts."""


def ids_received_by(node: Node, dialect: Dialect) -> frozenset[int]:
    """CAN ids of all documented messages that other nodes send to `node` or broadcast."""
    return frozenset(
        item.can_id
        for item in ITEMS
        if dialect in item.dialects and item.sender is not node and item.receiver in {None, node}
    )


def due_again(due_at: float, delay_s: float, now: float) -> float:
    """Next time of a periodic action: `delay_s` after it was due, so that delays do not add up;
    `delay_s` after `now` if that has passed, or if it was not due.
    """
    following = due_at + delay_s
    return following if now < following < inf else now + delay_s


def due_until(due_at: float, delay_s: float, end: float, now: float) -> float:
    """`due_again`, or `end` if that is closer than half of `delay_s`, so that an answer to the last
    repetition has time.
    """
    following = due_again(due_at, delay_s, now)
    return end if following > end - delay_s / 2 else following
