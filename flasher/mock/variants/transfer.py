"""Wrong bootloaders: transfer (TX)."""

from __future__ import annotations

import dataclasses
from math import inf
from typing import ClassVar, Final

from flasher.mock.memory import Operation
from flasher.mock.model import AnyMessage, MockDevice, is_damaged_packet
from flasher.mock.store import AREA_START
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.base import HangingDevice, PlainStore, bad_write, variant
from flasher.protocol import messages
from flasher.protocol.spec import (
    PACKET_COUNT_MAX,
    PACKET_DATA_SIZE,
    PACKET_FILLER,
    PACKET_START,
    Command,
)
from flasher.protocol.wire import Damage, Message

_BYTE: Final = 0xFF
_HANGS_AFTER: Final = 256
_UPGRADING: Final = frozenset(
    (BootloaderState.ERASING, BootloaderState.TRANSFER, BootloaderState.PROGRAMMING)
)
_BANK_BYTES: Final = 0x10000
_WRAP_S: Final = 65.536


@variant("nak-wrong-number", "TX-01", also="CR-01 CR-02 CR-03 TX-03 TX-04 TX-06 SE-04 BU-01")
class NakWrongNumber(MockDevice):
    """Requests the next packet when one was damaged."""

    def _answer_bad(self, now: float) -> str:
        return self._reply(messages.Nak(min(self._transfer.next_number + 1, PACKET_COUNT_MAX)), now)


@variant("swallows-after-bad", "TX-01", also="CR-01 CR-02 CR-03 FR-04 BU-01 CR-04 FR-05")
class SwallowsAfterBad(MockDevice):
    """Misses the message after a damaged packet."""

    _swallows = False

    def _take_damage(self, damage: Damage, now: float) -> None:
        super()._take_damage(damage, now)
        if is_damaged_packet(damage):
            self._swallows = self.state is BootloaderState.TRANSFER

    def _take_message(self, message: Message, now: float) -> None:
        if self._swallows and message.can_id == self.target.request_id:
            self._swallows = False
        else:
            super()._take_message(message, now)


@variant("writes-repeated-twice", "TX-02", also="TX-05 BU-01 BU-02")
class WritesRepeated(MockDevice):
    """Writes a repeated packet after its first copy: the rest of the image is moved. Writes
    at the end of the last write: a repeated packet is there twice.
    """

    store_type = PlainStore
    _written = 0

    def _erase(self, now: float) -> str:
        self._written = 0
        return super()._erase(now)

    def _store(self, now: float) -> str:
        self._append()
        self._due_at = now + self.profile.program_time_s
        return ""

    def _answer_repeated(self, now: float) -> str:
        self._append()
        return super()._answer_repeated(now)

    def _append(self) -> None:
        size_bytes = self._transfer.size_bytes
        if self._written * PACKET_DATA_SIZE < size_bytes:
            self._written += 1
            operation = self.store.storing(self._written, self._payload, size_bytes)
            self.store.flash.execute(operation)


@variant("accepts-skipped-number", "TX-03")
class AcceptsSkipped(MockDevice):
    """Accepts a packet after a gap, and leaves the gap."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        transfer = self._transfer
        if event is not BootloaderEvent.PACKET_BAD or not isinstance(row, messages.Packet):
            return event
        if row.total != transfer.total or not transfer.stored < row.number <= row.total:
            return event
        transfer.stored = row.number - 1
        return BootloaderEvent.PACKET_NEXT


@variant("ignores-total", "TX-04")
class IgnoresTotal(MockDevice):
    """Accepts a packet with any total."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Packet) and self._transfer.total:
            row = dataclasses.replace(row, total=self._transfer.total)
        super()._take_row(row, now)


@variant("repeat-overwrites", "TX-05")
class RepeatOverwrites(MockDevice):
    """Programs a repeated packet with other data over the first: a mixture of both."""

    store_type = PlainStore

    def _answer_repeated(self, now: float) -> str:
        transfer = self._transfer
        operation = self.store.storing(transfer.stored, self._payload, transfer.size_bytes)
        self.store.flash.execute(operation)
        return super()._answer_repeated(now)


@variant("ignores-start-byte", "TX-06")
class IgnoresStartByte(MockDevice):
    """Takes a packet with any start byte."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        message = bad_write(row, Command.PACKET)
        if message:
            data = bytes((PACKET_START,)) + message.data[1:]
            row = messages.decode(message._replace(data=data))
        super()._take_row(row, now)


@variant("eight-bit-numbers", "TX-07")
class ByteNumbers(MockDevice):
    """Expects packet 0 after packet 255. Counts them in a byte."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        wraps = isinstance(row, messages.Packet) and row.number > _BYTE
        return (
            BootloaderEvent.PACKET_BAD
            if wraps and self.state is BootloaderState.TRANSFER
            else event
        )

    def _answer_bad(self, now: float) -> str:
        return self._reply(messages.Nak(self._transfer.next_number & _BYTE), now)


@variant("hangs-after-256-packets", "TX-07")
class HangsAfter256(HangingDevice):
    """Hangs when packet 257 is stored, until power is cut. Has room for 256 packets in its list of
    received ones.
    """

    def _acknowledge(self, now: float) -> str:
        return self._hang() if self._transfer.stored >= _HANGS_AFTER else super()._acknowledge(now)


@variant("filler-checked", "TX-08")
class FillerChecked(MockDevice):
    """Refuses a last packet whose bytes after the image are not FF."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        if event is BootloaderEvent.PACKET_NEXT and isinstance(row, messages.Packet):
            start = (row.number - 1) * PACKET_DATA_SIZE
            filler = row.payload[self._transfer.size_bytes - start :]
            if row.number == row.total and set(filler) - {PACKET_FILLER}:
                return BootloaderEvent.PACKET_BAD
        return event


@variant("never-times-out", "TX-12", also="SE-01 SE-03")
class NeverTimesOut(MockDevice):
    """Accepts only the next packet after a pause in the transfer, until power is cut."""

    _waits_on = False
    in_ram = ("_waits_on",)

    def _await_host(self, now: float) -> None:
        self._waits_on = False
        self._due_at = now + self.profile.transfer_timeout_s

    def _expire(self, now: float) -> None:
        if self.state is BootloaderState.TRANSFER:
            self._waits_on = True
            self._due_at = inf
        else:
            super()._expire(now)

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        is_way_out = event in {
            BootloaderEvent.UPDATE,
            BootloaderEvent.UPDATE_AGAIN,
            BootloaderEvent.RESET,
        }
        stuck = self._waits_on and self.state is BootloaderState.TRANSFER
        return BootloaderEvent.NO_CONCERN if stuck and is_way_out else event


@variant("reset-in-transfer-hangs", "TX-13", also="SE-03")
class ResetHangs(HangingDevice):
    """Hangs at a reset during the upgrade until power is cut."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.ResetCommand) and self.state in _UPGRADING:
            self._hang()
        else:
            super()._take_row(row, now)


@variant("big-endian-numbers", "TX-01", also="CR-01 CR-02 CR-03 EN-02", upgrade_works=False)
class BigEndianNumbers(MockDevice):
    """Sends the numbers of ACK and NAK high byte first (against R4)."""

    big_endian: ClassVar[tuple[type[messages.UpgradeMessage], ...]] = (messages.Ack, messages.Nak)

    def _send(self, row: messages.UpgradeMessage) -> None:
        if isinstance(row, messages.Ack | messages.Nak) and isinstance(row, self.big_endian):
            swapped = int.from_bytes(row.number.to_bytes(2, "big"), "little")
            row = dataclasses.replace(row, number=swapped)
        super()._send(row)


@variant("big-endian-nak", "TX-01", also="CR-01 CR-02 CR-03 TX-03 TX-04 TX-06 SE-04 BU-01 EN-02")
class BigEndianNak(BigEndianNumbers):
    """Sends the number of a NAK high byte first (against R4)."""

    big_endian = (messages.Nak,)


@variant(
    "damage-ends-transfer",
    "TX-01",
    also="FR-02 FR-04 FR-05 FR-06 FR-09 CR-01 CR-02 CR-03 CR-04 BU-01",
)
class DamageEndsTransfer(MockDevice):
    """Announces itself again when a packet was damaged."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        in_transfer = self.state is BootloaderState.TRANSFER
        super()._take_damage(damage, now)
        if in_transfer and len(damage.data) > PACKET_DATA_SIZE:
            self._handle(BootloaderEvent.PAUSE_OVER, now)


@variant("repeat-unanswered", "TX-02", also="FR-08 TX-05 BU-01 BU-02")
class RepeatUnanswered(MockDevice):
    """Does not answer a repeated packet."""

    def _answer_repeated(self, now: float) -> str:
        return self._reply(None, now)


@variant("older-overwrites", "TX-03")
class OlderOverwrites(MockDevice):
    """Programs a packet that is older than the last one over its first copy."""

    store_type = PlainStore

    def _answer_older(self, now: float) -> str:
        if self._number:
            size_bytes = self._transfer.size_bytes
            operation = self.store.storing(self._number, self._payload, size_bytes)
            self.store.flash.execute(operation)
        return super()._answer_older(now)


@variant("total-looked-at-once", "TX-04")
class TotalLookedAtOnce(MockDevice):
    """Checks the total of packet 1 only."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        if event is BootloaderEvent.PACKET_BAD and isinstance(row, messages.Packet):
            is_next = row.number == self._transfer.stored + 1 <= self._transfer.total
            return BootloaderEvent.PACKET_NEXT if is_next and self._transfer.stored else event
        return event


@variant("sixteen-bit-offsets", "TX-07")
class SixteenBitOffsets(PlainStore):
    """Writes bytes beyond 64 KiB over the beginning."""

    def storing(self, number: int, payload: bytes, size_bytes: int) -> Operation:
        """Count offsets in 16 bits."""
        operation = super().storing(number, payload, size_bytes)
        offset = (operation.address - AREA_START) % _BANK_BYTES
        return operation._replace(address=AREA_START + offset)


@variant("numbers-modulo-256", "TX-03")
class NumbersModulo256(MockDevice):
    """Compares only the low byte of packet numbers."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Packet) and self.state is BootloaderState.TRANSFER:
            transfer = self._transfer
            for number in (transfer.stored, transfer.next_number):
                if number and (row.number - number) & _BYTE == 0:
                    row = dataclasses.replace(row, number=number)
        super()._take_row(row, now)


@variant("totals-modulo-256", "TX-04")
class TotalsModulo256(MockDevice):
    """Compares only the low byte of packet totals."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Packet) and (row.total - self._transfer.total) & _BYTE == 0:
            row = dataclasses.replace(row, total=self._transfer.total)
        super()._take_row(row, now)


@variant("number-zero-is-first", "TX-03", also="SE-04")
class NumberZeroIsFirst(MockDevice):
    """Accepts packet 0 as packet 1 at the beginning."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        message = bad_write(row, Command.PACKET)
        if message and not self._transfer.stored and not any(message.data[1:3]):
            data = message.data[:1] + b"\x01\x00" + message.data[3:]
            row = messages.decode(message._replace(data=data))
        super()._take_row(row, now)


@variant("acks-damaged-repetition", "TX-01", also="CR-01")
class AcksDamagedRepetition(MockDevice):
    """Acknowledges a damaged packet with the number stored last. Checks the number before the
    checksum.
    """

    def _answer_bad(self, now: float) -> str:
        stored = self._transfer.stored
        if not self._is_damage or not stored or self._number != stored:
            return super()._answer_bad(now)
        return self._reply(messages.Ack(stored), now)

    _is_damage = False

    def _take_damage(self, damage: Damage, now: float) -> None:
        self._is_damage = True
        super()._take_damage(damage, now)
        self._is_damage = False


@variant("acks-twice", "TX-07", also="*", upgrade_works=False)
class AcksTwice(MockDevice):
    """Sends every ACK of a packet twice."""

    def _acknowledge(self, now: float) -> str:
        detail = super()._acknowledge(now)
        self._send(messages.Ack(self._transfer.stored))
        return detail


@variant(
    "blank-packet-unanswered",
    "FR-03",
    also="UP-08 TX-01 TX-02 TX-03 TX-04 TX-05 TX-06 TX-07 TX-13 EN-01 EN-02 EN-07 EN-08 SE-04",
)
class BlankPacketUnanswered(MockDevice):
    """Acknowledges a packet of FF bytes only when it is repeated. Has no data to program for a
    blank packet, and forgets to answer it.
    """

    def _acknowledge(self, now: float) -> str:
        if set(self._payload) != {PACKET_FILLER}:
            return super()._acknowledge(now)
        self._transfer.stored += 1
        return self._reply(None, now)


@variant("pause-counts-from-start", "TX-12", also="FR-06 FR-10 CR-01 CR-02 CR-03 TX-07 TM-02 BU-02")
class PauseCountsFromStart(MockDevice):
    """Counts the pause from request transfer on, not from the last packet."""

    _began_at = 0.0

    def _request(self, now: float) -> str:
        self._began_at = now
        return super()._request(now)

    def _await_host(self, now: float) -> None:
        super()._await_host(self._began_at)


@variant("timer-wraps", "TX-12")
class TimerWraps(MockDevice):
    """Gives up a transfer 65.536 s after its start, where its clock of 16 bits wraps."""

    _booted_at = 0.0

    def _boot(self, now: float) -> str:
        self._booted_at = now
        return super()._boot(now)

    def _await_host(self, now: float) -> None:
        super()._await_host(now)
        wraps = int((now - self._booted_at) / _WRAP_S) + 1
        self._due_at = min(self._due_at, self._booted_at + wraps * _WRAP_S)
