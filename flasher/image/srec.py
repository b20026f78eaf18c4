"""Motorola S-record.

Record: S and type digit, then in hex digits the count of what follows, an address, data and check
sum; count to check sum add up to FF. Types: 0 header, 1 2 3 data with 16, 24, 32-bit address, 5 6
count of data records, 7 8 9 end. Some programs (bincopy is one) write the count and no end: a right
count shows as well that nothing was lost, so it is taken for an end.
"""

from __future__ import annotations

from typing import BinaryIO, Final

from flasher.image.records import Scanner, shown
from flasher.image.segments import SparseBytes

FORMAT: Final = "Motorola S-record"
_ADDRESS_SIZES: Final = {
    "0": 2, "1": 2, "2": 3, "3": 4, "5": 2, "6": 3, "7": 4, "8": 3, "9": 2,
}  # fmt: skip
_HEADER: Final = "0"
_DATA: Final = "123"
_COUNTS: Final = "56"
_ENDS: Final = "789"


def read(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """All data of an S-record file. Raises ImageError with the line number on any damage."""
    scanner = Scanner(file, source, FORMAT)
    data_records = 0
    first_line = 0
    for text in scanner.lines():
        kind, address, data = _parse(scanner, text)
        first_line = first_line or scanner.line
        if kind == _HEADER and scanner.line != first_line:
            raise scanner.refuse(
                "a header stands behind another record",
                "a damaged type: no check sum covers it, and this would lose a data record",
            )
        if kind in _DATA:
            data_records += 1
            scanner.check_end(address + len(data))
            into.add(address, data, scanner.place)
        scanner.counted = kind in _COUNTS
        if scanner.counted and address != data_records:
            raise scanner.refuse(
                f"{data_records} data records stand before the count of {address}",
                "lines were lost or doubled",
            )
        if kind in _ENDS:
            scanner.ended = True


def _parse(scanner: Scanner, text: str) -> tuple[str, int, bytes]:
    """Type, address and data of one record."""
    kind = text[1:2]
    if text[0] != "S" or kind not in _ADDRESS_SIZES:
        raise scanner.refuse(f"{shown(text)} does not start with S and a record type")
    record = scanner.unhex(text[2:], text)
    data_at = 1 + _ADDRESS_SIZES[kind]
    size = len(record) - data_at - 1
    if size < 0 or len(record) != 1 + record[0]:
        raise scanner.refuse(f"{shown(text)} does not have the length that it states")
    if sum(record) & 0xFF != 0xFF:
        computed = ~sum(record[:-1]) & 0xFF
        raise scanner.refuse(f"the check sum is {record[-1]:02X}, computed {computed:02X}")
    if size and kind in _COUNTS + _ENDS:
        raise scanner.refuse(f"a record of type S{kind} holds {size} bytes of data")
    return kind, int.from_bytes(record[1:data_at], "big"), record[data_at:-1]
