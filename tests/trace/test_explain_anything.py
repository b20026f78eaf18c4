"""Whatever a trace holds: `explain` names a cause, its story is JSON, and nothing raises."""

from __future__ import annotations

import json
import random

import pytest

from flasher.cli.look.explain_text import story_lines
from flasher.documents import as_json
from flasher.protocol.bittime import message_bits
from flasher.protocol.frame import Frame
from flasher.trace.decoder import TimedDecoder, TimedEvent, bits_of
from flasher.trace.explain import explain
from tests.loops import each

from .tape import Tape

WHOLE = (
    Tape().to_packet(4).packet(4).nak(4).packets(4, 10).end().complete().version(b"V1r2r3_20260517")
).frames


def spoilt(chance: random.Random) -> list[tuple[float, Frame]]:
    """The frames of an upgrade: some lost, doubled, damaged, out of turn, or the end missing."""
    frames = list(WHOLE)
    for _ in range(chance.randrange(1, 30)):
        at, other = chance.randrange(len(frames)), chance.randrange(len(frames))
        match chance.randrange(5):
            case 0:
                del frames[at]
            case 1:
                frames.insert(at, frames[other])
            case 2:
                frames[at], frames[other] = frames[other], frames[at]
            case 3:
                time, frame = frames[at]
                flipped = int.from_bytes(frame.data, "big") ^ 1 << chance.randrange(8)
                data = flipped.to_bytes(len(frame.data), "big")
                frames[at] = time, frame._replace(data=data)
            case _:
                frames = frames[: max(10, at)] if chance.random() < 0.1 else frames
    return frames


@pytest.mark.slow
@each("seed", range(40))
def test_a_spoilt_trace_has_a_story(seed: int) -> None:
    story = explain(spoilt(random.Random(seed)), source="x")
    assert story.verdict.text
    assert json.loads(json.dumps(as_json(story)))["verdict"]["text"] == story.verdict.text
    text = "\n".join(story_lines(story, packets=True))
    assert text.isascii()
    assert text.replace("\n", "").isprintable()
    for upgrade in story.upgrades:
        spans = [(span.begin_s, span.end_s) for span in upgrade.phases]
        assert all(begin <= end for begin, end in spans)
        assert spans == sorted(spans)


def test_frames_accepted_at_once_leave_as_late_as_the_wire_lets_them() -> None:
    frames = [frame for _, frame in Tape().packet(1).frames]
    wire_s = message_bits(frames) / 250_000
    pieces = TimedDecoder()
    (piece,) = [piece for each in frames for piece in pieces.feed(each, 5.0, bits_of(each))]
    assert piece.left_s(250_000) == pytest.approx(5.0 + wire_s)
    assert piece.began_s(250_000) == 5.0


def test_frames_stamped_as_they_ended_leave_with_the_last_stamp() -> None:
    pieces, now = TimedDecoder(), 5.0
    found: list[TimedEvent] = []
    for _, frame in Tape().packet(1).frames:
        now += bits_of(frame) / 250_000
        found += pieces.feed(frame, now, bits_of(frame))
    assert [piece.left_s(250_000) for piece in found] == [now]
    assert [piece.began_s(250_000) for piece in found] == [pytest.approx(5.0)]
