"""Flash memory as strict as the real thing, and the controller that works on it in time.

What a real part does not allow is an error here: programming what is not erased, off the program
unit, or outside. An operation can be left half done (`tear_...`), as a power cut leaves it; what is
torn has to be erased before it is programmed again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import inf
from typing import Final, NamedTuple

from flasher.errors import FlasherError

ERASED: Final = 0xFF
"""What an erased byte reads as."""


class FlashError(FlasherError):
    """The flash was used in a way that a real part does not allow: a bug of the bootloader."""


class FlashRangeError(FlashError):
    """The address lies outside of the memory."""


class FlashAlignmentError(FlashError):
    """The address or the size does not fit the page or the program unit."""


class FlashNotErasedError(FlashError):
    """A unit was programmed, or torn, since its page was erased."""


class Flash:
    """`size_bytes` of flash from address `start`, erased by the page, programmed by the unit.

    A unit counts as programmed even when it was programmed with FF, as in parts with ECC. Raises
    ValueError when the sizes do not divide each other.
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
        """Pages erased to the end."""
        self.program_count = 0
        """Program operations carried out to the end."""
        self._erased_page = bytes((ERASED,)) * page_size_bytes
        self._pages: dict[int, bytearray] = {}
        """By offset, those that are not erased: of megabytes, few pages are ever used."""
        self._used_units: set[int] = set()

    def read(self, address: int, size_bytes: int) -> bytes:
        """The bytes there. Raises FlashRangeError."""
        offset = self._offset(address, size_bytes)
        first = offset - offset % self.page_size_bytes
        pages = range(first, offset + size_bytes, self.page_size_bytes)
        found = b"".join(self._pages.get(page, self._erased_page) for page in pages)
        return found[offset - first :][:size_bytes]

    def erase_page(self, address: int) -> None:
        """Erase the page that begins at `address`.

        Raises FlashRangeError, FlashAlignmentError.
        """
        offset = self._page_offset(address)
        self._pages.pop(offset, None)
        self._used_units.difference_update(self._units(offset, self.page_size_bytes))
        self.erase_count += 1

    def program(self, address: int, data: bytes) -> None:
        """Program `data`, whole units.

        Raises FlashRangeError, FlashAlignmentError, FlashNotErasedError.
        """
        offset = self._programmable_offset(address, data)
        self._put(offset, data)
        self._used_units.update(self._units(offset, len(data)))
        self.program_count += 1

    def carry_out(self, operation: Operation) -> None:
        """Erase or program, to the end. Raises as these do."""
        if operation.data is None:
            self.erase_page(operation.address)
        else:
            self.program(operation.address, operation.data)

    def tear(self, operation: Operation, fraction: float) -> None:
        """Leave it interrupted after `fraction` of its time (0 to 1). Raises as `carry_out`."""
        if operation.data is None:
            self.tear_erase(operation.address, fraction)
        else:
            self.tear_program(operation.address, operation.data, fraction)

    def tear_erase(self, address: int, fraction: float) -> None:
        """Leave the erasing of a page interrupted after `fraction` of its time (0 to 1).

        That part of the page reads as erased, the rest as before, none of it can be programmed.
        Raises as `erase_page`.
        """
        offset = self._page_offset(address)
        done_bytes = int(fraction * self.page_size_bytes)
        self._put(offset, self._erased_page[:done_bytes])
        self._used_units.update(self._units(offset, self.page_size_bytes))

    def tear_program(self, address: int, data: bytes, fraction: float) -> None:
        """Leave programming interrupted after `fraction` of its time (0 to 1): units before that
        are programmed, the one under way half, the rest not at all. Raises as `program`.
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
                f"{size_bytes} bytes at 0x{address:08X} lie outside of the flash",
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
        """Let the cells hold `data`, whatever a real part would allow."""
        while data:
            place = offset % self.page_size_bytes
            page = self._pages.setdefault(offset - place, bytearray(self._erased_page))
            part = data[: self.page_size_bytes - place]
            page[place : place + len(part)] = part
            offset, data = offset + len(part), data[len(part) :]

    def _units(self, offset: int, size_bytes: int) -> range:
        """The program units that lie there."""
        unit = self.program_unit_bytes
        return range(offset // unit, (offset + size_bytes) // unit)


class Operation(NamedTuple):
    """Something to do to the flash: program `data` at `address`, or erase that page (no data)."""

    address: int
    data: bytes | None = None


class FlashController:
    """Carries operations out one after another, each taking its time.

    An operation changes the memory when its time is over. Cut short, it leaves as much of itself as
    the time allowed; with times of 0 there is nothing to cut.
    """

    def __init__(self, flash: Flash, *, erase_time_s: float, program_time_s: float) -> None:
        self._flash = flash
        self._erase_time_s = erase_time_s
        self._program_time_s = program_time_s
        self._waiting: deque[Operation] = deque()
        self._under_way: Operation | None = None
        self._began_at = 0.0

    @property
    def ends_at(self) -> float:
        """When the operation under way is over; infinite while there is none."""
        reached_at = self.reached_at(1.0)
        return inf if reached_at is None else reached_at

    def reached_at(self, share: float) -> float | None:
        """When `share` (0 to 1) of the operation under way is done; None while there is none."""
        if self._under_way is None:
            return None
        return self._began_at + share * self._duration_s(self._under_way)

    def run(self, operations: Iterable[Operation], now: float) -> None:
        """Begin `operations`, after the one under way; those that still waited are forgotten."""
        self._waiting = deque(operations)
        if self._under_way is None:
            self._begin_next(now)

    def advance(self, now: float) -> bool:
        """Finish what is over by now; True when nothing is left to do.

        Raises FlashError for an operation that the flash refuses.
        """
        while (operation := self._under_way) is not None:
            ends_at = self._began_at + self._duration_s(operation)
            if ends_at > now:
                return False
            self._flash.carry_out(operation)
            self._begin_next(ends_at)
        return True

    def abort(self, now: float) -> None:
        """Power or clock is gone: leave the operation under way torn, forget the rest."""
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
