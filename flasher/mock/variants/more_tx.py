"""Wrong bootloaders: more of transfer (TX), one for each way to get it wrong."""

from __future__ import annotations

from typing import Final

from flasher.mock.memory import Operation
from flasher.mock.model import MockDevice
from flasher.mock.store import AREA_START
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, PlainStore, Variant
from flasher.protocol import messages
from flasher.protocol.spec import PACKET_DATA_SIZE
from flasher.protocol.wire import Damage

_BANK_BYTES: Final = 0x10000


class DamageEndsTransfer(MockDevice):
    """A damaged packet ends the transfer: it announces itself again."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        in_transfer = self.state is State.TRANSFER
        super()._take_damage(damage, now)
        if in_transfer and len(damage.data) > PACKET_DATA_SIZE:
            self._handle(Event.PAUSE_OVER, now)


class RepeatUnanswered(MockDevice):
    """Drops a repeated packet without a word."""

    def _answer_repeated(self, now: float) -> str:
        self._await_host(now)
        return ""


class OlderOverwrites(MockDevice):
    """Programs every packet that it had before at its place, and acknowledges it."""

    store_type = PlainStore

    def _answer_older(self, now: float) -> str:
        if self._number:
            size_bytes = self._transfer.size_bytes
            operation = self.store.storing(self._number, self._payload, size_bytes)
            self.store.flash.program(operation.address, operation.data or b"")
        return super()._answer_older(now)


class TotalLookedAtOnce(MockDevice):
    """Looks at the total of packet 1 only."""

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        if event is Event.PACKET_BAD and isinstance(row, messages.Packet):
            is_next = row.number == self._transfer.stored + 1 <= self._transfer.total
            return Event.PACKET_NEXT if is_next and self._transfer.stored else event
        return event


class _SixteenBitStore(PlainStore):
    def storing(self, number: int, payload: bytes, size_bytes: int) -> Operation:
        """Offsets are counted in 16 bits."""
        operation = super().storing(number, payload, size_bytes)
        offset = (operation.address - AREA_START) % _BANK_BYTES
        return operation._replace(address=AREA_START + offset)


class SixteenBitOffsets(MockDevice):
    """Writes what lies behind 64 KiB over the beginning."""

    store_type = _SixteenBitStore


VARIANTS: Final = (
    Variant(
        "damage-ends-transfer",
        "TX-01",
        "announces itself again when a packet was damaged",
        DamageEndsTransfer,
        also=(
            "FR-02",
            "FR-04",
            "FR-05",
            "FR-06",
            "CR-01",
            "CR-02",
            "CR-03",
            "CR-04",
            "BU-01",
        ),
    ),
    Variant(
        "repeat-unanswered",
        "TX-02",
        "does not answer a repeated packet",
        RepeatUnanswered,
        also=("FR-08", "TX-05", "BU-01", "BU-02"),
    ),
    Variant(
        "older-overwrites",
        "TX-03",
        "programs a packet that is older than the last one over its first copy",
        OlderOverwrites,
    ),
    Variant(
        "total-looked-at-once",
        "TX-04",
        "looks at the total of packet 1 only",
        TotalLookedAtOnce,
    ),
    Variant(
        "sixteen-bit-offsets",
        "TX-07",
        "writes what lies behind 64 KiB over the beginning",
        SixteenBitOffsets,
    ),
)
