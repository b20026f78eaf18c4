"""Firmware file loader: detects Intel HEX, S-record, ELF or raw binary, checks it, fills gaps.

The format is detected by content first and by suffix second. A damaged HEX or S-record file is
still detected, so that its reader reports the damage. Other files are raw binaries;
`flasher.image.plausible` checks whether one can be a program.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import PurePath
from typing import BinaryIO, Final, NamedTuple

from flasher.errors import ErrorCode, ImageError, UsageError
from flasher.files import opened
from flasher.image import elf
from flasher.image.cortexm import check_starts_inside
from flasher.image.image import ADDRESS_SPACE, Image
from flasher.image.plausible import file_type
from flasher.image.records import read_hex, read_srec
from flasher.image.segments import SparseBytes, too_large_error
from flasher.protocol.spec import IMAGE_MAX_SIZE
from flasher.protocol.text import find_firmware_version, printable

HEAD_SIZE: Final = 65_536
"""Number of bytes examined to detect the format."""
_LINES_EXAMINED: Final = 100
DEFAULT_FILL_GAPS_UP_TO: Final = 4096
"""Gap size in bytes: more than between vector table and code; a larger gap separates parts."""
FILE_MAX_SIZE: Final = 128 * 1024 * 1024
"""Maximum size in bytes of a HEX, S-record or ELF file."""


class Format(Enum):
    """File formats; the value is the word of `--format`, `title` the name in messages."""

    HEX = "hex"
    BIN = "bin"
    SREC = "srec"
    ELF = "elf"

    @property
    def title(self) -> str:
        return _TITLES[self]


_TITLES: Final = {
    Format.HEX: "Intel HEX",
    Format.BIN: "raw binary",
    Format.SREC: "Motorola S-record",
    Format.ELF: "ELF",
}
_SUFFIXES: Final = {
    **dict.fromkeys((".hex", ".ihx", ".ihex", ".h86", ".mcs"), Format.HEX),
    **dict.fromkeys(
        (".s19", ".s28", ".s37", ".srec", ".sre", ".s", ".mot", ".mhx", ".sx", ".s1", ".s2", ".s3"),
        Format.SREC,
    ),
    **dict.fromkeys((".elf", ".axf"), Format.ELF),
    ".bin": Format.BIN,
}
_RECORDS: Final = {
    Format.HEX: re.compile(rb":[0-9A-Fa-f]{8}"),
    Format.SREC: re.compile(rb"S[0-9][0-9A-Fa-f]{4}"),
}
_STARTS: Final = {Format.HEX: re.compile(rb":"), Format.SREC: re.compile(rb"S[0-9]")}
_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\n\v\f\r"
FORMATS: Final = tuple(form.value for form in Format)
"""Values of `--format`."""
READERS: Final = {Format.HEX: read_hex, Format.SREC: read_srec, Format.ELF: elf.read}


def load(
    path: str | os.PathLike[str],
    *,
    stream: BinaryIO | None = None,
    format: str | None = None,  # noqa: A002  the option's own name
    base: int | None = None,
    range_: tuple[int, int] | None = None,
    fill_gaps_up_to: int = DEFAULT_FILL_GAPS_UP_TO,
    allow_outside_vector: bool = False,
) -> Image:
    """Load a firmware file and check it (R8, R9).

    The bytes of a seekable `stream` are loaded in place of the file, as those of standard input;
    `path` is then its name in messages. `format` is one of `FORMATS`; None detects it. `base` is
    the address of the first byte of a raw binary. `range_` is (start, end), end exclusive: other
    bytes of the file are ignored. Gaps up to `fill_gaps_up_to` bytes are filled with FF, from the
    start of the range. `allow_outside_vector` waives the merged-file rule of R8.

    Raises ImageError if the file cannot be used; UsageError if it does not exist, is not a regular
    file, or the options contradict each other.
    """
    if fill_gaps_up_to < 0:
        raise UsageError(f"gaps cannot be filled up to {fill_gaps_up_to} bytes")
    content = read(path, stream=stream, format=format, base=base, range_=range_)
    sparse = content.sparse
    data, first = sparse.join(fill_gaps_up_to)
    image = Image(
        data=data,
        base=first if content.has_addresses else None,
        format=content.format.title,
        source=sparse.source,
        segments=sparse.spans(),
        filled_bytes=len(data) - sparse.size_bytes,
        version=find_firmware_version(data),
        elf_machine=content.elf_machine,
    )
    if not allow_outside_vector:
        check_starts_inside(image)
    return image


class Content(NamedTuple):
    """Bytes of a firmware file, its gaps not filled."""

    sparse: SparseBytes
    format: Format
    has_addresses: bool
    """False for a raw binary without a base: its first byte is at 0."""
    elf_machine: int | None


def read(
    path: str | os.PathLike[str],
    *,
    stream: BinaryIO | None = None,
    format: str | None = None,  # noqa: A002  the option's own name
    base: int | None = None,
    range_: tuple[int, int] | None = None,
) -> Content:
    """Read the bytes of a firmware file, with the arguments and errors of `load`."""
    _check_options(format, base, range_)
    source = printable(os.fspath(path))
    with _content(path, stream) as (file, size_bytes):
        file.seek(0)
        head = file.read(HEAD_SIZE)
        file.seek(0)
        form = Format(format) if format else _detect(head, source)
        sparse = SparseBytes(source, range_)
        if form is Format.BIN:
            _read_binary(file, size_bytes, sparse, base)
        else:
            if base is not None:
                raise UsageError(
                    f"a base is for a raw binary, and {source} is an {form.title} file",
                    where="the file itself contains the addresses",
                    remedy="Leave out the base. Choose a part of the file with --range START:END.",
                )
            if size_bytes > FILE_MAX_SIZE:
                raise ImageError(
                    f"{source} is too large for an {form.title} file: {size_bytes} bytes",
                    cause="it contains debug information, or is not firmware",
                    remedy="Strip it, or convert it to a raw binary: objcopy -O binary.",
                    code=ErrorCode.IMAGE_TOO_LARGE,
                )
            READERS[form](file, source, sparse)
    has_addresses = form is not Format.BIN or base is not None
    return Content(
        sparse, form, has_addresses, elf.machine_of(head) if form is Format.ELF else None
    )


@contextmanager
def _content(
    path: str | os.PathLike[str], stream: BinaryIO | None
) -> Iterator[tuple[BinaryIO, int]]:
    """Yield a file, or the stream in its place, with its size in bytes."""
    if stream is not None:
        yield stream, stream.seek(0, os.SEEK_END)
    else:
        with opened(path, None, error=ImageError) as content:
            yield content


def _check_options(form: str | None, base: int | None, range_: tuple[int, int] | None) -> None:
    if form is not None and form not in FORMATS:
        raise UsageError(f"there is no image format {form!r}", remedy=f"one of {FORMATS}")
    if base is not None and not 0 <= base < ADDRESS_SPACE:
        raise UsageError(f"the base {base:#x} is not a 32-bit address")
    if range_ is not None and not 0 <= range_[0] < range_[1] <= ADDRESS_SPACE:
        raise UsageError(
            f"the range {range_[0]:#x}:{range_[1]:#x} is empty or not inside 32-bit addresses",
            remedy="Give START:END with END one past the last byte.",
        )


def _detect(head: bytes, source: str) -> Format:
    """Detect the format from the first `HEAD_SIZE` bytes."""
    if head.startswith(elf.MAGIC):
        return Format.ELF
    if file_type(head) is not None:
        return Format.BIN  # an archive may contain records as they are
    body = head.removeprefix(codecs.BOM_UTF8).lstrip()
    if _is_mostly_text(body):
        for form, start in _STARTS.items():
            if start.match(body):
                return form
    lines = [line.strip() for line in body.splitlines()[:_LINES_EXAMINED]]
    for form, record in _RECORDS.items():
        matching = sum(record.match(line) is not None for line in lines)
        if 2 * matching > len(lines):
            return form
    return format_of_suffix(source) or Format.BIN


def format_of_suffix(name: str) -> Format | None:
    """Return the format that the suffix of a file name means."""
    return _SUFFIXES.get(PurePath(name).suffix.lower())


def _is_mostly_text(head: bytes) -> bool:
    """Distinguish a damaged text file from a program whose first bytes look like a record."""
    return 2 * len(head.translate(None, _TEXT)) <= len(head)


def _read_binary(file: BinaryIO, size_bytes: int, sparse: SparseBytes, base: int | None) -> None:
    """Read a raw binary, or the part of it inside the address range."""
    source, window = sparse.source, sparse.window
    if window and base is None:
        raise UsageError(
            f"--range chooses addresses, and {source} is a raw binary, which has none",
            remedy="Give the address of its first byte with --base.",
        )
    start = base or 0
    end = start + size_bytes
    low, high = window or (start, end)
    low, high = max(low, start), min(high, end)
    if high - low > IMAGE_MAX_SIZE:
        raise too_large_error(source, high - low)
    if end > ADDRESS_SPACE:
        raise UsageError(f"{source} does not end below 4 GiB with the base 0x{start:08X}")
    if size_bytes:
        sparse.note(start, end)
    if low < high:
        file.seek(low - start)
        sparse.add(low, file.read(high - low), str)
