"""ELF: the loadable segments, at their physical addresses, read by bincopy.

bincopy takes the sections inside the loadable segments, as objcopy does. It lets later bytes
overwrite earlier ones, and a segment without sections is nothing to it; so the program headers are
read here first, and what bincopy finds has to be what they say.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import BinaryIO, Final

from flasher.errors import ImageError
from flasher.image.image import ADDRESS_SPACE
from flasher.image.segments import SparseBytes

FORMAT: Final = "ELF"
MAGIC: Final = b"\x7fELF"

_CLASS_AT, _CLASS_32 = 4, 1
_BYTE_ORDER_AT: Final = 5
_BYTE_ORDERS: Final = {1: "<", 2: ">"}
_HEADER: Final = "16s2H5I6H"
_PROGRAM_HEADER: Final = "8I"
_LOADABLE: Final = 1
_PROGRAM_HEADERS_MAX: Final = 64
_SECTIONS_MAX: Final = 4096
"""An image has a few dozen. bincopy's time grows with the product of the two."""


@dataclass(frozen=True)
class _Load:
    """A loadable segment that has bytes in the file."""

    number: int
    offset: int
    address: int
    size: int

    def place(self, _address: int) -> str:
        return f"program header {self.number}"


def read(file: BinaryIO, source: str, into: SparseBytes) -> None:
    """The bytes of all loadable segments. Raises ImageError when the file is damaged."""
    data = file.read()
    loads = _loads(data, source)
    from bincopy import BinFile  # noqa: PLC0415  a fifth of the time that flasher takes to load

    reader = BinFile()
    try:
        reader.add_elf(data)
        found = [(segment.address, bytes(segment.data)) for segment in reader.segments]
    except Exception as error:
        raise _refuse(source, f"its section table cannot be read ({error})") from error
    stated = SparseBytes(source, into.window)
    for load in loads:
        stated.add(load.address, data[load.offset : load.offset + load.size], load.place)
        end = load.address + load.size
        if not any(at < end and load.address < at + len(piece) for at, piece in found):
            raise _refuse(source, f"program header {load.number} has bytes but no section")
    stated_bytes = stated.size_bytes
    for address, piece in found:
        stated.add(address, piece, lambda _: "sections and program headers differ")
        into.add(address, piece, str)
    if stated.size_bytes != stated_bytes:
        raise _refuse(source, "a section lies outside of its program header")


def _loads(data: bytes, source: str) -> list[_Load]:
    """The loadable segments that have bytes in the file."""
    if not data.startswith(MAGIC):
        raise _refuse(source, "it does not start with 7F 45 4C 46")
    order = _BYTE_ORDERS.get(data[_BYTE_ORDER_AT]) if len(data) > _BYTE_ORDER_AT else None
    header = Struct(f"{order or '<'}{_HEADER}")
    if order is None or len(data) < header.size:
        raise _refuse(source, "its header is not whole")
    if data[_CLASS_AT] != _CLASS_32:
        raise ImageError(
            f"{source} is an ELF file for a 64-bit processor",
            cause="a program for the computer, not for the device",
            remedy="name the firmware's file",
        )
    fields = header.unpack_from(data)
    table_at, entry_size, entries, sections = fields[5], fields[9], fields[10], fields[12]
    entry = Struct(f"{order}{_PROGRAM_HEADER}")
    if entries and (entry_size != entry.size or table_at + entries * entry_size > len(data)):
        raise _refuse(source, "its program headers are not whole")
    if entries > _PROGRAM_HEADERS_MAX or sections > _SECTIONS_MAX:
        raise _refuse(source, f"it has {entries} program headers and {sections} sections")
    loads = []
    for number in range(entries):
        kind, offset, _, address, size, *_ = entry.unpack_from(data, table_at + number * entry_size)
        if kind != _LOADABLE or not size:
            continue
        if offset + size > len(data):
            raise _refuse(source, f"program header {number} points behind the end of the file")
        if address + size > ADDRESS_SPACE:
            raise _refuse(source, f"program header {number} runs past address 0xFFFFFFFF")
        loads.append(_Load(number, offset, address, size))
    if not loads:
        raise ImageError(
            f"{source} holds no loadable segment",
            cause="an object file or a file of debug information alone",
            remedy="name the linked program",
        )
    return loads


def _refuse(source: str, what: str) -> ImageError:
    return ImageError(
        f"{source} is a damaged ELF file: {what}",
        cause="cut off or damaged while it was written or copied",
        remedy="make the file again, or convert it: objcopy -O ihex",
    )
