"""Wrong bootloaders: update command (UP)."""

from __future__ import annotations

import dataclasses
from typing import Final

from flasher.mock.classify import Transfer
from flasher.mock.model import MockDevice
from flasher.mock.table import Event, State
from flasher.mock.variants.base import AnyRow, PlainStore, Variant
from flasher.protocol import messages
from flasher.protocol.spec import PACKET_DATA_SIZE, Command

_PATIENCE: Final = 8
"""Announcements after which a device without an application gives up."""

_LISTENS_UNTIL: Final = 3
_LOOP_S: Final = 0.005
"""Until the bootloader looks into its queue again."""


class _OnePacketMore(Transfer):
    @property
    def total(self) -> int:
        return self.size_bytes // PACKET_DATA_SIZE + 1


class FullPacketsFail(MockDevice):
    """Counts one packet too many where the size is a multiple of 128."""

    transfer_type = _OnePacketMore


class ErasesBeforeCheck(MockDevice):
    """Erases, then looks at the size."""

    def _refuse_update(self, now: float) -> str:
        size_bytes, limit_bytes = self._offered_bytes, self.profile.image_limit_bytes
        if self.state is State.ANNOUNCING and not 0 < size_bytes <= limit_bytes:
            _erase_at_once(self)
            self._has_whole_application = False
        return super()._refuse_update(now)


class ErasesFromApplication(MockDevice):
    """Its application takes the update command, and erases."""

    def _send_feedback(self, now: float) -> str:
        if self._message is not None and self._message.command == Command.UPDATE:
            _erase_at_once(self)
        return super()._send_feedback(now)


def _erase_at_once(device: MockDevice) -> None:
    """The record and the first page are gone; the time that it takes is not modelled."""
    for operation in device.store.erasing(1)[:2]:
        device.store.flash.erase_page(operation.address)


class StopsListening(MockDevice):
    """Listens between its first announcements only, when it has an application to start."""

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        is_late = self.state is State.ANNOUNCING and self._announced >= _LISTENS_UNTIL
        is_deaf = is_late and self._has_whole_application
        return Event.NO_CONCERN if is_deaf and event is Event.UPDATE else event


class QueuesUpdates(MockDevice):
    """Keeps an update command that comes while it erases, and erases and requests again for it."""

    _waiting_update = False

    def _handle(self, event: Event, now: float) -> None:
        if event is Event.UPDATE_AGAIN and self.state is State.ERASING:
            self._waiting_update = True
        super()._handle(event, now)

    def _request(self, now: float) -> str:
        detail = super()._request(now)
        if self._waiting_update:
            self._due = now + _LOOP_S
        return detail

    def _elapsed(self) -> Event:
        if self.state is State.TRANSFER and self._waiting_update:
            self._waiting_update = False
            return Event.UPDATE
        return super()._elapsed()


class AnyTargetName(MockDevice):
    """Takes the update command of every target for its own."""

    def _take_row(self, row: AnyRow, now: float) -> None:
        if isinstance(row, messages.UpdateCommand):
            row = dataclasses.replace(row, text=self.target.update_text)
        super()._take_row(row, now)


class MixesTransfers(MockDevice):
    """On an update command in the midst, requests anew but keeps what is stored, and its count."""

    store_type = PlainStore

    def _classify(self, row: AnyRow) -> Event:
        event = super()._classify(row)
        if event is Event.UPDATE and self.state is State.TRANSFER and self._transfer.stored:
            self._transfer.size_bytes = self._offered_bytes
            return Event.UPDATE_AGAIN
        return event


VARIANTS: Final = (
    Variant(
        "full-last-packet-fails",
        "UP-01",
        "wants a packet more when the size is a multiple of 128",
        FullPacketsFail,
        also=("EN-01", "EN-07", "EN-08", "PW-01", "PW-02", "TX-07"),
    ),
    Variant(
        "erases-before-checking-size",
        "UP-02",
        "erases the application before it refuses an impossible size",
        ErasesBeforeCheck,
        also=("SE-04",),
    ),
    Variant(
        "erases-from-application",
        "UP-03",
        "erases at an update command to the running application",
        ErasesFromApplication,
        also=("SE-03",),
    ),
    Variant(
        "listens-until-third-version",
        "UP-04",
        "takes no update command from its third announcement on",
        StopsListening,
        also=("UP-05",),
    ),
    Variant(
        "queues-updates",
        "UP-05",
        "erases and requests once for each update command that came",
        QueuesUpdates,
    ),
    Variant("any-target-name", "UP-06", "takes the update command of any target", AnyTargetName),
    Variant(
        "mixes-transfers",
        "UP-08",
        "goes on with what is stored when an update command comes in the midst",
        MixesTransfers,
    ),
)
