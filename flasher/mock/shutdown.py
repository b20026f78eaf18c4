"""The shutdown handshake of a BMS (5.1): announce, collect the others' answers, switch off."""

from __future__ import annotations

from typing import Final

from flasher.events import ShutdownAnnounced, ShutdownEnded
from flasher.mock.application import Port
from flasher.mock.timer import due_until
from flasher.protocol import contents
from flasher.protocol.catalogue import ITEMS, encode
from flasher.protocol.spec import Dialect, Node

SHUTDOWN_PERIOD_S: Final = 0.2
"""The announcement is repeated at this interval until all others are ready."""
SHUTDOWN_DELAY_S: Final = 1.0
"""From the first announcement to the opening of the discharge switch, whoever answered."""


class Shutdown:
    """One shutdown, from its first announcement to the end."""

    def __init__(self, dialect: Dialect, port: Port, why: str, now: float) -> None:
        self._port = port
        self._announcement = next(
            item for item in ITEMS if item.sender is Node.BMS and item.content is contents.Shutdown
        )
        self._missing = {
            item.sender
            for item in ITEMS
            if item.content is contents.Ready and item.receiver is None and dialect in item.dialects
        }
        self._answered: set[Node] = set()
        self._off_at = now + SHUTDOWN_DELAY_S
        self.due = now
        """When it next wants `tick`."""
        port.emit(ShutdownAnnounced(why))

    def ready(self, node: Node) -> None:
        """A node answered that it is ready."""
        if node in self._missing:
            self._missing.remove(node)
            self._answered.add(node)
            if not self._missing:
                self.due = self._off_at

    def tick(self, now: float) -> None:
        """Announce again, or switch off."""
        if now >= self._off_at:
            self._port.emit(ShutdownEnded(_names(self._answered), _names(self._missing)))
            self._port.switch_off(now)
        elif self._missing and now >= self.due:
            if self._port.is_idle:
                self._port.send(encode(self._announcement, contents.Shutdown()))
            self.due = due_until(self.due, SHUTDOWN_PERIOD_S, self._off_at, now)


def _names(nodes: set[Node]) -> tuple[str, ...]:
    return tuple(node.name for node in sorted(nodes, key=lambda node: node.value))
