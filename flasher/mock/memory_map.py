"""What stands at which address of a device, for those who read its memory (0x4308)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from flasher.mock.memory import Flash

ROM_START: Final = 0x0800_0000
ROM_SIZE_BYTES: Final = 0x8000
"""The bootloader, up to where the application area begins."""
RAM_START: Final = 0x2000_0000
RAM_SIZE_BYTES: Final = 0x5000


class Area(NamedTuple):
    """Addresses that can be read; `read` takes an address and a size in bytes."""

    start: int
    size_bytes: int
    read: Callable[[int, int], bytes]


class MemoryMap:
    """Areas of a device's memory; between them there is nothing."""

    def __init__(self, areas: Sequence[Area]) -> None:
        self._areas = areas

    def read(self, start: int, end: int) -> bytes | None:
        """The bytes from `start` to before `end`; None when one of them is nowhere."""
        found = b""
        while start < end:
            area = next((a for a in self._areas if 0 <= start - a.start < a.size_bytes), None)
            if area is None:
                return None
            size_bytes = min(end, area.start + area.size_bytes) - start
            found += area.read(start, size_bytes)
            start += size_bytes
        return found


def memory_map(flash: Flash) -> MemoryMap:
    """Bootloader, flash and RAM; what stands in the first and the last is made up, but fixed."""
    return MemoryMap(
        (
            Area(ROM_START, ROM_SIZE_BYTES, _made_up),
            Area(flash.start, flash.size_bytes, flash.read),
            Area(RAM_START, RAM_SIZE_BYTES, _made_up),
        )
    )


def _made_up(start: int, size_bytes: int) -> bytes:
    addresses = range(start, start + size_bytes)
    return bytes((address * 167 + (address >> 8) * 13) & 0xFF for address in addresses)
