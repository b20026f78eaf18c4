"""Trace conversion to another format, with remarks on frames if the format supports them."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.export.dbc import joined_frames
from flasher.trace.pcapng import PcapngWriter
from flasher.trace.recorder import Writer, message_of, writer_of
from flasher.trace.source import explain_path, frames_until_damage, trace_file
from flasher.trace.story import Step, Story

_Place = tuple[int | None, float]
"""CAN id (None for any) and seconds since the first frame, exactly as in the story."""
_ANY: Final = None


@dataclass(frozen=True)
class Converted:
    """Result of a trace conversion."""

    frames: int
    remarks: int
    """Number of frames with a remark."""
    damage: str
    """Place and reason at which reading stopped; empty at the end of the trace."""


def convert(trace: Path, to: Path, *, name: Path, channel: str | None = None) -> Converted:
    """Write a trace, or one channel of it, in the format of `to`'s suffix; messages call it `name`.
    Raises UsageError, and OSError when the disk is full.
    """
    remarks: dict[_Place, list[str]] = {}
    writer: Writer
    if to.suffix.lower() == ".pcapng":
        story = explain_path(trace, everything=True, channel=channel)
        remarks = _remarks(story)
        verdict = story.verdict
        parts = (verdict.text, verdict.likely, verdict.remedy)
        writer = PcapngWriter(to, "\n".join(filter(None, parts)))
    else:
        writer = writer_of(to, name=str(name))
    damage: list[str] = []
    frames = remarked = 0
    start: float | None = None
    now = -math.inf
    try:
        for at, frame in frames_until_damage(trace_file(trace), damage, channel=channel):
            now = max(now, at)
            start = now if start is None else start
            # Each is written once: frames accepted together have the same time.
            places = ((frame.can_id, now - start), (_ANY, now - start))
            remark = "\n".join(text for place in places for text in remarks.pop(place, ()))
            message = message_of(frame, sent=False, at_s=at)
            if remark and isinstance(writer, PcapngWriter):
                writer(message, remark)
                remarked += 1
            else:
                writer(message)
            frames += 1
    finally:
        writer.stop()
    return Converted(frames, remarked, " ".join(damage))


def convert_joined(trace: Path, to: Path, *, name: Path, channel: str | None = None) -> Converted:
    """Write each intact message of a trace, or of one channel of it, as one CAN FD frame, as the
    DBC describes them. Raises UsageError and OSError like `convert`.
    """
    damage: list[str] = []
    frames = 0
    writer = writer_of(to, name=str(name))
    try:
        frames_read = frames_until_damage(trace_file(trace), damage, channel=channel)
        for message in joined_frames(frames_read):
            writer(message)
            frames += 1
    finally:
        writer.stop()
    return Converted(frames, 0, " ".join(damage))


def _remarks(story: Story) -> dict[_Place, list[str]]:
    """Return trouble at the frame that showed it, and the end of each upgrade at its last frame."""
    found: dict[_Place, list[str]] = defaultdict(list)
    upgrades = story.upgrades
    for line in (*story.steps, *(line for upgrade in upgrades for line in upgrade.steps)):
        if isinstance(line, Step) and line.is_trouble:
            text = f"{line.title}: {line.text}".removesuffix(": ")
            found[line.can_id, line.at_s].append(text)
    for upgrade in upgrades:
        ended = f"{upgrade.target}, end of the upgrade: {upgrade.verdict.text}"
        found[_ANY, upgrade.end_s] += [ended, *upgrade.remarks]
    return found
