"""Views of `flasher station run`: a live table, lines of text, or JSON lines.

External text enters the table as `Text`, which is never parsed as markup. A state has a colour and
a word. Column widths do not depend on content, so the table does not move.
"""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table as Grid
from rich.text import Text

from flasher.cli.documents import to_json
from flasher.cli.output import Output, counted, duration
from flasher.protocol.text import printable
from flasher.report.scale import share_text
from flasher.station import events
from flasher.station.board import NO_BADGES, Board, Row, device_event_text
from flasher.station.events import LineStopped, SocketState, StationEvent
from flasher.station.records.model import Figures, RunState

WIDE: Final = 140
"""Terminal width from which the instruction is in the row instead of below it."""
REFRESH_S: Final = 0.1
"""Minimum time between two refreshes of the table."""
_STYLES: Final = {
    SocketState.STARTING: "dim",
    SocketState.EMPTY: "dim",
    SocketState.SILENT: "dim",
    SocketState.SCAN: "bold black on yellow",
    SocketState.RUNNING: "bold cyan",
    SocketState.SAVING: "bold blue",
    SocketState.PASS: "bold white on green",
    SocketState.FAIL: "bold white on red",
    SocketState.RECHECK: "bold white on magenta",
    SocketState.ERROR: "bold white on red",
    SocketState.STOPPED: "bold white on red",
}
_LOUD: Final = frozenset(
    {SocketState.FAIL, SocketState.RECHECK, SocketState.ERROR, SocketState.SCAN}
)
"""States in which the operator has to act."""
_STATE_WIDTH: Final = max(map(len, SocketState)) + 2
_Column = tuple[int | None, int | None]
_COLUMNS: Final[Sequence[_Column]] = ((None, 6), (None, _STATE_WIDTH), (6, None), (5, None))
"""Share and width of the columns for socket, state, serial number and step."""
_PROGRESS: Final[_Column] = (None, 13)
_WHAT_TO_DO: Final[_Column] = (6, None)
_HEAD_LINES: Final = 2
"""Number of lines for title and column names."""
_REPLY_LINES: Final = 3
"""Lines for the reply to the last scan."""
_HIGH: Final = 20
"""Minimum height for these reply lines; lower windows have one."""
_KEYS: Final = "Ctrl-C: no further unit; twice: stop now"


class View:
    """Applies events to the board and shows them."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.board = Board()
        self.typed: str | None = None
        """Text in the scan line; None if scans are not typed."""

    @contextmanager
    def on_screen(self) -> Iterator[None]:
        """Context in which the view is active; the table then uses the whole screen."""
        yield

    def __call__(self, event: StationEvent) -> None:
        self.board.apply(event)
        self.show(event)

    def show(self, event: StationEvent) -> None:
        """Show an event after the board has applied it."""

    def refresh(self, *, at_once: bool = False) -> None:
        """Draw if `at_once` is true or `REFRESH_S` has passed."""


class JsonLines(View):
    """Prints every event as a line of JSON."""

    def show(self, event: StationEvent) -> None:
        self.output.line(to_json(event))


class Lines(View):
    """Prints a line of text for each event that concerns the operator."""

    def show(self, event: StationEvent) -> None:
        for line in _words(event):
            at = f"{datetime.now().astimezone():%H:%M:%S}"
            self.output.result(f"{at}  {printable(line)}")


class Table(View):
    """Shows the board as a table that is refreshed in place."""

    def __init__(self, output: Output, now: Callable[[], float] = time.perf_counter) -> None:
        super().__init__(output)
        # The station's loop refreshes it, not a thread of rich. The alternate screen overwrites
        # lines without erasing them first, so it does not flicker.
        console = Console(markup=False, highlight=False, emoji=False)
        self._live = Live(console=console, screen=True, auto_refresh=False)
        self._now = now
        self._drawn_at = float("-inf")

    @contextmanager
    def on_screen(self) -> Iterator[None]:
        self._live.start()
        # Text on stderr would break the table, which shows everything important.
        self.output.write_stderr = lambda _text: None
        try:
            yield
        finally:
            self._live.stop()
            self.output.restore_stderr()

    def show(self, event: StationEvent) -> None:
        # Saving blocks the station: without this refresh the row would show the state before.
        is_saving = isinstance(event, events.SocketChanged) and event.state is SocketState.SAVING
        self.refresh(at_once=is_saving)

    def refresh(self, *, at_once: bool = False) -> None:
        if at_once or self._now() - self._drawn_at >= REFRESH_S:
            with suppress(OSError):  # a closed terminal does not stop the line
                table = draw(self.board, self._live.console, self.typed)
                self._live.update(table, refresh=True)
            self._drawn_at = self._now()


# -- the table ------------------------------------------------------------------------------------


def draw(board: Board, console: Console, typed: str | None = "") -> RenderableType:
    """Draw the board to fit the console: a row for each socket, with its instruction below if there
    is room, and totals. `typed`: text in the scan line; None: no scan line.
    """
    width, height = console.size
    foot = _foot(board, typed, width, height)
    room = max(height - _HEAD_LINES - len(foot), 1)
    rows = list(board.rows.values())
    is_wide = width >= WIDE
    is_double = not is_wide and 2 * len(rows) <= room
    shown = rows if len(rows) <= room else rows[: room - 1]
    # In a low window the instruction replaces the progress.
    more = (_PROGRESS, _WHAT_TO_DO) if is_wide else (_PROGRESS if is_double else _WHAT_TO_DO,)
    columns = (*_COLUMNS, *more)
    head = ("socket", "state", "serial number", "step", "    %    left", "")
    lines: list[RenderableType] = [
        _cut(board.title, "bold"),
        _grid(head, columns, "underline"),
    ]
    for row in shown:
        cells = _cells(row)
        if not is_wide and not is_double and row.state in _LOUD and row.note:
            cells[-1] = row.note
        lines.append(_grid([*cells, row.note], columns))
        if is_double:
            lines.append(_cut(f"       {row.note}"))
    if len(shown) < len(rows):
        text = f"{len(rows) - len(shown)} more sockets: make the window higher"
        lines.append(_cut(text, "dim"))
    return Group(*lines, *foot)


def _grid(cells: Iterable[str | Text], columns: Sequence[_Column], style: str = "") -> Grid:
    """One line of the table."""
    grid = Grid.grid(expand=True, padding=(0, 1, 0, 0))
    for ratio, width in columns:
        grid.add_column(ratio=ratio, width=width, no_wrap=True, overflow="ellipsis")
    texts = [Text(cell) if isinstance(cell, str) else cell for cell in cells]
    grid.add_row(*texts[: len(columns)], style=style)
    return grid


def _cells(row: Row) -> list[str | Text]:
    is_done = row.is_virtual and row.state is SocketState.PASS
    doing = row.code or row.step or ("virtual unit" if is_done else "")
    percent = "" if row.share is None else f"{int(row.share * 100)} %"
    left = ""
    if row.left_s is not None:
        whole = round(max(row.left_s, 0.0))
        left = f"{whole} s" if whole < 100 else f"{whole // 60}:{whole % 60:02d}"
    return [
        row.socket,
        Text(f" {row.state.value:<{_STATE_WIDTH - 1}}", style=_STYLES[row.state]),
        Text(row.serial or row.virtual_label, style="" if row.serial else "italic"),
        Text(doing, style="bold" if row.code else ""),
        f"{percent:>5} {left:>7}",
    ]


def _foot(board: Board, typed: str | None, width: int, height: int) -> list[Text]:
    lines = [Text(), _cut("no unit yet"), Text()]
    if board.figures is not None:
        failures = board.figures.failures.items()
        lines[1] = _cut(figures_line(board.figures), "bold")
        lines[2] = _cut("  ".join(f"{printable(code)} {count:,}" for code, count in failures))
    if board.unprinted:
        lines.append(_cut(f"labels {board.unprinted_words}", "bold red"))
    if board.stopped is not None:
        room = max(2, height // 4)
        lines += [
            _cut(f" {text:<{width - 2}} ", "bold white on red")
            for text in _stopped_lines(board.stopped, width - 2, room)
        ]
    reply_lines = _REPLY_LINES if height >= _HIGH else 1
    reply = textwrap.wrap(board.last_reply, width)[:reply_lines]
    reply += [""] * (reply_lines - len(reply))
    lines += [_cut(line, "bold red" if board.is_refusal else "") for line in reply]
    if typed is not None:
        lines.append(_cut(f"scan> {printable(typed)}_"))
    page = f"; the operator page: {board.page}" if board.page else ""
    return [*lines, _cut(_KEYS + page, "dim")]


def _stopped_lines(stop: LineStopped, width: int, room: int) -> list[str]:
    """Format reason and remedy of a stopped line; a long reason is shortened."""
    remedy = printable(f"{stop.remedy} Then scan RESUME.")
    reason = printable(f"LINE STOPPED  {stop.code}: {stop.reason}")
    lines = textwrap.wrap(f"{reason} {remedy}", width)
    if len(lines) <= room:
        return lines
    ends = textwrap.wrap(remedy, width)
    begins = textwrap.wrap(reason, width, max_lines=max(room - len(ends), 1), placeholder=" ...")
    return [*begins, *ends]


def _cut(line: str, style: str = "") -> Text:
    return Text(line, style=style, no_wrap=True, overflow="ellipsis")


def figures_line(figures: Figures) -> str:
    failed = figures.units - figures.passed
    first = share_text(figures.first_pass_share)
    line = (
        f"{counted(figures.units, 'unit')}: {figures.passed:,} passed, {failed:,} failed; "
        f"yield {share_text(figures.yield_share)}, first pass {first}"
    )
    if figures.duration_median_s is not None:
        line += f"; median {duration(figures.duration_median_s)}"
    return line


# -- lines ----------------------------------------------------------------------------------------


def _words(event: StationEvent) -> Iterator[str]:
    """Format an event as lines of text; none for progress."""
    match event:
        case events.StationStarted():
            yield f"{event.station}: {event.recipe}, revision {event.revision}"
            if event.virtual_sockets:
                yield f"VIRTUAL UNITS, no products: socket {', '.join(event.virtual_sockets)}"
            if not event.has_badges:
                yield NO_BADGES
            for run_id in event.recovered:
                yield f"run {run_id} was interrupted: its unit has to be checked"
        case events.ScanRefused(text, code, reason, remedy, _, source):
            where = f" ({source})" if source else ""
            yield f"refused {code}: {text}: {reason} {remedy}{where}"
        case events.PinAwaited(person, text, limit_s):
            yield f">>> {text}: type the PIN of {person} within {limit_s:.0f} s, or scan CANCEL"
        case events.OperatorPrompted(socket, text):
            yield f">>> {f'socket {socket}: ' if socket else ''}{text}"
        case events.LabelFailed() | events.LabelPrinted(is_reprint=True) | events.ScannerChanged():
            yield device_event_text(event)
        case events.LineStopped(code, reason, remedy):
            yield f"LINE STOPPED {code}: {reason} {remedy} Then scan RESUME."
        case events.LineResumed():
            yield "the line is running again"
        case _:
            words = _socket_words(event)
            if words:
                yield f"socket {getattr(event, 'socket', '')}  {words}"


def _socket_words(event: StationEvent) -> str:
    """Format an event of a socket; "" for progress."""
    match event:
        case events.RunStarted(_, serial, run_id, kind):
            return f"{serial}  run {run_id} begins, {kind.value}"
        case events.StepEnded(_, serial, step, _, state, duration_s):
            cause = f" {event.code}: {event.text}" if event.code else ""
            name = f"{step.value} {event.target}".strip()
            return f"{serial}  {name}: {state.value}, {duration_s:.2f} s{cause}"
        case events.RunEnded(run, action):
            if run.state is RunState.PASS:
                code, text = "", f"{run.text}. {action}"
            else:
                code, text = f" {run.code}", run.text  # with the action
            nature = " (virtual unit)" if run.is_virtual else ""
            return f"{run.serial}  {run.state.value}{nature}{code}: {text}"
        case events.SocketChanged(_, events.SocketState.ERROR, _, text):
            return f"ERROR: {text}"
        case events.RecordNotSaved(_, serial, _, reason, remedy):
            return f"{serial}  {reason} {remedy}"
        case events.WorkerFailed(_, reason):
            return f"its process ended: {reason}"
        case _:
            return ""
