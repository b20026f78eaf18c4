"""`flasher export`: the protocol and recorded traces in the form that other tools read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.cli import values
from flasher.cli.files import check_not_read, check_writable, write_whole, writing
from flasher.cli.framework import Decorator, argument, group, option
from flasher.cli.output import Output, counted
from flasher.errors import UsageError
from flasher.protocol.text import printable


@dataclass(frozen=True)
class ExportedFileDocument:
    """Of `export wireshark`."""

    file: str
    size_bytes: int


@dataclass(frozen=True)
class ExportedTraceDocument:
    """Of `export trace`."""

    file: str
    frames: int
    remarks: int
    """Frames that bear a remark."""
    damage: str
    """Where and why the trace could not be read on; empty where it was read to its end."""


DOCUMENTS: Final = (ExportedFileDocument, ExportedTraceDocument)
_OUT: Final = "-o/--output"
_EXAMPLES: Final = """\
examples:
  flasher export wireshark -o welling.lua
  flasher export trace upgrade.asc -o upgrade.pcapng
  flasher export trace upgrade.pcapng -o upgrade.log
"""
_WIRESHARK_EXAMPLES: Final = """\
examples:
  flasher export wireshark -o welling.lua
  wireshark -X lua_script:welling.lua upgrade.pcapng
  wireshark -X lua_script:welling.lua -k -i can0
  tshark -X lua_script:welling.lua -r upgrade.blf -Y welling.expert.nak
  tshark -X lua_script:welling.lua -o welling.dialect:motinova -r bike.pcapng

Wireshark loads it by itself from its folder of personal Lua plugins, which Help > About
Wireshark > Folders names (Linux and macOS: ~/.local/lib/wireshark/plugins, Windows:
%APPDATA%\\Wireshark\\plugins). It needs Wireshark 4.0 or later. Filters: welling.packet == 17,
welling.upgrade == 1, welling.copy > 1, welling.crc.ok == 0, welling.answer_ms > 100,
welling.expert.foreign_tool, welling.running_information.voltage_mv < 30000.
"""
_TRACE_EXAMPLES: Final = """\
examples:
  flasher export trace upgrade.asc -o upgrade.pcapng     for Wireshark, with remarks
  flasher export trace upgrade.pcapng -o upgrade.log     for canplayer, log2asc and tshark
  flasher export trace capture.pcapng -o upgrade.blf     for CANalyzer

In a .pcapng the frames at which something went wrong bear a remark (Wireshark: filter
frame.comment), the last frame of each upgrade its verdict, and the file the verdict of all.
The direction of frames is not kept.
"""


def _output_file(what: str, *suffixes: str, required: bool = False) -> Decorator:
    return option(
        "-o", "--output", "file", type=values.FilePath(*suffixes, gives=Path), metavar="FILE",
        required=required, brief=True, help=what,
    )  # fmt: skip


_trace = argument(
    "trace", type=values.FilePath(*values.TRACE_SUFFIXES, gives=Path),
    help="a recorded trace (.asc .blf .log .pcapng ...)",
)  # fmt: skip


@group(epilog=_EXAMPLES)
def export() -> None:
    """Write the protocol, or a recorded trace, for other tools. No bus is opened."""


@export.action("wireshark", epilog=_WIRESHARK_EXAMPLES)
@_output_file("the script (default: standard output)", "lua")
def wireshark(output: Output, *, file: Path | None) -> int:
    """Write a dissector for Wireshark and tshark, a script in Lua. It puts messages together from
    CAN frames, judges their CRC, names every field, numbers upgrades, packets and copies, finds the
    answer to each request with its time, and marks NAK, repetition, damage and a second tool.
    """
    from flasher import __version__  # noqa: PLC0415  loads the whole interface
    from flasher.export.wireshark import dissector  # noqa: PLC0415  not needed to show help

    return _protocol_file(output, file, dissector(__version__))


def _protocol_file(output: Output, file: Path | None, text: str) -> int:
    """What is made of the protocol alone."""
    if file is None:
        if output.json_wanted:
            raise UsageError("--json needs a file to write.", remedy="Name one with -o FILE.")
        output.text(text)
        return 0
    check_writable(file, _OUT)
    data = text.encode("utf-8")
    write_whole(file, data, _OUT)
    output.result(f"{printable(str(file))}: {len(data):,} bytes")
    output.document(ExportedFileDocument(file=str(file), size_bytes=len(data)))
    return 0


@export.action("trace", epilog=_TRACE_EXAMPLES)
@_trace
@_output_file("what to write; format by suffix", *values.TRACE_SUFFIXES, required=True)
def trace(output: Output, *, trace: Path, file: Path) -> int:
    """Write a recorded trace in another format."""
    from flasher.export.convert import convert  # noqa: PLC0415  loads python-can

    check_not_read(file, _OUT, [trace])
    with writing(file, _OUT) as part:
        made = convert(trace, part, called=file)
    shown = f"{printable(str(file))}: {counted(made.frames, 'frame')}"
    output.result(f"{shown}, {counted(made.remarks, 'remark')}" if made.remarks else shown)
    if made.damage:
        output.error_line(f"warning: {printable(str(trace))} ends there: {made.damage}")
    output.document(
        ExportedTraceDocument(
            file=str(file), frames=made.frames, remarks=made.remarks, damage=made.damage
        )
    )
    return 0
