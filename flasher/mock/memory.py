"""Flash memory model as strict as a real part, and its controller with erase and program times.

Operations that a real part does not allow are errors: programming without erasing, off the program
unit, or outside. An operation can be interrupted (`tear_...`), as by a power cut; torn memory must
be erased before it is programmed again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import inf
from typing import Final, NamedTuple

from flasher.errors import FlasherError

ERASED: Final = 0xFF
"""Value of an erased byte."""


class FlashError(FlasherError):
    """The bootloader used the flash in a way that a real part does not allow: a bug."""


class FlashRangeError(FlashError):
    """The address is outside the flash."""


class FlashAlignmentError(FlashError):
    """Address or size are not those of whole pages or program units."""


class FlashNotErasedError(FlashError):
    """A program unit was programmed, or torn, since its page was erased."""


class FlashMemory:
    """`size_bytes` of flash from address `start`, erased by page, programmed by unit.

    A unit counts as programmed even if it was programmed with FF, as in parts with ECC. Raises
    ValueError unless memory is whole pages, and a page whole program units.
    """

    def __init__(
        self, start: int, size_bytes: int, *, page_size_bytes: int, program_unit_bytes: int
    ) -> None:
        if size_bytes % page_size_bytes or page_size_bytes % program_unit_bytes:
            raise ValueError("memory is whole pages, and a page is whole program units")
        self.start = start
        self.size_bytes = size_bytes
        self.page_size_bytes = page_size_bytes
        self.program_unit_bytes = program_unit_bytes
        self.erase_count = 0
        """Number of completely erased pages."""
        self.program_count = 0
        """Number of completed program operations."""
        self._erased_page = bytes((ERASED,)) * page_size_bytes
        self._pages: dict[int, bytearray] = {}
        """Pages that are not erased, by offset: few of the megabytes are ever used."""
        self._used_units: set[int] = set()

    def assign(self, other: FlashMemory) -> None:
        """Take over the content of a memory of the same layout."""
        self._pages = {offset: bytearray(page) for offset, page in other._pages.items()}
        self._used_units = set(other._used_units)

    def read(self, address: int, size_bytes: int) -> bytes:
        """Read bytes. Raises FlashRangeError."""
        offset = self._offset(address, size_bytes)
        place = offset % self.page_size_bytes
        first = offset - place
        if place + size_bytes <= self.page_size_bytes:  # as a rule
            return bytes(self._pages.get(first, self._erased_page)[place : place + size_bytes])
        pages = range(first, offset + size_bytes, self.page_size_bytes)
        found = b"".join(self._pages.get(page, self._erased_page) for page in pages)
        return found[place:][:size_bytes]

    def erase_page(self, address: int) -> None:
        """Erase the page that begins at `address`.

        Raises FlashRangeError, FlashAlignmentError.
        """
        offset = self._page_offset(address)
        self._pages.pop(offset, None)
        self._used_units.difference_update(self._units(offset, self.page_size_bytes))
        self.erase_count += 1

    def program(self, address: int, data: bytes) -> None:
        """Program `data`, whole program units.

        Raises FlashRangeError, FlashAlignmentError, FlashNotErasedError.
        """
        offset = self._programmable_offset(address, data)
        self._put(offset, data)
        self._used_units.update(self._units(offset, len(data)))
        self.program_count += 1

    def execute(self, operation: Operation) -> None:
        """Complete an erase or program operation. Raises FlashError."""
        if operation.data is None:
            self.erase_page(operation.address)
        else:
            self.program(operation.address, operation.data)

    def tear(self, operation: Operation, fraction: float) -> None:
        """Interrupt an operation after `fraction` of its time (0 to 1). Raises FlashError."""
        if operation.data is None:
            self.tear_erase(operation.address, fraction)
        else:
            self.tear_program(operation.address, operation.data, fraction)

    def tear_erase(self, address: int, fraction: float) -> None:
        """Interrupt the erasing of a page after `fraction` of its time (0 to 1).

        That part of the page reads as erased, the rest as before; none of it can be programmed.
        Raises FlashRangeError, FlashAlignmentError.
        """
        offset = self._page_offset(address)
        done_bytes = int(fraction * self.page_size_bytes)
        self._put(offset, self._erased_page[:done_bytes])
        self._used_units.update(self._units(offset, self.page_size_bytes))

    def tear_program(self, address: int, data: bytes, fraction: float) -> None:
        """Interrupt programming after `fraction` of its time (0 to 1): earlier units are
        programmed, the current one half, the rest not. Raises FlashError.
        """
        offset = self._programmable_offset(address, data)
        unit = self.program_unit_bytes
        whole_bytes = min(int(fraction * len(data)) // unit * unit, len(data) - unit)
        done_bytes = whole_bytes + unit // 2
        self._put(offset, data[:done_bytes])
        self._used_units.update(self._units(offset, whole_bytes + unit))

    def _offset(self, address: int, size_bytes: int) -> int:
        offset = address - self.start
        if offset < 0 or size_bytes < 0 or offset + size_bytes > self.size_bytes:
            raise FlashRangeError(
                f"{size_bytes} bytes at 0x{address:08X} are outside the flash",
                where=f"flash from 0x{self.start:08X}, {self.size_bytes} bytes",
            )
        return offset

    def _page_offset(self, address: int) -> int:
        offset = self._offset(address, self.page_size_bytes)
        if offset % self.page_size_bytes:
            raise FlashAlignmentError(
                f"no page begins at 0x{address:08X}", where=f"{self.page_size_bytes} bytes a page"
            )
        return offset

    def _programmable_offset(self, address: int, data: bytes) -> int:
        offset = self._offset(address, len(data))
        unit = self.program_unit_bytes
        if not data or offset % unit or len(data) % unit:
            raise FlashAlignmentError(
                f"{len(data)} bytes at 0x{address:08X} are not whole program units",
                where=f"{unit} bytes a unit",
            )
        if not self._used_units.isdisjoint(self._units(offset, len(data))):
            raise FlashNotErasedError(
                f"{len(data)} bytes at 0x{address:08X} are programmed without having been erased",
                where=f"page 0x{address - offset % self.page_size_bytes:08X}",
            )
        return offset

    def _put(self, offset: int, data: bytes) -> None:
        """Store `data` without checks."""
        while data:
            place = offset % self.page_size_bytes
            page = self._pages.setdefault(offset - place, bytearray(self._erased_page))
            part = data[: self.page_size_bytes - place]
            page[place : place + len(part)] = part
            offset, data = offset + len(part), data[len(part) :]

    def _units(self, offset: int, size_bytes: int) -> range:
        """Numbers of the program units in a range."""
        unit = self.program_unit_bytes
        return range(offset // unit, (offset + size_bytes) // unit)


class Operation(NamedTuple):
    """Flash operation: program `data` at `address`, or erase that page if `data` is None."""

    address: int
    data: bytes | None = None


class FlashController:
    """Executes flash operations one after another, each with its duration.

    An operation changes the memory at its end. If interrupted, it leaves a partial change; with
    durations of 0 no operation can be interrupted.
    """

    def __init__(self, flash: FlashMemory, *, erase_time_s: float, program_time_s: float) -> None:
        self._flash = flash
        self._erase_time_s = erase_time_s
        self._program_time_s = program_time_s
        self._waiting: deque[Operation] = deque()
        self._under_way: Operation | None = None
        self._began_at = 0.0

    @property
    def ends_at(self) -> float:
        """End time of the current operation; infinite without one."""
        reached_at = self.reached_at(1.0)
        return inf if reached_at is None else reached_at

    def reached_at(self, share: float) -> float | None:
        """Time at which `share` (0 to 1) of the current operation is done; None without one."""
        if self._under_way is None:
            return None
        return self._began_at + share * self._duration_s(self._under_way)

    def run(self, operations: Iterable[Operation], now: float) -> None:
        """Queue `operations` after the current one, replacing those that wait."""
        self._waiting = deque(operations)
        if self._under_way is None:
            self._begin_next(now)

    def advance(self, now: float) -> bool:
        """Finish the operations that are over at `now`; True if none is left.

        Raises FlashError for an operation that the flash refuses.
        """
        while (operation := self._under_way) is not None:
            ends_at = self._began_at + self._duration_s(operation)
            if ends_at > now:
                return False
            self._flash.execute(operation)
            self._begin_next(ends_at)
        return True

    def abort(self, now: float) -> None:
        """Lose power or clock: tear the current operation, drop the rest."""
        self.advance(now)
        self._waiting.clear()
        operation, self._under_way = self._under_way, None
        if operation is None or now <= self._began_at:
            return
        self._flash.tear(operation, (now - self._began_at) / self._duration_s(operation))

    def _begin_next(self, now: float) -> None:
        self._under_way = self._waiting.popleft() if self._waiting else None
        self._began_at = now

    def _duration_s(self, operation: Operation) -> float:
        return self._erase_time_s if operation.data is None else self._program_time_s
