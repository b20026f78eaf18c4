"""Intel HEX.

Record: colon, then in hex digits size, 16-bit address, type, data and check sum; all bytes
together add up to 0. Types: 00 data, 01 end, 02 extended segment address (times 16), 03 and 05
start address (of no use here), 04 extended linear address (upper 16 bits).
"""

from __future__ import annotations

from typing import BinaryIO, Final

from flasher.image.records import Scanner, shown
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
    offset = 0
    is_linear = False
    for text in scanner.lines():
        record = _parse(scanner, text)
        kind, data = record[3], record[_HEAD_SIZE:-1]
        address = int.from_bytes(record[1:3], "big")
        if kind == _DATA and data:
            # Only under an extended linear address may a record go on beyond 64 KiB: elsewhere the
            # format has it wrap around and programs do not agree on it.
            if not is_linear and address + len(data) > _SEGMENT_SIZE:
                raise scanner.refuse("the record runs past the end of its 64 KiB segment")
            scanner.check_end(offset + address + len(data))
            into.add(offset + address, data, scanner.place)
        elif kind in (_SEGMENT, _LINEAR):
            if address:
                raise scanner.refuse("an extended address record has an address of its own")
            is_linear = kind == _LINEAR
            offset = int.from_bytes(data, "big") << (16 if is_linear else 4)
        elif kind == _END:
            scanner.ended = True


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
