"""`flasher read`: read an item of a device by its name, or its memory."""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path
from typing import Any, Final, Literal, NotRequired, Self, TypedDict

from flasher import api
from flasher.cli import arguments
from flasher.cli.content_text import content_document, content_lines
from flasher.cli.documents import FieldValue
from flasher.cli.files import check_writable, write_whole
from flasher.cli.output import Output, byte_count
from flasher.cli.recording import add_recording, recorded_connection
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, NoAnswerError, UsageError
from flasher.events import QueryAnswered
from flasher.host.items import find, meaningful_fields, readable
from flasher.host.read import check_range, piece_of
from flasher.protocol.contents import Memory
from flasher.protocol.fields import label
from flasher.protocol.spec import BMS, Dialect, Target
from flasher.protocol.text import printable

MEMORY: Final = "memory"
_OUTPUT: Final = "--output"
_HEX_SUFFIXES: Final = frozenset({".hex", ".ihex", ".ihx"})
_DUMP_WIDTH: Final = 16
_DESCRIPTION = """\
Read an item of a device by its name, or its memory. --list names the items. Nothing is written. The
documents let a tool read from the BMS only.
"""
_EPILOG = """\
examples:
  flasher read --list
  flasher read version-information -t bms -i socketcan -c can0
  flasher read serial-number -t bms --mock
  flasher read memory 0x8004000 0x8014000 -t bms -o application.hex -i socketcan -c can0

END of a memory range is exclusive. The format of FILE goes by its suffix (.hex is Intel HEX, all
else raw binary) or --format. FILE is written whole or not at all.
"""


class ItemDocument(TypedDict):
    """An item that was read."""

    target: str
    item: str
    fields: dict[str, FieldValue]


class MemoryDocument(TypedDict):
    """Memory that was read, `end` exclusive: `data` in hexadecimal, or the file it is in."""

    target: str
    start: int
    end: int
    data: NotRequired[str]
    file: NotRequired[str]
    format: NotRequired[Literal["hex", "bin"]]


class ReadableDocument(TypedDict):
    """The items that can be read, with the names of their fields."""

    items: dict[str, list[str]]


DOCUMENTS: Final = (ItemDocument, MemoryDocument, ReadableDocument)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = _DESCRIPTION
    parser.epilog = _EPILOG
    parser.add_argument("item", nargs="?", metavar="ITEM", help="what to read; see --list")
    parser.add_argument("values", nargs="*", metavar="START END", help="for memory: which")
    arguments.take_values_anywhere(parser, "values")
    arguments.add_target(parser, required=False)
    arguments.add_dialect(parser)
    group = parser.add_argument_group("read")
    group.add_argument("--list", action="store_true", help="list the items and stop")
    group.add_argument("-o", _OUTPUT, metavar="FILE", help="write memory to this file")
    group.add_argument("--format", choices=("hex", "bin"), help="format of FILE")
    arguments.add_mock(parser)
    add_recording(parser)
    arguments.add_bus(parser)


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    target = options.target or BMS
    dialect = api.as_dialect(options.dialect)
    if options.list:
        return _list(target, dialect, output)
    if options.item is None:
        raise UsageError("Nothing to read was named.", remedy="See flasher read --list.")
    if options.item.lower() == MEMORY:
        return _read_memory(options, target, dialect, output)
    if options.values or options.output or options.format:
        raise UsageError("START, END, --output and --format are for `flasher read memory` only.")
    return _read_item(options, target, dialect, output)


def _read_item(
    options: argparse.Namespace, target: Target, dialect: Dialect, output: Output
) -> int:
    entry = find(options.item, readable(target, dialect), target, "read")
    with (
        recorded_connection(options, output, target) as (connection, record),
        stop_on_signal() as stopped,
    ):
        device = connection.device(target, dialect=dialect)
        answer = device.read(entry.name, taps=record.taps, cancelled=stopped)
    document = content_document(answer)
    for line in content_lines(answer, entry.field):
        output.result(line)
    if entry.field:
        document = {entry.field: document[entry.field]}
    output.document(ItemDocument(target=target.name, item=entry.name, fields=document))
    return ExitCode.OK


# -- memory ---------------------------------------------------------------------------------------


def _read_memory(
    options: argparse.Namespace, target: Target, dialect: Dialect, output: Output
) -> int:
    start, end = _range(options.values)
    if target is not BMS:
        raise UsageError(f"The documents give no way to read memory of the {target.node.name}.")
    path = Path(options.output) if options.output else None
    if path is None and options.format:
        raise UsageError("--format needs --output FILE.")
    if path is not None:
        check_writable(path, _OUTPUT)
    with (
        recorded_connection(options, output, target) as (connection, record),
        stop_on_signal() as stopped,
        _MemoryProgress(end - start, output) as progress,
    ):
        try:
            device = connection.device(target, dialect=dialect)
            data = device.read_memory(
                start, end, taps=record.taps, on_event=progress, cancelled=stopped
            )
        except NoAnswerError as error:
            error.remedy = f"{error.remedy} No file was written."
            raise
    document: MemoryDocument = {"target": target.name, "start": start, "end": end}
    if path is not None:
        is_hex = options.format == "hex" or (
            options.format is None and path.suffix.lower() in _HEX_SUFFIXES
        )
        write_whole(path, _intel_hex(start, data) if is_hex else data, _OUTPUT)
        output.result(f"{byte_count(len(data))} from 0x{start:08X} in {printable(str(path))}")
        document["file"] = str(path)
        document["format"] = "hex" if is_hex else "bin"
    else:
        for at in range(0, len(data), _DUMP_WIDTH):
            output.result(_dump_line(start + at, data[at : at + _DUMP_WIDTH]))
        document["data"] = data.hex()
    output.document(document)
    return ExitCode.OK


def _range(values: list[str]) -> tuple[int, int]:
    if len(values) != 2:
        raise UsageError("Reading memory takes START and END.", remedy="END is exclusive.")
    try:
        start, end = (arguments.number(value) for value in values)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{error}.") from error
    check_range(start, end)
    return start, end


def _dump_line(address: int, data: bytes) -> str:
    text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in data)
    return f"{address:08X}  {data.hex(' '):<{_DUMP_WIDTH * 3 - 1}}  {text}"


def _intel_hex(start: int, data: bytes) -> bytes:
    from intelhex import IntelHex  # noqa: PLC0415  only where it is asked for

    image = IntelHex()
    image.frombytes(data, offset=start)
    text = io.StringIO()
    image.write_hex_file(text)
    return text.getvalue().encode("ascii")


class _MemoryProgress:
    """A bar on a terminal, nothing elsewhere."""

    def __init__(self, size_bytes: int, output: Output) -> None:
        self._size_bytes = size_bytes
        self._output = output
        self._wants_bar = sys.stderr.isatty() and output.verbosity >= 0
        self._bar: Any = None

    def __enter__(self) -> Self:
        if self._wants_bar:
            from tqdm import tqdm  # noqa: PLC0415  only where a bar is shown

            self._bar = tqdm(
                total=self._size_bytes,
                unit="B",
                unit_scale=True,
                desc=MEMORY,
                file=sys.stderr,
                dynamic_ncols=True,
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, event: object) -> None:
        """Take an event of the reading."""
        self._output.event(event)
        if (
            self._bar is not None
            and isinstance(event, QueryAnswered)
            and isinstance(event.content, Memory)
        ):
            self._bar.update(len(piece_of(event.content)))


def _list(target: Target, dialect: Dialect, output: Output) -> int:
    items = readable(target, dialect)
    document: dict[str, list[str]] = {}
    for name, entry in items.items():
        fields = [
            (field, codec)
            for field, codec in meaningful_fields(entry.content)
            if entry.field in ("", field)
        ]
        document[name] = [field for field, _ in fields]
        output.result(f"{name:<24} {', '.join(label(*field) for field in fields)}")
    if items:
        output.result(f"{MEMORY:<24} START END [-o FILE]")
    else:
        output.result(f"The documents give the tool nothing to read from the {target.node.name}.")
    output.document(ReadableDocument(items=document))
    return ExitCode.OK
