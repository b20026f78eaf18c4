"""Views of `flasher monitor`: text lines, JSON lines, or a table of the latest of every message.

On a terminal the table is refreshed in place. Column widths follow from the terminal's width alone,
so nothing moves while values change. Text from the bus enters the table as `Text`, which is never
parsed as markup.
"""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap
from typing import Final, Literal, Self

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleDimensions, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flasher.cli.documents import FieldValue
from flasher.cli.output import Output, counted
from flasher.protocol.frame import Frame
from flasher.trace.decoder import NOT_IN_DIALECT, BusEvent, Field, Kind
from flasher.trace.watcher import MessageHistory, MessageTable, Pulse, TimedFrame

_VALUE_WIDTH: Final = 64
"""Characters after which a value is truncated in lines, unless -v is given."""
WIDE: Final = 116
"""Width below which the table omits sender, receiver and count."""
_CHANGED: Final = "bold yellow"
_TROUBLE: Final = "red"
_VALUE_MAX: Final = 160
_FRAME_LINES: Final = 7
"""Lines around the rows: title, head, rule, two margins, the omitted count, and the cursor."""


@dataclass(frozen=True)
class SeenLine:
    """Decoded message, damaged bytes, or foreign frame. `from` and `to` are nodes, "all", or empty
    for the id of no node.
    """

    at_s: float
    """Seconds since the first event."""
    kind: Kind
    can_id: int
    command: int | None
    from_: str
    to: str
    message: str
    """Title in the documents."""
    trouble: bool
    fields: dict[str, FieldValue]
    changed: list[str]
    """Fields that differ from the previous message of this kind."""
    in_dialect: bool
    """False for a message that the document of --dialect does not have."""
    event: Literal["Seen"] = "Seen"


@dataclass(frozen=True)
class FrameLine:
    """CAN frame as received (--raw)."""

    at_s: float
    kind: Literal["frame"]
    can_id: int
    data: str
    """Data bytes in hexadecimal."""
    extended: bool
    remote: bool
    error: bool
    event: Literal["Frame"] = "Frame"


class MonitorView:
    """Shows a watcher's events; times count from the first event."""

    is_live = False
    """True for a view that needs `refresh` at intervals."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.board = MessageTable()
        self.name = ""
        self.messages = 0
        self.troubles = 0
        self._origin: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Do nothing; a table restores the terminal here."""

    def __call__(self, event: object) -> None:
        match event:
            case BusEvent():
                self.messages += 1
                self.troubles += event.is_trouble
                self.show(event, self.since(event.at), self.board.add(event))
            case TimedFrame(at, frame):
                self.show_frame(frame, self.since(at))
            case Pulse(at):
                self.refresh(at)

    def since(self, at: float) -> float:
        """Seconds since the first event."""
        if self._origin is None:
            self._origin = at
        return at - self._origin

    def show(self, seen: BusEvent, at_s: float, changed: frozenset[str]) -> None:
        """Show a message, damaged bytes or a foreign frame."""

    def show_frame(self, frame: Frame, at_s: float) -> None:
        """Show a frame, if raw frames are shown."""

    def refresh(self, now: float) -> None:
        """Refresh the display, called at intervals."""


class LineView(MonitorView):
    """Prints one line, or one JSON document, per event."""

    def show(self, seen: BusEvent, at_s: float, changed: frozenset[str]) -> None:
        # Faults are never cut.
        width = None if seen.is_alarm or self.output.verbosity >= 1 else _VALUE_WIDTH
        values = ", ".join(
            shown.words(width, "*" if shown.name in changed else "") for shown in seen.fields
        )
        mark = "! " if seen.is_trouble else ""
        text = f"{at_s:10.3f}  {seen.can_id:03X}  {seen.route:<9}  {mark}{seen.marked_title}"
        self.output.result(f"{text}: {values}" if values else text)
        self.output.line(
            SeenLine(
                at_s=round(at_s, 6),
                kind=seen.kind,
                can_id=seen.can_id,
                command=seen.command,
                from_=seen.sender,
                to=seen.receiver,
                message=seen.title,
                trouble=seen.is_trouble,
                fields={shown.name: shown.value for shown in seen.fields},
                changed=sorted(changed),
                in_dialect=seen.in_dialect,
            )
        )

    def show_frame(self, frame: Frame, at_s: float) -> None:
        words = [f"[{len(frame.data)}]", *filter(None, [frame.data.hex(" ")])]
        words += ["29-bit id"] * frame.is_extended
        words += ["remote request"] * frame.is_remote + ["error frame"] * frame.is_error
        self.output.result(f"{at_s:10.3f}  {frame.can_id:03X}  {' '.join(words)}")
        self.output.line(
            FrameLine(
                at_s=round(at_s, 6),
                kind="frame",
                can_id=frame.can_id,
                data=frame.data.hex(),
                extended=frame.is_extended,
                remote=frame.is_remote,
                error=frame.is_error,
            )
        )


# -- the table ------------------------------------------------------------------------------------


class TableView(MonitorView):
    """Table that is refreshed in place, or printed once at the end."""

    def __init__(self, output: Output, *, live: bool) -> None:
        super().__init__(output)
        self.is_live = live
        self._console = Console(markup=False, highlight=False, emoji=False)
        # The watcher refreshes between two frames, without a thread. On a separate screen
        # lines are written over each other, without erasing them first: nothing flickers.
        self._live = Live(console=self._console, screen=True, auto_refresh=False) if live else None
        self._view = BoardView(self._console)
        self._last_at = 0.0

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
        if kind is None:
            # Rich would end the program where the reader of stdout has gone.
            with self._console.capture() as table:
                self._console.print(self._view_now())
            self.output.text(table.get())

    def show(self, seen: BusEvent, at_s: float, changed: frozenset[str]) -> None:
        self._last_at = seen.at

    def refresh(self, now: float) -> None:
        self._last_at = now
        if self._live is not None:
            self._live.update(self._view_now(), refresh=True)

    def _view_now(self) -> RenderableType:
        counts = f"{self.since(self._last_at):.1f} s, {counted(self.messages, 'message')}"
        title = f"{self.name}: {counts}, {self.troubles:,} with trouble"
        return self._view.draw(self.board, self._last_at, title)


class BoardView:
    """Draws a message table to fit the console: one row per field, or one row per message if that
    is too long, limited to the height.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._too_long_for: ConsoleDimensions | None = None
        """Size at which one row per field was too long: keeps the layout from alternating."""

    def draw(self, board: MessageTable, now: float, title: str) -> RenderableType:
        size = self._console.size
        lines = list(board.lines())
        faults = _fault_lines(lines, size.width, size.height - _FRAME_LINES - 1)
        if size.height <= _FRAME_LINES + 1 and faults:
            title, faults = faults[0], []
        table = self._table(lines, now, title, size.height - len(faults))
        return Group(*(Text(line, style=_TROUBLE, no_wrap=True) for line in faults), table)

    def _table(self, lines: list[MessageHistory], now: float, title: str, height: int) -> Table:
        size = self._console.size
        wide = size.width >= WIDE
        room = max(height - _FRAME_LINES, 1)
        if size != self._too_long_for and len(lines) <= room:
            view = _by_field(lines, now, title, wide=wide)
            if len(self._console.render_lines(view, pad=False)) < height:
                return view
        self._too_long_for = size
        view = _by_message(lines[:room], now, title, wide=wide)
        if len(lines) > room:
            more = f"{len(lines) - room} more: enlarge the window, or use --node or --message"
            view.caption = Text(more, style="dim", no_wrap=True, overflow="ellipsis")
        return view


def _fault_lines(lines: list[MessageHistory], width: int, room: int) -> list[str]:
    """Return all active faults over the whole width, since the columns of a table truncate them.
    Faults without room are counted.
    """
    wrapped = [
        part
        for line in lines
        for shown in line.event.fields
        if line.event.is_alarm and shown.name == "faults"
        for part in wrap(f"FAULTS of the {line.event.sender}: {shown.text}", width)
    ]
    if len(wrapped) <= room:
        return wrapped
    shown_lines = wrapped[: max(room - 1, 0)]
    left = " ".join(wrapped[len(shown_lines) :]).count(",") + 1
    more = "more " if shown_lines else ""
    return [*shown_lines, f"{left} {more}FAULTS: enlarge the window"[:width]]


def _by_field(lines: list[MessageHistory], now: float, title: str, *, wide: bool) -> Table:
    table = _table(title, wide=wide)
    _column(table, "field", ratio=5)
    _column(table, "value", ratio=5, right=True, folds=True)
    _column(table, "unit", width=4, right=True)
    _figures(table, wide=wide)
    for line in lines:
        changed = line.changed(now)
        head, tail = _head(line, wide=wide), _tail(line, now, wide=wide)
        if not line.event.in_dialect:
            head[-1] = Text(line.event.marked_title, no_wrap=False, overflow="fold")
        for shown in line.event.fields or (None,):
            cells = [Text(), Text(), Text()] if shown is None else _cells(shown, changed)
            table.add_row(*head, *cells, *tail)
            head, tail = [Text()] * len(head), [Text()] * len(tail)
    return table


def _by_message(lines: list[MessageHistory], now: float, title: str, *, wide: bool) -> Table:
    table = _table(title, wide=wide)
    _column(table, "fields", ratio=6)
    _figures(table, wide=wide)
    for line in lines:
        changed = line.changed(now)
        words = []
        for shown in line.event.fields:
            mark, style = ("*", _CHANGED) if shown.name in changed else ("", "")
            words.append(Text(shown.words(mark=mark), style=style))
        if not line.event.in_dialect:  # first: text after it may be cut
            words.insert(0, Text(NOT_IN_DIALECT))
        fields = Text(", ").join(words)
        table.add_row(*_head(line, wide=wide), fields, *_tail(line, now, wide=wide))
    return table


def _table(title: str, *, wide: bool) -> Table:
    table = Table(
        title=Text(title, style="bold", no_wrap=True, overflow="ellipsis"),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        expand=True,
        pad_edge=False,
    )
    _column(table, "id", width=8 if wide else 3)
    if wide:
        _column(table, "from > to", width=9)
    _column(table, "message", ratio=5)
    return table


def _figures(table: Table, *, wide: bool) -> None:
    _column(table, "per s", width=6, right=True)
    if wide:
        _column(table, "count", width=7, right=True)


def _column(
    table: Table, name: str, *, width: int | None = None, ratio: int | None = None,
    right: bool = False, folds: bool = False,
) -> None:  # fmt: skip
    justify: Final = "right" if right else "left"
    table.add_column(
        Text(name),
        width=width,
        ratio=ratio,
        justify=justify,
        no_wrap=not folds,
        overflow="fold" if folds else "ellipsis",
    )


def _head(line: MessageHistory, *, wide: bool) -> list[Text]:
    seen = line.event
    style = _TROUBLE if seen.is_trouble else ""
    cells = [Text(f"{seen.can_id:03X}"), Text(seen.title, style=style)]
    if wide:
        cells.insert(1, Text(seen.route))
    return cells


def _tail(line: MessageHistory, now: float, *, wide: bool) -> list[Text]:
    rate = line.rate_hz(now)
    cells = [Text("-" if rate is None else f"{rate:.1f}")]
    if wide:
        cells.append(Text(f"{line.count:,}"))
    return cells


def _cells(shown: Field, changed: set[str]) -> list[Text]:
    """Return label, value and unit; a mark also shows a change, for screens without colours."""
    text = shown.text
    if len(text) > _VALUE_MAX:  # it wraps: limited to half the screen
        text = f"{text[:_VALUE_MAX].rstrip()} ..."
    if shown.name not in changed:
        return [Text(shown.label), Text(text), Text(shown.unit)]
    value = Text(f"*{text}", style=_CHANGED)
    return [Text(shown.label), value, Text(shown.unit, style=_CHANGED)]
