"""The live table of a station: one row a socket, totals below; refreshed in place on a terminal.

Column widths follow from the terminal's width alone, so nothing moves while values change. What
comes from outside enters as `Text`, which is never read as markup. A state is a colour and a word.
"""

from __future__ import annotations

import textwrap
from typing import Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from flasher.cli.station.board import Board, Row
from flasher.cli.station.text import figures_line
from flasher.protocol.text import printable
from flasher.station.events import LineStopped, SocketState

WIDE: Final = 140
"""From this width on, what to do stands in the row; else below it."""
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
    {
        SocketState.FAIL,
        SocketState.RECHECK,
        SocketState.ERROR,
        SocketState.SCAN,
    }
)
"""States in which somebody has to do something."""
_STATE_WIDTH: Final = max(map(len, SocketState)) + 2
_PERCENT_WIDTH: Final = 5
_LEFT_WIDTH: Final = 7
_HEAD_LINES: Final = 2
"""Title and head."""
_SAID_LINES: Final = 3
"""For the answer to the last scan."""
_HIGH: Final = 20
"""Lower windows have one line for it."""
_KEYS: Final = "Ctrl-C: no further unit; twice: stop now"


class StationTable:
    """Draws a board as it fits the console."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def draw(self, board: Board, typed: str | None = "") -> RenderableType:
        """The board; `typed` is what stands on the scan line so far, None: nothing is typed."""
        width, height = self._console.size
        is_wide = width >= WIDE
        foot = _foot(board, typed, width, height)
        room = max(height - _HEAD_LINES - len(foot), 1)
        lines = _rows(list(board.rows.values()), width, room, is_wide=is_wide)
        title = _cut(Text(board.title, style="bold"), width)
        return Group(title, _head(width, is_wide=is_wide), *lines, *foot)


def _rows(rows: list[Row], width: int, room: int, *, is_wide: bool) -> list[Text]:
    """A line a socket, and where there is room for it one below with what to do: for every socket,
    so that nothing moves.
    """
    is_double = not is_wide and 2 * len(rows) <= room
    shown = rows if len(rows) <= room else rows[: room - 1]
    lines: list[Text] = []
    for row in shown:
        # One line for all: the word of the state makes place for what to do.
        in_row = is_wide or (not is_double and row.state in _LOUD)
        lines.append(_row(row, width, is_wide=is_wide, in_row=in_row))
        if is_double:
            lines.append(_cut(Text(f"       {row.note}"), width))
    if len(shown) < len(rows):
        more = f"{len(rows) - len(shown)} more sockets: make the window higher"
        lines.append(_cut(Text(more, style="dim"), width))
    return lines


def _widths(width: int, *, is_wide: bool) -> tuple[int, int, int]:
    """Of socket, serial number and step."""
    if is_wide:
        return 8, 24, 18
    fixed = _STATE_WIDTH + _PERCENT_WIDTH + _LEFT_WIDTH + 4
    rest = max(width - fixed, 24)
    socket = 6
    step = min(20, max(8, (rest - socket) // 2))
    return socket, min(24, max(rest - socket - step - 1, 8)), step


def _head(width: int, *, is_wide: bool) -> Text:
    socket, serial, step = _widths(width, is_wide=is_wide)
    cells = [
        f"{'socket':<{socket}}"[:socket],
        f"{'state':<{_STATE_WIDTH}}",
        f"{'serial number':<{serial}}"[:serial],
        f"{'step':<{step}}"[:step],
        f"{'%':>{_PERCENT_WIDTH}}",
        f"{'left':>{_LEFT_WIDTH}}",
    ]
    if is_wide:
        cells.append("")
    return _cut(Text(" ".join(cells), style="underline"), width)


def _row(row: Row, width: int, *, is_wide: bool, in_row: bool) -> Text:
    socket, serial, step = _widths(width, is_wide=is_wide)
    is_done = row.is_virtual and row.state is SocketState.PASS
    doing = row.code or row.step or ("virtual unit" if is_done else "")
    percent = "" if row.share is None else f"{int(row.share * 100)} %"
    left = "" if row.left_s is None else _left(row.left_s)
    cells = [
        _cell(row.socket, socket),
        _cell(f" {row.state.value} ", _STATE_WIDTH, _STYLES[row.state]),
        _cell(row.serial or row.borne, serial, "" if row.serial else "italic"),
        _cell(doing, step, "bold" if row.code else ""),
        Text(f"{percent:>{_PERCENT_WIDTH}}"),
        Text(f"{left:>{_LEFT_WIDTH}}"),
    ]
    if in_row and row.note:
        # Where there is no place of its own for it, it stands where figures would be.
        cells = [*(cells if is_wide else cells[:4]), Text(f" {row.note}")]
    return _cut(Text(" ").join(cells), width)


def _left(seconds: float) -> str:
    whole = round(max(seconds, 0.0))
    return f"{whole} s" if whole < 100 else f"{whole // 60}:{whole % 60:02d}"


def _foot(board: Board, typed: str | None, width: int, height: int) -> list[Text]:
    lines = [Text()]
    if board.figures is not None:
        lines.append(Text(figures_line(board.figures), style="bold"))
        failures = board.figures.failures.items()
        lines.append(Text("  ".join(f"{printable(code)} {count:,}" for code, count in failures)))
    else:
        lines += [Text("no unit yet"), Text()]
    if board.stopped is not None:
        room = max(2, height // 4)
        for text in _stopped_lines(board.stopped, width - 2, room):
            lines.append(Text(f" {text:<{width - 2}} ", style="bold white on red"))
    said_lines = _SAID_LINES if height >= _HIGH else 1
    said = textwrap.wrap(board.said, width)[:said_lines]
    said += [""] * (said_lines - len(said))
    lines += [Text(line, style="bold red" if board.is_refusal else "") for line in said]
    if typed is not None:
        lines.append(Text(f"scan> {printable(typed)}_"))
    lines.append(Text(_KEYS, style="dim"))
    return [_cut(line, width) for line in lines]


def _stopped_lines(stop: LineStopped, width: int, room: int) -> list[str]:
    """Why the line stands and what to do; where there is no room for all, what to do is kept."""
    remedy = printable(f"{stop.remedy} Then scan RESUME.")
    reason = printable(f"LINE STOPPED  {stop.code}: {stop.reason}")
    lines = textwrap.wrap(f"{reason} {remedy}", width)
    if len(lines) <= room:
        return lines
    ends = textwrap.wrap(remedy, width)
    begins = textwrap.wrap(reason, width, max_lines=max(room - len(ends), 1), placeholder=" ...")
    return [*begins, *ends]


def _cell(text: str, width: int, style: str = "") -> Text:
    cell = Text(text, style=style)
    cell.truncate(width, overflow="ellipsis", pad=True)
    return cell


def _cut(line: Text, width: int) -> Text:
    line.truncate(width, overflow="ellipsis")
    line.no_wrap = True
    return line
