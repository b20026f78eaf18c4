"""What a terminal or a pipe takes: its width, its encoding."""

from __future__ import annotations

import io
import json
import os
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from flasher.cli.main import main
from flasher.cli.terminal import painted, started_as, takes_colour, wrap_line
from flasher.errors import ExitCode
from tests.loops import each
from tests.trace import traffic

from .conftest import SAMPLES, Flasher

MOCK = ("--mock", "--mock-speed", "0")
LONG = (
    "  likely cause: the device has no power, sleeps, is not on this bus, or its bootloader "
    "announces itself only at power-up, see https://example.org/a-word-of-more-than-forty-columns"
)


@each("width", [40, 60, 80, 120, 300])
def test_text_is_wrapped_between_words_and_hangs_after_its_label(width: int) -> None:
    lines = wrap_line(LONG, width)
    assert " ".join(line.strip() for line in lines) == LONG.strip()
    assert all(len(line) <= width or " " not in line.strip() for line in lines)
    assert all(line.startswith(" " * 16) for line in lines[1:])


@each(
    "line, wrapped",
    [
        ("short", ["short"]),
        ("", [""]),
        ("  flasher rescue bms.hex -t bms", ["  flasher rescue bms.hex -t bms"]),
        ("OK  BMS runs V1r0r4_20220512 now", ["OK  BMS runs", "    V1r0r4_20220512", "    now"]),
        (
            "RS-01 failed badly here | replay: flasher conformance -t bms --case RS-01",
            [
                "RS-01 failed badly",
                "here | replay:",
                "    flasher conformance -t bms --case RS-01",
            ],
        ),
        ("error: no such thing was found", ["error: no such thing", "       was found"]),
    ],
)  # fmt: skip
def test_what_is_short_or_a_command_stays_as_it_is(line: str, wrapped: list[str]) -> None:
    assert wrap_line(line, 20) == wrapped


def test_colours_take_no_room() -> None:
    line = painted("OK", "green") + "  BMS runs V1r0r4_20220512"
    assert wrap_line(line, 28) == [line]
    assert wrap_line(line, 27) == [painted("OK", "green") + "  BMS runs", "    V1r0r4_20220512"]
    whole = painted("  ! one two three", "red")
    assert wrap_line(whole, 13) == [painted("  ! one two", "red"), painted("  three", "red")]


COMMANDS = {
    "info": ("info", "-t", "bms", *MOCK),
    "scan": ("scan", *MOCK),
    "read": ("read", "running-information", "-t", "bms", *MOCK),
    "lines": ("monitor", "TRACE"),
    "table": ("monitor", "TRACE", "--table"),
    "explain": ("explain", "TRACE"),
    "flash": ("flash", str(SAMPLES / "obc.bin"), "-t", "obc", *MOCK),
    "image-info": ("image-info", str(SAMPLES / "wmc.s19")),
    "doctor": ("doctor", *MOCK),
    "conformance": ("conformance", "-t", "bms", "--mock", "--list"),
    "profile": ("profile", "show", "-t", "bms"),
    "mock": ("mock", "--list-variants"),
    "help": ("--help",),
    "help of mock": ("mock", "--help"),
    "wrong": ("flash", "\u00b0\u2026\udcff", "-t", "bms", *MOCK),
}


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "cp437", "utf-8"])
def test_no_encoding_of_a_stream_ends_a_command(
    encoding: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    trace = tmp_path_factory.mktemp("t") / "t.log"
    trace.write_text("".join(
        f"({number / 10:.6f}) can0 {frame.can_id:03X}#{frame.data.hex()} R\n"
        for number, frame in enumerate((*traffic.running(), *traffic.faults(b"\xff" * 4)))
    ))  # fmt: skip
    reported = {}
    for name, words in COMMANDS.items():
        streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
        monkeypatch.setattr(sys, "stdout", streams[0])
        monkeypatch.setattr(sys, "stderr", streams[1])
        code = main([str(trace) if word == "TRACE" else word for word in words])
        raw = [bytes(stream.buffer.getvalue()) for stream in streams]
        assert code != ExitCode.INTERNAL, (name, raw)
        assert b"Traceback" not in raw[1], (name, raw)
        reported[name] = raw[0].decode(encoding)
    degree = "deg" if encoding == "ascii" else "°"
    for name in ("info", "read", "lines"):
        assert f"{degree}C" in reported[name], reported[name]


def test_json_alone_is_answered_in_json(flasher: Flasher) -> None:
    run = flasher("--json")
    assert run.code == ExitCode.USAGE
    assert json.loads(run.out)["error"]["kind"] == "UsageError"


# -- how the program was started ------------------------------------------------------------------


@each(
    "orig_argv, module, program",
    [
        (["python3", "-m", "flasher"], "flasher.__main__", "python3 -m flasher"),
        ([".venv/bin/python3", ".venv/bin/flasher"], None, ".venv/bin/flasher"),
        (["/usr/bin/python3", "my tools/flasher"], None, "'my tools/flasher'"),
        (
            ["/usr/bin/python3", "/nowhere/flasher.pyz"],
            None,
            "/usr/bin/python3 /nowhere/flasher.pyz",
        ),
        (["python3", "-m", "pytest"], "pytest.__main__", "flasher"),
    ],
)
def test_the_words_that_start_the_program_again_are_those_that_started_it(
    orig_argv: list[str], module: str | None, program: str
) -> None:
    spec = None if module is None else ModuleSpec(module, None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules["__main__"], "__spec__", spec)
        patch.setattr(sys, "orig_argv", orig_argv)
        patch.setattr(sys, "argv", orig_argv[1:])
        assert started_as() == program


def test_the_program_on_the_path_is_named_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "flasher"
    program.touch(mode=0o755)
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    monkeypatch.setattr(sys, "argv", [str(program)])
    assert started_as() == str(program)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert started_as() == "flasher"


def test_commands_are_printed_as_the_program_was_started_and_no_other_words(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.main.started_as", lambda: "bin/flasher")
    run = flasher("help", "E999", "--json")
    assert "`bin/flasher help codes`" in run.err
    assert "`bin/flasher help codes`" in run.document["error"]["remedy"]
    run = flasher("image-info", SAMPLES / "bms.hex")
    assert "a firmware sample of flasher, refused" in run.out


@each("name, value", [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_a_terminal_without_colours_gets_none(name: str, value: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("NO_COLOR", raising=False)
        patch.setenv("TERM", "xterm")
        terminal = io.StringIO()
        patch.setattr(terminal, "isatty", lambda: True, raising=False)
        assert takes_colour(terminal)
        patch.setenv(name, value)
        assert not takes_colour(terminal)
