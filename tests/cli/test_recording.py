"""What commands leave of their frames: a trace file, and a bundle when they fail."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from flasher.api import Connection, Device
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.recording import BUNDLE_FOLDER, RecordingOptions, recording
from flasher.errors import (
    BusError,
    ExitCode,
    FlasherError,
    ImageError,
    InterruptedByUserError,
    NoAnswerError,
    UsageError,
)
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS
from flasher.trace.reader import read_trace
from tests.trace.tape import Tape

from .conftest import SAMPLES, Flasher

MOCK = ("--mock", "--mock-speed", "0")
NOTHING = RecordingOptions()


@pytest.fixture(autouse=True)
def command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["flasher", "flash", "a b", "\x1b"])


def bundles(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.exists() else []


def report_of(bundle: Path) -> dict[str, Any]:
    loaded = json.loads((bundle / "report.json").read_text())
    assert isinstance(loaded, dict)
    return loaded


def test_a_trace_names_the_channel_that_was_opened(tmp_path: Path) -> None:
    path = tmp_path / "trace.log"
    clock = VirtualClock()
    connection = Connection(SimulatedBus(250_000, clock).link(), clock, "socketcan can2")
    options = RecordingOptions(trace_file=str(path))
    with recording(options, Bus(), Output(), target=BMS) as record:
        record.opened(replace(connection, channel="can2"))
        record.taps[0](Frame(0x752, b"x"), sent=True, now=0.0)
    assert path.read_text().split()[1] == "can2"


def run_into(
    error: BaseException, options: RecordingOptions = NOTHING, *, only_asks: bool = False
) -> None:
    def command() -> None:
        with recording(options, Bus(), Output(), target=BMS) as record:
            record.only_asks = only_asks
            for at, frame in Tape().to_packet(3).packet(3):
                for tap in record.taps:
                    tap(frame, sent=frame.can_id == 0x752, now=at)
            raise error

    with pytest.raises(type(error)) as raised:
        command()
    assert raised.value is error


def test_a_failure_on_the_bus_leaves_a_bundle_and_states_where(
    bundle_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_into(NoAnswerError("Nobody.", where="packet 3", cause="no power", remedy="Switch on."))
    (bundle,) = bundles(bundle_folder)
    assert capsys.readouterr().err == f"bundle: {bundle}\n"
    report = report_of(bundle)
    assert report["error"] == {
        "kind": "NoAnswerError", "exit_code": 5, "what": "Nobody.", "where": "packet 3",
        "cause": "no power", "remedy": "Switch on.", "command": "",
    }  # fmt: skip
    assert report["command_line"] == ["flasher", "flash", "a b", r"\x1b"]
    assert (report["target"], report["bitrate_bps"]) == ("bms", 250_000)
    assert report["bitrate_source"] == "the dialect's"
    assert report["link"]["packets"] == 3
    assert "packet: number 3" in (bundle / "transcript.txt").read_text()


@pytest.mark.parametrize(
    "error",
    [
        UsageError("x"),
        ImageError("x"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_explains_itself_leaves_none(error: BaseException, bundle_folder: Path) -> None:
    run_into(error)
    assert bundles(bundle_folder) == []


@pytest.mark.parametrize("error", [InterruptedByUserError("Stopped."), KeyboardInterrupt()])
def test_what_was_interrupted_leaves_one_too(error: BaseException, bundle_folder: Path) -> None:
    run_into(error)
    (bundle,) = bundles(bundle_folder)
    assert report_of(bundle)["error"]["exit_code"] == ExitCode.INTERRUPTED
    assert bundle.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("error", [InterruptedByUserError("Stopped."), KeyboardInterrupt()])
def test_an_interrupted_query_does_not_take_the_place_of_the_last_failure(
    error: BaseException, bundle_folder: Path
) -> None:
    run_into(error, only_asks=True)
    assert bundles(bundle_folder) == []
    run_into(NoAnswerError("Nobody."), only_asks=True)
    assert len(bundles(bundle_folder)) == 1


def test_what_fails_before_a_frame_was_sent_or_received_leaves_nothing(
    flasher: Flasher, bundle_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    image = str(SAMPLES / "bms.bin")
    for words in (("flash", image, "-t", "bms"), ("info", "-t", "bms"), ("scan",)):
        run = flasher(*words)
        assert run.code == ExitCode.BUS
        assert "bundle" not in run.err
    assert bundles(bundle_folder) == bundles(tmp_path) == []


@pytest.mark.slow
def test_the_users_own_folder_keeps_the_last_fifty_and_explain_finds_the_latest(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, work = tmp_path / "state", tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.delenv(BUNDLE_FOLDER)
    monkeypatch.setenv("XDG_STATE_HOME", str(state))
    none_yet = flasher("explain", "--last")
    assert none_yet.code == ExitCode.USAGE
    assert "There is no bundle in" in none_yet.err
    for number in range(53):
        run_into(BusError(f"failure {number}"))
    folder = state / "flasher" / "bundles"
    assert len(bundles(folder)) == 50
    assert folder.stat().st_mode & 0o777 == 0o700
    assert "failure 52" in flasher("explain", "--last").out
    assert bundles(work) == []
    run_into(BusError("elsewhere"), RecordingOptions(bundle_dir=work))
    assert len(bundles(work)) == 1
    both = flasher("explain", "--last", work)
    assert (both.code, flasher("explain").code) == (ExitCode.USAGE, ExitCode.USAGE)


def test_a_bundle_of_before_is_still_explained(flasher: Flasher, bundle_folder: Path) -> None:
    run_into(BusError("x"))
    (bundle,) = bundles(bundle_folder)
    with can.Logger(bundle / "trace.log") as log, can.LogReader(bundle / "trace.blf") as messages:
        for message in messages:
            log(message)
    printed = flasher("explain", bundle).out.splitlines()
    (bundle / "trace.blf").unlink()
    assert flasher("explain", bundle).out.splitlines()[:8] == printed[:8]
    assert "reported then: exit code 4" in printed


def test_a_bug_leaves_a_bundle_with_its_traceback(bundle_folder: Path) -> None:
    run_into(ZeroDivisionError("oops"))
    error = report_of(bundles(bundle_folder)[0])["error"]
    assert (error["exit_code"], error["what"]) == (1, "oops")
    assert any("raise error" in line for line in error["traceback"])


def test_a_failure_that_is_returned_can_be_handed_in(bundle_folder: Path) -> None:
    with recording(NOTHING, Bus(), Output()) as record:
        record.flight(Frame(0x752, b""), sent=True, now=1.0)
        record.facts["outcome"] = {"ending": "refused"}
        record.failed(FlasherError("x"))
    (bundle,) = bundles(bundle_folder)
    assert bundle.name.startswith("flasher-bus-")
    assert report_of(bundle)["outcome"] == {"ending": "refused"}


def test_success_leaves_none(bundle_folder: Path) -> None:
    with recording(NOTHING, Bus(), Output(), target=BMS) as record:
        assert record.link_report() is None
    assert bundles(bundle_folder) == []


def test_no_bundle_leaves_none(bundle_folder: Path) -> None:
    run_into(BusError("x"), RecordingOptions(no_bundle=True))
    assert bundles(bundle_folder) == []


def test_the_option_goes_before_the_environment(tmp_path: Path, bundle_folder: Path) -> None:
    run_into(BusError("x"), RecordingOptions(bundle_dir=tmp_path / "here"))
    assert len(bundles(tmp_path / "here")) == 1
    assert bundles(bundle_folder) == []


def test_a_folder_that_cannot_be_written_is_one_warning_and_the_error_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_bytes(b"")
    run_into(BusError("x"), RecordingOptions(bundle_dir=tmp_path / "file"))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"warning: no bundle in {tmp_path / 'file'}: ")


def test_a_trace_file_holds_both_directions(tmp_path: Path) -> None:
    path = tmp_path / "trace.asc"
    with recording(RecordingOptions(trace_file=str(path)), Bus(), Output()) as record:
        for tap in record.taps:
            tap(Frame(0x752, b"\x01"), sent=True, now=1.0)
            tap(Frame(0x725, b"\x02"), sent=False, now=2.0)
    lines = [line.split() for line in path.read_text().splitlines() if " d " in line]
    assert [(words[2], words[3]) for words in lines] == [("752", "Tx"), ("725", "Rx")]


def test_the_echoes_of_an_adapter_are_in_neither_trace_nor_bundle_nor_figures(
    tmp_path: Path, bundle_folder: Path
) -> None:
    """An interface such as udp_multicast hears its own frames: they are no repetitions."""
    path, tape = tmp_path / "trace.log", Tape().to_packet(7)
    with recording(RecordingOptions(trace_file=str(path)), Bus(), Output(), target=BMS) as record:
        for now, frame in tape.frames:
            is_own = frame.can_id == BMS.request_id
            for tap in record.taps:
                tap(frame, sent=is_own, now=now)
                if is_own:
                    tap(frame._replace(is_echo=True), sent=False, now=now + 0.0001)
        link = record.link_report()
        record.failed(NoAnswerError("x"))
    assert link is not None
    assert link.repetitions == 0
    assert link.device_answer is not None
    (bundle,) = bundles(bundle_folder)
    assert len(path.read_text().splitlines()) == len(tape.frames)
    assert len(list(read_trace(bundle / "trace.blf"))) == len(tape.frames)


def test_a_trace_file_that_cannot_be_written_is_wrong_usage(bundle_folder: Path) -> None:
    with (
        pytest.raises(UsageError),
        recording(RecordingOptions(trace_file="/nowhere/x"), Bus(), Output()),
    ):
        pytest.fail("it began all the same")
    assert bundles(bundle_folder) == []


@pytest.mark.parametrize("name", ["image.log", "folder/../image.log", "link.log"])
def test_a_trace_never_replaces_the_image(flasher: Flasher, tmp_path: Path, name: str) -> None:
    """The suffix does not matter to an image: its content tells what it is."""
    image = tmp_path / "image.log"
    image.write_bytes((SAMPLES / "obc.bin").read_bytes())
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.log").symlink_to(image)
    run = flasher(
        "flash", image, "-t", "obc", "--mock", "--mock-speed", "0", "--trace-file", tmp_path / name
    )
    assert run.code == ExitCode.USAGE
    assert "is a file of the command itself" in run.err
    assert image.read_bytes() == (SAMPLES / "obc.bin").read_bytes()


@pytest.mark.parametrize(
    "words",
    [
        ("info", "-t", "bms"),
        ("read", "version-information"),
        ("read", "memory", "0x8004000", "0x8004080"),
        ("write", "user-string-1", "rack", "--yes"),
        ("scan",),
    ],
    ids=" ".join,
)
def test_commands_record_what_they_ask(
    words: tuple[str, ...], flasher: Flasher, tmp_path: Path, bundle_folder: Path
) -> None:
    trace = tmp_path / "trace.asc"
    assert flasher(*words, *MOCK, "--trace-file", trace).code == 0
    assert bundles(bundle_folder) == []
    assert "752" in trace.read_text() or words == ("scan",)
    printed = flasher("explain", trace)
    assert "verdict: no upgrade, but drive-system traffic" in printed.out


def test_a_silent_device_leaves_a_bundle_that_is_explained(
    flasher: Flasher, bundle_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(device: Device, _name: str) -> None:
        for tap in device._watch["taps"]:
            tap(Frame(0x752, b""), sent=True, now=1.0)
        raise NoAnswerError("The BMS did not answer.", remedy="Wake it.")

    monkeypatch.setattr(Device, "read", silent)
    run = flasher("read", "version-information", *MOCK)
    assert run.code == 5
    (bundle,) = bundles(bundle_folder)
    assert f"bundle: {bundle}" in run.err
    printed = flasher("explain", bundle)
    assert printed.code == 0
    assert "reported then: exit code 5" in printed.out
    assert "flasher read version-information --mock" in printed.out
    assert "The BMS did not answer." in printed.out


@pytest.mark.slow
def test_an_existing_trace_file_is_overwritten_only_on_request(
    flasher: Flasher, short_bms: Path, tmp_path: Path
) -> None:
    trace = tmp_path / "kept.asc"
    trace.write_text("evidence\n")
    words = ("flash", short_bms, "-t", "bms", "--mock", "--mock-speed", "0", "--trace-file", trace)
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "exists already" in run.err
    assert trace.read_text() == "evidence\n"
    assert flasher(*words, "--force").code == ExitCode.USAGE, "it waives checks alone"
    assert trace.read_text() == "evidence\n"
    run = flasher(*words, "--overwrite-trace", "--json")
    assert run.code == ExitCode.OK
    assert not [check for check in run.document["checks"] if check["verdict"] == "waived"]
    assert "evidence" not in trace.read_text()
    trace.write_text("")
    assert flasher(*words).code == ExitCode.OK
