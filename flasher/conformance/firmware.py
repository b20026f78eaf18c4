"""Images of simulated devices: short ones, and ones that look like firmware."""

from __future__ import annotations

from itertools import count
from typing import Final, NamedTuple, Protocol

from flasher.conformance.wire import PACKET_BYTES

GOOD: Final = ("V2r0r1_20240131", 10 * PACKET_BYTES - 3)
SECOND: Final = ("V1r9r0_20230517", 6 * PACKET_BYTES)
"""Version and size of short images, for cases that repeat transfers."""
_SECTORS: Final = 3
_BYTES_MIN: Final = 24 * PACKET_BYTES
_BYTES_MAX: Final = 64 * 1024
_REPEATED: Final = slice(3 * PACKET_BYTES, 4 * PACKET_BYTES)


class ImageMaker(Protocol):
    """Makes an image of `content` that runs on the device, with a head and a checksum in it."""

    def __call__(self, version: str, size_bytes: int, content: bytes) -> bytes: ...


class Firmware(NamedTuple):
    """Images for cases about content and size, each of another version."""

    good: bytes
    """Whole erase sectors; the middle one is blank, and two packets in a row are equal."""
    second: bytes | None
    """Smaller, with zeros where `good` is blank; its last packet has a single byte."""
    sizes: tuple[bytes, ...] = ()
    """One packet, one sector, a byte more and a byte less than a sector."""


def make_firmware(make: ImageMaker, sector_bytes: int, area_bytes: int) -> Firmware | None:
    """Make images of three sectors of `sector_bytes`, of 3 KiB to 64 KiB; None when the application
    area of `area_bytes` is too small for that.
    """
    part_bytes = min(max(sector_bytes, _BYTES_MIN // _SECTORS), _BYTES_MAX // _SECTORS)
    part_bytes -= part_bytes % PACKET_BYTES
    if area_bytes < _SECTORS * part_bytes:
        return None

    def varied(size_bytes: int, step: int) -> bytearray:
        content = bytearray(index * step % 253 for index in range(size_bytes))
        repeated = content[_REPEATED]
        content[_REPEATED.stop : _REPEATED.stop + PACKET_BYTES] = repeated
        return content

    def image(number: int, content: bytearray) -> bytes:
        return make(f"V1r8r{number}_20230201", len(content), bytes(content))

    middle = slice(part_bytes, 2 * part_bytes)
    good, second = varied(_SECTORS * part_bytes, 11), varied(2 * part_bytes + 1, 13)
    good[middle] = b"\xff" * part_bytes
    second[middle] = bytes(part_bytes)
    sizes = (PACKET_BYTES, part_bytes, part_bytes + 1, part_bytes - 1)
    others = (varied(part_bytes + 1, 17)[:size] for size in sizes)
    return Firmware(image(1, good), image(2, second), tuple(map(image, count(3), others)))
