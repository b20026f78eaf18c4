"""The device: a bootloader on a flash of its own, and the application that it starts, written from
the document alone.

Here is what it does, action by action of its table (`table`); how messages and time become events
of the table, and what else a device is, stands in `core`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Final

from flasher.errors import FlasherError
from flasher.events import ImageStored, PacketStored
from flasher.mock.core import DeviceCore
from flasher.mock.memory import Operation
from flasher.mock.table import Action, State
from flasher.protocol import messages
from flasher.protocol.spec import PACKET_COUNT_MAX
from flasher.protocol.text import find_firmware_version

NO_VERSION: Final = "unknown"
"""Firmware text of an application in whose image no version was found."""


class MockDevice(DeviceCore):
    """One upgradable device, an engine (`flasher.protocol.engine`); made as `DeviceCore` says."""

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
        if self._announced < self.burst or (not self._has_whole_application and goes_on):
            self._rearm(self.timings.boot_version_spacing_s, now)
        elif self._has_whole_application:
            self._rearm(self.profile.window_s, now)
        else:
            self._due = None
        return ""

    def _start(self, now: float) -> str:
        self._due = None
        firmware = self._firmware()
        self.application.start(firmware, now)
        return f"version {firmware}"

    def _firmware(self) -> str:
        """Version text in the image of the application."""
        return find_firmware_version(self.store.image() or b"") or NO_VERSION

    # -- actions: update command and transfer -----------------------------------------------------

    def _refuse_update(self, now: float) -> str:
        self._report(
            f"update command for {self._offered_bytes} bytes refused while {self.state.value}; "
            f"the largest image is {self.profile.image_limit_bytes} bytes"
        )
        return ""

    def _erase(self, now: float) -> str:
        self._transmitter.drop_unstarted()
        self._transfer = self.transfer_type(self._offered_bytes)
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
