"""Reading recorded traces of the formats that python-can knows."""

from __future__ import annotations

import gc
import sqlite3
import sys
import warnings
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import can
import pytest

from flasher.errors import ExitCode, UsageError
from flasher.protocol.frame import Frame
from flasher.python_can import load_mf4
from flasher.trace.reader import SeveralBusesError, read_trace
from flasher.trace.recorder import Recorder
from flasher.trace.source import frames_until_damage
from tests.trace import traffic


@pytest.mark.parametrize(
    "suffix", [".asc", ".blf", ".csv", ".db", ".log", ".pcapng", ".trc", ".asc.gz"]
)
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
    assert [frame[2:5] for frame in frames] == [
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


@pytest.mark.parametrize(
    ("suffix", "names"),
    [
        (".asc", "12"),
        (".blf", "12"),
        (".log", ("can0", "can1")),
        (".trc", "12"),
        pytest.param(".mf4", "01", marks=pytest.mark.slow),
    ],
)
def test_two_buses_in_a_trace_are_not_read_as_one(
    tmp_path: Path, suffix: str, names: tuple[str, str]
) -> None:
    if suffix == ".mf4":
        pytest.importorskip("asammdf", reason="needs the extra mf4")
        load_mf4()
    path = tmp_path / f"two{suffix}"
    with can.Logger(path) as logger:
        for channel, can_id in ((0, 0x752), (1, 0x725), (0, 0x720), (1, 0x720), (1, 0x721)):
            logger(
                can.Message(
                    arbitration_id=can_id, data=b"ab", channel=channel, is_extended_id=False
                )
            )
    with pytest.raises(SeveralBusesError, match="not a trace of one CAN bus") as caught:
        list(frames_until_damage(path, []))
    assert f"id 720 is on the channels {names[0]} and {names[1]}" in caught.value.cause
    assert f"--channel {names[0]} " in caught.value.remedy
    assert [frame.can_id for _, frame in read_trace(path, channel=names[0])] == [0x752, 0x720]
    assert [frame.can_id for _, frame in read_trace(path, channel=names[1])] == [
        0x725, 0x720, 0x721,
    ]  # fmt: skip
    with pytest.raises(UsageError, match="has no frame of the channel 9") as missing:
        list(read_trace(path, channel="9"))
    assert f"{names[0]}, {names[1]}" in missing.value.remedy


def test_what_one_program_writes_to_a_channel_for_each_direction_is_one_bus(tmp_path: Path) -> None:
    path = tmp_path / "script.log"
    with can.Logger(path) as logger:
        for channel, can_id in ((None, 0x752), ("can3", 0x725), (None, 0x752)):
            logger(
                can.Message(
                    arbitration_id=can_id, data=b"ab", channel=channel, is_extended_id=False
                )
            )
    assert [frame.can_id for _, frame in read_trace(path)] == [0x752, 0x725, 0x752]


def test_a_missing_file_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read: there is no file"):
        list(read_trace(tmp_path / "none.asc"))


def test_an_unknown_suffix_is_reported_with_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "trace.xyz"
    path.write_bytes(b"x")
    with pytest.raises(UsageError, match="no trace format has this suffix") as caught:
        list(read_trace(path))
    assert ".asc" in caught.value.remedy


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".blf", ".csv", ".log", ".db", ".asc.gz"])
def test_a_file_that_is_something_else_is_wrong_usage(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    path.write_bytes(b"this is no trace\nat all, whatever its name says\n" * 5)
    with warnings.catch_warnings():
        # python-can's reader of this format leaves the file to the garbage collector.
        warnings.simplefilter("ignore", ResourceWarning)
        with pytest.raises(UsageError) as caught:
            list(read_trace(path))
        code, reported = caught.value.exit_code, str(caught.value)
        del caught
        gc.collect()
    assert code == ExitCode.USAGE
    assert str(path) in reported


def test_a_name_with_an_escape_sequence_is_shown_harmlessly(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        list(read_trace(tmp_path / "a\x1b[2Jb.asc"))
    assert "\x1b" not in str(caught.value)


def test_a_blf_file_is_read_as_python_can_reads_it(tmp_path: Path) -> None:
    """Through containers that cut objects in two, packed and not, with CAN FD objects in them."""
    path = tmp_path / "trace.blf"
    for level in (0, 9):
        with can.BLFWriter(path, compression_level=level, max_container_size=1000) as writer:
            for number in range(500):
                is_fd = number % 5 == 0
                data = bytes([number & 0xFF]) * (number % 9 + 12 * (is_fd and number % 2))
                writer(
                    can.Message(
                        timestamp=1.7e9 + number / 128,
                        arbitration_id=number,
                        is_extended_id=number % 3 == 0,
                        is_remote_frame=number % 7 == 0 and not is_fd,
                        is_error_frame=number % 11 == 0 and not is_fd,
                        is_fd=is_fd,
                        data=b"" if number % 7 == 0 else data,
                    )
                )
        with can.LogReader(path) as reader:
            expected = [
                (message.timestamp, message.arbitration_id, bytes(message.data))
                for message in reader
                if not message.is_fd
            ]
        assert len(expected) == 400
        assert [(at, frame.can_id, frame.data) for at, frame in read_trace(path)] == expected


def test_frames_in_front_of_a_cut_are_read(tmp_path: Path) -> None:
    path = tmp_path / "trace.blf"
    with can.BLFWriter(path, max_container_size=1000) as writer:
        for number in range(100):
            writer(can.Message(timestamp=1.7e9 + number, arbitration_id=number))
    path.write_bytes(path.read_bytes()[:-20])
    found: list[Frame] = []
    with pytest.raises(UsageError, match="is not a trace") as caught:
        found.extend(frame for _, frame in read_trace(path))
    assert "ends within an object" in caught.value.cause
    assert "after frame" in caught.value.where


@pytest.mark.parametrize("mode", ["wal", "delete"])
def test_a_database_that_is_still_written_is_read_whole_and_left_alone(
    tmp_path: Path, mode: str
) -> None:
    """What SQLite holds beside the file belongs to it; nothing beside it comes or goes."""
    path = tmp_path / "trace.db"
    with closing(sqlite3.connect(path, isolation_level=None)) as writer:
        writer.execute(f"PRAGMA journal_mode = {mode}")
        writer.execute(
            "CREATE TABLE messages (ts REAL, arbitration_id INTEGER, extended INTEGER,"
            " remote INTEGER, error INTEGER, dlc INTEGER, data BLOB)"
        )
        row = (1.0, 0x752, 0, 0, 0, 2, b"ab")
        writer.execute("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        if mode == "delete":
            writer.execute("PRAGMA cache_size = 1")
            writer.execute("BEGIN")  # as of a program that was killed here
            writer.executemany("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", [row] * 5000)
        before = {each.name: each.read_bytes() for each in tmp_path.iterdir()}
        assert len(before) > 1
        assert [frame.data for _, frame in read_trace(path)] == [b"ab"]
        assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == before


def test_a_database_of_python_can_is_read_to_its_last_row(tmp_path: Path) -> None:
    """Its writer drops what is still queued when it is stopped: `num_frames` are in the file."""
    path = tmp_path / "trace.db"
    writer = can.SqliteWriter(path)
    for number in range(12_000):
        kind = number % 4
        writer(
            can.Message(
                timestamp=1.7e9 + number / 1000,
                arbitration_id=number % 0x700,
                is_extended_id=kind == 1,
                is_remote_frame=kind == 2,
                is_fd=kind == 3,
                data=(b"ab", b"", None, bytes(64))[kind],
            )
        )
    writer.stop()
    assert 500 < writer.num_frames <= 12_000
    read = [at for at, _ in read_trace(path)]
    written = range(writer.num_frames)
    assert read == [1.7e9 + number / 1000 for number in written if number % 4 != 3]


@pytest.mark.parametrize("error", [0, 1])
def test_a_remote_frame_of_a_database_has_no_data_even_if_its_row_has(
    tmp_path: Path, error: int
) -> None:
    path = tmp_path / "trace.db"
    can.SqliteWriter(path).stop()
    with closing(sqlite3.connect(path)) as connection, connection:
        row = (1.0, 0x752, 0, 1, error, 8, bytes(8))
        connection.execute("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", row)
    assert [frame for _, frame in read_trace(path)] == [
        Frame(0x752, b"", is_remote=True, is_error=bool(error))
    ]


def test_a_format_whose_package_is_missing_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("can.io.mf4.asammdf", None)
    monkeypatch.setitem(sys.modules, "asammdf", None)
    path = tmp_path / "trace.mf4"
    path.write_bytes(b"MDF     4.10")
    with pytest.raises(UsageError, match="needs a package that is not installed"):
        list(read_trace(path))


def test_a_byte_order_mark_of_a_text_does_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "trace.log"
    path.write_bytes(b"\xef\xbb\xbf(1.0) can0 752#00\r\n")
    assert [frame.data for _, frame in read_trace(path)] == [b"\0"]


def test_a_recording_that_grows_faster_than_it_is_read_has_an_end(tmp_path: Path) -> None:
    path = tmp_path / "trace.log"
    path.write_bytes(b"(1.0) can0 752#00\n" * 2000)
    count = 0
    for _ in read_trace(path):
        count += 1
        with path.open("ab") as file:
            file.write(b"(2.0) can0 752#00\n" * 2)
    assert count == 2000


@pytest.mark.slow
def test_a_measurement_file_that_ends_the_process_of_its_library_is_refused() -> None:
    """Fuzzing found it: asammdf ends with a segmentation fault."""
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    with pytest.raises(UsageError) as caught:
        list(read_trace(Path(__file__).parent / "damaged.mf4"))
    assert "it is damaged" in caught.value.cause


@pytest.mark.slow
@pytest.mark.parametrize("data", [b"", b"MDF     4.10", b"MDF     4.10    " + bytes(200)])
def test_an_invalid_measurement_file_is_refused_with_its_cause(tmp_path: Path, data: bytes) -> None:
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    path = tmp_path / "trace.mf4"
    path.write_bytes(data)
    with pytest.raises(UsageError) as caught:
        list(read_trace(path))
    assert "not a measurement file of version 4" in caught.value.cause
