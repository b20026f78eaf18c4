"""The device: a bootloader on a flash of its own, and the application that it starts, written from
the document alone.

What happens becomes an event (`classify`, `_elapsed`), the table says what follows, and the methods
at the end do it. An action may change everything but the state, and returns a few words for those
who watch.

Flash operations take their time in the controller. While they last the device hears, but a packet
that comes before the answer to the one before is out of turn.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import ClassVar, Final

from flasher.device.application import Application
from flasher.device.bms import BmsApplication
from flasher.device.classify import Situation, Transfer, classify, is_damaged_packet, named_number
from flasher.device.machine import Machine
from flasher.device.memory import FlashController, Operation
from flasher.device.memory_map import memory_map
from flasher.device.profile import DeviceProfile
from flasher.device.store import ApplicationStore, checksum_fits, factory_image
from flasher.device.table import TABLE, Action, Event, Row, State
from flasher.errors import FlasherError, UsageError
from flasher.events import DeviceStateEntered, ImageStored, PacketStored
from flasher.protocol import messages
from flasher.protocol.spec import BOOT_VERSION_BURST, DIALECTS, PACKET_COUNT_MAX, Node, Target
from flasher.protocol.text import find_firmware_version
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Damage, Message

NO_VERSION: Final = "unknown"
"""Firmware text of an application in whose image no version was found."""
_DEFAULT_PROFILE: Final = DeviceProfile()
_DEAF: Final = frozenset((State.OFF, State.RESTARTING))
_WORKS_ON_FLASH: Final = frozenset((State.ERASING, State.PROGRAMMING, State.CHECKING))
_PER_PACKET: Final = frozenset((State.TRANSFER, State.PROGRAMMING))
_TIMER_EVENTS: Final = {
    State.RESTARTING: Event.RESTART_DUE,
    State.TRANSFER: Event.PAUSE_OVER,
    State.REFUSED: Event.HOLD_OVER,
}


class Device(Machine):
    """One upgradable device, an engine (`flasher.protocol.engine`).

    At construction it has been on for a while: its application runs, or, when there is none, its
    bootloader announces itself from the first time it is given. A BMS has an application that
    answers, others a silent one unless another is given. Raises UsageError for timings that would
    make it announce without a pause.
    """

    table: ClassVar[Mapping[State, Row]] = TABLE

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
        self.store = ApplicationStore(profile)
        super().__init__(
            application or _own_application(target, profile, self.store),
            frozenset((target.request_id,)),
            bitrate_bps=bitrate_bps,
            timings=timings,
        )
        self.state = State.APPLICATION if has_application else State.ANNOUNCING
        self._controller = FlashController(
            self.store.flash,
            erase_time_s=profile.erase_time_s,
            program_time_s=profile.program_time_s,
        )
        self._transfer = Transfer(0)
        self._announced = 0
        self._has_whole_application = has_application
        self._runs_application = has_application
        # What the message in hand brought, for the action that follows it.
        self._offered_bytes = 0
        self._number: int | None = None
        self._payload = b""
        self._message: Message | None = None
        self._actions = self._make_actions()
        if has_application:
            self.store.load(factory_image(profile))
            detail = self._start(0.0)
        else:
            self._due = float("-inf")
            detail = "no application"
        self._events.append(DeviceStateEntered(self.state.value, detail))

    # -- what tests and the conformance suite look at ---------------------------------------------

    @property
    def stored_image(self) -> bytes | None:
        """The image of the whole application in the flash, exactly its size; None without one."""
        return self.store.image()

    @property
    def erase_count(self) -> int:
        """Pages erased to the end since construction."""
        return self.store.flash.erase_count

    @property
    def program_count(self) -> int:
        """Program operations (a packet, or the final record) done to the end since construction."""
        return self.store.flash.program_count

    # -- power ------------------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        """False after a power cut."""
        return self.state is not State.OFF

    def power_cut(self, now: float) -> None:
        """The power goes: all is lost but the flash, and an operation under way stays torn."""
        self._handle(Event.POWER_CUT, now)

    def power_on(self, now: float) -> None:
        """The power comes back; the device passes through its bootloader (R19)."""
        self._handle(Event.POWER_ON, now)
        self._run_timer(now)

    # -- from the world to events -----------------------------------------------------------------

    def _take_message(self, message: Message, now: float) -> None:
        self._message = message
        # On other ids there is nothing for a bootloader, whatever the command.
        if message.can_id == self.target.request_id:
            self._take_row(messages.decode(message), now)
        else:
            self._handle(Event.QUERY, now)

    def _take_row(
        self, row: messages.Row | messages.Malformed | messages.Unknown, now: float
    ) -> None:
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
        if is_own and is_damaged_packet(damage) and self.state is State.TRANSFER:
            self._number = named_number(damage.data)
            self._handle(Event.PACKET_BAD, now)

    def _classify(self, row: messages.Row | messages.Malformed | messages.Unknown) -> Event:
        situation = Situation(self.target, self.profile, self.state, self._transfer)
        event = classify(row, situation)
        if event is Event.END_WHOLE and not self._accepts_image():
            return Event.END_WRONG
        return event

    def _accepts_image(self) -> bool:
        """False when the product's images carry a checksum and this one's is wrong (R7)."""
        if self.profile.image_checksum == "none":
            return True
        return checksum_fits(self.store.read(self._transfer.size_bytes))

    def _expire(self, now: float) -> None:
        if self.state in _WORKS_ON_FLASH and not self._controller.advance(now):
            self._due = self._controller.ends_at
        else:
            self._handle(self._elapsed(), now)

    def _elapsed(self) -> Event:
        """What the expired timer means."""
        if self.state in _WORKS_ON_FLASH:
            return Event.FLASH_DONE
        if self.state is State.ANNOUNCING:
            if self._announced < BOOT_VERSION_BURST or not self._has_whole_application:
                return Event.ANNOUNCEMENT_DUE
            return Event.WINDOW_OVER
        if self.state is State.STARTING:
            restarts = self.profile.after_complete == "restarts"
            return Event.START_BY_RESTART_DUE if restarts else Event.START_DUE
        return _TIMER_EVENTS[self.state]

    def _handle(self, event: Event, now: float) -> None:
        before = self.state
        action, self.state = self.table[before][event]
        self._is_deaf = self.state in _DEAF
        self._runs_application = self.state is State.APPLICATION
        if before is State.APPLICATION and not self._runs_application:
            self.application.stop()
        detail = self._actions[action](now)
        if self.state is not before and not {self.state, before} <= _PER_PACKET:
            self._events.append(DeviceStateEntered(self.state.value, detail))

    def _make_actions(self) -> Mapping[Action, Callable[[float], str]]:
        return {
            Action.NOTHING: self._nothing,
            Action.IMPOSSIBLE: self._impossible,
            Action.CONFIRM_RESET: self._confirm_reset,
            Action.RESTART: self._restart,
            Action.SEND_FEEDBACK: self._send_feedback,
            Action.ANSWER: self._answer,
            Action.BOOT: self._boot,
            Action.ANNOUNCE: self._announce,
            Action.START: self._start,
            Action.REFUSE_UPDATE: self._refuse_update,
            Action.ERASE: self._erase,
            Action.REQUEST: self._request,
            Action.STORE: self._store,
            Action.ACKNOWLEDGE: self._acknowledge,
            Action.ANSWER_REPEATED: self._answer_repeated,
            Action.ANSWER_OLDER: self._answer_older,
            Action.ANSWER_BAD: self._answer_bad,
            Action.RECORD: self._record,
            Action.COMPLETE: self._complete,
            Action.COMPLETE_AGAIN: self._complete_again,
            Action.REFUSE_END: self._refuse_end,
            Action.REFUSE_END_AGAIN: self._refuse_end_again,
            Action.SWITCH_OFF: self._switch_off,
        }

    def _send(self, row: messages.Row) -> None:
        """Send one of the upgrade's messages to the tool."""
        self.send(row.to_message(self.target.answer_id))

    # -- actions: application, reset, announcements -----------------------------------------------

    def _nothing(self, now: float) -> str:
        return ""

    def _impossible(self, now: float) -> str:
        raise FlasherError(
            "the device model met an event that cannot happen",
            where=f"state {self.state.value}",
            cause="a bug of the device model",
        )

    def _send_feedback(self, now: float) -> str:
        if self.profile.upgrade_in_application == "general_feedback":
            self._send(messages.GeneralFeedback())
        return ""

    def _answer(self, now: float) -> str:
        if self._message is not None:
            self.application.take(self._message, now)
        return ""

    def _confirm_reset(self, now: float) -> str:
        self._send(messages.GeneralFeedback())
        self._await_restart(now)
        return "reset"

    def _restart(self, now: float) -> str:
        """Without a word: general feedback is the application's (R15)."""
        self._transmitter.drop_unstarted()
        self._await_restart(now)
        return "into the bootloader"

    def _await_restart(self, now: float) -> None:
        self._controller.abort(now)
        self._forget_received()
        self._due = now + self.profile.reset_delay_s

    def _boot(self, now: float) -> str:
        """Only what is whole may be started; without it the announcements go on (R14)."""
        self._has_whole_application = self.store.image() is not None
        self._announced = 0
        self._due = now
        return "whole application" if self._has_whole_application else "no application"

    def _announce(self, now: float) -> str:
        # A bus that takes nothing must not pile announcements up.
        if not self._announced or self._transmitter.idle:
            version = self.profile.boot_version
            self._send(messages.BootVersion(self.target.boot_name, version))
        self._announced += 1
        goes_on = self.profile.without_application == "announces"
        if self._announced < BOOT_VERSION_BURST or (not self._has_whole_application and goes_on):
            self._rearm(self.timings.boot_version_spacing_s, now)
        elif self._has_whole_application:
            self._rearm(self.profile.window_s, now)
        else:
            self._due = None
        return ""

    def _start(self, now: float) -> str:
        self._due = None
        firmware = find_firmware_version(self.store.image() or b"") or NO_VERSION
        self.application.start(firmware, now)
        return f"version {firmware}"

    # -- actions: update command and transfer -----------------------------------------------------

    def _refuse_update(self, now: float) -> str:
        self._report(
            f"update command for {self._offered_bytes} bytes refused while {self.state.value}; "
            f"the largest image is {self.profile.image_limit_bytes} bytes"
        )
        return ""

    def _erase(self, now: float) -> str:
        self._transmitter.drop_unstarted()
        self._transfer = Transfer(self._offered_bytes)
        self._work(self.store.erasing(self._offered_bytes), now)
        return f"for {self._offered_bytes} bytes in {self._transfer.total} packets"

    def _work(self, operations: list[Operation], now: float) -> None:
        self._controller.run(operations, now)
        self._due = self._controller.ends_at

    def _request(self, now: float) -> str:
        self._send(messages.RequestTransfer())
        self._await_host(now)
        return ""

    def _await_host(self, now: float) -> None:
        waits = self.profile.pause_in_transfer == "waits"
        self._due = None if waits else now + self.profile.transfer_timeout_s

    def _store(self, now: float) -> str:
        transfer = self._transfer
        number = transfer.wanted
        operation = self.store.storing(number, self._payload, transfer.size_bytes)
        self._work([operation], now)
        return ""

    def _acknowledge(self, now: float) -> str:
        transfer = self._transfer
        transfer.stored += 1
        self._send(messages.Ack(transfer.stored))
        self._events.append(PacketStored(transfer.stored, transfer.total))
        self._await_host(now)
        return ""

    def _answer_repeated(self, now: float) -> str:
        """The first copy stays, whatever the second one holds (TX-05)."""
        stored = self._transfer.stored
        if self.profile.repeated_packet == "ack":
            self._send(messages.Ack(stored))
        else:
            self._send(messages.Nak(min(stored + 1, PACKET_COUNT_MAX)))
        self._await_host(now)
        return ""

    def _answer_older(self, now: float) -> str:
        if self.profile.older_packet == "ack" and self._number is not None:
            self._send(messages.Ack(self._number))
        elif self.profile.older_packet == "nak":
            self._send(messages.Nak(self._transfer.wanted))
        self._await_host(now)
        return ""

    def _answer_bad(self, now: float) -> str:
        choice = self.profile.bad_packet
        if choice == "nak_received" and self._number is not None:
            self._send(messages.Nak(self._number))
        elif choice != "silence":
            self._send(messages.Nak(self._transfer.wanted))
        self._await_host(now)
        return ""

    # -- actions: end -----------------------------------------------------------------------------

    def _record(self, now: float) -> str:
        self._work([self.store.recording(self._transfer.size_bytes)], now)
        return f"{self._transfer.size_bytes} bytes"

    def _complete(self, now: float) -> str:
        image = self.store.read(self._transfer.size_bytes)
        self._events.append(ImageStored(len(image), hashlib.sha256(image).hexdigest()))
        self._send(messages.Complete())
        self._due = now + self.profile.start_delay_s
        return "the new application"

    def _complete_again(self, now: float) -> str:
        if self.profile.repeated_end == "same_answer":
            self._send(messages.Complete())
        return ""

    def _refuse_end(self, now: float) -> str:
        """The number in it is that of the packet wanted, of the last one when all are there."""
        self._send(messages.Nak(self._transfer.wanted))
        if self.state is State.REFUSED:
            self._due = now + self.profile.refused_hold_s
        else:
            self._await_host(now)
        return "image checksum wrong"

    def _refuse_end_again(self, now: float) -> str:
        if self.profile.repeated_end == "same_answer":
            self._send(messages.Nak(self._transfer.wanted))
        return ""

    def _switch_off(self, now: float) -> str:
        self._controller.abort(now)
        self._lose_memory()
        return ""


def _own_application(
    target: Target, profile: DeviceProfile, store: ApplicationStore
) -> Application:
    if target.node is Node.BMS:
        return BmsApplication(profile, memory_map(store.flash))
    return Application(target.node, DIALECTS[profile.dialect])
