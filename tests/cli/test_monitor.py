"""`flasher monitor`: lines, JSON lines and the table, of traces and of live buses."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import can
import pytest
from rich.console import Console, ConsoleDimensions

from flasher.cli.look.monitor_views import BoardView
from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from flasher.trace.decoder import BusEvent
from flasher.trace.recorder import Recorder
from flasher.trace.watcher import MessageTable, Watcher, replay
from tests.cli.conftest import Flasher
from tests.loops import each
from tests.peers.wording import REPORT
from tests.trace import traffic

OTHER = b"\x9f\x8c" + traffic.RUNNING_DATA[2:]
HOSTILE = b"[red]\x1b[2J.".ljust(16) + bytes(48)


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """A recorded trace: running information twice, a handshake, a NAK, version information."""
    path = tmp_path / "trace.asc"
    messages = [
        traffic.running(),
        traffic.running(OTHER),
        traffic.handshake(),
        traffic.nak(),
        traffic.frames(0x720, REPORT, 0x1540, HOSTILE),
        [Frame(0x123, b"abc")],
    ]
    with Recorder(path) as record:
        for number, frames in enumerate(messages):
            for frame in frames:
                record(frame, sent=False, now=number / 2)
    return path


def documents(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


# -- traces ----------------------------------------------------------------------------------------


def test_a_trace_is_one_line_a_message_with_units_and_changes(
    flasher: Flasher, trace: Path
) -> None:
    run = flasher("monitor", trace)
    assert run.code == ExitCode.OK
    lines = run.out.splitlines()
    assert len(lines) == 6
    assert lines[0] == (
        "     0.000  720  BMS > all  running information: voltage 36000 mV, mean current -1000 mA, "
        "remaining capacity 9000 mAh, full-charge capacity 10400 mAh, cell temperature 25 °C, "
        "state of charge 80 %, status charger connected, state of health 98 %"
    )
    assert lines[1].startswith(
        "     0.500  720  BMS > all  running information: *voltage 35999 mV, mean current"
    )
    assert lines[2] == "     1.000  712  WMC > BMS  handshake: text HANDSHAKE"
    assert lines[3] == "     1.500  725  BMS > CDL  ! NAK: number 1"
    assert lines[5] == "     2.500  123             foreign frame: data 61 62 63"
    assert "6 messages shown of" in run.err
    assert "1 with trouble" in run.err


def test_device_text_reaches_no_terminal_unescaped(flasher: Flasher, trace: Path) -> None:
    run = flasher("monitor", trace)
    assert "\x1b" not in run.out
    assert r"[red]\x1b[2J" in run.out


@pytest.mark.parametrize(
    ("words", "titles"),
    [
        (("--node", "wmc"), ["handshake"]),
        (("--node", "MC"), ["handshake"]),
        (("--node", "cdl", "--node", "wmc"), ["handshake", "NAK"]),
        (("--message", "Running"), ["running information"] * 2),
        (("--errors",), ["NAK"]),
        (("--count", "1"), ["running information"]),
        (("--duration", "1.2"), ["running information", "running information", "handshake"]),
    ],
)
def test_filters_and_limits(
    flasher: Flasher, trace: Path, words: tuple[str, ...], titles: list[str]
) -> None:
    *shown, end = documents(flasher("monitor", trace, "--json", *words).out)
    assert [document["message"] for document in shown] == titles
    assert end["messages"] == len(titles)


def test_json_lines_hold_typed_fields_and_end_with_the_exit_code(
    flasher: Flasher, trace: Path
) -> None:
    first, second, *_, end = documents(flasher("monitor", trace, "--json").out)
    assert first["fields"]["voltage_mv"] == 36000
    assert first["fields"]["status"] == ["charger connected"]
    assert (first["from"], first["to"], first["can_id"]) == ("BMS", "all", 0x720)
    assert (first["command"], first["kind"], first["trouble"]) == (0x1010, "message", False)
    assert (first["changed"], second["changed"]) == ([], ["voltage_mv"])
    assert second["at_s"] == pytest.approx(0.5, abs=0.001)
    assert (end["ok"], end["exit_code"], end["messages"], end["troubles"]) == (True, 0, 6, 1)


def test_raw_shows_every_frame_before_its_message(flasher: Flasher, trace: Path) -> None:
    lines = flasher("monitor", trace, "--raw", "--message", "nak").out.splitlines()
    at = next(number for number, line in enumerate(lines) if "NAK" in line)
    assert lines[at - 2 : at] == [
        "     1.500  725  [8] 55 aa 0c 04 c3 02 01 00",
        "     1.500  725  [5] e8 83 bc 00 f0",
    ]
    shown = documents(flasher("monitor", trace, "--raw", "--json").out)
    assert {"kind": "frame", "can_id": 0x123, "data": "616263"}.items() <= shown[-3].items()


def test_long_values_are_cut_unless_more_is_wanted(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "packet.log"
    with Recorder(path) as record:
        for frame in traffic.frames(0x752, 0x16, 0xA385, b"\x01\x01\x00\x01\x00" + bytes(128)):
            record(frame, sent=True, now=0.0)
    assert flasher("monitor", path).out.count("00 ") < 30
    assert "0 ..." in flasher("monitor", path).out
    assert flasher("monitor", path, "-v").out.count(" 00") == 128


def test_a_table_of_a_trace_is_printed_once(
    flasher: Flasher, trace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("LINES", "60")
    run = flasher("monitor", trace, "--table")
    assert run.out.count("running information") == 1
    assert "\x1b" not in run.out
    assert "state of charge" in run.out


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("none.asc",), "cannot be read"),
        (("none.xyz",), "no trace format has this suffix"),
        (("none.asc", "--mock"), "A trace is read without a bus."),
        (("none.asc", "-i", "virtual"), "A trace is read without a bus."),
        (("--mock", "--message", "runing"), "no message has these words"),
        (("--mock", "--node", "abs"), "there is no node"),
        (("--mock", "--count", "0"), "must be 1 or more"),
        (("--mock", "--lines", "--table"), "do not go together"),
    ],
)
def test_wrong_usage_states_what_is_wrong(
    flasher: Flasher, words: tuple[str, ...], reported: str
) -> None:
    run = flasher("monitor", *words)
    assert run.code == ExitCode.USAGE
    assert run.out == ""
    assert reported in run.err


# -- live ------------------------------------------------------------------------------------------


def test_the_mock_is_watched_for_the_time_that_was_asked_for(flasher: Flasher) -> None:
    run = flasher("monitor", "--mock", "--mock-speed", "0", "--duration", "30", "--json")
    assert run.code == ExitCode.OK
    assert documents(run.out)[-1]["exit_code"] == 0
    assert "watching the built-in mock" in run.err


def test_a_bus_is_watched_and_nothing_is_sent(flasher: Flasher) -> None:
    channel = uuid.uuid4().hex
    with can.Bus(interface="virtual", channel=channel) as other:
        message = can.Message(arbitration_id=0x123, data=b"abc", is_extended_id=False)
        task = other.send_periodic(message, 0.01)
        try:
            run = flasher(
                "monitor", "-i", "virtual", "-c", channel, "--count", "3", "--duration", "20"
            )
        finally:
            task.stop()
        assert other.recv(0.0) is None
    assert run.code == ExitCode.OK
    assert run.out.count("foreign frame") == 3


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_ends_it_with_exit_code_0() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "flasher", "monitor", "--mock", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert "watching" in process.stderr.readline()
    process.send_signal(2)
    out, err = process.communicate(timeout=20)
    assert process.returncode == ExitCode.OK
    assert json.loads(out.splitlines()[-1])["exit_code"] == 0
    assert "Traceback" not in err


@pytest.mark.slow
def test_on_a_terminal_the_table_is_refreshed_without_erasing_anything(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    for name, value in {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "stdout", screen)
    run = flasher("monitor", "--mock", "--mock-speed", "0", "--duration", "2")
    assert run.code == ExitCode.OK
    drawn_ = screen.getvalue()
    assert drawn_.count("the built-in mock: ") >= 8
    assert "\x1b[?1049h" in drawn_
    assert "\x1b[?1049l" in drawn_
    assert "\x1b[2K" not in drawn_
    assert drawn_.count("\x1b[2J") <= 1
    behind = drawn_.rpartition("\x1b[?1049l")[2]
    assert behind.count("the built-in mock: 2.0 s") == 1


# -- the table -------------------------------------------------------------------------------------


def board_of(*messages: Iterable[Frame]) -> MessageTable:
    board = MessageTable()

    def add(event: object) -> None:
        if isinstance(event, BusEvent):
            board.add(event)

    frames = [(number / 2, frame) for number, each in enumerate(messages) for frame in each]
    replay(Watcher(), frames, add)
    return board


def drawn(board: MessageTable, *, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), color_system=None)
    view = BoardView(console).draw(board, 0.6, "title [bold]x[/bold]")
    with console.capture() as capture:
        console.print(view)
    return capture.get().splitlines()


def test_a_high_window_has_a_row_a_field_with_values_and_units_to_the_right() -> None:
    lines = drawn(board_of(traffic.running(), traffic.running(OTHER)), width=120, height=40)
    labels = ("voltage", "full-charge capacity", "state of charge")
    by_label = {label: line for line in lines for label in labels if label in line}
    ends = {label: line.rstrip() for label, line in by_label.items()}
    assert ends["full-charge capacity"].endswith("10400    mAh")
    assert ends["state of charge"].endswith("80      %")
    assert len(ends["full-charge capacity"]) == len(ends["state of charge"])
    assert "*35999     mV" in by_label["voltage"]
    assert "BMS > all" in by_label["voltage"]


def test_text_of_devices_and_of_the_title_is_no_markup() -> None:
    board = board_of(traffic.frames(0x720, REPORT, 0x1540, HOSTILE))
    text = "\n".join(drawn(board, width=120, height=40))
    assert r"[red]\x1b[2J" in text
    assert "title [bold]x[/bold]" in text


def test_a_low_window_has_a_row_a_message() -> None:
    lines = drawn(board_of(traffic.running(), traffic.handshake()), width=120, height=12)
    (row,) = [line for line in lines if "running information" in line]
    assert "voltage 36000 mV, mean current" in row
    assert len(lines) < 12


@pytest.mark.parametrize("width", [80, 120])
def test_no_fault_is_cut_off(flasher: Flasher, tmp_path: Path, width: int) -> None:
    faults = b"\xff" * 4
    board = board_of(
        *(traffic.frames(0x752, 0x11, command << 8, b"") for command in range(0x30, 0x3A)),
        traffic.faults(faults),
    )
    shown = " ".join(line.strip() for line in drawn(board, width=width, height=24))
    assert "bit 31 (not in the document)" in shown
    for name in ("AFE fault", "MCU fault", "MOS over temperature warning"):
        assert name in shown
    with Recorder(tmp_path / "t.asc") as record:
        for frame in traffic.faults(faults):
            record(frame, sent=False, now=0.0)
    for command in ("monitor", "explain"):
        assert "bit 31 (not in the document)" in flasher(command, tmp_path / "t.asc").out


def test_faults_that_have_no_room_are_counted() -> None:
    lines = drawn(board_of(traffic.faults(b"\xff" * 4)), width=80, height=9)
    assert lines[0].strip() == "32 FAULTS: enlarge the window"
    assert len(lines) <= 9


def test_what_the_dialect_does_not_have_is_marked(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "t.asc"
    hmi = traffic.frames(0x742, 0x11, 0x5000, b"")
    goodbye = traffic.frames(0x710, REPORT, 0x1808, b"SHUTDOWN")
    with Recorder(path) as record:
        for frame in (*hmi, *goodbye, *traffic.nak(), *traffic.running()):
            record(frame, sent=False, now=0.0)
    marked = {"welling": ["742 5000"], "motinova": ["710 1808", "725 C302"]}
    for dialect, wanted in marked.items():
        lines = documents(flasher("monitor", path, "--dialect", dialect, "--json").out)[:-1]
        found = [f"{line['can_id']:03X} {line['command']:04X}" for line in lines]
        assert [f for f, line in zip(found, lines, strict=True) if not line["in_dialect"]] == wanted
        shown = flasher("monitor", path, "--dialect", dialect).out.splitlines()
        assert sum("(not in this dialect)" in line for line in shown) == len(wanted)
        table = flasher("monitor", path, "--dialect", dialect, "--table").out
        assert table.count("dialect)") == len(wanted), table


def test_what_has_no_room_is_counted() -> None:
    messages = [traffic.frames(0x752, 0x11, command << 8, b"") for command in range(0x30, 0x3A)]
    lines = drawn(board_of(*messages), width=120, height=10)
    assert any("more: enlarge the window" in line for line in lines)
    assert len(lines) <= 10


@pytest.mark.slow
@each("width", [40, 80, 116, 200])
@each("height", [8, 10, 24, 60])
def test_it_never_exceeds_the_window(width: int, height: int) -> None:
    board = board_of(
        traffic.running(),
        traffic.faults(b"\xff" * 4),
        traffic.frames(0x720, REPORT, 0x1540, HOSTILE),
    )
    lines = drawn(board, width=width, height=height)
    assert len(lines) <= height
    assert all(len(line) <= width for line in lines)


def test_widths_do_not_depend_on_the_values() -> None:
    low, high = bytes(16), b"\xff" * 8 + traffic.RUNNING_DATA[8:]
    heads = {drawn(board_of(traffic.running(d)), width=120, height=40)[2] for d in (low, high)}
    assert len(heads) == 1


def test_a_layout_that_was_too_long_stays_until_the_window_changes() -> None:
    console = Console(width=120, height=15, file=io.StringIO(), color_system=None)
    view = BoardView(console)

    def rows(board: MessageTable) -> int:
        with console.capture() as capture:
            console.print(view.draw(board, 0.0, "title"))
        return len(capture.get().splitlines())

    few = board_of(traffic.running())
    before = rows(few)
    rows(board_of(traffic.running(), traffic.frames(0x720, REPORT, 0x1540, HOSTILE)))
    assert rows(few) < before
    console.size = ConsoleDimensions(120, 16)
    assert rows(few) == before
