"""Wrong bootloaders: framing (FR)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.mock.model import MockDevice
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, HangingDevice, Variant
from flasher.protocol import messages
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    CRC_SIZE,
    FRAME_DATA_SIZE,
    HEADER,
    LENGTH_MIN,
    PREFIX_SIZE,
    TAIL,
    Command,
    Mode,
)
from flasher.protocol.wire import Damage, DamageReason, Message, Reassembler

_CRC_AT: Final = slice(-CRC_SIZE - len(TAIL), -len(TAIL))
_BACK_TO_BACK_S: Final = 0.0007
"""A frame that ends so soon after the last one followed it without a pause: at 250 kbit/s a frame
takes 0.4 to 0.55 ms.
"""
_KNOWN_COMMANDS: Final = frozenset(Command) | {item.command for item in ITEMS}
_KNOWN_MODES: Final = frozenset(Mode)


class _ShortFrameEnds(Reassembler):
    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        found = super().feed(payload, now)
        if len(payload) < FRAME_DATA_SIZE:
            self.reset()
        return found


class ShortFrameEnds(MockDevice):
    """Takes a frame of less than 8 bytes for the last one of a message."""

    reassembler_type = _ShortFrameEnds


class _HeaderAtFrameStart(Reassembler):
    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        starts = payload.startswith(HEADER) or HEADER.startswith(payload)
        return super().feed(payload, now) if self._buffer or starts else ()


class HeaderAtFrameStart(MockDevice):
    """Looks for a header at the start of a frame only: behind junk it is missed."""

    reassembler_type = _HeaderAtFrameStart


class _HeaderRestarts(Reassembler):
    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        if payload.startswith(HEADER):
            self.reset()
        return super().feed(payload, now)


class HeaderRestarts(MockDevice):
    """Begins anew at every frame that starts with a header's bytes."""

    reassembler_type = _HeaderRestarts


class _TailIgnored(Reassembler):
    def _judge_message(self, size: int, found: list[Message | Damage]) -> None:
        self._buffer[size - len(TAIL) : size] = TAIL
        super()._judge_message(size, found)


class TailIgnored(MockDevice):
    """Does not look at the tail."""

    reassembler_type = _TailIgnored


class _LengthTrusted(Reassembler):
    def deadline(self) -> float | None:
        return None

    def tick(self, now: float) -> Sequence[Message | Damage]:
        return ()

    def _damage(self, reason: DamageReason, size: int, found: list[Message | Damage]) -> None:
        """Give up all that the length covers, not its header only."""
        found.append(Damage(self.can_id, reason, bytes(self._buffer[:size])))
        del self._buffer[:size]


class LengthTrusted(MockDevice):
    """Waits for as many bytes as the length says, for ever, whatever comes meanwhile."""

    reassembler_type = _LengthTrusted


class ShortLengthHangs(HangingDevice):
    """Computes length minus 2 unsigned."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        is_bad = damage.reason is DamageReason.BAD_LENGTH
        if is_bad and damage.data[PREFIX_SIZE - 1] < LENGTH_MIN:
            self._hang()
        else:
            super()._take_damage(damage, now)


class _PaddingFatal(Reassembler):
    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        found = super().feed(payload, now)
        if self.held_size and any(isinstance(one, Message) for one in found):
            self.reset()
            return (Damage(self.can_id, DamageReason.JUNK, payload),)
        return found


class PaddingFatal(MockDevice):
    """Wants a message to end with its last frame."""

    reassembler_type = _PaddingFatal


class BackToBackLost(MockDevice):
    """Is not yet ready for the first frame that follows a message without a pause."""

    _message_ended_at = float("-inf")
    _skips = False

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id == self.target.request_id and frame.data.startswith(HEADER):
            self._skips = now - self._message_ended_at < _BACK_TO_BACK_S
        if not self._skips or frame.can_id != self.target.request_id:
            super().receive(frame, now)

    def _take_message(self, message: Message, now: float) -> None:
        self._message_ended_at = now
        super()._take_message(message, now)


class EveryFrameIsPayload(MockDevice):
    """Copies its receive buffer at every frame with its id, of whatever kind."""

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id == self.target.request_id and not frame.is_payload:
            frame = Frame(frame.can_id, frame.data or bytes(FRAME_DATA_SIZE))
        super().receive(frame, now)


class UnknownRestarts(MockDevice):
    """Its bootloader's default branch is a restart."""

    def _classify(self, row: AnyRow) -> Event:
        if isinstance(row, messages.Unknown | messages.Malformed):
            message = row.message
            is_known = message.command in _KNOWN_COMMANDS and message.mode in _KNOWN_MODES
            if not is_known and self.state is not State.APPLICATION:
                return Event.RESET
        return super()._classify(row)


VARIANTS: Final = (
    Variant(
        "short-frame-ends-message",
        "FR-01",
        "drops a message when a frame other than its last has less than 8 bytes",
        ShortFrameEnds,
    ),
    Variant(
        "header-at-frame-start-only",
        "FR-02",
        "misses a message whose header stands behind junk in the same frame",
        HeaderAtFrameStart,
    ),
    Variant(
        "header-in-data-restarts",
        "FR-03",
        "begins a new message where 55 AA stands at the start of a frame of data",
        HeaderRestarts,
    ),
    Variant(
        "ignores-tail",
        "FR-04",
        "takes a message with any last byte",
        TailIgnored,
        also=("CR-01",),
    ),
    Variant(
        "trusts-length",
        "FR-05",
        "after a broken-off message, swallows the next ones until its length is used up",
        LengthTrusted,
        also=("TX-01", "CR-02"),
    ),
    Variant(
        "short-length-hangs",
        "FR-06",
        "hangs on a length of 0 or 1 until power is cut",
        ShortLengthHangs,
        also=("SE-03",),
    ),
    Variant(
        "padding-is-fatal",
        "FR-07",
        "drops a message whose last frame is padded to 8 bytes",
        PaddingFatal,
    ),
    Variant(
        "back-to-back-lost",
        "FR-08",
        "misses a message that follows the one before without a pause",
        BackToBackLost,
    ),
    Variant(
        "every-frame-is-payload",
        "FR-09",
        "takes remote, extended, error and empty frames between for payload",
        EveryFrameIsPayload,
    ),
    Variant(
        "unknown-restarts",
        "FR-10",
        "its bootloader restarts on an unknown command or mode",
        UnknownRestarts,
        also=("SE-01", "SE-03", "FR-06"),
    ),
)
