"""`flasher image`: show, convert and merge image files."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click

from flasher.cli import values
from flasher.cli.files import check_new, check_not_read, write_whole
from flasher.cli.framework import group, option, option_set
from flasher.cli.options import STANDARD_INPUT, Selection, image_argument, standard_input
from flasher.cli.output import Output, byte_count
from flasher.cli.upgrade import image_info
from flasher.errors import ExitCode, UsageError
from flasher.image.convert import WRITTEN, check_no_other_file, encode, merge
from flasher.image.image import AddressSpan
from flasher.image.load import Content, Format, format_of_suffix, read
from flasher.image.segments import SparseBytes
from flasher.protocol.text import printable

_OUT: Final = "-o/--output"
_STANDARD_OUTPUT: Final = "-"
_EXAMPLES: Final = """\
examples:
  flasher image info firmware.hex bootloader.bin
  flasher image convert firmware.hex -o firmware.bin --fill
  flasher image merge bootloader.hex firmware.bin@0x8004000 -o whole.hex
"""
_CONVERT_EXAMPLES: Final = """\
examples:
  flasher image convert firmware.hex -o firmware.bin --fill
  flasher image convert firmware.bin --base 0x8004000 -o firmware.s19
  flasher image convert whole.hex --range 0x8004000:0x8020000 -o application.hex
  flasher image convert firmware.elf --to bin -o - | sha256sum

The format is that of FILE's suffix, or of --to. Addresses and gaps are kept; a raw binary has
neither. An entry address (records 03, 05, S7 to S9, ELF) is not kept.
"""
_MERGE_EXAMPLES: Final = """\
examples:
  flasher image merge bootloader.hex firmware.hex -o whole.hex
  flasher image merge firmware.hex data.bin@0x801F000 -o firmware-with-data.hex
  flasher image merge a.bin@0x8004000 b.bin@0x8008000 -o both.bin --fill

A raw binary needs the address of its first byte after its name. Bytes for the same address must be
equal, else nothing is written (exit code 3).
"""


@dataclass(frozen=True)
class WrittenImageDocument:
    """Result of `image convert` and `image merge`."""

    sources: list[str]
    file: str
    format: str
    size_bytes: int
    """Bytes of the device's memory in the file, filler included."""
    segments: tuple[AddressSpan, ...]
    filled_bytes: int
    file_sha256: str


DOCUMENTS: Final = (*image_info.DOCUMENTS, WrittenImageDocument)


@dataclass(frozen=True)
class _Written:
    """File to write."""

    file: str
    to: str | None
    fill: bool
    force: bool

    def check(self, sources: Sequence[str], *, is_json: bool) -> Format:
        """Return the format. Raises UsageError."""
        form = Format(self.to) if self.to else format_of_suffix(self.file)
        if form not in WRITTEN:
            is_piped = self.file == _STANDARD_OUTPUT
            raise UsageError(
                "The format of standard output is not known."
                if is_piped
                else f"{printable(self.file)} has no suffix of a format that can be written.",
                where=_OUT,
                remedy="Choose one with --to hex, --to srec or --to bin.",
            )
        if self.file != _STANDARD_OUTPUT:
            check_not_read(self.file, _OUT, sources)
            check_new(Path(self.file), _OUT, force=self.force)
        elif is_json:
            raise UsageError(
                "--json and the file would both be on standard output.",
                remedy="Name a file with -o, or leave out --json.",
            )
        elif form is Format.BIN and sys.stdout.isatty():
            raise UsageError(
                "Standard output is this terminal, which cannot show a raw binary.",
                remedy="Pipe it into a program, or name a file with -o.",
            )
        return form

    def write(
        self, output: Output, sparse: SparseBytes, form: Format, sources: Sequence[str]
    ) -> ExitCode:
        """Write the file, and describe it."""
        data = encode(sparse, form, fills=self.fill)
        spans = sparse.spans()
        whole = AddressSpan(spans[0].start, spans[-1].end - spans[0].start)
        if form is Format.BIN or self.fill:
            first = sparse.window[0] if sparse.window else whole.start
            spans = (AddressSpan(first, whole.end - first),)
        size_bytes = sum(span.size_bytes for span in spans)
        filled = size_bytes - sparse.size_bytes
        say = output.result
        if self.file == _STANDARD_OUTPUT:
            output.data(data)
            say = output.progress
        else:
            write_whole(Path(self.file), data, _OUT)
        name = "standard output" if self.file == _STANDARD_OUTPUT else printable(self.file)
        say(f"written: {name}, {form.title}, {byte_count(size_bytes)}")
        for span in spans:
            say(f"  segment: {span}")
        if filled:
            say(f"  gaps:    {byte_count(filled)} filled with FF")
        if form is Format.BIN:
            say(f"  base:    0x{spans[0].start:08X}, which the file does not contain")
        return output.document(
            WrittenImageDocument(
                sources=list(sources),
                file=self.file,
                format=form.title,
                size_bytes=size_bytes,
                segments=spans,
                filled_bytes=filled,
                file_sha256=hashlib.sha256(data).hexdigest(),
            )
        )


_written = option_set(
    "written",
    _Written,
    option(
        "-o", "--output", "file", metavar="FILE", type=values.FilePath(*values.IMAGE_SUFFIXES),
        required=True, brief=True, help="the file to write; - is standard output",
    ),
    option(
        "--to", type=click.Choice([form.value for form in WRITTEN]), brief=True,
        help="format to write (default: by the suffix of FILE)",
    ),
    option("--fill", is_flag=True, brief=True, help="fill gaps with FF"),
    option("--force", is_flag=True, help="overwrite an older file"),
)  # fmt: skip


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE,))
def image() -> None:
    """Show, convert and merge image files. Opens no adapter."""


image.add_command(image_info.image_info, "info")


@image.action("convert", epilog=_CONVERT_EXAMPLES)
@image_argument()
@option_set("selection", Selection)
@_written
def convert(output: Output, image: str, selection: Selection, written: _Written) -> int:
    """Convert an image between Intel HEX, S-record and raw binary, or take a part of it."""
    form = written.check([image], is_json=output.json_wanted)
    content = _read(image, selection)
    if form is not Format.BIN and not content.has_addresses:
        raise UsageError(
            f"{content.sparse.source} is a raw binary, and {form.title} needs addresses.",
            remedy="Give the address of its first byte: --base 0x8004000.",
        )
    return written.write(output, content.sparse, form, [image])


@image.action("merge", epilog=_MERGE_EXAMPLES)
@image_argument(
    "images", nargs=-1, required=True, metavar="IMAGE...",
    also="; a raw binary as IMAGE@ADDRESS, such as data.bin@0x801F000",
)  # fmt: skip
@_written
def merge_(output: Output, images: tuple[str, ...], written: _Written) -> int:
    """Merge images into one file, such as bootloader, application and data at their addresses."""
    parts = [_at_address(each) for each in images]
    sources = [path for path, _ in parts]
    image_info.check_one_standard_input(sources)
    form = written.check(sources, is_json=output.json_wanted)
    contents = [_read(path, Selection(None, base, None)) for path, base in parts]
    name = "the merged image" if written.file == _STANDARD_OUTPUT else printable(written.file)
    return written.write(output, merge(contents, name), form, sources)


def _at_address(text: str) -> tuple[str, int | None]:
    """Separate FILE@ADDRESS; a file whose whole name has an @ is taken as it is."""
    path, at, address = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    try:
        return path, values.address(address)
    except click.BadParameter as error:
        raise UsageError(
            f"{printable(text)}: {error.message}",
            remedy="Write FILE@ADDRESS, such as firmware.bin@0x8004000.",
        ) from error


def _read(path: str, selection: Selection) -> Content:
    """Read an image file, or standard input. Raises ImageError and UsageError."""
    is_piped = path == STANDARD_INPUT
    if not is_piped:
        image_info.check_no_release(path)
    content = read(
        "standard input" if is_piped else path,
        stream=standard_input() if is_piped else None,
        format=selection.format,
        base=selection.base,
        range_=selection.range_,
    )
    check_no_other_file(content)
    return content
