"""Wrong bootloaders: reset and boot version (RS)."""

from __future__ import annotations

from typing import Final, TypeGuard

from flasher.mock.model import MockDevice
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, HangingDevice, Variant
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Command, Mode
from flasher.protocol.wire import Message, Reassembler

_PATIENCE: Final = 8
"""Announcements after which a device without an application gives up."""


class NoFeedback(MockDevice):
    """Restarts without a word."""

    def _confirm_reset(self, now: float) -> str:
        self._await_restart(now)
        return "reset"


class ThreeAnnouncements(MockDevice):
    """Counts from 1 to below 4."""

    burst = 3


class FeedbackOnWrongId(MockDevice):
    """Confirms a reset to everybody, not to the tool."""

    def send(self, message: Message) -> None:
        if message.command == Command.GENERAL_FEEDBACK:
            message = message._replace(can_id=self.target.broadcast_id)
        super().send(message)


class TwoRestarts(MockDevice):
    """Keeps a reset that comes during the restart, and carries it out after the burst."""

    _waiting_reset = False

    def _await_restart(self, now: float) -> None:
        super()._await_restart(now)
        self._meanwhile = Reassembler(self.target.request_id, self.timings.inter_frame_timeout_s)

    def receive(self, frame: Frame, now: float) -> None:
        if self.state is State.RESTARTING and frame.can_id == self.target.request_id:
            for found in self._meanwhile.feed(frame.data, now):
                if isinstance(found, Message) and messages.decode(found) == messages.Reset():
                    self._waiting_reset = True
        super().receive(frame, now)

    def _elapsed(self) -> Event:
        burst_over = self.state is State.ANNOUNCING and self._announced >= self.burst
        if burst_over and self._waiting_reset:
            self._waiting_reset = False
            return Event.RESET
        return super()._elapsed()


class StaysInBootloader(MockDevice):
    """Waits for an update command for ever, after a burst of announcements."""

    def _announce(self, now: float) -> str:
        detail = super()._announce(now)
        if self._has_whole_application and self._announced >= self.burst:
            self._due = None
        return detail


class GivesUp(HangingDevice):
    """Without an application to start, announces itself twice four times and hangs."""

    def _announce(self, now: float) -> str:
        detail = super()._announce(now)
        hopeless = not self._has_whole_application and self._announced > _PATIENCE
        return self._hang() if hopeless else detail


def _is_bad_reset(row: AnyRow) -> TypeGuard[messages.Malformed]:
    return isinstance(row, messages.Malformed) and row.message.command == Command.RESET


class ResetByAnyText(MockDevice):
    """Does not look at the text of a reset."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if _is_bad_reset(row) and row.message.mode == Mode.WRITE:
            row = messages.Reset()
        super()._take_row(row, now)


class ResetByRead(MockDevice):
    """Does not look at the mode of a reset."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if _is_bad_reset(row) and row.message.data == messages.Reset.DATA:
            row = messages.Reset()
        super()._take_row(row, now)


class SilentPowerUp(MockDevice):
    """Starts a whole application at power-up without passing through the announcements."""

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


VARIANTS: Final = (
    Variant("no-feedback", "RS-01", "restarts at a reset without general feedback", NoFeedback),
    Variant(
        "announces-three-times",
        "RS-01",
        "announces itself three times",
        ThreeAnnouncements,
        also=("RS-02", "RS-05", "UP-04"),
    ),
    Variant(
        "announces-every-60-ms",
        "RS-01",
        "announces itself 60 ms apart",
        timings={"boot_version_spacing_s": 0.06},
        also=("RS-05", "TM-05"),
    ),
    Variant(
        "feedback-on-wrong-id",
        "RS-01",
        "answers on its broadcast id: general feedback to 7S0",
        FeedbackOnWrongId,
        also=("CR-04", "UP-03"),
    ),
    Variant("two-restarts", "RS-02", "restarts once for each of two resets", TwoRestarts),
    Variant(
        "stays-in-bootloader",
        "RS-03",
        "without an update command, waits silently for ever",
        StaysInBootloader,
        also=(
            "RS-02",
            "RS-05",
            "UP-02",
            "UP-04",
            "UP-03",
            "UP-06",
            "PW-01",
            "EN-01",
            "BU-02",
            "CO-01",
            "SE-01",
            "SE-03",
            "SE-04",
        ),
    ),
    Variant(
        "gives-up-without-application",
        "RS-03",
        "without an application, announces itself eight times and hangs",
        GivesUp,
        also=("TX-07", "TX-12", "PW-01", "PW-02", "SE-01"),
    ),
    Variant("resets-at-any-text", "RS-04", "takes a reset with a wrong text", ResetByAnyText),
    Variant("resets-on-read", "RS-04", "takes a reset that is a read", ResetByRead),
    Variant(
        "silent-power-up",
        "RS-05",
        "starts the application at power-up without announcing itself",
        SilentPowerUp,
    ),
)
