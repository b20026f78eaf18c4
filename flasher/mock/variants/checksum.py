"""Wrong bootloaders: checksum (CR)."""

from __future__ import annotations

from typing import Final

from flasher.mock.classify import is_damaged_packet
from flasher.mock.model import MockDevice
from flasher.mock.variants.base import Variant
from flasher.protocol import messages
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.crc import crc32
from flasher.protocol.spec import (
    COMMAND_SIZE,
    CRC_SIZE,
    PACKET_FILLER,
    PREFIX_SIZE,
    TAIL,
    Command,
    Mode,
    data_size,
)
from flasher.protocol.wire import Damage, DamageReason, Message, Reassembler, encode, split

_CRC_AT: Final = slice(-CRC_SIZE - len(TAIL), -len(TAIL))
_BACK_TO_BACK_S: Final = 0.0007
"""A frame that ends so soon after the last one followed it without a pause: at 250 kbit/s a frame
takes 0.4 to 0.55 ms.
"""
_KNOWN_COMMANDS: Final = frozenset(Command) | {item.command for item in ITEMS}
_KNOWN_MODES: Final = frozenset(Mode)


def _with_mirrored_crc(wire: bytes) -> bytes:
    """`wire` with its CRC the other way round."""
    changed = bytearray(wire)
    changed[_CRC_AT] = changed[_CRC_AT][::-1]
    return bytes(changed)


class _CrcIgnored(Reassembler):
    def _crc_fits(self, wire: bytes) -> bool:
        return True


class CrcIgnored(MockDevice):
    """Does not look at the CRC."""

    reassembler_type = _CrcIgnored


class ShortPacketFilled(MockDevice):
    """Takes a packet that ends early for a whole one: it has no CRC, so none is looked at."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        if damage.reason is DamageReason.INCOMPLETE and is_damaged_packet(damage):
            data = damage.data[PREFIX_SIZE + COMMAND_SIZE :][: data_size(Command.PACKET)]
            filled = data.ljust(data_size(Command.PACKET), bytes((PACKET_FILLER,)))
            message = Message(damage.can_id, Mode.WRITE, Command.PACKET, filled)
            self._take_row(messages.decode(message), now)
        else:
            super()._take_damage(damage, now)


class _EitherCrcOrder(Reassembler):
    def _crc_fits(self, wire: bytes) -> bool:
        return super()._crc_fits(wire) or super()._crc_fits(_with_mirrored_crc(wire))


class EitherCrcOrder(MockDevice):
    """Takes the CRC in either order."""

    reassembler_type = _EitherCrcOrder


class _CrcWithoutId(Reassembler):
    def _crc_fits(self, wire: bytes) -> bool:
        crc = int.from_bytes(wire[_CRC_AT], "big")
        return super()._crc_fits(wire) or crc32(wire[: -CRC_SIZE - len(TAIL)]) == crc


class CrcWithoutId(MockDevice):
    """Takes a CRC that leaves the id out as well."""

    reassembler_type = _CrcWithoutId


class FeedbackCrcMirrored(MockDevice):
    """Sends the CRC of its application's general feedback low byte first."""

    def send(self, message: Message) -> None:
        if message.command != Command.GENERAL_FEEDBACK:
            super().send(message)
        elif not self.is_off_bus:
            frames = split(message.can_id, _with_mirrored_crc(encode(message)))
            self._transmitter.queue(frames)


VARIANTS: Final = (
    Variant(
        "no-crc-check",
        "CR-01",
        "takes a message with any CRC",
        CrcIgnored,
        also=("CR-02", "CR-03", "TX-01", "BU-01"),
    ),
    Variant(
        "short-packet-filled",
        "CR-02",
        "fills a packet that lost a frame with FF and stores it",
        ShortPacketFilled,
        also=("TX-01", "TM-02", "BU-01", "BU-02"),
    ),
    Variant("either-crc-order", "CR-03", "takes a little-endian CRC as well", EitherCrcOrder),
    Variant("crc-without-id", "CR-03", "takes a CRC that leaves the id out as well", CrcWithoutId),
    Variant(
        "feedback-crc-mirrored",
        "CR-04",
        "sends general feedback with a little-endian CRC",
        FeedbackCrcMirrored,
        also=("RS-01", "RS-04", "UP-03"),
    ),
)
