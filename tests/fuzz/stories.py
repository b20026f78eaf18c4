"""Harnesses of the story of a trace, and of the bundle of a failed command."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

from flasher.cli.look.explain_text import story_lines
from flasher.documents import as_json
from flasher.errors import UsageError
from flasher.protocol.frame import Frame
from flasher.report.explain_page import render
from flasher.trace.bundle import REPORT, TRACE
from flasher.trace.decoder import ROUTES
from flasher.trace.explain import explain
from flasher.trace.source import explain_path, recorded_of
from flasher.trace.story import Story
from tests.fuzz.harness import Choices, Harness, own_folder
from tests.hostile import good
from tests.trace.tape import Tape
from tests.trace.test_explain_anything import WHOLE, spoilt

_IDS: Final = tuple(ROUTES)
_FAR: Final = 0xFF
"""A time or an id of its own, in place of a usual one."""


def _check(story: Story) -> None:
    """As `flasher explain --json --html` shows it."""
    assert story.verdict.text
    json.dumps(as_json(story), allow_nan=False)
    text = "\n".join(story_lines(story, packets=True))
    assert text.isascii()
    assert text.replace("\n", "").isprintable()
    for upgrade in story.upgrades:
        spans = [(span.begin_s, span.end_s) for span in upgrade.phases]
        assert all(begin <= end for begin, end in spans)
        assert spans == sorted(spans)
    render(story)


# -- frames ----------------------------------------------------------------------------------------


def _timed(choices: Choices) -> Iterator[tuple[float, Frame]]:
    now = 0.0
    while choices:
        pause, which, size = choices.byte(), choices.byte(), choices.byte()
        now += (choices.number(2) - 0x4000 if pause == _FAR else pause / 4) / 1000
        is_long = bool(size & 0x80)
        if which == _FAR:
            can_id = choices.number(4) & (0x1FFF_FFFF if is_long else 0x7FF)
        else:
            can_id = _IDS[which % len(_IDS)]
        is_remote, is_error = bool(size & 0x40), size & 0x30 == 0x30
        data = b"" if is_remote else choices.take(min(size & 0x0F, 8))
        yield now, Frame(can_id, data, is_long and not is_error, is_remote, is_error)


def take_story(data: bytes) -> None:
    choices = Choices(data)
    flags = choices.byte()
    _check(
        explain(
            _timed(choices),
            source="x",
            suffix=("asc", "log", "blf", "trc")[flags & 3],
            until=1000.0 if flags & 4 else None,
            everything=bool(flags & 8),
            is_one_tool=bool(flags & 16),
        )
    )


def _as_choices(frames: Sequence[tuple[float, Frame]]) -> bytes:
    made, before = b"\0", frames[0][0]
    for at, frame in frames:
        milliseconds, before = round((at - before) * 1000), at
        if 0 <= milliseconds * 4 < _FAR:
            pause = bytes((milliseconds * 4,))
            late = b""
        else:
            pause = bytes((_FAR,))
            late = (min(max(milliseconds, -0x4000), 0xBFFF) + 0x4000).to_bytes(2, "big")
        size = len(frame.data) | frame.is_remote << 6 | (0x30 if frame.is_error else 0)
        which = _IDS.index(frame.can_id) if frame.can_id in _IDS else _FAR
        far = frame.can_id.to_bytes(4, "big") if which == _FAR else b""
        made += pause + bytes((which, size)) + late + far + frame.data
    return made


def _frames() -> Iterator[bytes]:
    yield _as_choices(WHOLE)
    yield _as_choices(WHOLE[:40])
    yield _as_choices(Tape().error(3).to_packet(2).frames)
    for seed in range(3):
        yield _as_choices(spoilt(Random(seed))[:60])


# -- bundles ---------------------------------------------------------------------------------------


@cache
def _bundle() -> Path:
    folder = own_folder()
    good.trace(folder / TRACE)
    return folder


def take_bundle(data: bytes) -> None:
    folder = _bundle()
    (folder / REPORT).write_bytes(data)
    recorded = recorded_of(folder)
    assert recorded.error.isprintable()
    assert recorded.command.isprintable()
    _check(explain_path(folder))


def _reports() -> Iterator[bytes]:
    report = {
        "command_line": ["flasher", "flash", "x.hex"],
        "bitrate_bps": 250_000,
        "written_at": 1.7e9,
        "error": {"exit_code": 5, "what": "No answer.", "where": "x", "cause": "y", "remedy": "z"},
    }
    yield json.dumps(report).encode()
    yield b"{}"


def _words() -> list[str]:
    return [f'"{name}": ' for name in json.loads(next(_reports()))] + ["null", "1e999", "[", "{"]


HARNESSES: Final = {
    "story": Harness(take_story, _frames, "flasher.trace.explain._StoryBuilder", max_size=2048),
    "bundle": Harness(
        take_bundle,
        _reports,
        "flasher.trace.source._recorded",
        (UsageError,),
        words=_words,
    ),
}
