"""Sequence diagram layout: lifelines, arrows and blocks; `templates/sequence.html` draws it.

Pure functions, for a width in CSS pixels: labels are broken into lines that fit. A long dialogue is
first thinned (`thinned`), then divided into parts of a page's height, each with its own lifelines,
so that a printer can break between them.
"""

from __future__ import annotations

import textwrap
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from flasher.report.base import shortened, visible
from flasher.report.scale import duration_text
from flasher.translation import ENGLISH, Translator

ITEMS_SHOWN: Final = 240
"""Maximum number of items in a diagram."""
_MARGIN_STEPS: Final = 3
"""Number of items kept before and after trouble when a dialogue is thinned."""
_PART_HEIGHT: Final = 760
_TIME_WIDTH: Final = 62
_LINE_HEIGHT: Final = 15
_CHAR_WIDTH: Final = 6.7
"""Mean width of a character at the font size of the style sheet, rounded up."""
_HEAD_HEIGHT: Final = 40
_LABEL_LINES: Final = 4
_LABEL_WIDTH_MIN: Final = 170
_EDGE: Final = 8
_QUIET_S: Final = 1.0
"""Length from which a pause is drawn as a block."""
_NAME_LIMIT: Final = 20
_MARK: Final = "! "
"""Prefix of trouble, which colour alone must not mark."""


@dataclass(frozen=True)
class DiagramItem:
    """Item of a diagram. An arrow goes from `sender` to `receiver`; a receiver that is not a
    participant means all of them. An item without sender is a block, a box across all lifelines: a
    summary of messages, or a remark.
    """

    at_s: float
    title: str
    text: str = ""
    sender: str = ""
    receiver: str = ""
    is_trouble: bool = False
    end_s: float | None = None
    """End of an item with a duration."""


class Lifeline(NamedTuple):
    """Vertical line of a participant."""

    name: str
    x: float


@dataclass(frozen=True)
class DiagramRow:
    """Positioned item. `tips` are the ends of an arrow's heads; `title` is the bold part of the
    label, at the beginning of its first line.
    """

    is_arrow: bool
    time: str
    top: float
    y: float
    """Line of an arrow, or lower edge of a block."""
    begin_x: float
    tips: tuple[float, ...]
    label_x: float
    title: str
    lines: tuple[str, ...]
    is_trouble: bool


@dataclass(frozen=True)
class Part:
    """Part of a diagram with a page's height and its own lifelines."""

    width: float
    height: float
    lifelines: tuple[Lifeline, ...]
    rows: tuple[DiagramRow, ...]
    description: str


def thinned(items: Sequence[DiagramItem], most: int = ITEMS_SHOWN) -> list[DiagramItem]:
    """Reduce to about `most` items: the beginning, the end, and the surroundings of trouble. A
    block replaces the others and counts them.
    """
    if len(items) <= most:
        return list(items)
    third = most // 3
    kept = {*range(third), *range(len(items) - third, len(items))}
    for index, item in enumerate(items):
        if item.is_trouble and len(kept) < most:
            near = range(max(0, index - _MARGIN_STEPS), min(len(items), index + _MARGIN_STEPS + 1))
            kept.update(near)
    shown: list[DiagramItem] = []
    previous = -1
    for index in sorted(kept):
        if index > previous + 1:
            shown.append(_omitted_block(items[previous + 1 : index]))
        shown.append(items[index])
        previous = index
    return shown


def _omitted_block(items: Sequence[DiagramItem]) -> DiagramItem:
    troubles = sum(item.is_trouble for item in items)
    text = f"{troubles:,} of them with trouble" if troubles else ""
    title = f"{len(items):,} {'step' if len(items) == 1 else 'steps'} not drawn"
    return DiagramItem(items[0].at_s, title, text, is_trouble=bool(troubles))


def diagram(
    items: Sequence[DiagramItem],
    participants: Sequence[str],
    width: float,
    translate: Translator = ENGLISH,
) -> list[Part]:
    """Lay out a diagram in parts, from top to bottom, `width` CSS pixels wide; none without items.

    Raises ValueError without participants.
    """
    if not participants:
        raise ValueError("a sequence diagram needs participants")
    lifelines = _lifelines(participants, width)
    parts: list[Part] = []
    rows: list[DiagramRow] = []
    top = float(_HEAD_HEIGHT)
    for item in _with_pauses(items, translate):
        row = _row(item, lifelines, top, width)
        if rows and row.y > _PART_HEIGHT:
            parts.append(_part(rows, lifelines, width))
            rows, top = [], float(_HEAD_HEIGHT)
            row = _row(item, lifelines, top, width)
        rows.append(row)
        top = row.y + _EDGE
    if rows:
        parts.append(_part(rows, lifelines, width))
    return parts


def _part(rows: Sequence[DiagramRow], lifelines: tuple[Lifeline, ...], width: float) -> Part:
    names = ", ".join(shortened(line.name, _NAME_LIMIT) for line in lifelines)
    description = f"{len(rows)} steps between {names}, from {rows[0].time or 'the start'} on."
    return Part(width, rows[-1].y + 2 * _EDGE, lifelines, tuple(rows), description)


def _lifelines(participants: Sequence[str], width: float) -> tuple[Lifeline, ...]:
    """Distribute the participants evenly from left to right."""
    begin, end = _TIME_WIDTH + 34.0, width - 40.0
    if len(participants) == 1:
        return (Lifeline(participants[0], (begin + end) / 2),)
    step = (end - begin) / (len(participants) - 1)
    return tuple(
        Lifeline(name, round(begin + step * index, 1)) for index, name in enumerate(participants)
    )


def _with_pauses(items: Iterable[DiagramItem], translate: Translator) -> Iterable[DiagramItem]:
    """Insert a block for each long silence before an arrow, and translate."""
    previous_s: float | None = None
    for item in items:
        # A block without an end is a pause itself, or replaces steps that are not drawn.
        is_open = not item.sender and item.end_s is None
        if previous_s is not None and not is_open and item.at_s - previous_s >= _QUIET_S:
            quiet = translate.numbers(duration_text(item.at_s - previous_s))
            yield DiagramItem(previous_s, translate(f"{quiet} later"))
        yield replace(item, title=translate(item.title), text=translate(item.text))
        previous_s = None if is_open else item.end_s or item.at_s


def time_text(seconds: float) -> str:
    """Format seconds since the beginning, for the left column."""
    return f"{seconds:.3f} s" if seconds < 1000 else f"{seconds:.1f} s"


def _row(item: DiagramItem, lifelines: Sequence[Lifeline], top: float, width: float) -> DiagramRow:
    if not item.sender:
        return _block(item, top, width)
    at = {line.name: line.x for line in lifelines}
    begin_x = at.get(item.sender, lifelines[0].x)
    if item.receiver in at:
        tips: tuple[float, ...] = (at[item.receiver],)
    else:
        tips = tuple(line.x for line in lifelines if line.name != item.sender)
    low, high = min(begin_x, *tips, begin_x), max(begin_x, *tips, begin_x)
    room = max(high - low - 2 * _EDGE, _LABEL_WIDTH_MIN)
    title, lines = _label(item, room)
    needed = max(map(len, lines)) * _CHAR_WIDTH
    label_x = max(_TIME_WIDTH + _EDGE, min(low + _EDGE, width - needed - _EDGE))
    y = top + _LINE_HEIGHT * len(lines) + _EDGE
    time = time_text(item.at_s)
    return DiagramRow(
        bool(item.sender), time, top, y, begin_x, tips, label_x, title, lines, item.is_trouble
    )


def _block(item: DiagramItem, top: float, width: float) -> DiagramRow:
    left, right = float(_TIME_WIDTH + _EDGE), width - _EDGE
    title, lines = _label(item, right - left - 2 * _EDGE)
    y = top + _LINE_HEIGHT * len(lines) + _EDGE * 1.5
    time, label_x = time_text(item.at_s), (left + right) / 2
    return DiagramRow(
        bool(item.sender), time, top, y, left, (right,), label_x, title, lines, item.is_trouble
    )


def _label(item: DiagramItem, room: float) -> tuple[str, tuple[str, ...]]:
    """Return the bold part of the first line, and all lines: the title, then the text."""
    label = f"{item.title}{item.text}"
    wide = sum(unicodedata.east_asian_width(char) in "WF" for char in label)
    columns = max(8, int(room / _CHAR_WIDTH / (1 + wide / max(1, len(label)))))
    title = visible(shortened((_MARK if item.is_trouble else "") + item.title))
    label = f"{title}: {item.text}" if item.text else title
    lines = textwrap.wrap(
        visible(shortened(label)),
        columns,
        max_lines=_LABEL_LINES,
        placeholder=" \N{HORIZONTAL ELLIPSIS}",
    ) or [""]
    return title if lines[0].startswith(title) else lines[0], tuple(lines)
