"""The flight recorder and the bundle that is made of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import can
import pytest

from flasher.errors import UsageError
from flasher.protocol.frame import Frame
from flasher.trace.bundle import write_bundle
from flasher.trace.reader import read_trace
from flasher.trace.source import explain_path
from flasher.trace.story import Cause
from flasher.trace.taps import FlightRecorder

from .tape import START_S, Tape

MIXED = [
    (Frame(0x752, bytes(range(8))), True),
    (Frame(0x725, b"\x01"), False),
    (Frame(0x7FF, b"", is_remote=True), False),
    (Frame(0x1ABCDEF, b"\xff\x00", is_extended=True), False),
    (Frame(0x12, b"\x01", is_extended=True), False),
    (Frame(0, b"", is_error=True), False),
    (Frame(0x123, b""), True),
]


def recorded(tape: Tape) -> FlightRecorder:
    """The recorder of a tool that received and sent this; its clock starts at 50."""
    recorder = FlightRecorder(wall_clock=lambda: tape.frames[0][0])
    for at, frame in tape:
        recorder(frame, sent=frame.can_id == 0x752, now=at - START_S + 50)
    return recorder


def test_the_ring_keeps_the_last_frames_and_counts_all() -> None:
    recorder = FlightRecorder(limit=3)
    for number in range(10):
        recorder(Frame(number, b""), sent=False, now=float(number))
    assert [entry.frame.can_id for entry in recorder] == [7, 8, 9]
    assert (len(recorder), recorder.frames) == (3, 10)
    assert recorder.last == (9.0, Frame(9, b""), False)


def test_frames_directions_and_times_survive_the_way_through_the_file(tmp_path: Path) -> None:
    recorder = FlightRecorder(wall_clock=lambda: START_S + 0.000456)
    for number, (frame, sent) in enumerate(MIXED):
        recorder(frame, sent=sent, now=7.0 + number * 0.000123)
    path = write_bundle(tmp_path, recorder, {})
    read = list(read_trace(path / "trace.blf"))
    assert [frame for _, frame in read] == [frame for frame, _ in MIXED]
    assert [at for at, _ in read] == pytest.approx(
        [START_S + 0.000456 + number * 0.000123 for number in range(len(MIXED))], abs=1e-6
    )
    with can.LogReader(path / "trace.blf") as messages:
        assert [not message.is_rx for message in messages] == [sent for _, sent in MIXED]


def test_a_bundle_holds_trace_transcript_and_report(tmp_path: Path) -> None:
    tape = Tape().to_packet(3).packet(3).nak(3)
    facts = {"target": "bms", "command_line": ["flasher", "flash", "x"], "path": Path("x")}
    path = write_bundle(tmp_path / "new", recorded(tape), facts, wall_clock=lambda: START_S + 9)
    assert re.fullmatch(r"flasher-bms-\d{8}-\d{6}", path.name)
    assert sorted(file.name for file in path.iterdir()) == [
        "report.json", "trace.blf", "transcript.txt",
    ]  # fmt: skip
    lines = (path / "transcript.txt").read_text().splitlines()
    assert lines[0] == "  0.000500  out  752  CDL > BMS  reset"
    assert lines[-1].split(maxsplit=1)[1] == "in   725  BMS > CDL  ! NAK: number 3"
    report = json.loads((path / "report.json").read_text())
    assert report["command_line"] == ["flasher", "flash", "x"]
    assert report["path"] == "x"
    assert report["frames_kept"] == len(tape.frames)
    assert report["last_frame"]["wall_s"] == pytest.approx(tape.now, abs=1e-5)
    assert report["last_frame"]["monotonic_s"] == pytest.approx(tape.now - START_S + 50, abs=1e-5)
    assert set(report["versions"]) == {"flasher", "python_can", "python", "os"}


def test_a_bundle_never_overwrites_another(tmp_path: Path) -> None:
    recorder = recorded(Tape().reset())
    paths = [write_bundle(tmp_path, recorder, {}, wall_clock=lambda: START_S) for _ in range(3)]
    assert [path.name[-2:] for path in paths[1:]] == ["-2", "-3"]
    assert len(set(paths)) == 3


def test_nothing_is_left_of_a_bundle_that_could_not_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(OSError, match="No space"):
        write_bundle(tmp_path, recorded(Tape().reset()), {})
    assert list(tmp_path.iterdir()) == []


def test_an_empty_ring_makes_a_bundle_too(tmp_path: Path) -> None:
    path = write_bundle(tmp_path, FlightRecorder(), {"error": {"exit_code": 4, "what": "no bus"}})
    story = explain_path(path)
    assert story.verdict.cause is Cause.EMPTY
    assert story.recorded is not None
    assert (story.recorded.exit_code, story.recorded.error) == (4, "no bus")


def test_a_bundle_is_explained_with_what_was_reported_then(tmp_path: Path) -> None:
    tape = Tape().to_packet(3).packet(3)
    facts = {
        "command_line": ["flasher", "flash", "a b.hex"],
        "error": {"exit_code": 7, "what": "It failed.", "where": "packet 3", "cause": "\x1b[2J"},
    }
    path = write_bundle(tmp_path, recorded(tape), facts, wall_clock=lambda: tape.now + 2)
    story = explain_path(path)
    assert story.verdict.cause is Cause.PACKET_UNANSWERED
    assert story.recorded is not None
    assert story.recorded.command == "flasher flash 'a b.hex'"
    assert story.recorded.error == r"It failed. | where: packet 3 | likely cause: \x1b[2J"


@pytest.mark.parametrize("report", ["", "[1]", "{", "\x00", '"' + "x" * 100])
def test_a_report_that_is_none_is_wrong_usage(report: str, tmp_path: Path) -> None:
    path = write_bundle(tmp_path, recorded(Tape().reset()), {})
    (path / "report.json").write_text(report)
    with pytest.raises(UsageError, match="not the report of a bundle"):
        explain_path(path)


@pytest.mark.parametrize("report", ["{}", '{"error": 1, "command_line": 2, "written_at": "x"}'])
def test_a_report_with_other_things_in_it_is_coped_with(report: str, tmp_path: Path) -> None:
    path = write_bundle(tmp_path, recorded(Tape().reset()), {})
    (path / "report.json").write_text(report)
    assert explain_path(path).frames == 2


def test_a_folder_that_is_no_bundle_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not a bundle"):
        explain_path(tmp_path)
