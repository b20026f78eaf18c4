"""`flasher read`: read an item of a device by its name, or its memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import click

from flasher.api import as_dialect
from flasher.cli import values
from flasher.cli.documents import FieldValue, content_document
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import argument, command, option
from flasher.cli.look.content import content_lines
from flasher.cli.look.memory import MEMORY, intel_hex, read_with_bar
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output, byte_count
from flasher.cli.recording import RecordingOptions, recorded_device, recording_options
from flasher.errors import ExitCode, NoAnswerError, UsageError
from flasher.host.items import find_item, meaningful_fields, readable
from flasher.host.query import check_range
from flasher.procedures import in_bootloader_error
from flasher.protocol.fields import label
from flasher.protocol.spec import BMS, WELLING, Dialect, Target
from flasher.protocol.text import printable

_OUTPUT: Final = "--output"
_HEX_SUFFIXES: Final = frozenset({".hex", ".ihex", ".ihx"})
_DUMP_WIDTH: Final = 16
_EXAMPLES: Final = """\
examples:
  flasher read --list
  flasher read version-information -t bms -i socketcan -c can0
  flasher read serial-number -t bms --mock
  flasher read memory 0x8004000 0x8014000 -t bms -o application.hex -i socketcan -c can0

END of a memory range is exclusive. The format of FILE follows from its suffix (.hex is Intel HEX,
any other raw binary) or --format. FILE is written whole or not at all.
"""


@dataclass(frozen=True)
class ItemDocument:
    """Item that was read."""

    target: str
    item: str
    fields: dict[str, FieldValue]
    two_devices: str | None = None
    """Evidence of a second device, such as an answer that came twice."""


@dataclass(frozen=True)
class MemoryDocument:
    """Memory that was read, `end` exclusive: `data` in hexadecimal, or the file it is in."""

    target: str
    start: int
    end: int
    data: str | None = None
    file: str | None = None
    format: Literal["hex", "bin"] | None = None
    two_devices: str | None = None


@dataclass(frozen=True)
class ReadableDocument:
    """Items that can be read, with the names of their fields."""

    items: dict[str, list[str]]


DOCUMENTS: Final = (ItemDocument, MemoryDocument, ReadableDocument)


def _items(ctx: click.Context) -> list[str]:
    """Complete the items that can be read, of the target if it is given."""
    dialect = as_dialect(ctx.params.get("dialect_name") or WELLING.name)
    return [*readable(ctx.params.get("target") or BMS, dialect), MEMORY]


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.INTERRUPTED))
@argument(
    "item", required=False, shell_complete=values.offers(_items),
    help="what to read; see --list",
)  # fmt: skip
@argument("start", required=False, help="for memory: the first address")
@argument("end", required=False, help="for memory: the address after the last")
@target_option(required=False)
@option("--list", "is_list", is_flag=True, panel="read", brief=True, help="list the items and stop")
@option(
    "-o", _OUTPUT, "file", metavar="FILE", type=values.FilePath(gives=Path), panel="read",
    brief=True, help="write memory to this file",
)  # fmt: skip
@option("--format", type=click.Choice(("hex", "bin")), panel="read", help="format of FILE")
@bus_options()
@recording_options
def read(
    output: Output,
    target: Target | None,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    item: str | None,
    start: str | None,
    end: str | None,
    is_list: bool,
    file: Path | None,
    format: str | None,  # noqa: A002  the name of the option
) -> int:
    """Read an item of a device by its name, or its memory. --list names the items. Nothing is
    written. The documents let a tool read from the BMS only.
    """
    target = target or BMS
    if is_list:
        return _list(target, bus.dialect, output)
    if item is None:
        raise UsageError("Name an item to read.", remedy="See flasher read --list.")
    if item.lower() != MEMORY:
        if start or file or format:
            raise UsageError(
                "START, END, --output and --format are for `flasher read memory` only."
            )
        return _read_item(item, target, bus, recorded, output)
    first, stop = _range(start, end)
    if target is not BMS:
        raise UsageError(
            f"The documents give no way to read memory of the {target.node.name}.",
            remedy="Use -t bms.",
        )
    if file is None and format:
        raise UsageError("--format needs --output FILE.")
    check_writable(file, _OUTPUT)
    with recorded_device(recorded, bus, output, BMS) as (device, record):
        data = read_with_bar(device, first, stop, output, record)
    if file is not None:
        is_hex = format == "hex" or (format is None and file.suffix.lower() in _HEX_SUFFIXES)
        write_whole(file, intel_hex(first, data) if is_hex else data, _OUTPUT, is_private=True)
        output.result(f"{byte_count(len(data))} from 0x{first:08X} in {printable(str(file))}")
        name: Literal["hex", "bin"] = "hex" if is_hex else "bin"
        document = MemoryDocument(
            target.name, first, stop, file=str(file), format=name, two_devices=record.two_devices
        )
    else:
        for at in range(0, len(data), _DUMP_WIDTH):
            line = data[at : at + _DUMP_WIDTH]
            text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in line)
            output.result(f"{first + at:08X}  {line.hex(' '):<{_DUMP_WIDTH * 3 - 1}}  {text}")
        document = MemoryDocument(
            target.name, first, stop, data=data.hex(), two_devices=record.two_devices
        )
    return output.document(document)


def _read_item(
    item: str, target: Target, bus: Bus, recorded: RecordingOptions, output: Output
) -> int:
    entry = find_item(item, readable(target, bus.dialect), target, "read")
    with recorded_device(recorded, bus, output, target) as (device, record):
        try:
            answer = device.read(entry.name)
        except NoAnswerError as error:
            heard = device.connection.scan(bus.dialect, taps=record.taps).heard.get(target.node)
            if heard is None or not heard.boot_version:
                raise
            raise in_bootloader_error(target, heard.boot_version) from error
    document = content_document(answer)
    output.results(content_lines(answer, entry.field))
    if entry.field:
        document = {entry.field: document[entry.field]}
    return output.document(
        ItemDocument(target.name, entry.name, fields=document, two_devices=record.two_devices)
    )


# -- memory ---------------------------------------------------------------------------------------


def _range(start: str | None, end: str | None) -> tuple[int, int]:
    if start is None or end is None:
        raise UsageError("Reading memory takes START and END.", remedy="END is exclusive.")
    try:
        first, stop = values.number(start), values.number(end)
    except click.BadParameter as error:
        raise UsageError(f"{error.message}.") from error
    check_range(first, stop)
    return first, stop


def _list(target: Target, dialect: Dialect, output: Output) -> int:
    items = {
        name: {
            field: label(field, codec)
            for field, codec in meaningful_fields(entry.content)
            if entry.field in ("", field)
        }
        for name, entry in readable(target, dialect).items()
    }
    if items:
        rows = [(name, ", ".join(labels.values())) for name, labels in items.items()]
        output.table([*rows, (MEMORY, "START END [-o FILE]")])
    else:
        output.result(f"The documents give no readable item of the {target.node.name}.")
    return output.document(
        ReadableDocument(items={name: list(labels) for name, labels in items.items()})
    )
