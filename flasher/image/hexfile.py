"""Intel HEX: the scan before the library, and the library.

Record: colon, then in hex digits size, 16-bit address, type, data and check sum; all bytes
together add up to 0. Types: 00 data, 01 end, 02 extended segment address (times 16), 03 and 05
start address (of no use here), 04 extended linear address (upper 16 bits).
"""

from __future__ import annotations

from collections.abc import Iterator
from io import StringIO
from typing import BinaryIO, Final

from intelhex import IntelHex

from flasher.image.records import Run, Runs, Scanner, shown
from flasher.image.segments import SparseBytes

FORMAT: Final = "Intel HEX"
_DATA, _END, _SEGMENT, _START_SEGMENT, _LINEAR, _START_LINEAR = range(6)
_SIZES: Final = {_END: 0, _SEGMENT: 2, _START_SEGMENT: 4, _LINEAR: 2, _START_LINEAR: 4}
_HEAD_SIZE: Final = 4
_OVERHEAD_SIZE: Final = _HEAD_SIZE + 1
_SEGMENT_SIZE: Final = 0x1_0000


def read(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """All data of an Intel HEX file. Raises ImageError with the line number on any damage."""
    scanner = Scanner(file, source, FORMAT)
    for run in scan(scanner):
        into.add(run.start, scanner.agreed(run, _read_run), run.place)


def _read_run(run: Run) -> tuple[int, bytes]:
    reader = IntelHex(StringIO("\n".join(run.lines)))
    return reader.minaddr(), reader.tobinstr()


def scan(scanner: Scanner) -> Iterator[Run]:
    """The runs of a file, every record checked."""
    runs = Runs()
    area = _Area(scanner)
    for text in scanner.lines():
        record = _parse(scanner, text)
        kind, size = record[3], record[0]
        address = int.from_bytes(record[1:3], "big")
        if kind == _DATA and size:
            start = area.place(address, size)
            for run in runs.add(start, size, text, scanner.line):
                yield area.in_context(run)
        elif kind in (_SEGMENT, _LINEAR):
            for run in runs.take():
                yield area.in_context(run)
            area.move(kind, address, record[_HEAD_SIZE:-1], text)
        elif kind == _END:
            scanner.ended = True
    for run in runs.take():
        yield area.in_context(run)


class _Area:
    """Where the 16-bit addresses of data records lie, as the extended records have it."""

    def __init__(self, scanner: Scanner) -> None:
        self._scanner = scanner
        self._offset = 0
        self._is_linear = False
        self._record: str | None = None

    def move(self, kind: int, address: int, data: bytes, text: str) -> None:
        if address:
            raise self._scanner.refuse("an extended address record has an address of its own")
        self._is_linear = kind == _LINEAR
        self._offset = int.from_bytes(data, "big") << (16 if self._is_linear else 4)
        self._record = text

    def place(self, address: int, size: int) -> int:
        """The absolute address of a data record.

        Only under an extended linear address may a record go on beyond 64 KiB: elsewhere the
        format has it wrap around and programs do not agree on it.
        """
        if not self._is_linear and address + size > _SEGMENT_SIZE:
            raise self._scanner.refuse("the record runs past the end of its 64 KiB segment")
        start = self._offset + address
        self._scanner.check_end(start + size)
        return start

    def in_context(self, run: Run) -> Run:
        """The run with the extended record in front that the library needs to place it."""
        if self._record is not None:
            run.lines.insert(0, self._record)
        return run


def _parse(scanner: Scanner, text: str) -> bytes:
    if text[0] != ":":
        raise scanner.refuse(f"{shown(text)} does not start with a colon")
    record = scanner.unhex(text[1:], text)
    if len(record) < _OVERHEAD_SIZE or len(record) != _OVERHEAD_SIZE + record[0]:
        raise scanner.refuse(f"{shown(text)} does not have the length that it states")
    if sum(record) & 0xFF:
        computed = -sum(record[:-1]) & 0xFF
        raise scanner.refuse(f"the check sum is {record[-1]:02X}, computed {computed:02X}")
    kind = record[3]
    if kind > _START_LINEAR:
        raise scanner.refuse(f"there is no record type {kind:02X}")
    if _SIZES.get(kind, record[0]) != record[0]:
        raise scanner.refuse(f"a record of type {kind:02X} holds {record[0]} bytes")
    return record
