"""Reading recorded traces of the formats that python-can knows."""

from __future__ import annotations

import gc
import warnings
from itertools import pairwise
from pathlib import Path

import can
import pytest

from flasher.errors import ExitCode, UsageError
from flasher.protocol.frame import Frame
from flasher.trace.reader import read_trace
from flasher.trace.recorder import Recorder
from tests.trace import traffic


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".log", ".trc", ".asc.gz"])
def test_what_was_recorded_is_read_again(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    frames = traffic.running() + traffic.reset()
    with Recorder(path) as record:
        for number, frame in enumerate(frames):
            record(frame, sent=number % 2 == 0, now=number / 100)
    found = list(read_trace(path))
    assert [frame for _, frame in found] == frames
    steps = [after[0] - before[0] for before, after in pairwise(found)]
    assert steps == pytest.approx([0.01] * len(steps), abs=0.002)


def test_extended_remote_and_error_frames_stay_what_they_are(tmp_path: Path) -> None:
    path = tmp_path / "trace.blf"
    with Recorder(path) as record:
        record(Frame(0x12345, b"a", is_extended=True), sent=False, now=0.0)
        record(Frame(0x720, b"", is_remote=True), sent=False, now=0.1)
        record(Frame(0, bytes(8), is_error=True), sent=False, now=0.2)
    frames = [frame for _, frame in read_trace(path)]
    assert [frame[2:] for frame in frames] == [
        (True, False, False),
        (False, True, False),
        (False, False, True),
    ]


def test_can_fd_frames_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "trace.log"
    with can.Logger(path) as logger:
        logger(can.Message(arbitration_id=0x720, data=bytes(12), is_fd=True, is_extended_id=False))
        logger(can.Message(arbitration_id=0x720, data=b"ab", is_extended_id=False))
    assert [frame.data for _, frame in read_trace(path)] == [b"ab"]


def test_a_missing_file_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read: there is no file"):
        list(read_trace(tmp_path / "none.asc"))


def test_an_unknown_suffix_is_told_with_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "trace.xyz"
    path.write_bytes(b"x")
    with pytest.raises(UsageError, match="no trace format has this suffix") as caught:
        list(read_trace(path))
    assert ".asc" in caught.value.remedy


@pytest.mark.parametrize("suffix", [".blf", ".csv", ".log", ".db", ".asc.gz"])
def test_a_file_that_is_something_else_is_wrong_usage(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    path.write_bytes(b"this is no trace\nat all, whatever its name says\n" * 5)
    with warnings.catch_warnings():
        # python-can's reader of this format leaves the file to the garbage collector.
        warnings.simplefilter("ignore", ResourceWarning)
        with pytest.raises(UsageError) as caught:
            list(read_trace(path))
        code, said = caught.value.exit_code, str(caught.value)
        del caught
        gc.collect()
    assert code == ExitCode.USAGE
    assert str(path) in said


def test_a_name_with_an_escape_sequence_is_shown_harmlessly(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        list(read_trace(tmp_path / "a\x1b[2Jb.asc"))
    assert "\x1b" not in str(caught.value)
