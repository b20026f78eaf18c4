"""`flasher export`: what it writes, and what it says when it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.trace.reader import read_trace
from tests.cli.conftest import Flasher
from tests.export.tshark import write_capture
from tests.trace.tape import Tape


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """An upgrade with a NAK, a damaged packet and an unanswered packet."""
    tape = Tape().to_packet(4).damaged_packet(4).nak(4).packet(4).wait(0.6)
    return tape.packet(4).ack(4).packets(5, 10).end().complete().save(tmp_path / "trace.blf")


# -- wireshark ------------------------------------------------------------------------------------


def test_the_dissector_goes_to_a_file_or_to_standard_output(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "welling.lua"
    ran = flasher("export", "wireshark", "-o", path)
    assert ran.code == ExitCode.OK
    assert f"{path}: " in ran.out
    script = path.read_text(encoding="utf-8")
    assert "welling.dissector" in script
    assert flasher("export", "wireshark").out == script


def test_json_needs_a_file(flasher: Flasher, tmp_path: Path) -> None:
    assert flasher("export", "wireshark", "--json").code == ExitCode.USAGE
    path = tmp_path / "welling.lua"
    document = flasher("export", "wireshark", "-o", path, "--json").document
    assert document["file"] == str(path)
    assert document["size_bytes"] == path.stat().st_size


@pytest.mark.parametrize("content", [b"", b"this is no trace\n"])
@pytest.mark.parametrize("to", ["trace out.blf", "trace --joined out.blf", "csv out.csv"])
def test_a_file_without_a_frame_is_reported(
    flasher: Flasher, tmp_path: Path, content: bytes, to: str
) -> None:
    (tmp_path / "empty.asc").write_bytes(content)
    *action, name = to.split()
    ran = flasher("export", *action, tmp_path / "empty.asc", "-o", tmp_path / name)
    assert ran.code == ExitCode.OK
    assert "no classic CAN frame in" in ran.err
    assert "its format does not match its suffix" in ran.err


def test_joined_frames_are_not_called_an_empty_trace(
    flasher: Flasher, trace: Path, tmp_path: Path
) -> None:
    joined = tmp_path / "joined.log"
    flasher("export", "trace", trace, "--joined", "-o", joined)
    assert "only CAN FD frames" in flasher("export", "csv", joined).err
    story = flasher("explain", joined).out
    assert "The trace holds no classic CAN frame." in story
    assert "only CAN FD frames" in " ".join(story.split())


def test_a_trace_without_a_wanted_message_is_no_empty_one(
    flasher: Flasher, trace: Path, tmp_path: Path
) -> None:
    ran = flasher("export", "csv", trace, "--message", "history", "-o", tmp_path / "out.csv")
    assert ": 0 messages" in ran.out
    assert ran.err == ""


# -- trace ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".pcapng", ".log", ".asc", ".blf", ".csv", ".trc", ".asc.gz"])
def test_a_trace_is_the_same_in_another_format(
    flasher: Flasher, trace: Path, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"other{suffix}"
    ran = flasher("export", "trace", trace, "-o", path)
    assert ran.code == ExitCode.OK, ran.err
    before, after = list(read_trace(trace)), list(read_trace(path))
    assert [frame for _, frame in after] == [frame for _, frame in before]
    steps = [at - before[0][0] for at, _ in before]
    assert [at - after[0][0] for at, _ in after] == pytest.approx(steps, abs=0.002)
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted((trace.name, path.name))


def test_remarks_stand_where_something_went_wrong(
    flasher: Flasher, trace: Path, tmp_path: Path
) -> None:
    path = tmp_path / "trace.pcapng"
    document = flasher("export", "trace", trace, "-o", path, "--json").document
    assert document["remarks"] == 4
    assert document["frames"] == len(list(read_trace(trace)))
    raw = path.read_bytes()
    for reported in (
        b"NAK: number 4", b"damaged bytes: reason wrong CRC", b"not answered",
        b"BMS, end of the upgrade: The BMS has every packet",
    ):  # fmt: skip
        assert raw.count(reported) == 1, reported


def test_a_trace_that_is_cut_off_is_written_up_to_there(flasher: Flasher, tmp_path: Path) -> None:
    cut = write_capture(tmp_path / "trace.pcapng", Tape().to_end().complete())
    cut.write_bytes(cut.read_bytes()[:-7])
    ran = flasher("export", "trace", cut, "-o", tmp_path / "out.log")
    assert ran.code == ExitCode.OK
    assert "ends there" in ran.err
    whole = len(Tape().to_end().complete().frames)
    assert len(list(read_trace(tmp_path / "out.log"))) == whole - 1


@pytest.mark.parametrize(
    ("name", "reported"),
    [
        ("out.xyz", "no trace format has this suffix"),
        ("out.pcap", "no trace format has this suffix"),
        ("none/out.log", "its folder does not exist"),
        ("trace.blf", "a file of the command itself"),
    ],
)
def test_what_cannot_be_written_is_reported(
    flasher: Flasher, trace: Path, tmp_path: Path, name: str, reported: str
) -> None:
    before = trace.read_bytes()
    ran = flasher("export", "trace", trace, "-o", tmp_path / name)
    assert ran.code == ExitCode.USAGE
    assert reported in ran.err
    assert str(tmp_path / name) in ran.err
    assert [each.name for each in tmp_path.iterdir()] == [trace.name]
    assert trace.read_bytes() == before


def test_a_disk_that_is_full_leaves_the_older_file(
    flasher: Flasher, trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("flasher.trace.recorder.CandumpWriter.__call__", full)
    older = tmp_path / "out.log"
    older.write_text("older")
    ran = flasher("export", "trace", trace, "-o", older)
    assert ran.code == ExitCode.USAGE
    assert "No space left on device" in ran.err
    assert older.read_text() == "older"
    assert len(list(tmp_path.iterdir())) == 2


def test_an_export_needs_to_be_named(flasher: Flasher) -> None:
    assert flasher("export").code == ExitCode.USAGE
    ran = flasher("export", "wiresharc")
    assert ran.code == ExitCode.USAGE
    assert "Did you mean wireshark?" in ran.err


def test_the_folder_of_a_bundle_is_read_as_its_trace(
    flasher: Flasher, trace: Path, tmp_path: Path
) -> None:
    bundle = tmp_path / "flasher-bms"
    bundle.mkdir()
    trace.rename(bundle / "trace.blf")
    assert flasher("export", "trace", bundle, "-o", tmp_path / "out.pcapng").code == ExitCode.OK
    assert flasher("export", "csv", bundle, "-o", tmp_path / "out.csv").code == ExitCode.OK
    frames = [frame for _, frame in read_trace(tmp_path / "out.pcapng")]
    assert frames == [frame for _, frame in read_trace(bundle / "trace.blf")]
    (bundle / "trace.blf").unlink()
    ran = flasher("export", "trace", bundle, "-o", tmp_path / "out.log")
    assert ran.code == ExitCode.USAGE
    assert "is a folder, but not a bundle" in ran.err
