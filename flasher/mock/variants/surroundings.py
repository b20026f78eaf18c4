"""Wrong bootloaders: timing (TM), bus (BU), bad input (SE) and other traffic (CO)."""

from __future__ import annotations

import dataclasses
from collections import deque
from functools import cached_property
from itertools import pairwise
from math import inf
from typing import Final

from flasher.mock.machine import BUS_OFF_S
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.store import AREA_START
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.base import HangingDevice, PlainStore, variant
from flasher.protocol import messages
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.frame import Frame
from flasher.protocol.spec import FRAME_DATA_SIZE, OVERHEAD_SIZE, PACKET_DATA_SIZE, TARGETS, Mode
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Damage, DamageReason, Message, Reassembler

_WORD: Final = 0xFFFF_FFFF
_BUSY_S: Final = 0.001
_PACKETS_A_PAGE: Final = 16
_SLOW_S: Final = DEFAULT_TIMINGS.ack_timeout_s + 0.1
"""Longer than a host waits for an ACK (R12)."""
_LOG_BYTES: Final = 4096
_JUNK_BYTES: Final = 64
_LOAD_WINDOW_S: Final = 0.1
_LOAD_FRAMES: Final = 140
"""Number of foreign frames in that time that is too many: 250 kbit/s carries about 200."""
_WRONG_MESSAGE: Final = frozenset((DamageReason.BAD_CRC, DamageReason.BAD_TAIL))
_APPLICATION_COMMANDS: Final = frozenset(item.command for item in ITEMS)
_USELESS: Final = frozenset(
    (BootloaderEvent.NO_CONCERN, BootloaderEvent.OUT_OF_TURN, BootloaderEvent.RESET_IGNORED)
)


@variant("drops-after-20-ms-gap", "TM-02", also="BU-01", timings={"inter_frame_timeout_s": 0.02})
class ImpatientWithGaps(MockDevice):
    """Drops a message when 20 ms pass between two of its frames."""


@variant(
    "slow-sixteenth-packet",
    "TM-05",
    also="UP-08 TX-01 TX-02 TX-03 TX-04 TX-05 TX-06 TX-07 TX-12 TX-13 EN-01 EN-02 EN-07 EN-08 "
    "SE-04",
)
class SlowSixteenth(MockDevice):
    """Acknowledges packets 16, 32, ... after 0.6 s."""

    def _store(self, now: float) -> str:
        detail = super()._store(now)
        if self._transfer.next_number % _PACKETS_A_PAGE == 0:
            self._due_at = now + _SLOW_S
        return detail


@variant("doubled-frame-hangs", "BU-01", also="CR-02")
class DoubledFrameHangs(HangingDevice):
    """Hangs at a message with a doubled frame until power is cut."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        size = FRAME_DATA_SIZE
        frames = [damage.data[at : at + size] for at in range(0, len(damage.data), size)]
        # Filler repeats itself rightly.
        doubled = any(one == next_one and len(set(one)) > 1 for one, next_one in pairwise(frames))
        if doubled and damage.reason in _WRONG_MESSAGE:
            self._hang()
        else:
            super()._take_damage(damage, now)


@variant("stays-off-after-bus-off", "BU-02")
class StaysOffBus(MockDevice):
    """Does not come back from bus-off until power is cut."""

    def bus_off(self, now: float, off_s: float = BUS_OFF_S) -> None:
        super().bus_off(now, inf)


@variant("collision-hangs", "BU-06")
class CollisionHangs(HangingDevice):
    """Hangs when another node sends with its answer id, until power is cut."""

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id == self.target.answer_id and self.has_power and not self.hangs:
            self._hang()
        super().receive(frame, now)


@variant("logs-useless-messages", "SE-01", also="SE-03 CO-04")
class LogsUseless(HangingDevice):
    """Hangs after 4 KiB of useless messages in a row. Keeps every useless message until a useful
    one comes, in a memory that is soon full.
    """

    _log_bytes = 0

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event, message = super()._classify(row), self._message
        is_useless = event in _USELESS
        if event is BootloaderEvent.QUERY and message is not None:
            is_known = message.command in _APPLICATION_COMMANDS
            is_useless = self.state is not BootloaderState.APPLICATION or not is_known
        if message is None or not is_useless:
            self._log_bytes = 0
            return event
        self._log_bytes += OVERHEAD_SIZE + len(message.data)
        if self._log_bytes > _LOG_BYTES:
            self._log_bytes = 0
            self._hang()
            return BootloaderEvent.NO_CONCERN
        return event


@variant("noise-hangs", "SE-03", also="SE-01 FR-10 FR-02 FR-09 TX-01 BU-01 CR-01 CR-02 FR-06")
class NoiseHangs(HangingDevice):
    """Hangs at 64 bytes of junk in a row, or at a report sent to its bootloader."""

    def _take_message(self, message: Message, now: float) -> None:
        is_own = message.can_id == self.target.request_id
        if is_own and message.mode == Mode.REPORT and self.state is not BootloaderState.APPLICATION:
            self._hang()
        else:
            super()._take_message(message, now)

    def _take_damage(self, damage: Damage, now: float) -> None:
        if damage.reason is DamageReason.JUNK and len(damage.data) >= _JUNK_BYTES:
            self._hang()
        else:
            super()._take_damage(damage, now)


@variant("writes-anywhere", "SE-04", also="TX-03")
class WritesAnywhere(MockDevice):
    """Writes and acknowledges a packet beyond the total. It goes to the address of its number,
    whatever is there.
    """

    store_type = PlainStore
    _is_beyond = False

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        self._is_beyond = (
            event is BootloaderEvent.PACKET_BAD
            and isinstance(row, messages.Packet)
            and row.total == self._transfer.total < row.number
        )
        return event

    def _take_damage(self, damage: Damage, now: float) -> None:
        self._is_beyond = False
        super()._take_damage(damage, now)

    def _answer_bad(self, now: float) -> str:
        if not self._is_beyond or self._number is None:
            return super()._answer_bad(now)
        address = AREA_START + (self._number - 1) * PACKET_DATA_SIZE
        self.store.flash.program(address, self._payload)
        return self._reply(messages.Ack(self._number), now)


@variant("size-rounds-to-small", "SE-04", also="UP-02")
class SizeRoundedUp(MockDevice):
    """Rounds a size of nearly 2^32 up to a small one, and erases for it. Rounds the size up to
    whole packets in 32 bits, then looks whether it fits.
    """

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.UpdateCommand):
            rounded = row.size_bytes + PACKET_DATA_SIZE - 1
            if rounded > _WORD:
                wrapped = max((rounded & _WORD) // PACKET_DATA_SIZE, 1) * PACKET_DATA_SIZE
                row = dataclasses.replace(row, size_bytes=wrapped)
        super()._take_row(row, now)


@variant("any-message-is-life", "SE-01", also="CO-04")
class AnyMessageIsLife(MockDevice):
    """Restarts its window and its transfer timeout with every useless message."""

    def _take_message(self, message: Message, now: float) -> None:
        before, due = self.state, self._due_at
        super()._take_message(message, now)
        if self.state is not before or self._due_at != due:
            return
        if self.state is BootloaderState.TRANSFER:
            self._await_host(now)
        elif self.state is BootloaderState.ANNOUNCING and self._announced >= self.burst:
            self._due_at = now + self.profile.window_s


@variant("load-hangs", "CO-01", also="CO-02")
class LoadHangs(HangingDevice):
    """Hangs when 140 foreign frames come within 100 ms. Is interrupted by every frame on the bus:
    more than it can serve leave it hanging.
    """

    @cached_property
    def _foreign(self) -> deque[float]:
        """Times of the last foreign frames."""
        return deque(maxlen=_LOAD_FRAMES)

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id != self.target.request_id and self.has_power and not self.hangs:
            self._foreign.append(now)
            is_full = len(self._foreign) == _LOAD_FRAMES
            if is_full and now - self._foreign[0] <= _LOAD_WINDOW_S:
                self._foreign.clear()
                self._hang()
        super().receive(frame, now)


@variant("hears-other-targets", "CO-02", also="CO-04")
class HearsOtherTargets(MockDevice):
    """Accepts packets for other targets during its own transfer."""

    @cached_property
    def _others(self) -> dict[int, Reassembler]:
        return {
            target.request_id: Reassembler(target.request_id, self.timings.inter_frame_timeout_s)
            for target in TARGETS.values()
            if target is not self.target
        }

    def receive(self, frame: Frame, now: float) -> None:
        super().receive(frame, now)
        other = self._others.get(frame.can_id)
        if other is None or not frame.is_payload or self.state is not BootloaderState.TRANSFER:
            return
        for one in other.feed(frame.data, now):
            if not isinstance(one, Message):
                continue
            if isinstance(messages.decode(one), messages.Packet | messages.EndOfTransfer):
                self._take(one._replace(can_id=self.target.request_id), now)


@variant("answers-in-bootloader", "CO-04", also="FR-10 SE-01")
class AnswersInBootloader(MockDevice):
    """Its bootloader confirms messages of chapter 3."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        command = row.message.command if isinstance(row, messages.Unknown) else None
        if self.state is not BootloaderState.APPLICATION and command in _APPLICATION_COMMANDS:
            self._send(messages.GeneralFeedbackMessage())
        super()._take_row(row, now)


@variant("answer-lost-on-busy-bus", "CO-01", also="FR-09")
class AnswerLostOnBusyBus(MockDevice):
    """Loses an ACK that is due within 1 ms after a foreign frame. Gives up when its transmit
    mailbox is not free at once.
    """

    _foreign_at = -inf

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id not in (self.target.request_id, self.target.answer_id):
            self._foreign_at = now
        super().receive(frame, now)

    def _acknowledge(self, now: float) -> str:
        detail = super()._acknowledge(now)
        if now - self._foreign_at < _BUSY_S:
            self._transmitter.drop_unstarted()
        return detail
