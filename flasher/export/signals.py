"""Signal export: traces as rows of values, one per message, for tables, notebooks and plots."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flasher.export.names import key
from flasher.protocol.text import no_formula
from flasher.trace.decoder import BusEvent, Field, Kind, TimedDecoder, bits_of
from flasher.trace.reader import read_trace
from flasher.trace.source import frames_until_damage, trace_file

Value = str | int | None
FIXED_COLUMNS: Final = (
    "time_s", "stamp_s", "frame", "id", "sender", "receiver", "kind", "message",
)  # fmt: skip
"""Columns of every row, followed by those of fields."""


@dataclass(frozen=True)
class SignalRow:
    """Message, or stretch of damaged bytes, with its time."""

    time_s: float
    """Time of the last frame in seconds since the first frame of the trace."""
    stamp_s: float
    """The same time as stored in the trace: since 1970, or since some start."""
    frame: int
    """Number of the frame that completed the message, from 1, as Wireshark counts."""
    event: BusEvent

    def values(self) -> dict[str, Any]:
        """Values by column name; a list has a column for each of its values."""
        event = self.event
        fixed = (
            self.time_s, self.stamp_s, self.frame, f"{event.can_id:03X}", event.sender,
            event.receiver, event.kind.value, event.title,
        )  # fmt: skip
        return {**dict(zip(FIXED_COLUMNS, fixed, strict=True)), **dict(self.fields())}

    def fields(self) -> Iterator[tuple[str, Value]]:
        """Yield names and values of the fields, such as `running_information.voltage_mv`."""
        prefix = key(self.event.title)
        for field in self.event.fields:
            yield from _columns(f"{prefix}.{field.name}", field)


def _columns(name: str, field: Field) -> Iterator[tuple[str, Value]]:
    value = field.value
    if not isinstance(value, list):
        yield name, value
    elif value and isinstance(value[0], int):
        yield from ((f"{name}.{at}", each) for at, each in enumerate(value, 1))
    else:
        yield name, ", ".join(value)


def rows(
    trace: str | os.PathLike[str],
    *,
    wanted: Callable[[str], bool] = lambda _title: True,
    damage: list[str] | None = None,
) -> Iterator[SignalRow]:
    """Yield the messages of a trace whose titles are `wanted`, ordered by their ends. The place at
    which reading stopped is added to `damage`. Raises UsageError for a file that is not a trace.
    """
    decoder = TimedDecoder()
    first_s: float | None = None
    now, number = -math.inf, 0
    frames = (
        read_trace(trace)
        if damage is None
        else frames_until_damage(trace_file(Path(trace)), damage)
    )
    for at_s, frame in frames:
        number += 1
        now = max(now, at_s)
        first_s = now if first_s is None else first_s
        for timed in decoder.feed(frame, now, bits_of(frame)):
            event = timed.event
            if event.kind is not Kind.FOREIGN and wanted(event.title):
                yield SignalRow(timed.end_s - first_s, timed.end_s, number, event)
    if first_s is not None:
        for timed in decoder.finish(now):
            if wanted(timed.event.title):
                yield SignalRow(timed.end_s - first_s, timed.end_s, number, timed.event)


def csv_text(rows: Sequence[SignalRow]) -> str:
    """Format rows as CSV with a column for each field."""
    file = io.StringIO()
    lines = [row.values() for row in rows]
    columns = dict.fromkeys((*FIXED_COLUMNS, *(name for line in lines for name in line)))
    writer = csv.DictWriter(file, columns, lineterminator="\r\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({name: _cell(value) for name, value in line.items()})
    return file.getvalue()


def _cell(value: Value | float) -> str:
    if isinstance(value, float):
        return f"{value:.6f}"
    return no_formula(value) if isinstance(value, str) else str(value)


def trace_rows(trace: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """Yield the messages of a trace as rows for a table: `pandas.DataFrame(trace_rows(path))`.

    Columns are time_s (since the first frame), stamp_s (as in the file), frame (its number, as in
    Wireshark), id, sender, receiver, kind, message, and one for each field, with its unit in the
    name: running_information.voltage_mv. Raises UsageError for a file that is not a trace, or is
    damaged.
    """
    return (row.values() for row in rows(trace))
