"""ELF reader: sections inside loadable segments, at physical addresses, like objcopy.

Other bytes of a segment (the file's own headers, padding) are not part of the program. A segment
with bytes but no section is refused as ambiguous.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from struct import Struct
from typing import BinaryIO, Final

from flasher.errors import ErrorCode, ImageError
from flasher.image.image import ADDRESS_SPACE
from flasher.image.segments import SparseBytes

MAGIC: Final = b"\x7fELF"
EM_ARM: Final = 40
_MACHINES: Final = {
    2: "SPARC",
    3: "x86",
    8: "MIPS",
    20: "PowerPC",
    36: "V850",
    42: "SuperH",
    62: "x86-64",
    83: "AVR",
    87: "V850",
    94: "Xtensa",
    105: "MSP430",
    173: "RX",
    183: "AArch64",
    197: "RL78",
    243: "RISC-V",
}

_CLASS_AT, _CLASS_32 = 4, 1
_BYTE_ORDER_AT: Final = 5
_BYTE_ORDERS: Final = {1: "<", 2: ">"}
_MACHINE_AT, _MACHINE_END = 18, 20
_HEADER: Final = "16s2H5I6H"
_PROGRAM_HEADER: Final = "8I"
_LOADABLE: Final = 1
_SECTION_HEADER: Final = "10I"
_NO_BITS: Final = 8
_ALLOCATED: Final = 2
_PROGRAM_HEADERS_MAX: Final = 64
_SECTIONS_MAX: Final = 4096
"""A linked program has a few dozen. Processing time grows with the product of both limits."""


@dataclass(frozen=True)
class _Load:
    """Loadable segment (program header) with bytes in the file."""

    number: int
    offset: int
    address: int
    size: int

    @property
    def end(self) -> int:
        return self.offset + self.size

    def place(self, _address: int) -> str:
        return f"program header {self.number}"


def read(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """Read the bytes of all loadable sections. Raises ImageError for a damaged ELF file."""
    data = file.read()
    order, fields = _header(data, source)
    sections_at, section_size, section_count = fields[6], fields[11], fields[12]
    loads = _loads(data, source, order, fields)
    sections = sorted(
        (offset, offset + size)
        for _, kind, flags, _, offset, size, *_ in _table(
            data,
            source,
            "its section table is",
            Struct(order + _SECTION_HEADER),
            (sections_at, section_size, section_count),
        )
        if size and flags & _ALLOCATED and kind != _NO_BITS
    )
    for load in loads:
        inside = [each for each in sections if load.offset <= each[0] < load.end]
        if not inside:
            raise _refuse(source, f"program header {load.number} has bytes but no section")
        done = load.offset
        for start, end in inside:
            if end > load.end:
                raise _refuse(source, "a section is outside its program header")
            fresh = max(start, done)  # overlapping sections share the same bytes
            into.add(load.address + fresh - load.offset, data[fresh:end], load.place)
            done = max(done, end)


def machine_of(head: bytes) -> int | None:
    """Processor number (e_machine) from the first bytes of an ELF file; None if truncated."""
    order = _BYTE_ORDERS.get(head[_BYTE_ORDER_AT]) if len(head) >= _MACHINE_END else None
    return None if order is None else int(Struct(f"{order}H").unpack_from(head, _MACHINE_AT)[0])


def machine_name(machine: int | None) -> str:
    """Processor name of an ELF machine number."""
    return _MACHINES.get(machine or 0, f"ELF machine {machine}")


def _header(data: bytes, source: str) -> tuple[str, tuple[int, ...]]:
    """Return the byte order, as in `struct`, and the ELF header fields."""
    if not data.startswith(MAGIC):
        raise _refuse(source, "it does not start with 7F 45 4C 46")
    order = _BYTE_ORDERS.get(data[_BYTE_ORDER_AT]) if len(data) > _BYTE_ORDER_AT else None
    header = Struct(f"{order or '<'}{_HEADER}")
    if order is None or len(data) < header.size:
        raise _refuse(source, "its header is truncated")
    if data[_CLASS_AT] != _CLASS_32:
        raise ImageError(
            f"{source} is an ELF file for a 64-bit processor",
            cause="it is a program for a computer, not for the device",
            remedy="Name the firmware file.",
        )
    fields = header.unpack_from(data)
    if fields[10] > _PROGRAM_HEADERS_MAX or fields[12] > _SECTIONS_MAX:
        raise _refuse(source, f"it has {fields[10]} program headers and {fields[12]} sections")
    return order, fields


def _table(
    data: bytes, source: str, what: str, entry: Struct, place: tuple[int, int, int]
) -> Iterator[tuple[int, ...]]:
    """Yield the entries of an ELF header table; `place` is its offset, entry size and length."""
    at, size, count = place
    if count and (size != entry.size or at + count * size > len(data)):
        raise _refuse(source, f"{what} truncated")
    return (entry.unpack_from(data, at + number * size) for number in range(count))


def _loads(data: bytes, source: str, order: str, fields: tuple[int, ...]) -> list[_Load]:
    """Return the loadable segments. Raises ImageError for one outside file or address space."""
    place = fields[5], fields[9], fields[10]
    table = _table(data, source, "its program headers are", Struct(order + _PROGRAM_HEADER), place)
    loads = []
    for number, (kind, offset, _, address, size, *_) in enumerate(table):
        if kind != _LOADABLE or not size:
            continue
        if offset + size > len(data):
            raise _refuse(source, f"program header {number} points past the end of the file")
        if address + size > ADDRESS_SPACE:
            raise _refuse(source, f"program header {number} runs past address 0xFFFFFFFF")
        loads.append(_Load(number, offset, address, size))
    if not loads:
        raise ImageError(
            f"{source} has no loadable segment",
            cause="it is an object file, or contains only debug information",
            remedy="Name the linked program.",
            code=ErrorCode.IMAGE_EMPTY,
        )
    return loads


def _refuse(source: str, what: str) -> ImageError:
    return ImageError(
        f"{source} is a damaged ELF file: {what}",
        cause="cut off or damaged while it was written or copied",
        remedy="Make the file again, or convert it: objcopy -O ihex.",
        code=ErrorCode.IMAGE_DAMAGED,
    )
