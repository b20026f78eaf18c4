"""Application of a device model, started by its bootloader (R19), and its interface to the machine.

The base class is silent, because the documents do not describe answers of WMC and OBC. `bms`
answers, `clients` ask.
"""

from __future__ import annotations

from math import inf
from typing import Protocol

from flasher.protocol.catalogue import ITEMS
from flasher.protocol.spec import Dialect, Node
from flasher.protocol.wire import Message


class ApplicationPort(Protocol):
    """The machine, as seen by its application."""

    @property
    def is_idle(self) -> bool:
        """True if everything was accepted by the bus. Repeated messages are only sent then, so that
        they do not pile up on a blocked bus.
        """
        ...

    def send(self, message: Message) -> None:
        """Queue a message."""
        ...

    def emit(self, event: object) -> None:
        """Report an event."""
        ...

    def switch_off(self, now: float) -> None: ...


class Application:
    """Silent application; base class of the others."""

    def __init__(self, node: Node, dialect: Dialect) -> None:
        self.node = node
        self.dialect = dialect
        self._port: ApplicationPort | None = None

    @property
    def received_ids(self) -> frozenset[int]:
        """CAN ids of the messages that it processes."""
        return frozenset()

    @property
    def port(self) -> ApplicationPort:
        """The machine that it runs on. Raises LookupError before `attach`."""
        if self._port is None:
            raise LookupError("an application runs on a machine")
        return self._port

    def attach(self, port: ApplicationPort) -> None:
        self._port = port

    def start(self, firmware: str, now: float) -> None:
        """Start, with the version text of its image."""

    def stop(self) -> None:
        """Stop at a restart or power loss; only stored data are kept."""

    def note_traffic(self, now: float) -> None:
        """Note a received frame of any node."""

    def take(self, message: Message, now: float) -> None:
        """Process an intact message on one of its ids."""

    def hold_key(self, now: float) -> None:
        """The key was held long enough to switch off."""

    @property
    def due_at(self) -> float:
        """When to call `tick` next; infinite for never."""
        return inf

    def tick(self, now: float) -> None:
        """Process the time `due_at`."""


def ids_received_by(node: Node, dialect: Dialect) -> frozenset[int]:
    """CAN ids of all documented messages that others send to `node` or broadcast."""
    return frozenset(
        item.can_id
        for item in ITEMS
        if dialect in item.dialects and item.sender is not node and item.receiver in {None, node}
    )


def due_again(due_at: float, delay_s: float, now: float) -> float:
    """Next time of something periodic: `delay_s` after it was due, so that delays do not add up;
    but `delay_s` after `now` if that has passed, or it was not due.
    """
    following = due_at + delay_s
    return following if now < following < inf else now + delay_s


def due_until(due_at: float, delay_s: float, end: float, now: float) -> float:
    """Same as `due_again`, but `end` if that is closer than half of `delay_s`, so that the last
    repetition keeps its time for an answer.
    """
    following = due_again(due_at, delay_s, now)
    return end if following > end - delay_s / 2 else following
