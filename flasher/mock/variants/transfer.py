"""Wrong bootloaders: transfer (TX)."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Final

from flasher.mock.classify import is_damaged_packet
from flasher.mock.model import MockDevice
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, HangingDevice, PlainStore, Variant
from flasher.protocol import messages
from flasher.protocol.spec import (
    PACKET_COUNT_MAX,
    PACKET_DATA_SIZE,
    PACKET_FILLER,
    PACKET_START,
    Command,
    Mode,
)
from flasher.protocol.wire import Damage, Message

_BYTE: Final = 0xFF
_HANGS_AFTER: Final = 256
_UPGRADING: Final = frozenset((State.ERASING, State.TRANSFER, State.PROGRAMMING))


class NakWrongNumber(MockDevice):
    """Asks for the packet after the one that it wants."""

    def _answer_bad(self, now: float) -> str:
        self._send(messages.Nak(min(self._transfer.wanted + 1, PACKET_COUNT_MAX)))
        self._await_host(now)
        return ""


class SwallowsAfterBad(MockDevice):
    """Skips a message after a damaged packet, as if the damage had been a message more."""

    _swallows = False

    def _take_damage(self, damage: Damage, now: float) -> None:
        super()._take_damage(damage, now)
        if is_damaged_packet(damage):
            self._swallows = self.state is State.TRANSFER

    def _take_message(self, message: Message, now: float) -> None:
        if self._swallows and message.can_id == self.target.request_id:
            self._swallows = False
        else:
            super()._take_message(message, now)


class WritesRepeated(MockDevice):
    """Writes wherever it stopped writing: a packet that is repeated stands there twice."""

    store_type = PlainStore
    _written = 0

    def _erase(self, now: float) -> str:
        self._written = 0
        return super()._erase(now)

    def _store(self, now: float) -> str:
        self._append()
        self._due = now + self.profile.program_time_s
        return ""

    def _answer_repeated(self, now: float) -> str:
        self._append()
        return super()._answer_repeated(now)

    def _append(self) -> None:
        size_bytes = self._transfer.size_bytes
        if self._written * PACKET_DATA_SIZE < size_bytes:
            self._written += 1
            operation = self.store.storing(self._written, self._payload, size_bytes)
            self.store.flash.program(operation.address, operation.data or b"")


class AcceptsSkipped(MockDevice):
    """Takes any number beyond the last one, and goes on from there."""

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        transfer = self._transfer
        if event is not Event.PACKET_BAD or not isinstance(row, messages.Packet):
            return event
        if row.total != transfer.total or not transfer.stored < row.number <= row.total:
            return event
        transfer.stored = row.number - 1
        return Event.PACKET_NEXT


class IgnoresTotal(MockDevice):
    """Does not look at the total."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if isinstance(row, messages.Packet) and self._transfer.total:
            row = dataclasses.replace(row, total=self._transfer.total)
        super()._take_row(row, now)


class RepeatOverwrites(MockDevice):
    """Programs a repeated packet over its first copy."""

    store_type = PlainStore

    def _answer_repeated(self, now: float) -> str:
        transfer = self._transfer
        operation = self.store.storing(transfer.stored, self._payload, transfer.size_bytes)
        self.store.flash.program(operation.address, operation.data or b"")
        return super()._answer_repeated(now)


class IgnoresStartByte(MockDevice):
    """Does not look at the start byte of a packet."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if isinstance(row, messages.Malformed):
            message = row.message
            if (message.command, message.mode) == (Command.PACKET, Mode.WRITE):
                data = bytes((PACKET_START,)) + message.data[1:]
                row = messages.decode(message._replace(data=data))
        super()._take_row(row, now)


class ByteNumbers(MockDevice):
    """Counts packets in a byte: the one after 255 is 0."""

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        in_transfer = self.state is State.TRANSFER and isinstance(row, messages.Packet)
        return Event.PACKET_BAD if in_transfer and self._wraps(row) else event

    @staticmethod
    def _wraps(row: AnyRow) -> bool:
        return isinstance(row, messages.Packet) and row.number > _BYTE

    def _answer_bad(self, now: float) -> str:
        self._send(messages.Nak(self._transfer.wanted & _BYTE))
        self._await_host(now)
        return ""


class HangsAfter256(HangingDevice):
    """Has room for 256 packets in its list of what was received."""

    def _acknowledge(self, now: float) -> str:
        return self._hang() if self._transfer.stored >= _HANGS_AFTER else super()._acknowledge(now)


class FillerChecked(MockDevice):
    """Refuses a last packet that is filled with anything but FF."""

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        if event is Event.PACKET_NEXT and isinstance(row, messages.Packet):
            start = (row.number - 1) * PACKET_DATA_SIZE
            filler = row.payload[self._transfer.size_bytes - start :]
            if row.number == row.total and set(filler) - {PACKET_FILLER}:
                return Event.PACKET_BAD
        return event


class NeverTimesOut(MockDevice):
    """After a long pause, still takes nothing but the next packet: a transfer that was left can
    be ended by a power cut only.
    """

    _waits_on = False

    def _await_host(self, now: float) -> None:
        self._waits_on = False
        self._due = now + self.profile.transfer_timeout_s

    def _expire(self, now: float) -> None:
        if self.state is State.TRANSFER:
            self._waits_on = True
            self._due = None
        else:
            super()._expire(now)

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        is_way_out = event in {Event.UPDATE, Event.UPDATE_AGAIN, Event.RESET}
        stuck = self._waits_on and self.state is State.TRANSFER
        return Event.NO_CONCERN if stuck and is_way_out else event

    def _switch_off(self, now: float) -> str:
        self._waits_on = False
        return super()._switch_off(now)


class ResetHangs(HangingDevice):
    """A reset in the midst of an upgrade leaves it hanging."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if isinstance(row, messages.Reset) and self.state in _UPGRADING:
            self._hang()
        else:
            super()._take_row(row, now)


class BigEndianNumbers(MockDevice):
    """Sends packet numbers high byte first."""

    big_endian: ClassVar[tuple[type[messages.Row], ...]] = (messages.Ack, messages.Nak)

    def _send(self, row: messages.Row) -> None:
        if isinstance(row, messages.Ack | messages.Nak) and isinstance(row, self.big_endian):
            swapped = int.from_bytes(row.number.to_bytes(2, "big"), "little")
            row = dataclasses.replace(row, number=swapped)
        super()._send(row)


class BigEndianNak(BigEndianNumbers):
    """The same, where it asks again only."""

    big_endian = (messages.Nak,)


VARIANTS: Final = (
    Variant(
        "nak-wrong-number",
        "TX-01",
        "asks for the next packet when one was damaged",
        NakWrongNumber,
        also=("CR-01", "CR-02", "CR-03", "TX-03", "TX-04", "TX-06", "SE-04", "BU-01"),
    ),
    Variant(
        "swallows-after-bad",
        "TX-01",
        "misses the message after a damaged packet",
        SwallowsAfterBad,
        also=("CR-01", "CR-02", "CR-03", "FR-04", "BU-01", "CR-04", "FR-05"),
    ),
    Variant(
        "writes-repeated-twice",
        "TX-02",
        "writes a repeated packet behind its first copy: the rest of the image is moved",
        WritesRepeated,
        also=("TX-05", "BU-01", "BU-02"),
    ),
    Variant(
        "accepts-skipped-number",
        "TX-03",
        "takes a packet after a gap, and leaves the gap",
        AcceptsSkipped,
    ),
    Variant("ignores-total", "TX-04", "takes a packet with any total", IgnoresTotal),
    Variant(
        "repeat-overwrites",
        "TX-05",
        "programs a repeated packet with other data over the first: a mixture of both",
        RepeatOverwrites,
    ),
    Variant("ignores-start-byte", "TX-06", "takes a packet with any start byte", IgnoresStartByte),
    Variant(
        "eight-bit-numbers",
        "TX-07",
        "expects packet 0 after packet 255",
        ByteNumbers,
    ),
    Variant(
        "hangs-after-256-packets",
        "TX-07",
        "hangs when packet 257 is stored, until power is cut",
        HangsAfter256,
    ),
    Variant(
        "filler-checked",
        "TX-08",
        "refuses a last packet whose bytes behind the image are not FF",
        FillerChecked,
    ),
    Variant(
        "never-times-out",
        "TX-12",
        "after a pause in the transfer, takes only the next packet until power is cut",
        NeverTimesOut,
        also=("SE-01", "SE-03"),
    ),
    Variant(
        "reset-in-transfer-hangs",
        "TX-13",
        "hangs at a reset during the upgrade until power is cut",
        ResetHangs,
        also=("SE-03",),
    ),
    Variant(
        "big-endian-nak",
        "TX-01",
        "sends the number of a NAK high byte first (against R4)",
        BigEndianNak,
        also=("CR-01", "CR-02", "CR-03", "TX-03", "TX-04", "TX-06", "SE-04", "BU-01", "EN-02"),
    ),
    Variant(
        "big-endian-numbers",
        "TX-01",
        "sends the numbers of ACK and NAK high byte first (against R4)",
        BigEndianNumbers,
        also=("CR-01", "CR-02", "CR-03", "EN-02"),
        upgrade_works=False,
    ),
)
