"""Memory layout of the device model: application area, completeness record, ROM and RAM.

The record is on its own page after the application area. It is erased before everything else and
written last, its magic at the end, so that a power cut at any moment leaves either a complete
application or none.
"""

from __future__ import annotations

import zlib
from struct import Struct
from typing import ClassVar, Final

from flasher.mock.memory import ERASED, FlashMemory, Operation
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import PACKET_DATA_SIZE

AREA_START: Final = 0x0800_8000
"""Address of the application area; not visible on the wire (R8)."""
_RECORD: Final = Struct("<II8s")
_MAGIC: Final = b"WHOLEAPP"
_CHECKSUM: Final = Struct("<I")
_FACTORY_IMAGE_BYTES: Final = 500
_ROM_START: Final = 0x0800_0000
_ROM_SIZE_BYTES: Final = AREA_START - _ROM_START
"""The bootloader's memory, up to the application area."""
_RAM_START: Final = 0x2000_0000
_RAM_SIZE_BYTES: Final = 0x5000


def checksum_fits(image: bytes) -> bool:
    """True if the last four bytes of an image are the CRC-32 of the rest, little-endian (R7)."""
    body = image[: -_CHECKSUM.size]
    return len(image) > _CHECKSUM.size and _CHECKSUM.pack(zlib.crc32(body)) == image[len(body) :]


def with_checksum(head: bytes, size_bytes: int, content: bytes = b"") -> bytes:
    """Put `head` at the beginning of `content`, fill it up to `size_bytes` with varying bytes, and
    put the checksum of R7 at the end.
    """
    body = head + content[len(head) : size_bytes - _CHECKSUM.size]
    body += bytes(index * 7 % 253 for index in range(size_bytes - len(body) - _CHECKSUM.size))
    return body + _CHECKSUM.pack(zlib.crc32(body))


def factory_image(profile: DeviceProfile) -> bytes:
    """Create the initial application: its version among filler, with the checksum of R7."""
    size_bytes = min(_FACTORY_IMAGE_BYTES, profile.application_area_bytes)
    body = b"factory application " + profile.factory_version.encode("ascii") + b"\x00"
    body += bytes(index % 251 for index in range(size_bytes - len(body) - _CHECKSUM.size))
    return body + _CHECKSUM.pack(zlib.crc32(body))


class ApplicationStore:
    """Application area and completeness record, on their own flash."""

    flash_type: ClassVar[type[FlashMemory]] = FlashMemory

    def __init__(self, profile: DeviceProfile) -> None:
        self._area_bytes = profile.application_area_bytes
        self._erases_all = profile.erased_pages == "all"
        self._record_address = AREA_START + self._area_bytes
        self.flash = self.flash_type(
            AREA_START,
            self._area_bytes + profile.page_size_bytes,
            page_size_bytes=profile.page_size_bytes,
            program_unit_bytes=profile.program_unit_bytes,
        )

    def image(self) -> bytes | None:
        """Return the complete image in the area; None if there is none, or if it is damaged."""
        size_bytes, crc, magic = _RECORD.unpack(self.flash.read(self._record_address, _RECORD.size))
        if magic != _MAGIC or not 0 < size_bytes <= self._area_bytes:
            return None
        image = self.flash.read(AREA_START, size_bytes)
        return image if self._is_intact(image, crc) else None

    def _is_intact(self, image: bytes, crc: int) -> bool:
        return zlib.crc32(image) == crc

    def read(self, size_bytes: int) -> bytes:
        """Read the first bytes of the area, complete or not."""
        return self.flash.read(AREA_START, size_bytes)

    def erasing(self, size_bytes: int) -> list[Operation]:
        """Operations that erase the area for an image: the record first, then the pages."""
        area_bytes = self._area_bytes if self._erases_all else size_bytes
        pages = range(AREA_START, AREA_START + area_bytes, self.flash.page_size_bytes)
        return [Operation(self._record_address), *(Operation(page) for page in pages)]

    def storing(self, number: int, payload: bytes, size_bytes: int) -> Operation:
        """Operation that stores packet `number` of an image of `size_bytes`.

        Bytes beyond the size are not stored (TX-08).
        """
        offset = (number - 1) * PACKET_DATA_SIZE
        return Operation(AREA_START + offset, self._units(payload[: size_bytes - offset]))

    def recording(self, size_bytes: int) -> Operation:
        """Operation that marks the first `size_bytes` of the area as a complete application."""
        record = _RECORD.pack(size_bytes, zlib.crc32(self.read(size_bytes)), _MAGIC)
        return Operation(self._record_address, self._units(record))

    def load(self, image: bytes) -> None:
        """Program an image and its record without operation times and counts, as in a factory."""
        self.flash.program(AREA_START, self._units(image))
        self.flash.execute(self.recording(len(image)))
        self.flash.program_count = 0

    def _units(self, data: bytes) -> bytes:
        """Fill `data` up to whole program units."""
        unit = self.flash.program_unit_bytes
        return data.ljust(-(-len(data) // unit) * unit, bytes((ERASED,)))


class MemoryMap:
    """Memory for memory reads (0x4308): flash, and constant invented contents of ROM and RAM."""

    def __init__(self, flash: FlashMemory) -> None:
        self._areas = (
            (_ROM_START, _ROM_SIZE_BYTES, _invented),
            (flash.start, flash.size_bytes, flash.read),
            (_RAM_START, _RAM_SIZE_BYTES, _invented),
        )

    def read(self, start: int, end: int) -> bytes | None:
        """Read memory from `start` up to `end`, exclusive; None if a byte is outside of it."""
        found = b""
        while start < end:
            area = next((each for each in self._areas if 0 <= start - each[0] < each[1]), None)
            if area is None:
                return None
            area_start, area_bytes, read = area
            size_bytes = min(end, area_start + area_bytes) - start
            found += read(start, size_bytes)
            start += size_bytes
        return found


def _invented(start: int, size_bytes: int) -> bytes:
    addresses = range(start, start + size_bytes)
    return bytes((address * 167 + (address >> 8) * 13) & 0xFF for address in addresses)
