"""Wrong bootloaders: framing (FR) and checksum (CR)."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Final

from flasher.mock.model import AnyMessage, MockDevice, is_damaged_packet
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.base import HangingDevice, variant
from flasher.protocol import messages
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.crc import crc32
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    COMMAND_SIZE,
    CRC_SIZE,
    FRAME_DATA_SIZE,
    HEADER,
    LENGTH_MIN,
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
"""Maximum interval of frames without a pause; at 250 kbit/s a frame takes 0.4 to 0.55 ms."""
_KNOWN_COMMANDS: Final = frozenset(Command) | {item.command for item in ITEMS}
_KNOWN_MODES: Final = frozenset(Mode)
_WRITTEN: Final = (Command.RESET, Command.UPDATE, Command.PACKET, Command.END_OF_TRANSFER)


@variant("short-frame-ends-message", "FR-01")
class ShortFrameEnds(Reassembler):
    """Drops a message when a frame other than its last has less than 8 bytes."""

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        found = super().feed(payload, now)
        if len(payload) < FRAME_DATA_SIZE:
            self.reset()
        return found


@variant("header-at-frame-start-only", "FR-02")
class HeaderAtFrameStart(Reassembler):
    """Misses a message whose header follows junk in the same frame."""

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        starts = payload.startswith(HEADER) or HEADER.startswith(payload)
        return super().feed(payload, now) if self._buffer or starts else ()


@variant("header-in-data-restarts", "FR-03", also="FR-10")
class HeaderRestarts(Reassembler):
    """Begins a new message where a frame of data starts with 55 AA."""

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        if payload.startswith(HEADER):
            self.reset()
        return super().feed(payload, now)


@variant("ignores-tail", "FR-04", also="CR-01")
class TailIgnored(Reassembler):
    """Accepts a message with any last byte."""

    def _judge_message(self, size: int, found: list[Message | Damage]) -> None:
        self._buffer[size - len(TAIL) : size] = TAIL
        super()._judge_message(size, found)


@variant("trusts-length", "FR-05", also="TX-01 CR-02 BU-01")
class LengthTrusted(Reassembler):
    """After a broken-off message, swallows the next ones until its length is used up."""

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        found = super().feed(payload, now)
        self.due_at = inf
        return found

    def _damage(self, reason: DamageReason, size: int, found: list[Message | Damage]) -> None:
        """Skip the whole length of a damaged message, not only its header."""
        found.append(Damage(self.can_id, reason, bytes(self._buffer[:size])))
        del self._buffer[:size]


@variant("short-length-hangs", "FR-06", also="SE-03")
class ShortLengthHangs(HangingDevice):
    """Hangs on a length of 0 or 1 until power is cut. Computes length minus 2 unsigned."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        is_bad = damage.reason is DamageReason.BAD_LENGTH
        if is_bad and damage.data[PREFIX_SIZE - 1] < LENGTH_MIN:
            self._hang()
        else:
            super()._take_damage(damage, now)


@variant("padding-is-fatal", "FR-07")
class PaddingFatal(Reassembler):
    """Drops a message whose last frame is padded to 8 bytes."""

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        found = super().feed(payload, now)
        if self.buffered_bytes and any(isinstance(one, Message) for one in found):
            self.reset()
            return (Damage(self.can_id, DamageReason.JUNK, payload),)
        return found


@variant("back-to-back-lost", "FR-08")
class BackToBackLost(MockDevice):
    """Misses a message that follows the one before without a pause."""

    _message_ended_at = -inf
    _skips = False

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id == self.target.request_id and frame.data.startswith(HEADER):
            self._skips = now - self._message_ended_at < _BACK_TO_BACK_S
        if not self._skips or frame.can_id != self.target.request_id:
            super().receive(frame, now)

    def _take_message(self, message: Message, now: float) -> None:
        self._message_ended_at = now
        super()._take_message(message, now)


@variant("every-frame-is-payload", "FR-09")
class EveryFrameIsPayload(MockDevice):
    """Mistakes remote, extended, error and empty frames for payload. Copies its receive buffer at
    every frame with its id, of whatever kind.
    """

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id == self.target.request_id and not frame.is_payload:
            frame = Frame(frame.can_id, frame.data or bytes(FRAME_DATA_SIZE))
        super().receive(frame, now)


@variant("unknown-restarts", "FR-10", also="SE-01 SE-03 FR-06")
class UnknownRestarts(MockDevice):
    """Its bootloader restarts on an unknown command or mode."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        if isinstance(row, messages.Unknown | messages.Malformed):
            message = row.message
            is_known = message.command in _KNOWN_COMMANDS and message.mode in _KNOWN_MODES
            if not is_known and self.state is not BootloaderState.APPLICATION:
                return BootloaderEvent.RESET
        return super()._classify(row)


def _with_mirrored_crc(wire: bytes) -> bytes:
    """Return a message with its CRC in reverse byte order."""
    changed = bytearray(wire)
    changed[_CRC_AT] = changed[_CRC_AT][::-1]
    return bytes(changed)


@variant("no-crc-check", "CR-01", also="CR-02 CR-03 TX-01 BU-01")
class CrcIgnored(Reassembler):
    """Accepts a message with any CRC."""

    def _crc_fits(self, wire: bytes) -> bool:
        return True


@variant("short-packet-filled", "CR-02", also="TX-01 TM-02 BU-01 BU-02")
class ShortPacketFilled(MockDevice):
    """Fills a packet that lost a frame with FF and stores it. Mistakes a truncated packet for a
    whole one: it has no CRC, so none is checked.
    """

    def _take_damage(self, damage: Damage, now: float) -> None:
        if damage.reason is DamageReason.INCOMPLETE and is_damaged_packet(damage):
            data = damage.data[PREFIX_SIZE + COMMAND_SIZE :][: data_size(Command.PACKET)]
            filled = data.ljust(data_size(Command.PACKET), bytes((PACKET_FILLER,)))
            message = Message(damage.can_id, Mode.WRITE, Command.PACKET, filled)
            self._take_row(messages.decode(message), now)
        else:
            super()._take_damage(damage, now)


@variant("either-crc-order", "CR-03")
class EitherCrcOrder(Reassembler):
    """Accepts a little-endian CRC as well."""

    def _crc_fits(self, wire: bytes) -> bool:
        return super()._crc_fits(wire) or super()._crc_fits(_with_mirrored_crc(wire))


@variant("crc-without-id", "CR-03")
class CrcWithoutId(Reassembler):
    """Accepts a CRC that is computed without the CAN id as well."""

    def _crc_fits(self, wire: bytes) -> bool:
        crc = int.from_bytes(wire[_CRC_AT], "big")
        return super()._crc_fits(wire) or crc32(wire[: -CRC_SIZE - len(TAIL)]) == crc


@variant("feedback-crc-mirrored", "CR-04", also="RS-01 RS-04 UP-03")
class FeedbackCrcMirrored(MockDevice):
    """Sends general feedback with a little-endian CRC."""

    def send(self, message: Message) -> None:
        if message.command != Command.GENERAL_FEEDBACK:
            super().send(message)
        elif not self.is_off_bus:
            frames = split(message.can_id, _with_mirrored_crc(encode(message)))
            self._transmitter.queue(frames)


@variant("crc-zero-accepted", "CR-03")
class CrcZeroAccepted(Reassembler):
    """Accepts a message whose CRC is 00000000. Kept for bench tests."""

    def _crc_fits(self, wire: bytes) -> bool:
        return super()._crc_fits(wire) or wire[_CRC_AT] == bytes(CRC_SIZE)


@variant("crc-ones-accepted", "CR-03")
class CrcOnesAccepted(Reassembler):
    """Accepts a message whose CRC is FFFFFFFF."""

    def _crc_fits(self, wire: bytes) -> bool:
        return super()._crc_fits(wire) or wire[_CRC_AT] == b"\xff" * CRC_SIZE


@variant("long-commands-accepted", "FR-06", also="RS-04 UP-06")
class LongCommandsAccepted(Reassembler):
    """Accepts a reset or update command with more data than its command states. Goes by the length
    byte, and reads as much of the data as it needs.
    """

    def _judge_head(self, found: list[Message | Damage]) -> bool:
        head = self._buffer[PREFIX_SIZE - 1 : PREFIX_SIZE + COMMAND_SIZE]
        is_short = int.from_bytes(head[1:], "big") in (Command.RESET, Command.UPDATE)
        return (is_short and head[2] < head[0] - COMMAND_SIZE) or super()._judge_head(found)

    def _judge_message(self, size: int, found: list[Message | Damage]) -> None:
        super()._judge_message(size, found)
        last = found[-1]
        if isinstance(last, Message):
            found[-1] = last._replace(data=last.data[: data_size(last.command)])


@variant("tail-in-crc", "FR-03", also="FR-02 TX-07 TM-05")
class TailInCrc(Reassembler):
    """Mistakes F0 in the first byte of a CRC for the tail. Searches the tail from the end of the
    data on: the CRC before it may contain the same byte.
    """

    def _crc_fits(self, wire: bytes) -> bool:
        return not wire[_CRC_AT].startswith(TAIL) and super()._crc_fits(wire)


@variant("answers-padded", "CR-04")
class AnswersPadded(MockDevice):
    """Fills the last frame of its messages up to 8 bytes. Its CAN driver always sends 8 bytes."""

    def send(self, message: Message) -> None:
        if not self.is_off_bus:
            wire = encode(message)
            whole = -(-len(wire) // FRAME_DATA_SIZE) * FRAME_DATA_SIZE
            self._transmitter.queue(split(message.can_id, wire.ljust(whole, b"\x00")))


@variant("ignores-mode", "FR-10", also="RS-04 UP-06")
class IgnoresMode(MockDevice):
    """Accepts reset, update command, packet and end of transfer with any mode."""

    def _take_message(self, message: Message, now: float) -> None:
        if message.can_id == self.target.request_id and message.command in _WRITTEN:
            message = message._replace(mode=Mode.WRITE)
        super()._take_message(message, now)
