"""Device model: a bootloader with its flash, and its application; written from the documents alone.

A message or an expired timer becomes an event (`_classify`, `_elapsed`), the table names the action
and the next state, and the actions are the methods below, in the order of the states. An action may
change everything but the state, and returns a short description. Flash operations take time in the
controller. Meanwhile the device receives, but a packet before the answer to the previous one is out
of turn.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from math import inf
from typing import ClassVar, Final

from flasher.errors import FlasherError, UsageError
from flasher.events import DeviceStateEntered, ImageStored, PacketStored
from flasher.mock.application import Application
from flasher.mock.bms import BmsApplication
from flasher.mock.machine import Machine
from flasher.mock.memory import FlashController, Operation
from flasher.mock.profile import DeviceProfile
from flasher.mock.store import ApplicationStore, MemoryMap, checksum_fits, factory_image
from flasher.mock.table import TABLE, BootloaderEvent, BootloaderState
from flasher.protocol import messages
from flasher.protocol.spec import (
    BOOT_VERSION_BURST,
    COMMAND_SIZE,
    DIALECTS,
    HEADER,
    LENGTH_SIZE,
    MODE_SIZE,
    PACKET_COUNT_MAX,
    PREFIX_SIZE,
    Command,
    Mode,
    Node,
    Target,
    data_size,
    packet_count,
)
from flasher.protocol.text import find_firmware_version
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message

NO_VERSION: Final = "unknown"
"""Firmware version of an image that contains none."""
AnyMessage = messages.UpgradeMessage | messages.Malformed | messages.Unknown
"""Decoded message for the bootloader."""
_DEFAULT_PROFILE: Final = DeviceProfile()
_DEAF: Final = frozenset((BootloaderState.OFF, BootloaderState.RESTARTING))
_WORKS_ON_FLASH: Final = frozenset(
    (BootloaderState.ERASING, BootloaderState.PROGRAMMING, BootloaderState.CHECKING)
)
_UNREPORTED: Final = (
    (BootloaderState.TRANSFER, BootloaderState.PROGRAMMING),
    (BootloaderState.PROGRAMMING, BootloaderState.TRANSFER),
)
"""Transitions without an event, because they occur with every packet."""
_DURING_END: Final = frozenset((BootloaderState.CHECKING, BootloaderState.STARTING))
_AFTER_END: Final = _DURING_END | {BootloaderState.REFUSED}
_WAITS_FOR_UPDATE: Final = frozenset((BootloaderState.ANNOUNCING, BootloaderState.REFUSED))
_TIMER_EVENTS: Final = {
    BootloaderState.RESTARTING: BootloaderEvent.RESTART_DUE,
    BootloaderState.TRANSFER: BootloaderEvent.PAUSE_OVER,
    BootloaderState.REFUSED: BootloaderEvent.HOLD_OVER,
    **dict.fromkeys(_WORKS_ON_FLASH, BootloaderEvent.FLASH_DONE),
}
"""Timer event of each state that has only one."""
_UPGRADE: Final = frozenset((Command.UPDATE, Command.PACKET, Command.END_OF_TRANSFER))
_PACKET_HEAD: Final = (
    HEADER
    + Mode.WRITE.to_bytes(MODE_SIZE, "big")
    + (COMMAND_SIZE + data_size(Command.PACKET)).to_bytes(LENGTH_SIZE, "big")
    + Command.PACKET.to_bytes(COMMAND_SIZE, "big")
)
_NUMBER_AT: Final = PREFIX_SIZE + COMMAND_SIZE + 1
"""Position of the packet number in a message, after the start byte."""
_NUMBER_END: Final = _NUMBER_AT + 2


@dataclass
class ReceivedTransfer:
    """Transfer in progress: image size, and number of stored packets."""

    size_bytes: int
    stored: int = 0

    @property
    def total(self) -> int:
        return packet_count(self.size_bytes)

    @property
    def next_number(self) -> int:
        """Number of the next packet, or of the last one when all are stored."""
        return min(self.stored + 1, self.total)


def is_damaged_packet(damage: Damage) -> bool:
    """True if damaged bytes begin like a packet, so that a NAK is due (TX-01)."""
    return damage.data.startswith(_PACKET_HEAD)


_LEAST_SPACING: Final = 0.8
"""Shortest interval of two announcements as a share of the documented one: after a stall of this
computer, a late one followed by one in time would look like two bootloaders (R27)."""


class MockDevice(Machine):
    """Upgradable device as an engine (`flasher.protocol.engine`).

    It starts powered: its application runs, or, without one, its bootloader announces itself from
    the first call on. A BMS has an answering application, others a silent one unless another is
    given. Raises UsageError for boot versions without a pause between them.
    """

    store_type: ClassVar[type[ApplicationStore]] = ApplicationStore
    transfer_type: ClassVar[type[ReceivedTransfer]] = ReceivedTransfer
    burst: ClassVar[int] = BOOT_VERSION_BURST
    """Number of boot versions before the application starts."""
    in_ram: ClassVar[tuple[str, ...]] = ()
    """Attributes that a power cut resets to the class's values."""

    def __init__(
        self,
        target: Target,
        *,
        bitrate_bps: int,
        profile: DeviceProfile = _DEFAULT_PROFILE,
        timings: Timings = DEFAULT_TIMINGS,
        has_application: bool = True,
        application: Application | None = None,
    ) -> None:
        if timings.boot_version_spacing_s <= 0:
            raise UsageError("the time between two announcements is greater than 0")
        self.target = target
        self.profile = profile
        self.store = self.store_type(profile)
        if application is None and target.node is Node.BMS:
            application = BmsApplication(profile, MemoryMap(self.store.flash))
        super().__init__(
            application or Application(target.node, DIALECTS[profile.dialect]),
            frozenset((target.request_id,)),
            bitrate_bps=bitrate_bps,
            timings=timings,
        )
        self.state = BootloaderState.APPLICATION if has_application else BootloaderState.ANNOUNCING
        self._controller = FlashController(
            self.store.flash,
            erase_time_s=profile.erase_time_s,
            program_time_s=profile.program_time_s,
        )
        self._transfer = self.transfer_type(0)
        self._announced = 0
        self._has_whole_application = has_application
        self._runs_application = has_application
        # Contents of the current message, for its action.
        self._offered_bytes = 0
        self._number: int | None = None
        self._payload = b""
        self._message: Message | None = None
        if has_application:
            self.store.load(factory_image(profile))
            detail = self._start(0.0)
        else:
            self._due_at = -inf
            detail = "no application"
        self._events.append(DeviceStateEntered(self.state.value, detail))

    # -- for tests and the conformance suite -------------------------------------------------------

    @property
    def stored_image(self) -> bytes | None:
        """Image of the complete application in flash; None without one."""
        return self.store.image()

    @property
    def erase_count(self) -> int:
        """Number of pages erased since construction."""
        return self.store.flash.erase_count

    @property
    def program_count(self) -> int:
        """Number of program operations (a packet, or the final record) since construction."""
        return self.store.flash.program_count

    @property
    def operations_done(self) -> int:
        """Number of erase and program operations completed since construction."""
        return self.erase_count + self.program_count

    def readback(self) -> bytes:
        """Contents of the application area, complete or torn."""
        return self.store.read(self.profile.application_area_bytes)

    def operation_reaches(self, share: float) -> float | None:
        """Time at which `share` (0 to 1) of the current flash operation is done, for a power cut
        during it; None without one.
        """
        return self._controller.reached_at(share)

    # -- power ------------------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        return self.state is not BootloaderState.OFF

    def power_cut(self, now: float) -> None:
        """Lose everything but the flash; a current flash operation stays torn."""
        self._handle(BootloaderEvent.POWER_CUT, now)

    def power_on(self, now: float) -> None:
        """Restart through the bootloader (R19)."""
        self._handle(BootloaderEvent.POWER_ON, now)
        self._run_timer(now)

    # -- from messages and timers to events -------------------------------------------------------

    def _take_message(self, message: Message, now: float) -> None:
        self._message = message
        # A bootloader ignores other ids, whatever the command.
        if message.can_id == self.target.request_id:
            self._take_row(messages.decode(message), now)
        else:
            self._handle(BootloaderEvent.QUERY, now)

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Packet):
            self._number, self._payload = row.number, row.payload
        elif isinstance(row, messages.UpdateCommand):
            self._offered_bytes = row.size_bytes
        elif isinstance(row, messages.Malformed):
            self._number = None
            self._report(f"malformed message {row.message.command:04X}: {row.problem}")
        self._handle(self._classify(row), now)

    def _take_damage(self, damage: Damage, now: float) -> None:
        is_own = damage.can_id == self.target.request_id
        if is_own and is_damaged_packet(damage) and self.state is BootloaderState.TRANSFER:
            number = damage.data[_NUMBER_AT:_NUMBER_END]
            is_whole = len(number) == _NUMBER_END - _NUMBER_AT
            self._number = int.from_bytes(number, "little") if is_whole else None
            self._handle(BootloaderEvent.PACKET_BAD, now)

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        """Return the event of a message. Profile options that change the state are applied here;
        those that only change the answer are applied in the action.
        """
        if self.state is BootloaderState.APPLICATION:
            return _in_application(row)
        match row:
            case messages.ResetCommand():
                announces = self.state is BootloaderState.ANNOUNCING
                profile = self.profile
                choice = profile.reset_in_bootloader if announces else profile.reset_in_transfer
                return (
                    BootloaderEvent.RESET if choice == "restarts" else BootloaderEvent.RESET_IGNORED
                )
            case messages.Unknown():
                return BootloaderEvent.QUERY
            case messages.UpdateCommand() if row.text == self.target.update_text:
                return self._classify_update(row)
            case messages.Packet() if self.state is BootloaderState.TRANSFER:
                return self._classify_packet(row)
            case messages.EndOfTransfer():
                return self._classify_end()
            case messages.Packet():
                return BootloaderEvent.OUT_OF_TURN
            case messages.Malformed() if row.message.command == Command.PACKET:
                return (
                    BootloaderEvent.PACKET_BAD
                    if self.state is BootloaderState.TRANSFER
                    else BootloaderEvent.OUT_OF_TURN
                )
        return BootloaderEvent.NO_CONCERN

    def _classify_update(self, row: messages.UpdateCommand) -> BootloaderEvent:
        state, transfer = self.state, self._transfer
        if not 0 < row.size_bytes <= self.profile.image_limit_bytes or state in _DURING_END:
            return BootloaderEvent.UPDATE_REFUSED
        if state in _WAITS_FOR_UPDATE:
            return BootloaderEvent.UPDATE
        # Repeated update commands before packet 1 are one transfer (UP-05).
        is_begun = state is BootloaderState.PROGRAMMING or transfer.stored
        if not is_begun and row.size_bytes == transfer.size_bytes:
            return BootloaderEvent.UPDATE_AGAIN
        starts_over = self.profile.update_in_transfer == "starts_over"
        return BootloaderEvent.UPDATE if starts_over else BootloaderEvent.UPDATE_REFUSED

    def _classify_packet(self, row: messages.Packet) -> BootloaderEvent:
        transfer = self._transfer
        if row.total != transfer.total or row.number > min(row.total, transfer.stored + 1):
            return BootloaderEvent.PACKET_BAD
        if row.number > transfer.stored:
            return BootloaderEvent.PACKET_NEXT
        return (
            BootloaderEvent.PACKET_REPEATED
            if row.number == transfer.stored
            else BootloaderEvent.PACKET_OLDER
        )

    def _classify_end(self) -> BootloaderEvent:
        if self.state in _AFTER_END:
            return BootloaderEvent.END_AGAIN
        if self.state is not BootloaderState.TRANSFER:
            return BootloaderEvent.OUT_OF_TURN
        if self._transfer.stored != self._transfer.total:
            return BootloaderEvent.END_EARLY
        return BootloaderEvent.END_WHOLE if self._accepts_image() else BootloaderEvent.END_WRONG

    def _accepts_image(self) -> bool:
        """False if images of this profile have a checksum, and this image's is wrong (R7)."""
        if self.profile.image_checksum == "none":
            return True
        return checksum_fits(self.store.read(self._transfer.size_bytes))

    def _expire(self, now: float) -> None:
        if self.state in _WORKS_ON_FLASH and not self._controller.advance(now):
            self._due_at = self._controller.ends_at
        else:
            self._handle(self._elapsed(), now)

    def _elapsed(self) -> BootloaderEvent:
        """Return the event of the expired timer."""
        if self.state is BootloaderState.ANNOUNCING:
            if self._announced < self.burst or not self._has_whole_application:
                return BootloaderEvent.ANNOUNCEMENT_DUE
            return BootloaderEvent.WINDOW_OVER
        if self.state is BootloaderState.STARTING:
            restarts = self.profile.after_complete == "restarts"
            return BootloaderEvent.START_BY_RESTART_DUE if restarts else BootloaderEvent.START_DUE
        return _TIMER_EVENTS[self.state]

    def _handle(self, event: BootloaderEvent, now: float) -> None:
        before = self.state
        move = TABLE[before].get(event)
        if move is None:
            raise FlasherError(
                "the device model met an event that cannot happen",
                where=f"state {before.value}",
                cause="a bug of the device model",
            )
        self.state = move.state or before
        self._is_deaf = self.state in _DEAF
        self._runs_application = self.state is BootloaderState.APPLICATION
        if before is BootloaderState.APPLICATION and not self._runs_application:
            self.application.stop()
        detail = getattr(self, f"_{move.action}")(now)
        if self.state is not before and (self.state, before) not in _UNREPORTED:
            self._events.append(DeviceStateEntered(self.state.value, detail))

    # -- actions: application, reset, announcements -----------------------------------------------

    def _ignore(self, now: float) -> str:
        return ""

    def _send_feedback(self, now: float) -> str:
        if self.profile.upgrade_in_application == "general_feedback":
            self._send(messages.GeneralFeedbackMessage())
        return ""

    def _answer(self, now: float) -> str:
        if self._message is not None:
            self.application.take(self._message, now)
        return ""

    def _confirm_reset(self, now: float) -> str:
        self._send(messages.GeneralFeedbackMessage())
        self._await_restart(now)
        return "reset"

    def _restart(self, now: float) -> str:
        """Restart without general feedback, which only the application sends (R15)."""
        self._transmitter.drop_unstarted()
        self._await_restart(now)
        return "into the bootloader"

    def _await_restart(self, now: float) -> None:
        self._controller.abort(now)
        self._forget_received()
        self._due_at = now + self.profile.reset_delay_s

    def _boot(self, now: float) -> str:
        """Announce, then start a complete application; else go on announcing (R14)."""
        self._has_whole_application = self.store.image() is not None
        self._announced = 0
        self._due_at = now
        return "whole application" if self._has_whole_application else "no application"

    def _announce(self, now: float) -> str:
        # Announcements must not pile up on a blocked bus.
        if not self._announced or self._transmitter.idle:
            version = self.profile.boot_version
            self._send(messages.BootVersion(self.target.boot_name, version))
        self._announced += 1
        goes_on = self.profile.without_application == "announces"
        if self._announced < self.burst or (not self._has_whole_application and goes_on):
            spacing_s = self.timings.boot_version_spacing_s
            self._rearm(spacing_s, now)
            self._due_at = max(self._due_at, now + _LEAST_SPACING * spacing_s)
        elif self._has_whole_application:
            self._rearm(self.profile.window_s, now)
        else:
            self._due_at = inf
        return ""

    def _start(self, now: float) -> str:
        self._due_at = inf
        firmware = self._firmware()
        self.application.start(firmware, now)
        return f"version {firmware}"

    def _firmware(self) -> str:
        """Firmware version in the application's image."""
        return find_firmware_version(self.store.image() or b"") or NO_VERSION

    # -- actions: update command and transfer -----------------------------------------------------

    def _refuse_update(self, now: float) -> str:
        self._report(
            f"update command for {self._offered_bytes} bytes refused while {self.state.value}; "
            f"the largest image is {self.profile.image_limit_bytes} bytes"
        )
        return ""

    def _erase(self, now: float) -> str:
        """Erase the completeness record first, then the pages."""
        self._transmitter.drop_unstarted()
        self._transfer = self.transfer_type(self._offered_bytes)
        self._work(self.store.erasing(self._offered_bytes), now)
        return f"for {self._offered_bytes} bytes in {self._transfer.total} packets"

    def _work(self, operations: list[Operation], now: float) -> None:
        self._controller.run(operations, now)
        self._due_at = self._controller.ends_at

    def _request(self, now: float) -> str:
        return self._reply(messages.RequestTransfer(), now)

    def _reply(self, row: messages.UpgradeMessage | None, now: float) -> str:
        """Answer, or stay silent, and wait for the host."""
        if row is not None:
            self._send(row)
        self._await_host(now)
        return ""

    def _await_host(self, now: float) -> None:
        waits = self.profile.pause_in_transfer == "waits"
        self._due_at = inf if waits else now + self.profile.transfer_timeout_s

    def _store(self, now: float) -> str:
        transfer = self._transfer
        operation = self.store.storing(transfer.next_number, self._payload, transfer.size_bytes)
        self._work([operation], now)
        return ""

    def _acknowledge(self, now: float) -> str:
        transfer = self._transfer
        transfer.stored += 1
        self._events.append(PacketStored(transfer.stored, transfer.total))
        return self._reply(messages.Ack(transfer.stored), now)

    def _answer_repeated(self, now: float) -> str:
        """Keep the first copy, whatever the second one contains (TX-05)."""
        stored = self._transfer.stored
        if self.profile.repeated_packet == "ack":
            return self._reply(messages.Ack(stored), now)
        return self._reply(messages.Nak(min(stored + 1, PACKET_COUNT_MAX)), now)

    def _answer_older(self, now: float) -> str:
        if self.profile.older_packet == "ack" and self._number is not None:
            return self._reply(messages.Ack(self._number), now)
        refused = self.profile.older_packet == "nak"
        return self._reply(messages.Nak(self._transfer.next_number) if refused else None, now)

    def _answer_bad(self, now: float) -> str:
        choice = self.profile.bad_packet
        if choice == "nak_received" and self._number is not None:
            return self._reply(messages.Nak(self._number), now)
        return self._reply(
            None if choice == "silence" else messages.Nak(self._transfer.next_number), now
        )

    # -- actions: end -----------------------------------------------------------------------------

    def _record(self, now: float) -> str:
        self._work([self.store.recording(self._transfer.size_bytes)], now)
        return f"{self._transfer.size_bytes} bytes"

    def _complete(self, now: float) -> str:
        image = self.store.read(self._transfer.size_bytes)
        self._events.append(ImageStored(len(image), hashlib.sha256(image).hexdigest()))
        self._send(messages.Complete())
        self._due_at = now + self.profile.start_delay_s
        return "the new application"

    def _complete_again(self, now: float) -> str:
        if self.profile.repeated_end == "same_answer":
            self._send(messages.Complete())
        return ""

    def _refuse_end(self, now: float) -> str:
        """Send NAK with the number of the next packet, or of the last one when all are stored."""
        self._send(messages.Nak(self._transfer.next_number))
        if self.state is BootloaderState.REFUSED:
            self._due_at = now + self.profile.refused_hold_s
        else:
            self._await_host(now)
        return "image checksum wrong"

    def _refuse_end_again(self, now: float) -> str:
        if self.profile.repeated_end == "same_answer":
            self._send(messages.Nak(self._transfer.next_number))
        return ""

    def _switch_off(self, now: float) -> str:
        self._controller.abort(now)
        self._lose_memory()
        for name in self.in_ram:
            vars(self).pop(name, None)
        return ""

    def _send(self, row: messages.UpgradeMessage) -> None:
        """Send an upgrade message to the tool."""
        self.send(row.to_message(self.target.answer_id))


def _in_application(row: AnyMessage) -> BootloaderEvent:
    """Return the event of a message to the running application."""
    match row:
        case messages.ResetCommand():
            return BootloaderEvent.RESET
        case messages.UpdateCommand() | messages.Packet() | messages.EndOfTransfer():
            return BootloaderEvent.UPGRADE_IN_APPLICATION
        case messages.Malformed():
            # Like any write it may be confirmed (2.2.1(2), R17).
            is_upgrade = row.message.mode == Mode.WRITE and row.message.command in _UPGRADE
            return BootloaderEvent.UPGRADE_IN_APPLICATION if is_upgrade else BootloaderEvent.QUERY
        case messages.Unknown():
            return BootloaderEvent.QUERY
    return BootloaderEvent.NO_CONCERN
