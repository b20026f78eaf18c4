"""How `flasher station run` shows what happens: a live table, a line a happening, JSON lines."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live

from flasher.cli.documents import to_json
from flasher.cli.output import Output
from flasher.cli.station.board import Board
from flasher.cli.station.table import StationTable
from flasher.protocol.text import printable
from flasher.station import events
from flasher.station.events import SocketState, StationEvent

REFRESH_S: Final = 0.1
"""Time between two refreshes of the table at the least."""
_AT_ONCE: Final = frozenset({SocketState.SAVING})


class View:
    """Takes the station's events into the board, and shows them."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.board = Board()
        self.typed: str | None = None
        """What stands on the scan line; None where nobody can type."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Nothing is held."""

    def __call__(self, event: StationEvent) -> None:
        """Show one event."""
        self.board.apply(event)
        self.show(event)

    def show(self, event: StationEvent) -> None:
        """An event that the board has taken in already."""

    def refresh(self, *, at_once: bool = False) -> None:
        """A moment has passed; `at_once` waits for no other one."""


class JsonLines(View):
    """Every event as a line of JSON."""

    def show(self, event: StationEvent) -> None:
        self.output.line(to_json(event))


class Lines(View):
    """A line for what a person has to know."""

    def show(self, event: StationEvent) -> None:
        for line in _words(event):
            at = f"{datetime.now().astimezone():%H:%M:%S}"
            self.output.result(f"{at}  {printable(line)}")


class Table(View):
    """The board, refreshed in place."""

    def __init__(self, output: Output, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__(output)
        console = Console(markup=False, highlight=False, emoji=False)
        # No thread refreshes: the station's own turn does. On a screen of its own lines are
        # written over each other, without erasing them first: nothing flickers.
        self._live = Live(console=console, screen=True, auto_refresh=False)
        self._table = StationTable(console)
        self._now = now
        self._drawn_at = float("-inf")

    def __enter__(self) -> Self:
        self._live.start()
        # Text on stderr would tear the table; what matters stands in it.
        self.output.write_stderr = lambda _text: None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._live.stop()
        self.output.restore_stderr()

    def show(self, event: StationEvent) -> None:
        # The station is busy while it saves: what the row said last would stay for so long.
        is_saving = isinstance(event, events.SocketChanged) and event.state in _AT_ONCE
        self.refresh(at_once=is_saving)

    def refresh(self, *, at_once: bool = False) -> None:
        if at_once or self._now() - self._drawn_at >= REFRESH_S:
            with contextlib.suppress(OSError):  # a terminal that is gone does not stop the line
                self._live.update(self._table.draw(self.board, self.typed), refresh=True)
            self._drawn_at = self._now()


def _words(event: StationEvent) -> Iterator[str]:
    """An event in words; nothing for what is only progress."""
    match event:
        case events.StationStarted():
            yield f"{event.station}: {event.recipe}, revision {event.revision}"
            if event.virtual_sockets:
                yield f"VIRTUAL UNITS, no products: socket {', '.join(event.virtual_sockets)}"
            for run_id in event.recovered:
                yield f"run {run_id} was interrupted: its unit has to be checked"
        case events.ScanRefused(text, code, reason, remedy):
            yield f"refused {code}: {text}: {reason} {remedy}"
        case events.OperatorPrompted(socket, text):
            yield f">>> {f'socket {socket}: ' if socket else ''}{text}"
        case events.LineStopped(code, reason, remedy):
            yield f"LINE STOPPED {code}: {reason} {remedy} Then scan RESUME."
        case events.LineResumed():
            yield "the line goes on"
        case _:
            words = _socket_words(event)
            if words:
                yield f"socket {getattr(event, 'socket', '')}  {words}"


def _socket_words(event: StationEvent) -> str:
    """What an event says of its socket."""
    match event:
        case events.RunStarted(_, serial, run_id, kind):
            return f"{serial}  run {run_id} begins, {kind.value}"
        case events.StepEnded(_, serial, step, _, state, duration_s):
            said = f" {event.code}: {event.text}" if event.code else ""
            name = f"{step.value} {event.target}".strip()
            return f"{serial}  {name}: {state.value}, {duration_s:.2f} s{said}"
        case events.RunEnded():
            code = "" if event.code == "OK" else f" {event.code}"
            text = event.text.rstrip(". ")
            nature = " (virtual unit)" if event.is_virtual else ""
            return f"{event.serial}  {event.outcome.value}{nature}{code}: {text}. {event.action}"
        case events.SocketChanged(_, events.SocketState.ERROR, _, text):
            return f"ERROR: {text}"
        case events.RecordNotSaved(_, serial, _, reason, remedy):
            return f"{serial}  {reason} {remedy}"
        case events.WorkerFailed(_, reason):
            return f"its process is gone: {reason}"
        case _:
            return ""
