"""What a terminal or a pipe takes: its width, its encoding."""

from __future__ import annotations

import io
import json
import sys

import pytest

from flasher.cli.main import main
from flasher.cli.terminal import painted, wrap_line
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
def test_text_is_wrapped_between_words_and_hangs_behind_its_label(width: int) -> None:
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
    said = {}
    for name, words in COMMANDS.items():
        streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
        monkeypatch.setattr(sys, "stdout", streams[0])
        monkeypatch.setattr(sys, "stderr", streams[1])
        code = main([str(trace) if word == "TRACE" else word for word in words])
        raw = [bytes(stream.buffer.getvalue()) for stream in streams]
        assert code != ExitCode.INTERNAL, (name, raw)
        assert b"Traceback" not in raw[1], (name, raw)
        said[name] = raw[0].decode(encoding)
    degree = "deg" if encoding == "ascii" else "°"
    for name in ("info", "read", "lines"):
        assert f"{degree}C" in said[name], said[name]


def test_json_alone_is_answered_in_json(flasher: Flasher) -> None:
    run = flasher("--json")
    assert run.code == ExitCode.USAGE
    assert json.loads(run.out)["error"]["kind"] == "UsageError"
