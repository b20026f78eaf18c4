"""Excerpt of a case's trace for people: its relevant part, as messages and raw frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Final, NamedTuple

from flasher.conformance.results import CaseResult, RunReport, TraceEntry
from flasher.conformance.wire import BOOT_VERSION
from flasher.protocol.frame import Frame
from flasher.trace.decoder import BusEvent, Decoder

_FRAMES_A_MESSAGE: Final = 20
_FIELDS: Final = 8
_FIRST_FRAMES: Final = 200
"""Frames of a case within which its bootloader has announced itself."""
_LINE: Final = 120
"""Longest text of fields in a line."""
_AFTER_S: Final = 0.02
"""A frame this soon after a failed check belongs to it."""


class TraceRow(NamedTuple):
    """A decoded message and the text of its fields."""

    seen: BusEvent
    text: str

    def __str__(self) -> str:
        seen = self.seen
        sender = seen.sender or f"{seen.can_id:03X}"
        text = self.text if len(self.text) <= _LINE else f"{self.text[:_LINE]}..."
        return f"{seen.at:9.4f} s  {sender} > {seen.receiver}  {seen.title}  {text}".rstrip()


class Excerpt(NamedTuple):
    """A part of the frames of a case."""

    messages: Sequence[TraceRow]
    frames: Sequence[TraceEntry]
    text: str
    """Description of the part."""


def excerpt(result: CaseResult, messages: int, frames: int) -> Excerpt:
    """Up to `messages` and `frames` of a case: the last ones before its first failed check, or the
    first ones when none failed.
    """
    if not result.trace:
        return Excerpt((), (), "")
    failure = result.first_failure
    many = messages * _FRAMES_A_MESSAGE
    if failure is not None:
        entries = [one for one in result.trace if one.at_s <= failure.at_s + _AFTER_S]
        rows = decoded_rows(entries[-many:])[-messages:]
        text = f"up to the first failed check, {len(rows)} messages"
        shown = entries[-frames:]
    else:
        found = decoded_rows(result.trace[:many])
        rows = found[:messages]
        whole = len(rows) == len(found) and len(result.trace) <= many
        text = f"{'all' if whole else 'the first'} {len(rows)} messages"
        shown = list(result.trace[:frames])
    count = len(result.trace) + result.trace_dropped
    return Excerpt(rows, shown, f"{text}; {count:,} frames in the case")


def frame_lines(frames: Sequence[TraceEntry]) -> Iterator[str]:
    """Format frames as lines: time in seconds, `>` for sent ones, id, size, bytes."""
    for entry in frames:
        frame = entry.frame
        can_id = f"{frame.can_id:0{8 if frame.is_extended else 3}X}"
        kinds = {"remote": frame.is_remote, "error": frame.is_error}
        kind = "".join(f"  {name}" for name, is_it in kinds.items() if is_it)
        way, data = ">" if entry.sent else "<", frame.data.hex(" ").upper()
        yield f"{entry.at_s:10.6f} {way} {can_id} [{len(frame.data)}] {data}{kind}".rstrip()


def decoded_rows(entries: Sequence[TraceEntry]) -> list[TraceRow]:
    """Decode the frames into messages, including bytes without a message."""
    decoder = Decoder()
    found: list[BusEvent] = []
    for entry in entries:
        due = decoder.deadline()
        if due is not None and due <= entry.at_s:
            found += decoder.tick(due)
        found += decoder.feed(Frame(*entry.frame), entry.at_s)
    due = decoder.deadline()
    if due is not None:
        found += decoder.tick(due)
    return [
        TraceRow(seen, ", ".join(f"{one.label} {one.text}" for one in islice(seen.fields, _FIELDS)))
        for seen in found
    ]


def boot_versions(report: RunReport) -> tuple[str, ...]:
    """Distinct boot versions in the frames of a run."""
    found: dict[str, None] = {}
    for result in report.results:
        replies = [entry for entry in result.trace[:_FIRST_FRAMES] if not entry.sent]
        for row in decoded_rows(replies):
            if row.seen.command == BOOT_VERSION:
                found[" ".join(field.text for field in row.seen.fields)] = None
    return tuple(found)
