"""Bus view of the bench: live list of messages."""

from __future__ import annotations

from typing import Final

from flasher.driver import drive
from flasher.trace.decoder import BusEvent
from flasher.trace.watcher import MessageTable, Pulse, Watcher
from flasher.web.bench import BenchController
from flasher.web.bench_state import Activity, BusWatch, SeenMessage

WATCH_TURN_S: Final = 0.5
"""Refresh interval, slow enough to read."""


def watch(bench: BenchController) -> None:
    """Show the bus traffic until stopped, without sending."""
    board = MessageTable()
    messages = troubles = 0
    began_s = 0.0

    def happened(event: object) -> None:
        nonlocal messages, troubles
        if isinstance(event, BusEvent):
            messages += 1
            troubles += event.is_trouble
            board.add(event)
        elif isinstance(event, Pulse):
            now = event.at
            rows = tuple(
                SeenMessage(line.event, frozenset(line.changed(now)), line.count, line.rate_hz(now))
                for line in board.lines()
            )
            bench.show(watched=BusWatch(now - began_s, messages, troubles, rows))

    bench.show(doing=Activity.WATCHING, watched=BusWatch(0.0, 0, 0, ()))
    watcher = Watcher(pulse_s=WATCH_TURN_S, dialect=bench.backend.dialect)
    with bench.connected(asks=False) as connection:
        began_s = connection.clock.now()
        drive(
            watcher, connection.link, connection.clock,
            on_event=happened, cancelled=bench.cancelled,
        )  # fmt: skip
