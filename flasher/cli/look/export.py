"""`flasher export`: convert the protocol and recorded traces for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from flasher import __version__
from flasher.cli import values
from flasher.cli.documents import document_of
from flasher.cli.extras import need
from flasher.cli.files import check_not_read, check_writable, write_whole, writing
from flasher.cli.framework import Decorator, argument, group, option
from flasher.cli.output import Output, counted
from flasher.errors import UsageError
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.export.signals import SignalRow


@dataclass(frozen=True)
class ExportedFileDocument:
    """Result of `export wireshark` and `export dbc`."""

    file: str
    size_bytes: int


@dataclass(frozen=True)
class ExportedTraceDocument:
    """Result of `export trace`."""

    file: str
    frames: int
    remarks: int
    """Number of frames with a comment."""
    damage: str
    """Place and reason at which reading stopped; empty if the whole trace was read."""


@dataclass(frozen=True)
class ExportedSignalsDocument:
    """Result of `export csv` and `export mf4`."""

    file: str
    messages: int
    damage: str
    """Place and reason at which reading stopped; empty if the whole trace was read."""


DOCUMENTS: Final = (ExportedFileDocument, ExportedTraceDocument, ExportedSignalsDocument)
_OUT: Final = "-o/--output"
_EXAMPLES: Final = """\
examples:
  flasher export wireshark -o welling.lua
  flasher export trace upgrade.asc -o upgrade.pcapng
  flasher export csv upgrade.asc -o upgrade.csv
  flasher export dbc -o welling.dbc
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
  flasher export trace upgrade.asc -o upgrade.pcapng     for Wireshark, with comments
  flasher export trace upgrade.pcapng -o upgrade.log     for canplayer, log2asc and tshark
  flasher export trace capture.pcapng -o upgrade.blf     for CANalyzer
  flasher export trace two.blf --channel 2 -o bike.log   one of two buses
  flasher export trace upgrade.asc --joined -o joined.asc
                                                         for a program with the DBC

In a .pcapng, frames with a fault have a comment (Wireshark: filter frame.comment), the last frame
of each upgrade has its verdict, and the file has the verdict of all. The direction of frames is
not stored. With --joined the file has messages only, without comments.
"""
_DBC_EXAMPLES: Final = """\
examples:
  flasher export dbc -o welling.dbc
  flasher export trace upgrade.blf --joined -o joined.blf
  flasher export trace upgrade.blf --joined -o joined.log

A DBC describes single frames, but messages of the drive system take several. So this DBC describes
each message as one CAN FD frame, as in traces of `flasher export trace --joined`. It covers numbers
and flags, with their units, in the first 64 bytes of a message; it cannot express texts (versions,
serial numbers), plain bytes (image, memory, ids), bytes after the 64th, or CRC errors. Signals are
named after message and field (running_information_voltage_mv); the signal `command` selects the
message. The encoding is Windows-1252.
"""
_CSV_EXAMPLES: Final = """\
examples:
  flasher export csv upgrade.asc -o upgrade.csv
  flasher export csv bike.blf --message "running information" -o running.csv
  flasher export csv bike.pcapng --message "cell voltages" --message faults

One row a message, one column a field, with its unit in the name. time_s counts from the first frame
of the trace, stamp_s is the time in the trace, frame the number of the message's last frame.
"""
_MF4_EXAMPLES: Final = """\
examples:
  flasher export mf4 bike.blf -o bike.mf4
  flasher export mf4 bike.blf --message "running information" -o running.mf4

One channel for each number and each flag (running_information.voltage_mv), with its unit; the
messages of one kind are a group. Needs the extra `mf4`. MF4 files of others are read as traces when
they hold CAN frames.
"""


def _output_file(what: str, *suffixes: str, required: bool = False) -> Decorator:
    return option(
        "-o", "--output", "file", type=values.FilePath(*suffixes, gives=Path), metavar="FILE",
        required=required, brief=True, help=what,
    )  # fmt: skip


_trace = argument(
    "trace", type=values.FilePath(*values.TRACE_SUFFIXES, gives=Path),
    help="a recorded trace (.asc .blf .log .pcapng ...), or the folder of a bundle",
)  # fmt: skip


_message_option = option(
    "--message", "messages", multiple=True, metavar="WORDS", brief=True,
    help="only messages with these words in their title (default: all); may be repeated",
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
    from flasher.export.wireshark import dissector  # noqa: PLC0415  not needed to show help

    return _protocol_file(output, file, dissector(__version__))


def _needs_file() -> UsageError:
    return UsageError("--json needs a file to write.", remedy="Name one with -o FILE.")


def _protocol_file(output: Output, file: Path | None, text: str, *, encoding: str = "utf-8") -> int:
    """Write a file that depends on the protocol only, not on a trace."""
    if file is None:
        if output.json_wanted:
            raise _needs_file()
        output.text(text)
        return 0
    check_writable(file, _OUT)
    data = text.encode(encoding)
    write_whole(file, data, _OUT)
    output.result(f"{printable(str(file))}: {len(data):,} bytes")
    return output.document(ExportedFileDocument(file=str(file), size_bytes=len(data)))


@export.action("dbc", epilog=_DBC_EXAMPLES)
@_output_file("the DBC (default: standard output)", "dbc")
def dbc(output: Output, *, file: Path | None) -> int:
    """Write a DBC, for SavvyCAN, CANalyzer, cantools and the like: the messages as far as a DBC can
    describe them.
    """
    from flasher.export.dbc import dbc as make  # noqa: PLC0415  loads python-can

    return _protocol_file(output, file, make(), encoding="cp1252")


@export.action("trace", epilog=_TRACE_EXAMPLES)
@_trace
@_output_file("what to write; format by suffix", *values.TRACE_SUFFIXES, required=True)
@option(
    "--joined", is_flag=True, brief=True,
    help="each intact message as one CAN FD frame, as the DBC has them; nothing else",
)  # fmt: skip
@option(
    "--channel", metavar="NAME",
    help="only frames of this channel, where the trace has several (can1; in .asc and .blf 1, 2)",
)  # fmt: skip
def trace(output: Output, *, trace: Path, file: Path, joined: bool, channel: str | None) -> int:
    """Write a recorded trace in another format."""
    from flasher.export.convert import convert, convert_joined  # noqa: PLC0415  loads python-can

    check_not_read(file, _OUT, [trace])
    with writing(file, _OUT) as part:
        made = (convert_joined if joined else convert)(trace, part, name=file, channel=channel)
    shown = f"{printable(str(file))}: {counted(made.frames, 'frame')}"
    output.result(f"{shown}, {counted(made.remarks, 'remark')}" if made.remarks else shown)
    _warn(output, trace, made.damage, made=made.frames)
    return output.document(document_of(ExportedTraceDocument, made, file=str(file)))


@export.action("csv", epilog=_CSV_EXAMPLES)
@_trace
@_output_file("the table (default: standard output)", "csv")
@_message_option
def csv(output: Output, *, trace: Path, file: Path | None, messages: tuple[str, ...]) -> int:
    """Write the decoded messages of a recorded trace as a table."""
    from flasher.export.signals import csv_text  # noqa: PLC0415  loads python-can

    if file is None and output.json_wanted:
        raise _needs_file()
    check_writable(file, _OUT, [trace])
    found, damage = _rows(trace, messages)
    text = csv_text(found)
    if file is None:
        output.text(text)
    else:
        write_whole(file, text.encode("utf-8"), _OUT, is_private=True)
        output.result(f"{printable(str(file))}: {counted(len(found), 'message')}")
    _warn(output, trace, damage, made=len(found))
    return output.document(
        ExportedSignalsDocument(file=str(file), messages=len(found), damage=damage)
    )


@export.action("mf4", epilog=_MF4_EXAMPLES)
@_trace
@_output_file("the measurement file", "mf4", required=True)
@_message_option
def mf4(output: Output, *, trace: Path, file: Path, messages: tuple[str, ...]) -> int:
    """Write the decoded numbers and flags of a recorded trace as a measurement (ASAM MDF 4)."""
    need("flasher export mf4", "mf4")
    from flasher.export.mf4 import write_mf4  # noqa: PLC0415  an extra

    if file.suffix.lower() != ".mf4":
        raise UsageError(
            f"{printable(str(file))} does not end with .mf4.",
            where=_OUT,
            remedy="Name it with this suffix, by which other programs recognise the format.",
        )
    check_not_read(file, _OUT, [trace])
    found, damage = _rows(trace, messages)
    with writing(file, _OUT) as part:
        channels = write_mf4(found, part)
    count = f"{counted(len(found), 'message')}, {counted(channels, 'channel')}"
    output.result(f"{printable(str(file))}: {count}")
    _warn(output, trace, damage, made=len(found))
    return output.document(
        ExportedSignalsDocument(file=str(file), messages=len(found), damage=damage)
    )


def _rows(trace: Path, messages: tuple[str, ...]) -> tuple[list[SignalRow], str]:
    """Return the messages with one of the words in their titles, and where reading stopped."""
    from flasher.cli.look.monitor import check_messages  # noqa: PLC0415  loads python-can
    from flasher.export.signals import rows  # noqa: PLC0415  loads python-can

    check_messages(messages)
    words = [each.lower() for each in messages]
    damage: list[str] = []
    found = rows(
        trace,
        wanted=lambda title: not words or any(each in title.lower() for each in words),
        damage=damage,
    )
    return list(found), " ".join(damage)


def _warn(output: Output, trace: Path, damage: str, *, made: int) -> None:
    """Warn about a damaged trace, or one without classic CAN frames. `made` is the number of
    exported frames or messages.
    """
    from flasher.trace.source import frames_until_damage, trace_file  # noqa: PLC0415  python-can

    shown = printable(str(trace))
    if damage:
        output.error_line(f"warning: {shown} ends there: {damage}")
    elif not made and not any(True for _ in frames_until_damage(trace_file(trace), [])):
        output.error_line(
            f"warning: no classic CAN frame in {shown}: nothing was recorded, it holds "
            "only CAN FD frames, as --joined makes them, or its format does not match its suffix"
        )
