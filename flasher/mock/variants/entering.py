"""Wrong bootloaders: reset and boot version (RS), update command (UP)."""

from __future__ import annotations

import dataclasses
from math import inf
from typing import Final

from flasher.mock.model import AnyMessage, MockDevice, ReceivedTransfer
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.base import HangingDevice, PlainStore, bad_write, variant
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.spec import PACKET_DATA_SIZE, Command
from flasher.protocol.wire import Message, Reassembler

_PATIENCE: Final = 8
"""Number of announcements after which a device without an application gives up."""
_LISTENS_UNTIL: Final = 3
LOOP_S: Final = 0.005
"""Interval at which the bootloader reads its queue."""
_POINTER_BYTES: Final = 4
_BYTE_MAX: Final = 0xFF
_SIXTEEN_BITS: Final = 0xFFFF
_LEFTOVER_S: Final = 0.1
_UPDATES_MAX: Final = 20


@variant("no-feedback", "RS-01")
class NoFeedback(MockDevice):
    """Restarts at a reset without general feedback."""

    def _confirm_reset(self, now: float) -> str:
        self._await_restart(now)
        return "reset"


@variant("announces-three-times", "RS-01", also="RS-02 RS-05 UP-04")
class ThreeAnnouncements(MockDevice):
    """Announces itself three times."""

    burst = 3


@variant(
    "announces-every-60-ms", "RS-01", also="RS-05 TM-05", timings={"boot_version_spacing_s": 0.06}
)
class SlowAnnouncements(MockDevice):
    """Announces itself 60 ms apart."""


@variant("feedback-on-wrong-id", "RS-01", also="CR-04 UP-03")
class FeedbackOnWrongId(MockDevice):
    """Answers on its broadcast id: general feedback to 7S0."""

    def send(self, message: Message) -> None:
        if message.command == Command.GENERAL_FEEDBACK:
            message = message._replace(can_id=self.target.broadcast_id)
        super().send(message)


@variant("two-restarts", "RS-02")
class TwoRestarts(MockDevice):
    """Restarts once for each of two resets. Keeps a reset that comes during the restart, and
    carries it out after the burst.
    """

    _waiting_reset = False

    def _await_restart(self, now: float) -> None:
        super()._await_restart(now)
        self._meanwhile = Reassembler(self.target.request_id, self.timings.inter_frame_timeout_s)

    def receive(self, frame: Frame, now: float) -> None:
        if self.state is BootloaderState.RESTARTING and frame.can_id == self.target.request_id:
            for found in self._meanwhile.feed(frame.data, now):
                if isinstance(found, Message) and messages.decode(found) == messages.ResetCommand():
                    self._waiting_reset = True
        super().receive(frame, now)

    def _elapsed(self) -> BootloaderEvent:
        burst_over = self.state is BootloaderState.ANNOUNCING and self._announced >= self.burst
        if burst_over and self._waiting_reset:
            self._waiting_reset = False
            return BootloaderEvent.RESET
        return super()._elapsed()


@variant(
    "stays-in-bootloader",
    "RS-03",
    also="RS-02 RS-05 UP-02 UP-04 UP-03 UP-06 TX-03 PW-01 EN-01 EN-02 BU-02 CO-01 SE-01 SE-03 "
    "SE-04",
)
class StaysInBootloader(MockDevice):
    """Waits silently forever if no update command comes."""

    def _announce(self, now: float) -> str:
        detail = super()._announce(now)
        if self._has_whole_application and self._announced >= self.burst:
            self._due_at = inf
        return detail


@variant("gives-up-without-application", "RS-03", also="TX-07 TX-12 PW-01 PW-02 SE-01")
class GivesUp(HangingDevice):
    """Hangs after eight announcements if it has no application."""

    def _announce(self, now: float) -> str:
        detail = super()._announce(now)
        hopeless = not self._has_whole_application and self._announced > _PATIENCE
        return self._hang() if hopeless else detail


@variant("resets-at-any-text", "RS-04")
class ResetByAnyText(MockDevice):
    """Accepts a reset with a wrong text."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        super()._take_row(messages.ResetCommand() if bad_write(row, Command.RESET) else row, now)


@variant("resets-on-read", "RS-04")
class ResetByRead(MockDevice):
    """Accepts a reset that is a read."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        message = row.message if isinstance(row, messages.Malformed) else None
        if message and (message.command, message.data) == (
            Command.RESET,
            messages.ResetCommand.DATA,
        ):
            row = messages.ResetCommand()
        super()._take_row(row, now)


@variant("silent-power-up", "RS-05")
class SilentPowerUp(MockDevice):
    """Starts the application at power-up without announcing itself."""

    _is_power_up = False

    def power_on(self, now: float) -> None:
        self._is_power_up = not self.has_power
        super().power_on(now)

    def _boot(self, now: float) -> str:
        detail = super()._boot(now)
        if self._is_power_up and self._has_whole_application:
            self._announced = self.burst
        self._is_power_up = False
        return detail


@variant(
    "full-last-packet-fails",
    "UP-01",
    also="UP-08 TX-01 TX-02 TX-03 TX-04 TX-05 TX-06 TX-07 TX-12 TX-13 EN-01 EN-02 EN-07 EN-08 "
    "PW-01 PW-02 SE-01 SE-04",
)
class FullPacketsFail(ReceivedTransfer):
    """Expects one packet more when the size is a multiple of 128."""

    @property
    def total(self) -> int:
        return self.size_bytes // PACKET_DATA_SIZE + 1


@variant("erases-before-checking-size", "UP-02", also="SE-04")
class ErasesBeforeCheck(MockDevice):
    """Erases the application before it refuses an impossible size."""

    def _refuse_update(self, now: float) -> str:
        size_bytes, limit_bytes = self._offered_bytes, self.profile.image_limit_bytes
        if self.state is BootloaderState.ANNOUNCING and not 0 < size_bytes <= limit_bytes:
            _erase_at_once(self)
            self._has_whole_application = False
        return super()._refuse_update(now)


@variant("erases-from-application", "UP-03", also="SE-03")
class ErasesFromApplication(MockDevice):
    """Erases at an update command to the running application."""

    def _send_feedback(self, now: float) -> str:
        if self._message is not None and self._message.command == Command.UPDATE:
            _erase_at_once(self)
        return super()._send_feedback(now)


def _erase_at_once(device: MockDevice) -> None:
    """Erase the record and the first page, without modelling the time that it takes."""
    for operation in device.store.erasing(1)[:2]:
        device.store.flash.execute(operation)


@variant(
    "listens-until-third-version",
    "UP-04",
    also="FR-01 FR-07 FR-08 CR-04 UP-05 TX-13 PW-01 CO-01 CO-02",
)
class StopsListening(MockDevice):
    """Accepts no update command from its third announcement on. Listens between its first
    announcements only, when it has an application to start.
    """

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        is_late = self.state is BootloaderState.ANNOUNCING and self._announced >= _LISTENS_UNTIL
        is_deaf = is_late and self._has_whole_application
        return BootloaderEvent.NO_CONCERN if is_deaf and event is BootloaderEvent.UPDATE else event


@variant("queues-updates", "UP-05")
class QueuesUpdates(MockDevice):
    """Carries out a second update command after packet 1. Keeps an update command that comes while
    it erases, and erases for it in the transfer.
    """

    _waiting_update = False

    def _handle(self, event: BootloaderEvent, now: float) -> None:
        if event is BootloaderEvent.UPDATE_AGAIN and self.state is BootloaderState.ERASING:
            self._waiting_update = True
        super()._handle(event, now)

    def _acknowledge(self, now: float) -> str:
        detail = super()._acknowledge(now)
        if self._waiting_update:
            self._due_at = now + LOOP_S
        return detail

    def _elapsed(self) -> BootloaderEvent:
        if self.state is BootloaderState.TRANSFER and self._waiting_update:
            self._waiting_update = False
            return BootloaderEvent.UPDATE
        return super()._elapsed()


@variant("any-target-name", "UP-06")
class AnyTargetName(MockDevice):
    """Accepts the update command of any target."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.UpdateCommand):
            row = dataclasses.replace(row, text=self.target.update_text)
        super()._take_row(row, now)


@variant("mixes-transfers", "UP-08", also="FR-07 UP-01 TX-12 TM-05")
class MixesTransfers(MockDevice):
    """Continues with the stored packets when an update command comes during the transfer."""

    store_type = PlainStore

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        if (
            event is BootloaderEvent.UPDATE
            and self.state is BootloaderState.TRANSFER
            and self._transfer.stored
        ):
            self._transfer.size_bytes = self._offered_bytes
            return BootloaderEvent.UPDATE_AGAIN
        return event


@variant("reset-text-of-four", "RS-04")
class ResetTextOfFour(MockDevice):
    """Compares the first four letters of a reset's text. As many as a pointer has bytes."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        message = bad_write(row, Command.RESET)
        if message and message.data.startswith(messages.ResetCommand.DATA[:_POINTER_BYTES]):
            row = messages.ResetCommand()
        super()._take_row(row, now)


@variant("update-text-of-four", "UP-06")
class UpdateTextOfFour(MockDevice):
    """Compares the first four letters of a target's name. As many as a pointer has bytes."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        message, text = bad_write(row, Command.UPDATE), self.target.update_text.encode("ascii")
        if message and message.data.startswith(text[:_POINTER_BYTES]):
            row = messages.decode(message._replace(data=text + message.data[len(text) :]))
        super()._take_row(row, now)


@variant("reset-from-any-node", "RS-04")
class ResetFromAnyNode(MockDevice):
    """Accepts a reset that another node than the tool sends. Checks only the receiver."""

    def _take_message(self, message: Message, now: float) -> None:
        if messages.decode(message) == messages.ResetCommand():
            message = message._replace(can_id=self.target.request_id)
        super()._take_message(message, now)


@variant("dies-after-255-announcements", "RS-03")
class DiesAfter255(HangingDevice):
    """Hangs after 255 announcements if it has no application."""

    def _announce(self, now: float) -> str:
        return self._hang() if self._announced >= _BYTE_MAX else super()._announce(now)


@variant(
    "feedback-after-version",
    "RS-01",
    also="FR-06 FR-10 CR-03 RS-02 UP-04 UP-06 CO-04",
)
class FeedbackAfterVersion(MockDevice):
    """Sends general feedback after the first boot version. Leaves the answer to a reset to the
    bootloader.
    """

    _owes_feedback = False

    def _confirm_reset(self, now: float) -> str:
        self._owes_feedback = True
        self._await_restart(now)
        return "reset"

    def _announce(self, now: float) -> str:
        detail = super()._announce(now)
        if self._owes_feedback:
            self._owes_feedback = False
            self._send(messages.GeneralFeedbackMessage())
        return detail


@variant("leftover-announcement", "UP-04", also="*")
class LeftoverAnnouncement(MockDevice):
    """Announces itself once more 0.1 s after request transfer. Does not stop the timer of its
    announcements at the update command.
    """

    _leftover_at = inf
    in_ram = ("_leftover_at",)

    def _request(self, now: float) -> str:
        self._leftover_at = now + _LEFTOVER_S
        return super()._request(now)

    def deadline(self) -> float | None:
        due_at = super().deadline()
        found = self._leftover_at if due_at is None else min(due_at, self._leftover_at)
        return None if found == inf else found

    def tick(self, now: float) -> None:
        super().tick(now)
        if now >= self._leftover_at:
            self._leftover_at = inf
            self._send(messages.BootVersion(self.target.boot_name, self.profile.boot_version))


@variant("sixteen-bit-size", "UP-02", profile={"application_area_bytes": 48 * 1024})
class SixteenBitSize(MockDevice):
    """Keeps 16 bits of the size, and takes one beyond 64 KiB for a small one."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.UpdateCommand):
            row = dataclasses.replace(row, size_bytes=row.size_bytes & _SIXTEEN_BITS)
        super()._take_row(row, now)


@variant("hangs-at-20th-update", "UP-08", also="FR-07 TX-12 EN-01 BU-01 PW-01")
class HangsAt20thUpdate(HangingDevice):
    """Hangs at the 20th update command since power-up until power is cut. Allocates a buffer for
    each transfer, and frees none.
    """

    _updates = 0
    in_ram = ("hangs", "_updates")

    def _erase(self, now: float) -> str:
        self._updates += 1
        return self._hang() if self._updates >= _UPDATES_MAX else super()._erase(now)


@variant("reset-while-erasing-hangs", "TX-13")
class ResetWhileErasingHangs(HangingDevice):
    """Hangs at a reset while it erases until power is cut."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.ResetCommand) and self.state is BootloaderState.ERASING:
            self._hang()
        else:
            super()._take_row(row, now)


@variant("completes-without-transfer", "EN-02")
class CompletesWithoutTransfer(MockDevice):
    """Answers an end of transfer with complete while it announces itself. Counts no packet missing
    as long as none was announced.
    """

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.EndOfTransfer) and self.state is BootloaderState.ANNOUNCING:
            self._send(messages.Complete())
        super()._take_row(row, now)


@variant("acks-without-transfer", "TX-03")
class AcksWithoutTransfer(MockDevice):
    """Acknowledges packets while it announces itself, and stores nothing."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Packet) and self.state is BootloaderState.ANNOUNCING:
            self._send(messages.Ack(row.number))
        super()._take_row(row, now)
