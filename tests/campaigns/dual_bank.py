"""Dual-bank devices: they store an image in a second bank, check it there, and keep the application
until it is complete.

`SwapsBanks` runs the image from the bank that was recorded last. `CopiesImage` copies it into the
application area in the restart after complete, page by page, and goes on with that after a power
cut. `KeepsJournal` names the bank that runs in a journal.
"""

from __future__ import annotations

import zlib
from struct import Struct
from typing import ClassVar, Final

from flasher.mock.memory import Operation
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import AREA_START, ApplicationStore, checksum_fits
from flasher.mock.table import BootloaderState
from flasher.protocol.spec import PACKET_DATA_SIZE

_RECORD: Final = Struct("<III8s")
"""Size, CRC, number of the upgrade."""
_MAGIC: Final = b"BANKDONE"


class DualBankStore(ApplicationStore):
    """Two banks with a record each; the one with the highest number is the application."""

    def __init__(self, profile: DeviceProfile) -> None:
        super().__init__(profile)
        self._bank_bytes = self._area_bytes + profile.page_size_bytes
        self.flash = self.flash_type(
            AREA_START,
            2 * self._bank_bytes,
            page_size_bytes=profile.page_size_bytes,
            program_unit_bytes=profile.program_unit_bytes,
        )

    @property
    def active(self) -> int:
        """The bank of the application, 0 without one."""
        numbers = [self._number(bank) for bank in (0, 1)]
        return 1 if numbers[1] > numbers[0] else 0

    def bank(self, number: int) -> int:
        """Start address of a bank."""
        return AREA_START + number * self._bank_bytes

    def image(self) -> bytes | None:
        return self.image_in(self.active)

    def image_in(self, bank: int) -> bytes | None:
        """The image that the record of this bank describes; None unless it is intact."""
        size_bytes, crc, _, magic = self._record(bank)
        if magic != _MAGIC or not 0 < size_bytes <= self._area_bytes:
            return None
        image = self.flash.read(self.bank(bank), size_bytes)
        return image if zlib.crc32(image) == crc else None

    def read(self, size_bytes: int) -> bytes:
        return self.flash.read(self.bank(self.active), size_bytes)

    def staged(self, size_bytes: int) -> bytes:
        """The first bytes of the other bank."""
        return self.flash.read(self.bank(1 - self.active), size_bytes)

    def erasing(self, size_bytes: int) -> list[Operation]:
        return self.erasing_bank(1 - self.active, size_bytes)

    def erasing_bank(self, bank: int, size_bytes: int) -> list[Operation]:
        """Operations that erase a bank for an image: its record first."""
        start = self.bank(bank)
        size_bytes = self._area_bytes if self._erases_all else size_bytes
        pages = range(start, start + size_bytes, self.flash.page_size_bytes)
        return [Operation(start + self._area_bytes), *map(Operation, pages)]

    def storing(self, number: int, payload: bytes, size_bytes: int) -> Operation:
        offset = (number - 1) * PACKET_DATA_SIZE
        units = self._units(payload[: size_bytes - offset])
        return Operation(self.bank(1 - self.active) + offset, units)

    def recording(self, size_bytes: int) -> Operation:
        bank = 1 - self.active
        return self.recording_in(bank, self.staged(size_bytes), self._number(1 - bank) + 1)

    def recording_in(self, bank: int, image: bytes, number: int) -> Operation:
        """Operation that records `image` as what is in this bank."""
        record = _RECORD.pack(len(image), zlib.crc32(image), number, _MAGIC)
        return Operation(self.bank(bank) + self._area_bytes, self._units(record))

    def load(self, image: bytes) -> None:
        for operation in self.erasing_bank(0, len(image)):
            self.flash.erase_page(operation.address)
        self.flash.erase_page(self.bank(1) + self._area_bytes)
        self.flash.program(self.bank(0), self._units(image))
        self.flash.execute(self.recording_in(0, image, 1))
        self.flash.program_count = self.flash.erase_count = 0

    def _record(self, bank: int) -> tuple[int, int, int, bytes]:
        at = self.bank(bank) + self._area_bytes
        size_bytes, crc, number, magic = _RECORD.unpack(self.flash.read(at, _RECORD.size))
        return size_bytes, crc, number, magic

    def _number(self, bank: int) -> int:
        return self._record(bank)[2] if self.image_in(bank) is not None else 0


class SwapsBanks(MockDevice):
    """Keeps the old application until complete (see the module)."""

    store_type = DualBankStore
    store: DualBankStore

    def _accepts_image(self) -> bool:
        staged = self.store.staged(self._transfer.size_bytes)
        return self.profile.image_checksum == "none" or checksum_fits(staged)


class CopyingStore(DualBankStore):
    """Bank 0 is the application; an image in bank 1 waits until it is copied there."""

    @property
    def active(self) -> int:
        return 0

    @property
    def waiting(self) -> bytes | None:
        """A complete image that still has to be copied."""
        return self.image_in(1)

    def copying(self, image: bytes) -> list[Operation]:
        """Operations that copy it; its own record is erased last."""
        start, size = self.bank(0), PACKET_DATA_SIZE
        pieces = [
            Operation(start + at, self._units(image[at : at + size]))
            for at in range(0, len(image), size)
        ]
        done = Operation(self.bank(1) + self._area_bytes)
        return [
            *self.erasing_bank(0, len(image)),
            *pieces,
            self.recording_in(0, image, 1),
            done,
        ]


class CopiesImage(SwapsBanks):
    """Copies the image in the restart after complete (see the module), which needs the choice
    `after_complete=restarts`.
    """

    store_type = CopyingStore
    store: CopyingStore
    in_ram = ("_is_copying",)
    _is_copying = False

    def _expire(self, now: float) -> None:
        is_restarting = self.state in (BootloaderState.STARTING, BootloaderState.RESTARTING)
        if not (is_restarting and self._copies(now)):
            super()._expire(now)

    def _copies(self, now: float) -> bool:
        """Begin copying, or go on; False when nothing is left to copy."""
        waiting = self.store.waiting
        if waiting is not None and not self._is_copying:
            self._is_copying = True
            self._controller.run(self.store.copying(waiting), now)
        if self._is_copying and not self._controller.advance(now):
            self._due_at = self._controller.ends_at
            return True
        self._is_copying = False
        return False


class JournalStore(DualBankStore):
    """Which bank is the application is the last entry of a journal: two pages after the banks, of
    which one is erased when the other one is full.
    """

    pages: ClassVar[int] = 2

    def __init__(self, profile: DeviceProfile) -> None:
        super().__init__(profile)
        self._journal = AREA_START + 2 * self._bank_bytes
        self._page_bytes = profile.page_size_bytes
        self._entry_bytes = len(self._units(bytes(_RECORD.size)))
        self.flash = self.flash_type(
            AREA_START,
            2 * self._bank_bytes + self.pages * self._page_bytes,
            page_size_bytes=profile.page_size_bytes,
            program_unit_bytes=profile.program_unit_bytes,
        )

    def _record(self, bank: int) -> tuple[int, int, int, bytes]:
        """The newest entry of this bank; its number is odd for bank 1."""
        entries = [one for _, one in self._entries() if one[3] == _MAGIC and one[2] % 2 == bank]
        return max(entries, key=lambda one: one[2], default=(0, 0, 0, b""))

    def _entries(self) -> list[tuple[int, tuple[int, int, int, bytes]]]:
        """Address and contents of every place for an entry."""
        start, page_bytes, entry_bytes = self._journal, self._page_bytes, self._entry_bytes
        pages = range(start, start + self.pages * page_bytes, page_bytes)
        return [
            (page + place, _RECORD.unpack_from(content, place))
            for page in pages
            for content in (self.flash.read(page, page_bytes),)
            for place in range(0, page_bytes - entry_bytes + 1, entry_bytes)
        ]

    def erasing_bank(self, bank: int, size_bytes: int) -> list[Operation]:
        return super().erasing_bank(bank, size_bytes)[1:]  # no record is in the bank

    def recording_in(self, bank: int, image: bytes, number: int) -> Operation:
        return self.entering(bank, image, number)[-1]

    def entering(self, bank: int, image: bytes, number: int) -> list[Operation]:
        """Operations that append an entry, after erasing a page for it where none is free."""
        number += (number + bank) % 2
        record = self._units(_RECORD.pack(len(image), zlib.crc32(image), number, _MAGIC))
        entries = self._entries()
        used = [at for at, one in entries if one[0] != 0xFFFF_FFFF]
        newest = max((one[2], at) for at, one in entries if one[3] == _MAGIC)[1] if used else 0
        free = [at for at, one in entries if one[0] == 0xFFFF_FFFF]
        if free:
            return [Operation(free[0], record)]
        pages = [self._journal + page * self._page_bytes for page in range(self.pages)]
        page = next((one for one in pages if not one <= newest < one + self._page_bytes), pages[0])
        return [Operation(page), Operation(page, record)]

    def load(self, image: bytes) -> None:
        for bank in (0, 1):
            self.flash.erase_page(self.bank(bank))
        for page in range(self.pages):
            self.flash.erase_page(self._journal + page * self._page_bytes)
        for operation in self.erasing_bank(0, len(image)):
            self.flash.erase_page(operation.address)
        self.flash.program(self.bank(0), self._units(image))
        self.flash.execute(self.recording_in(0, image, 2))
        self.flash.program_count = self.flash.erase_count = 0


class KeepsJournal(SwapsBanks):
    """Swaps banks by an entry in a journal."""

    store_type = JournalStore
    store: JournalStore

    def _record(self, now: float) -> str:
        store = self.store
        bank, image = 1 - store.active, store.staged(self._transfer.size_bytes)
        number = max(store._number(0), store._number(1)) + 1
        self._work(store.entering(bank, image, number), now)
        return f"{len(image)} bytes"
