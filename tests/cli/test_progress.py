"""How an upgrade goes, as a terminal shows it and as a file keeps it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import pytest

from flasher import events
from flasher.api import make_plan
from flasher.cli.output import Output
from flasher.cli.upgrade.progress import Progress
from flasher.errors import BusError, ExitCode
from flasher.events import Phase
from flasher.host.event_text import reason_text
from flasher.host.table import Reason
from flasher.image.image import Image
from tests.cli.conftest import SAMPLES, Flasher
from tests.end_to_end.processes import FLASHER, clean_environment

pty = pytest.importorskip("pty", reason="there are no pseudo terminals here")

COLUMNS = 100
OBC_BIN = str(SAMPLES / "obc.bin")
PHASES = [
    "resetting the application ...",
    "waiting for the boot version ...",
    "boot version: PBU V1.0.0",
    "waiting for request transfer ...",
    "transferring ...",
    "waiting for the final answer ...",
]


def screen(written: str) -> list[str]:
    """What a terminal shows after `written`: carriage returns write over the line."""
    lines: list[list[str]] = [[]]
    column = 0
    for char in written:
        if char == "\r":
            column = 0
        elif char == "\n":
            lines.append([])
        else:
            line = lines[-1]
            line.extend(" " * (column + 1 - len(line)))
            line[column] = char
            column += 1
    return ["".join(line).rstrip() for line in lines]


@dataclass
class Terminal:
    """A pseudo terminal: `file` is what a process writes to, `read` what it has written."""

    master: int
    file: TextIO

    def read(self) -> str:
        """All that was written; closes the side of the process."""
        self.file.close()
        chunks: list[bytes] = []
        # Linux says EIO at the end, others say nothing.
        while True:
            try:
                chunk = os.read(self.master, 65536)
            except OSError:
                break
            if not chunk:
                break
            chunks.append(chunk)
        return b"".join(chunks).decode()


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    import fcntl  # noqa: PLC0415  exists where pty does
    import struct  # noqa: PLC0415
    import termios  # noqa: PLC0415

    monkeypatch.delenv("NO_COLOR", raising=False)
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 25, COLUMNS, 0, 0))
    opened = Terminal(master, os.fdopen(slave, "w", buffering=1))
    yield opened
    opened.file.close()
    os.close(master)


def flash_on(terminal: Terminal, *words: str, **environment: str) -> tuple[int, str]:
    """A real process whose stderr is the terminal; its exit code and what it wrote there."""
    with subprocess.Popen(
        [*FLASHER, *words],
        stdout=subprocess.DEVNULL,
        stderr=terminal.file,
        env=clean_environment(**environment),
    ) as process:
        written = terminal.read()
    return process.returncode, written


def test_the_wait_for_a_lost_adapter_is_counted_down_in_one_line(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", terminal.file)
    plan = make_plan(Image.from_bytes(bytes(200)), "bms", "welling")
    with Progress(plan, Output()) as show:
        show(events.AdapterLost("unplugged.", 5.0))
        for left_s in (5, 4, 3):
            show(events.AdapterAwaited(left_s))
        show(events.AdapterBack())
    lines = [line for line in screen(terminal.read()) if line]
    assert lines[0] == "warning: unplugged. Waiting 5 s for the adapter ..."
    assert lines[1].startswith("waiting for the adapter, 3 s left |")
    assert lines[2] == "the adapter is back"
    assert len(lines) == 3


# -- a real process on a terminal -----------------------------------------------------------------


@pytest.mark.slow
def test_a_bar_with_bytes_and_rate_appears_and_does_not_tear_the_lines(
    terminal: Terminal,
) -> None:
    code, written = flash_on(terminal, "flash", OBC_BIN, "-t", "obc", "--mock", "--mock-speed", "1")
    assert code == ExitCode.OK
    lines = screen(written)
    shown = lines[lines.index(PHASES[0]) :]
    bar = re.compile(r"OBC: 100%\|█+\| 4\.00k/4\.00k \[00:00<00:00, [\d.]+kB/s\]")
    assert [line for line in shown if line and not bar.fullmatch(line)] == PHASES
    assert [line for line in shown if bar.fullmatch(line)] == [shown[shown.index(PHASES[4]) + 1]]
    # The bar has moved: it was drawn with other figures before.
    assert len(set(re.findall(r"OBC:\s+(\d+)%", written))) > 2
    assert max(map(len, shown)) <= COLUMNS


@pytest.mark.slow
def test_quiet_shows_no_bar_on_a_terminal(terminal: Terminal) -> None:
    code, written = flash_on(
        terminal, "-q", "flash", OBC_BIN, "-t", "obc", "--mock", "--mock-speed", "5"
    )
    assert code == ExitCode.OK
    assert written == ""


@pytest.mark.slow
def test_errors_are_coloured_on_a_terminal_unless_no_color_is_set(
    terminal: Terminal, flasher: Flasher
) -> None:
    bad = str(SAMPLES / "bad" / "no_end.hex")
    code, written = flash_on(terminal, "flash", bad, "-t", "obc", "--mock")
    assert code == ExitCode.IMAGE
    assert written.startswith("\x1b[1;31merror:\x1b[0m ")
    # Away from a terminal there are no colours.
    assert flasher("flash", bad, "-t", "obc", "--mock").err.startswith("error: ")


@pytest.mark.slow
def test_no_color_is_honoured(terminal: Terminal) -> None:
    bad = str(SAMPLES / "bad" / "no_end.hex")
    code, written = flash_on(terminal, "flash", bad, "-t", "obc", "--mock", NO_COLOR="1")
    assert code == ExitCode.IMAGE
    assert "\x1b" not in written
    assert written.startswith("error: ")


def test_an_empty_no_color_does_not_count(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", terminal.file)
    monkeypatch.setenv("NO_COLOR", "")
    Output().failure(BusError("unplugged."))
    assert "\x1b[1;31m" in terminal.read()


# -- events, one by one ---------------------------------------------------------------------------


IMAGE = Image.from_bytes(bytes(1000))
PLAN = make_plan(IMAGE, "bms")
"""Eight packets."""


def show(output: Output, *happened: object) -> None:
    with Progress(PLAN, output) as progress:
        for event in happened:
            progress(event)


def acknowledged(*numbers: int) -> list[events.PacketAcknowledged]:
    return [events.PacketAcknowledged(number, PLAN.total_packets, 1) for number in numbers]


def test_lines_that_come_while_the_bar_is_on_stand_above_it(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", terminal.file)
    show(
        Output(verbosity=2),
        events.PhaseEntered(Phase.TRANSFER, 1),
        *acknowledged(1, 2),
        events.MessageRepeated("packet 3", "not answered", 2),
        *acknowledged(3),
        events.Reported("a second tool is on the bus"),
        events.BytesDamaged(0x725, "bad tail", b"\x55\xaa\x13"),
        *acknowledged(4, 5, 6, 7, 8),
        events.PhaseEntered(Phase.END, 1),
    )
    lines = screen(terminal.read())
    assert lines[:4] == [
        "transferring ...",
        "not answered: sending packet 3 again, try 2",
        "note: a second tool is on the bus",
        "bytes on 0x725 ignored: bad tail: 55 aa 13",
    ]
    assert re.match(r"BMS: 100%\|.*\| 1\.00k/1\.00k \[.*, 1 repeated\]$", lines[4])
    assert lines[5:] == ["waiting for the final answer ...", ""]


def test_a_new_attempt_begins_a_new_bar(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", terminal.file)
    show(
        Output(),
        *acknowledged(1, 2, 3),
        events.AttemptStarted(2, "the device restarted"),
        events.PhaseEntered(Phase.UPDATE, 2),
        *acknowledged(1),
    )
    lines = screen(terminal.read())
    assert [line[:8] for line in lines] == ["BMS:  38", "the devi", "waiting ", "BMS:  13", ""]
    assert lines[1] == "the device restarted: beginning again, attempt 2"


def test_a_terminal_that_goes_away_does_not_end_the_upgrade(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Gone:
        """Says that it is a terminal and takes nothing."""

        encoding = "utf-8"

        def isatty(self) -> bool:
            return True

        def write(self, _text: str) -> int:
            raise OSError(5, "Input/output error")

        def flush(self) -> None:
            raise OSError(5, "Input/output error")

        def fileno(self) -> int:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr("sys.stderr", Gone())
    output = Output()
    show(output, events.PhaseEntered(Phase.TRANSFER, 1), *acknowledged(1, 2, 8))
    output.error_line("this has no reader")


def test_away_from_a_terminal_there_is_one_line_a_phase_and_no_carriage_return(
    flasher: Flasher,
) -> None:
    run = flasher("flash", OBC_BIN, "-t", "obc", "--mock", "--mock-speed", "0")
    lines = run.err.splitlines()
    assert lines[lines.index(PHASES[0]) :] == PHASES
    assert "\r" not in run.err
    assert "\x1b" not in run.err


@pytest.mark.parametrize(
    ("verbosity", "shown"),
    [
        (-1, []),
        (0, []),
        (1, ["the device refused packet 3: sending packet 3 again, try 2", "note: odd"]),
        (
            2,
            [
                "the device refused packet 3: sending packet 3 again, try 2",
                "note: odd",
                "bytes on 0x725 ignored: bad CRC: 01",
            ],
        ),
    ],
)
def test_verbosity_decides_how_much_is_reported(
    capsys: pytest.CaptureFixture[str], verbosity: int, shown: list[str]
) -> None:
    show(
        Output(verbosity=verbosity),
        *acknowledged(1, 2),
        events.MessageRepeated("packet 3", Reason.PACKET_REFUSED.value, 2),
        events.Reported("odd"),
        events.BytesDamaged(0x725, "bad CRC", b"\x01"),
        object(),
    )
    captured = capsys.readouterr()
    assert captured.err.splitlines() == shown
    assert captured.out == ""


def test_everything_that_is_sent_again_has_a_sentence() -> None:
    reasons = {reason.value for reason in Reason}
    assert len(reasons) >= 9
    assert {reason for reason in reasons if reason_text(reason, "packet 3") == reason} == set()


@pytest.mark.slow
def test_tqdm_is_loaded_only_for_a_bar(tmp_path: Path) -> None:
    code = (
        "import sys; from flasher.cli.main import main; "
        f"code = main(['flash', {OBC_BIN!r}, '-t', 'obc', '--mock', '--mock-speed', '0']); "
        "sys.exit(code or 'tqdm' in sys.modules)"
    )
    subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, cwd=tmp_path, timeout=20
    )
