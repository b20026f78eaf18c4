"""What runs on a device once its bootloader has started it (R19), and what it may ask of the
machine that it runs on.

The base is silent: the documents tell nothing of what WMC and OBC would answer. `bms` answers,
`clients` ask.
"""

from __future__ import annotations

from math import inf
from typing import Protocol

from flasher.protocol.catalogue import ITEMS
from flasher.protocol.spec import Dialect, Node
from flasher.protocol.wire import Message


class Port(Protocol):
    """The machine, as its application sees it."""

    @property
    def is_idle(self) -> bool:
        """True when everything that was to be sent has been accepted by the bus. What repeats is
        sent only then, so that a bus that takes nothing does not pile it up.
        """
        ...

    def send(self, message: Message) -> None:
        """Send a message after those before it."""
        ...

    def emit(self, event: object) -> None:
        """Tell those who watch."""
        ...

    def switch_off(self, now: float) -> None:
        """Cut the machine's own power."""
        ...


class Application:
    """An application that is silent; base of those that are not."""

    def __init__(self, node: Node, dialect: Dialect) -> None:
        self.node = node
        self.dialect = dialect
        self._port: Port | None = None

    @property
    def hears(self) -> frozenset[int]:
        """CAN ids of the messages that it takes."""
        return frozenset()

    @property
    def port(self) -> Port:
        """The machine that it runs on. Raises LookupError before it was attached to one."""
        if self._port is None:
            raise LookupError("an application runs on a machine")
        return self._port

    def attach(self, port: Port) -> None:
        """Put it on the machine that it runs on."""
        self._port = port

    def start(self, firmware: str, now: float) -> None:
        """It starts, with the version text that its image holds."""

    def stop(self) -> None:
        """A restart, or the power is gone: all is lost but what is kept on purpose."""

    def heard(self, now: float) -> None:
        """A frame was received, from any node."""

    def take(self, message: Message, now: float) -> None:
        """An intact message arrived on one of the ids that it hears."""

    def hold_key(self, now: float) -> None:
        """The key was held for as long as it takes to switch off."""

    @property
    def due_at(self) -> float:
        """When it next wants `tick`; infinite while it waits for others."""
        return inf

    def tick(self, now: float) -> None:
        """The time that it asked for has come."""


def ids_heard_by(node: Node, dialect: Dialect) -> frozenset[int]:
    """CAN ids of all messages of the documents that others send to `node`, or to all."""
    return frozenset(
        item.can_id
        for item in ITEMS
        if dialect in item.dialects and item.sender is not node and item.receiver in {None, node}
    )


def due_again(due_at: float, delay_s: float, now: float) -> float:
    """When something that repeats is due again: `delay_s` after it was due, so that lateness does
    not add up, but after `now` where that is over already, or where it was not due.
    """
    following = due_at + delay_s
    return following if now < following < inf else now + delay_s


def due_until(due_at: float, delay_s: float, end: float, now: float) -> float:
    """The same, but `end` once that is nearer than half of `delay_s`: what is repeated last keeps
    its time to be answered, whatever the sums of times say.
    """
    following = due_again(due_at, delay_s, now)
    return end if following > end - delay_s / 2 else following
