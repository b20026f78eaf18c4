"""Wrong bootloaders: more of the end (EN) and of bad input (SE)."""

from __future__ import annotations

import dataclasses
from typing import Final

from flasher.mock.model import MockDevice
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, HangingDevice, Variant
from flasher.protocol import messages
from flasher.protocol.spec import PACKET_DATA_SIZE
from flasher.protocol.wire import Message

_WORD: Final = 0xFFFF_FFFF


class RunsOnce(MockDevice):
    """Starts the new application, and has forgotten it at the next restart."""

    _ended = False

    def _complete(self, now: float) -> str:
        self._ended = True
        return super()._complete(now)

    def _boot(self, now: float) -> str:
        detail = super()._boot(now)
        if self._ended and self.profile.after_complete == "starts":
            self._has_whole_application = False
        return detail

    def _erase(self, now: float) -> str:
        self._ended = False
        return super()._erase(now)


class RefusesSecondEnd(MockDevice):
    """Takes the second end of transfer for one that came too early."""

    def _complete_again(self, now: float) -> str:
        self._send(messages.Nak(self._transfer.total))
        return ""


class CompletesSecondEnd(MockDevice):
    """An early end of transfer is refused once: the second one is believed."""

    _refused = False

    def _erase(self, now: float) -> str:
        self._refused = False
        return super()._erase(now)

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        if event is not Event.END_EARLY:
            return event
        if self._refused and self._accepts_image():
            return Event.END_WHOLE
        self._refused = True
        return event


class RefusalHangs(HangingDevice):
    """Waits for ever after it has refused an image."""

    def _refuse_end(self, now: float) -> str:
        detail = super()._refuse_end(now)
        if self.state is State.REFUSED:
            self._due = None
        return detail

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        stuck = self.state is State.REFUSED and event is not Event.END_AGAIN
        return Event.NO_CONCERN if stuck else event


class SizeRoundedUp(MockDevice):
    """Rounds the size up to whole packets in 32 bits, then looks whether it fits."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if isinstance(row, messages.UpdateCommand):
            rounded = row.size_bytes + PACKET_DATA_SIZE - 1
            if rounded > _WORD:
                wrapped = max((rounded & _WORD) // PACKET_DATA_SIZE, 1) * PACKET_DATA_SIZE
                row = dataclasses.replace(row, size_bytes=wrapped)
        super()._take_row(row, now)


class AnyMessageIsLife(MockDevice):
    """Its timers begin anew with every message that comes, of use or not."""

    def _take_message(self, message: Message, now: float) -> None:
        before, due = self.state, self._due
        super()._take_message(message, now)
        if self.state is not before or self._due != due:
            return
        if self.state is State.TRANSFER:
            self._await_host(now)
        elif self.state is State.ANNOUNCING and self._announced >= self.burst:
            self._due = now + self.profile.window_s


VARIANTS: Final = (
    Variant(
        "runs-new-application-once",
        "EN-01",
        "does not find the new application any more after the next restart",
        RunsOnce,
        also=(
            "CR-03",
            "RS-01",
            "RS-02",
            "RS-03",
            "RS-05",
            "UP-02",
            "UP-03",
            "UP-04",
            "UP-06",
            "TM-05",
            "SE-01",
            "SE-03",
            "SE-04",
            "CO-01",
        ),
    ),
    Variant(
        "second-end-refused",
        "EN-02",
        "answers the end of transfer that follows complete with a NAK",
        RefusesSecondEnd,
    ),
    Variant(
        "believes-second-early-end",
        "EN-02",
        "refuses an early end of transfer once, and completes at the second one",
        CompletesSecondEnd,
    ),
    Variant(
        "refusal-is-final",
        "EN-04",
        "takes nothing after it has refused an image, until power is cut",
        RefusalHangs,
        profile={"image_checksum": "crc32"},
    ),
    Variant(
        "size-rounds-to-small",
        "SE-04",
        "rounds a size of nearly 2^32 up to a small one, and erases for it",
        SizeRoundedUp,
        also=("UP-02",),
    ),
    Variant(
        "any-message-is-life",
        "SE-01",
        "window and pause begin anew with every message of no use",
        AnyMessageIsLife,
        also=("CO-04",),
    ),
)
