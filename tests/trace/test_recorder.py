"""The recorder: every frame of both directions in a file, whatever the clocks and the disk do."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import can
import pytest

from flasher.errors import ExitCode, UsageError
from flasher.protocol.frame import Frame
from flasher.trace.recorder import Recorder, message_of, writer_of
from tests.loops import each

SENT = Frame(0x752, b"\x55\xaa\x16\x07")
RECEIVED = Frame(0x725, b"\x55\xaa\x13\x05\x55\x03\x42\x05")
DEV_FULL = Path("/dev/full")


def record(path: Path, *frames: tuple[float, bool, Frame]) -> None:
    with Recorder(path) as recorder:
        for now, sent, frame in frames:
            recorder(frame, sent=sent, now=now)


def read(path: Path) -> Sequence[can.Message]:
    with can.LogReader(path) as reader:
        return list(reader)


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".log", ".trc", ".asc.gz"])
def test_frames_of_both_directions_are_recorded_in_order(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    record(path, (5.0, True, SENT), (5.25, False, RECEIVED))
    first, second = read(path)
    assert (first.arbitration_id, bytes(first.data)) == (0x752, SENT.data)
    assert (second.arbitration_id, bytes(second.data)) == (0x725, RECEIVED.data)
    assert second.timestamp - first.timestamp == pytest.approx(0.25, abs=0.001)


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_the_direction_is_in_the_file_where_the_format_has_it(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    record(path, (5.0, True, SENT), (5.25, False, RECEIVED))
    assert [message.is_rx for message in read(path)] == [False, True]


def test_a_log_is_what_candump_writes(tmp_path: Path) -> None:
    """Without letters for the direction, with which Wireshark does not know it for one."""
    path = tmp_path / "trace.log"
    record(
        path,
        (1.0, True, SENT),
        (2.0, False, Frame(0x18DA00F1, b"\x01", is_extended=True)),
        (3.0, False, Frame(0x725, b"", is_remote=True)),
        (4.0, False, Frame(0, b"", is_error=True)),
    )
    reported = [line.partition(") ")[2] for line in path.read_text(encoding="ascii").splitlines()]
    assert reported == [
        f"can0 752#{SENT.data.hex().upper()}",
        "can0 18DA00F1#01",
        "can0 725#R",
        "can0 20000080#0000000000000000",
    ]


@each(
    "channel, name",
    [
        ("can2", "can2"),
        ("PCAN_USBBUS1", "PCAN_USBBUS1"),
        ("/dev/ttyACM0@115200", "ttyACM0_115200"),
        ("239.74.163.2", "239.74.163.2"),
        ("a channel\n(1.0) x", "a_channel__1.0_"),
        ("", "can0"),
    ],
)
def test_a_log_names_the_channel_in_one_word_that_can_utils_take(
    tmp_path: Path, channel: str, name: str
) -> None:
    path = tmp_path / "trace.log"
    with Recorder(path) as recorder:
        recorder.channel = channel
        recorder(SENT, sent=True, now=1.0)
    assert path.read_text(encoding="ascii").split()[1] == name
    assert [message.arbitration_id for message in read(path)] == [SENT.can_id]


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".log"])
def test_extended_remote_and_error_frames_are_recorded_for_what_they_are(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"trace{suffix}"
    record(
        path,
        (1.0, False, Frame(0x18DA00F1, b"\x01", is_extended=True)),
        (2.0, False, Frame(0x725, b"", is_remote=True)),
        (3.0, False, Frame(0x000, b"", is_error=True)),
        (4.0, False, Frame(0x725, b"")),
    )
    extended, remote, error, empty = read(path)
    assert extended.is_extended_id
    assert extended.arbitration_id == 0x18DA00F1
    assert remote.is_remote_frame
    assert error.is_error_frame
    assert (empty.is_extended_id, empty.is_remote_frame, empty.is_error_frame) == (False,) * 3
    assert len(empty.data) == 0


def test_a_database_holds_every_frame_and_none_of_the_recording_before(tmp_path: Path) -> None:
    path = tmp_path / "trace.db"
    for count in (10, 2_501):
        record(path, *((at / 1000, True, SENT) for at in range(count)))
        assert len(read(path)) == count


def test_a_database_that_cannot_be_written_any_more_ends_the_recording_and_states_why(
    tmp_path: Path,
) -> None:
    writer = writer_of(tmp_path / "trace.db")
    writer.stop()
    with pytest.raises(OSError, match="closed database"):
        writer(message_of(SENT, sent=True, at_s=0.0))


def test_a_disk_that_fills_up_leaves_what_a_database_held_before_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def small(*arguments: Any, **options: Any) -> sqlite3.Connection:
        connection: sqlite3.Connection = connect(*arguments, **options)
        connection.execute("PRAGMA max_page_count = 20")
        return connection

    connect = sqlite3.connect
    monkeypatch.setattr("flasher.trace.recorder.sqlite3.connect", small)
    with Recorder(tmp_path / "trace.db") as recorder:
        for at in range(5_000):
            recorder(SENT, sent=True, now=at / 1000)
    monkeypatch.undo()
    assert recorder.failure == "database or disk is full"
    assert len(read(tmp_path / "trace.db")) >= 500


def test_the_recorded_frames_keep_their_spacing_though_the_wall_clock_jumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TM-04."""
    wall = [1_700_000_000.0]
    monkeypatch.setattr("flasher.trace.recorder.time.time", lambda: wall[0])
    path = tmp_path / "trace.log"
    with Recorder(path) as recorder:
        recorder(SENT, sent=True, now=100.0)
        wall[0] -= 3600.0
        recorder(RECEIVED, sent=False, now=100.5)
        wall[0] += 86_400.0
        recorder(SENT, sent=True, now=101.0)
    times = [message.timestamp for message in read(path)]
    assert times == pytest.approx([1_700_000_000.0, 1_700_000_000.5, 1_700_000_001.0])


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".csv", ".db", ".log", ".trc"])
def test_closing_twice_is_harmless(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    recorder = Recorder(path)
    with recorder:
        recorder(SENT, sent=True, now=1.0)
        recorder(SENT, sent=True, now=2.0)
    recorder.__exit__(None, None, None)
    assert len(read(path)) == 2


def test_an_error_in_the_block_is_handed_on_and_the_file_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "trace.blf"

    def fail() -> NoReturn:
        with Recorder(path) as recorder:
            recorder(SENT, sent=True, now=1.0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert len(read(path)) == 1


# -- what goes wrong ------------------------------------------------------------------------------


def test_a_suffix_without_a_format_names_those_that_have_one(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no trace format has this suffix") as caught:
        Recorder(tmp_path / "trace.xyz")
    assert ".asc" in caught.value.remedy
    assert caught.value.exit_code == ExitCode.USAGE


def test_a_file_that_cannot_be_made_is_wrong_usage(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written: its folder does not exist"):
        Recorder(tmp_path / "no" / "trace.asc")
    (tmp_path / "folder.asc").mkdir()
    with pytest.raises(UsageError, match=r"folder\.asc cannot be written"):
        Recorder(tmp_path / "folder.asc")


@pytest.mark.slow
@pytest.mark.parametrize("error", [NotImplementedError, ImportError])
def test_a_format_whose_package_is_missing_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    """python-can's .mf4 needs a package of its own."""

    def missing(_path: str) -> NoReturn:
        raise error("The asammdf package was not found.")

    monkeypatch.setattr("flasher.trace.recorder.can.Logger", missing)
    with pytest.raises(UsageError, match="not installed") as caught:
        Recorder(tmp_path / "trace.mf4")
    assert "asammdf" in caught.value.cause


class FullDisk:
    """A writer whose disk fills up after some messages."""

    def __init__(self, messages: int) -> None:
        self.left = messages

    def __call__(self, _message: can.Message) -> None:
        if not self.left:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.left -= 1

    def stop(self) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_disk_that_fills_up_ends_the_recording_and_states_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.trace.recorder.can.Logger", lambda _path: FullDisk(1))
    with Recorder(tmp_path / "trace.asc") as recorder:
        for number in range(3):
            recorder(SENT, sent=True, now=float(number))
    assert recorder.failure == "No space left on device"


def test_a_recording_that_cannot_be_closed_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.trace.recorder.can.Logger", lambda _path: FullDisk(100))
    with Recorder(tmp_path / "trace.asc") as recorder:
        recorder(SENT, sent=True, now=1.0)
    assert recorder.failure == "No space left on device"


def test_a_whole_recording_has_no_failure(tmp_path: Path) -> None:
    with Recorder(tmp_path / "trace.asc") as recorder:
        recorder(SENT, sent=True, now=1.0)
    assert recorder.failure is None


@pytest.mark.skipif(not DEV_FULL.exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("suffix", [".log", ".asc", ".csv"])
def test_a_real_full_disk_is_noticed_while_recording(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"trace{suffix}"
    path.symlink_to(DEV_FULL)

    with Recorder(path) as recorder:
        for number in range(10_000):
            recorder(SENT, sent=True, now=number * 0.001)
    assert recorder.failure is not None


@each(
    "name, shown",
    [("no\x1b[2J/x.log", "no\\x1b[2J/x.log"), ("x\x1b.y", "x\\x1b.y"), ("", "''")],
)
def test_a_name_that_cannot_be_written_is_shown_harmlessly(name: str, shown: str) -> None:
    with pytest.raises(UsageError) as caught:
        Recorder(name)
    assert caught.value.what.startswith(shown)
