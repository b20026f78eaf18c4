"""Intel HEX and S-record reader: a strict check, then intelhex or bincopy, and a comparison.

The libraries accept a missing end record, wrapping addresses and lost records, reject repeated
records, and need a hundred bytes of memory per byte of image. So a strict pass first rejects
damaged files and stores nothing. The records that pass go to the library in batches. Addresses,
count and CRC-32 of the library's bytes must equal those of the strict pass: two independent
readings.
"""

from __future__ import annotations

from binascii import Error as HexError
from binascii import unhexlify
from bisect import bisect_right
from codecs import BOM_UTF8, BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import pairwise
from typing import BinaryIO, Final
from zlib import crc32

from flasher.errors import ErrorCode, ImageError
from flasher.image.image import ADDRESS_SPACE
from flasher.image.segments import PIECES_MAX, SparseBytes, empty_error, scattered_error

LINES_MAX: Final = 1_100_000
"""Maximum number of lines, against files of blank lines. The largest image has 1,048,560 records of
eight bytes; usual programs write 16 or 32 bytes per record."""
_LINE_MAX: Final = 1024
"""More characters than any record of either format has."""
_SHOWN_MAX: Final = 40


@dataclass
class _Scanner:
    """Reads the lines of a record file and checks what both formats have in common."""

    file: BinaryIO
    source: str
    format: str
    line: int = 0
    """Number of the current line, from 1."""
    ended: bool = False
    """The end record has been read."""
    counted: bool = False
    """The last record was a correct count of all records, which ends a file like an end record."""

    def lines(self) -> Iterator[str]:
        """Yield the stripped lines of the file, without blank ones.

        Raises ImageError for a line longer than a record, for non-ASCII characters, for anything
        after the end record, and for a missing end record.
        """
        while raw := self.file.readline(_LINE_MAX):
            self.line += 1
            if len(raw) == _LINE_MAX:
                raise self.refuse(
                    "the line is longer than any record", "another type of file, or lost line ends"
                )
            if self.line > LINES_MAX:
                raise self.refuse(
                    f"it has more than {LINES_MAX:,} lines",
                    "another type of file, or one with very short records",
                )
            text = raw.strip()
            if not text:
                continue
            if self.ended:
                raise self.refuse(
                    "there is data after the end record",
                    "two files joined into one, or a file written over a longer one",
                )
            if not text.isascii():
                has_mark = self.line == 1 and raw.startswith((BOM_UTF8, BOM_UTF16_LE, BOM_UTF16_BE))
                raise self.refuse(
                    "the line holds bytes that are not ASCII",
                    "an editor saved it as Unicode, with a byte order mark" if has_mark else "",
                )
            yield text.decode("ascii")
        if self.line == 0:
            raise empty_error(self.source)
        if not (self.ended or self.counted):
            raise self.refuse(
                "the end record is missing: this is where the file ends",
                "the file was cut off while it was written or copied",
            )

    def record(
        self, text: str, digits_at: int, *, least_size: int, uncounted_size: int, total: int
    ) -> bytes:
        """Decode a record whose hex digits begin at `digits_at` in `text`. The first byte counts
        all but `uncounted_size` bytes; the last is a checksum, so that all bytes add up to `total`.

        Raises ImageError for wrong digits, length or checksum.
        """
        try:
            record = unhexlify(text[digits_at:])
        except (HexError, ValueError):
            raise self.refuse(f"{_shown(text)} does not consist of pairs of hex digits") from None
        if len(record) < least_size or len(record) != uncounted_size + record[0]:
            raise self.refuse(f"{_shown(text)} does not have the length in its count")
        if sum(record) & 0xFF != total:
            computed = (total - sum(record[:-1])) & 0xFF
            raise self.refuse(f"the checksum is {record[-1]:02X}, computed {computed:02X}")
        return record

    def refuse(self, what: str, cause: str = "") -> ImageError:
        """Create the ImageError for the current line."""
        return ImageError(
            f"{self.source} is a damaged {self.format} file: {what}",
            where=_place(self.line),
            cause=cause or "damaged while it was copied, or edited by hand",
            remedy="Copy or make the file again.",
            code=ErrorCode.IMAGE_DAMAGED,
        )


def _place(line: int) -> str:
    return f"line {line}"


def _shown(text: str) -> str:
    """Escape and shorten a line for an error message."""
    cut = text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."
    return ascii(cut)


# -- two readings ---------------------------------------------------------------------------------


_Piece = tuple[int, bytes]
"""Address and the bytes from there on."""
_Source = tuple[int, str, str]
"""Line number of a piece, the record that sets its base address (may be empty), and its line."""
_Load = Callable[[str], list[_Piece]]
"""Loads lines with a library; returns their pieces in ascending order."""
_BATCH_MAX: Final = 1024
"""Maximum number of records per library call. Limits memory, and the time of bincopy, which grows
with the square of its pieces."""


class _Reading:
    """Loads checked records with a library, and compares its bytes with the strict check."""

    def __init__(self, scanner: _Scanner, load: _Load, into: SparseBytes) -> None:
        self._scanner = scanner
        self._load = load
        self._into = into
        self._batch: dict[_Piece, _Source] = {}
        """Records in file order, without repetitions, which intelhex rejects."""
        self._loads_left = PIECES_MAX

    def add(self, address: int, data: bytes, text: str, prefix: str = "") -> None:
        """Add a record. Raises ImageError past 32-bit addresses and for contradicting bytes."""
        end = address + len(data)
        if end > ADDRESS_SPACE:
            raise self._scanner.refuse("the record runs past the last 32-bit address, 0xFFFFFFFF")
        if not self._into.leaves_out(address, end):
            self._batch.setdefault((address, data), (self._scanner.line, prefix, text))
            if len(self._batch) == _BATCH_MAX:
                self.finish()

    def finish(self) -> None:
        """Load the remaining records."""
        batch, self._batch = list(self._batch.items()), {}
        if batch:
            self._load_apart(batch)

    def _load_apart(self, batch: Sequence[tuple[_Piece, _Source]]) -> None:
        """Load a batch. Overlapping records are loaded in halves, because a library rejects an
        overlap or keeps one of two contradicting bytes.
        """
        ascending = sorted(batch)
        checked = [piece for piece, _ in ascending]
        if any(start + len(data) > after for (start, data), (after, _) in pairwise(checked)):
            half = len(batch) // 2
            self._load_apart(batch[:half])
            self._load_apart(batch[half:])
            return
        self._loads_left -= 1
        if self._loads_left < 0:
            raise scattered_error(self._into.source)
        sources = [source for _, source in ascending]
        loaded = self._loaded(sources)
        if _digest(loaded) != _digest(checked):
            raise self._differs(sources)
        starts = [start for start, _ in checked]
        for start, data in loaded:
            self._into.add(start, data, lambda at: _place(sources[bisect_right(starts, at) - 1][0]))

    def _loaded(self, sources: Sequence[_Source]) -> list[_Piece]:
        lines, last = [], ""
        for _, prefix, text in sources:
            if prefix != last:
                lines.append(prefix)
                last = prefix
            lines.append(text)
        try:
            return self._load("\n".join(lines))
        except Exception as error:  # any error: the records had passed the strict check
            raise self._differs(sources) from error

    def _differs(self, sources: Sequence[_Source]) -> ImageError:
        return ImageError(
            f"{self._into.source} was read twice, and the two readings differ; nothing of it "
            "was used.",
            where=f"records between {_place(min(sources)[0])} and {_place(max(sources)[0])}",
            cause="a bug of this program or of the library for this format, or faulty memory of "
            "this computer",
            remedy="Convert the file to a raw binary (objcopy -O binary), name its address with "
            "--base, and report it with the file.",
            code=ErrorCode.IMAGE_READINGS,
        )


def _digest(pieces: Sequence[_Piece]) -> tuple[list[list[int]], int]:
    """Return the contiguous address ranges as [start, end], and the CRC-32 of all bytes."""
    spans: list[list[int]] = []
    end = -1
    for start, data in pieces:
        if start != end:
            spans.append([start, start])
        end = spans[-1][1] = start + len(data)
    return spans, crc32(b"".join([data for _, data in pieces]))


# -- Intel HEX ------------------------------------------------------------------------------------

# Record: colon, then size, 16-bit address, type, data and checksum; all bytes together add up to
# 0. Types: 00 data, 01 end, 02 extended segment address (times 16), 03 and 05 start address
# (unused here), 04 extended linear address (upper 16 bits).
_DATA, _END, _SEGMENT, _START_SEGMENT, _LINEAR, _START_LINEAR = range(6)
_SIZES: Final = {_END: 0, _SEGMENT: 2, _START_SEGMENT: 4, _LINEAR: 2, _START_LINEAR: 4}
_HEAD_SIZE: Final = 4
_OVERHEAD_SIZE: Final = _HEAD_SIZE + 1
_SEGMENT_SIZE: Final = 0x1_0000


_FROM_ZERO: Final = ":020000040000FA"
"""Extended linear address record with the base address at the start of a file."""


def read_hex(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """Read an Intel HEX file. Raises ImageError with the line number of any damage."""
    scanner = _Scanner(file, source, "Intel HEX")
    reading = _Reading(scanner, _by_intelhex, into)
    offset, prefix = 0, _FROM_ZERO
    is_linear = False
    for text in scanner.lines():
        if text[0] != ":":
            raise scanner.refuse(f"{_shown(text)} does not start with a colon")
        record = scanner.record(
            text, 1, least_size=_OVERHEAD_SIZE, uncounted_size=_OVERHEAD_SIZE, total=0
        )
        kind, data = record[3], record[_HEAD_SIZE:-1]
        address = int.from_bytes(record[1:3], "big")
        if kind > _START_LINEAR:
            raise scanner.refuse(f"there is no record type {kind:02X}")
        if _SIZES.get(kind, len(data)) != len(data):
            raise scanner.refuse(f"a record of type {kind:02X} contains {len(data)} bytes")
        if kind == _DATA and data:
            # Only under an extended linear address may a record cross 64 KiB: elsewhere it wraps
            # around by the format, but programs disagree.
            if not is_linear and address + len(data) > _SEGMENT_SIZE:
                raise scanner.refuse("the record runs past the end of its 64 KiB segment")
            reading.add(offset + address, data, text, prefix)
        elif kind in (_SEGMENT, _LINEAR):
            if address:
                raise scanner.refuse("an extended address record has an address of its own")
            is_linear, prefix = kind == _LINEAR, text
            offset = int.from_bytes(data, "big") << (16 if is_linear else 4)
        elif kind == _END:
            scanner.ended = True
    reading.finish()


def _by_intelhex(lines: str) -> list[_Piece]:
    from intelhex import IntelHex  # noqa: PLC0415  only for such a file

    loaded = IntelHex(StringIO(lines))
    first, end = loaded.minaddr(), loaded.maxaddr() + 1
    spans = [(first, end)] if end - first == len(loaded) else loaded.segments()
    return [(start, loaded.gets(start, end - start)) for start, end in spans]


# -- Motorola S-record ----------------------------------------------------------------------------

# Record: S and type digit, then the count of what follows, an address, data and checksum; count to
# checksum add up to FF. Types: 0 header, 1 2 3 data with 16, 24, 32-bit address, 5 6 count of data
# records, 7 8 9 end. Some programs (such as bincopy) write the count and no end: a correct count
# also proves that nothing was lost, so it ends a file.
_ADDRESS_SIZES: Final = {
    "0": 2, "1": 2, "2": 3, "3": 4, "5": 2, "6": 3, "7": 4, "8": 3, "9": 2,
}  # fmt: skip
_HEADER: Final = "0"
_DATA_KINDS: Final = "123"
_COUNTS: Final = "56"
_ENDS: Final = "789"


def read_srec(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """Read an S-record file. Raises ImageError with the line number of any damage."""
    scanner = _Scanner(file, source, "Motorola S-record")
    reading = _Reading(scanner, _by_bincopy, into)
    data_records = 0
    first_line = 0
    for text in scanner.lines():
        kind = text[1:2]
        if text[0] != "S" or kind not in _ADDRESS_SIZES:
            raise scanner.refuse(f"{_shown(text)} does not start with S and a record type")
        data_at = 1 + _ADDRESS_SIZES[kind]
        record = scanner.record(text, 2, least_size=data_at + 1, uncounted_size=1, total=0xFF)
        address, data = int.from_bytes(record[1:data_at], "big"), record[data_at:-1]
        if data and kind in _COUNTS + _ENDS:
            raise scanner.refuse(f"a record of type S{kind} contains {len(data)} bytes of data")
        first_line = first_line or scanner.line
        if kind == _HEADER and scanner.line != first_line:
            raise scanner.refuse(
                "a header follows another record",
                "a damaged record type, which no checksum covers: a data record would be lost",
            )
        if kind in _DATA_KINDS:
            data_records += 1
            if data:
                reading.add(address, data, text)
        scanner.counted = kind in _COUNTS
        if scanner.counted and address != data_records:
            raise scanner.refuse(
                f"{data_records} data records precede the count of {address}",
                "lines were lost or doubled",
            )
        scanner.ended = kind in _ENDS
    reading.finish()


def _by_bincopy(lines: str) -> list[_Piece]:
    from bincopy import BinFile  # noqa: PLC0415  only for such a file

    loaded = BinFile()
    loaded.add_srec(lines)
    return [(segment.address, bytes(segment.data)) for segment in loaded.segments]
