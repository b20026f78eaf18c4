"""Flash memory that can be made to fail: errors, worn-out sectors, wrong bits."""

from __future__ import annotations

from collections import Counter

from flasher.conformance.subject import FlashCall, FlashEffect, FlashFault
from flasher.mock.memory import FlashMemory, Operation


class FailingFlash:
    """Executes the flash calls of a bootloader on `memory`, and makes the chosen one fail.

    A failed erase leaves its sector as it was; later writes there are combined with the old content
    (AND), like in NOR flash. A failed write stores nothing.
    """

    def __init__(self, memory: FlashMemory) -> None:
        self._memory = memory
        self.calls: Counter[FlashCall] = Counter()
        self.failed_at: float | None = None
        self._fault: FlashFault | None = None
        self._worn: int | None = None
        self._stuck: tuple[int, int] | None = None
        """Address of a byte, and a mask of the bit in it that stays 1."""
        self._not_erased: set[int] = set()
        """Sectors whose last erase failed."""

    def fail(self, fault: FlashFault | None) -> None:
        """Make one call fail, or none; calls are counted from now on."""
        self.calls.clear()
        self._fault, self.failed_at = fault, None
        self._worn = self._stuck = None

    def read(self, address: int, size_bytes: int, now: float) -> bytes:
        """Raises FlashError, like the following."""
        data = self._memory.read(address, size_bytes)
        if data and self._effect_of(FlashCall.READ, now) is not None:
            data = bytes((data[0] ^ 1,)) + data[1:]
        return data

    def execute(self, operation: Operation, now: float) -> bool:
        """Erase or write; False when the flash reports an error."""
        call = FlashCall.ERASE if operation.data is None else FlashCall.WRITE
        effect = self._effect_of(call, now)
        data = operation.data
        sectors = self._sectors(operation.address, 1 if data is None else len(data))
        if effect is FlashEffect.WORN_SECTOR:
            self._worn = sectors[0]
        if effect is FlashEffect.ERROR or self._worn in sectors:
            if data is None:
                self._not_erased.update(sectors)
            return False
        if data is None:
            self._not_erased.difference_update(sectors)
            self._memory.execute(operation)
            return True
        if effect is FlashEffect.WRONG_BIT:
            self._stuck = _written_bit(operation.address, data)
        if self._stuck is not None and 0 <= self._stuck[0] - operation.address < len(data):
            at, mask = self._stuck[0] - operation.address, self._stuck[1]
            data = data[:at] + bytes((data[at] | mask,)) + data[at + 1 :]
        if self._not_erased.intersection(sectors):
            self._write_over(operation.address, data, sectors)
        else:
            self._memory.program(operation.address, data)
        return True

    def _effect_of(self, call: FlashCall, now: float) -> FlashEffect | None:
        """Count the call; the effect of the fault when it begins with this call."""
        fault, number = self._fault, self.calls[call]
        self.calls[call] += 1
        if fault is None or (fault.call, fault.number) != (call, number):
            return None
        self.failed_at = now
        return fault.effect

    def _sectors(self, address: int, size_bytes: int) -> range:
        """Addresses of the sectors that an operation changes."""
        size = self._memory.page_size_bytes
        return range(address - (address - self._memory.start) % size, address + size_bytes, size)

    def _write_over(self, address: int, data: bytes, sectors: range) -> None:
        content = bytearray(self._memory.read(sectors.start, len(sectors) * sectors.step))
        for at, byte in enumerate(data, address - sectors.start):
            content[at] &= byte
        for sector in sectors:
            self._memory.erase_page(sector)
        self._memory.program(sectors.start, bytes(content))


def _written_bit(address: int, data: bytes) -> tuple[int, int] | None:
    """The first bit that this write changes to 0, with the address of its byte."""
    for at, byte in enumerate(data):
        if byte != 0xFF:
            return address + at, ~byte & byte + 1
    return None
