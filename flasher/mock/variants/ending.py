"""Wrong bootloaders: end of transfer (EN) and power cuts (PW)."""

from __future__ import annotations

from math import inf
from typing import Final

from flasher.mock.memory import ERASED, Operation
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.store import AREA_START, ApplicationStore
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.base import HangingDevice, PlainStore, bad_write, variant
from flasher.protocol import messages
from flasher.protocol.spec import Command

_DARK_BOOTS: Final = 2
"""Number of power-ups in a row without an application after which it hangs."""


@variant("announces-after-complete", "EN-01", also="EN-07 EN-08", upgrade_works=False)
class AnnouncesAfterComplete(MockDevice):
    """Does not start the new application until power is cut, announces itself instead."""

    _holds_back = False
    in_ram = ("_holds_back",)

    def _complete(self, now: float) -> str:
        self._holds_back = True
        return super()._complete(now)

    def _elapsed(self) -> BootloaderEvent:
        if self.state is BootloaderState.STARTING:
            return BootloaderEvent.START_BY_RESTART_DUE
        return super()._elapsed()

    def _boot(self, now: float) -> str:
        detail = super()._boot(now)
        self._has_whole_application = self._has_whole_application and not self._holds_back
        return detail


@variant("accepts-early-end", "EN-02")
class AcceptsEarlyEnd(MockDevice):
    """Completes when packets are missing."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        if event is not BootloaderEvent.END_EARLY:
            return event
        return BootloaderEvent.END_WHOLE if self._accepts_image() else BootloaderEvent.END_WRONG


@variant("ignores-image-checksum", "EN-04", profile={"image_checksum": "crc32"})
class ImageChecksumIgnored(MockDevice):
    """Starts an image whose own checksum is wrong."""

    def _accepts_image(self) -> bool:
        return True


@variant("keeps-longer-rest", "EN-07", also="UP-01 UP-08 EN-01 EN-08")
class KeepsLongerRest(PlainStore):
    """Does not erase the page where a smaller image ends: a mixture with the old one."""

    def erasing(self, size_bytes: int) -> list[Operation]:
        old = self.image()
        operations = super().erasing(size_bytes)
        if old is None or len(old) <= size_bytes:
            return operations
        page = self.flash.page_size_bytes
        kept = AREA_START + (size_bytes - 1) // page * page
        return [operation for operation in operations if operation.address != kept]


@variant(
    "reports-old-version",
    "EN-08",
    also="UP-08 TX-01 TX-02 TX-03 TX-04 TX-05 TX-06 TX-13 EN-01 EN-02 EN-07 SE-04",
)
class ReportsOldVersion(MockDevice):
    """Reports the version from before the upgrade until power is cut (a BMS). Reads the version of
    its application at power-up only.
    """

    _version: str | None = None
    in_ram = ("_version",)

    def _firmware(self) -> str:
        if self._version is None:
            self._version = super()._firmware()
        return self._version


@variant("starts-torn-image", "PW-01", also="RS-03 TX-12 EN-04 PW-02")
class StartsTornImage(MockDevice):
    """Starts an incompletely stored image."""

    def _boot(self, now: float) -> str:
        super()._boot(now)
        first = self.store.read(self.profile.program_unit_bytes)
        self._has_whole_application = set(first) != {ERASED}
        return "something" if self._has_whole_application else "no application"


class _Trusting(ApplicationStore):
    def _is_intact(self, image: bytes, crc: int) -> bool:
        return True


class _RecordFirst(_Trusting):
    def erasing(self, size_bytes: int) -> list[Operation]:
        return [*super().erasing(size_bytes), self.recording(size_bytes)]


@variant("record-first", "PW-01", also="TX-12 EN-04 RS-03 PW-02")
class RecordFirst(MockDevice):
    """Declares the new image whole before its first packet."""

    store_type = _RecordFirst

    def _record(self, now: float) -> str:
        self._due_at = now
        return f"{self._transfer.size_bytes} bytes"


@variant("ack-before-write", "PW-01", also="TX-02 TX-05")
class AckBeforeWrite(MockDevice):
    """Acknowledges a packet, and writes it when the next message comes."""

    _buffered: Operation | None = None

    def _store(self, now: float) -> str:
        self._flush()
        transfer = self._transfer
        self._buffered = self.store.storing(
            transfer.next_number, self._payload, transfer.size_bytes
        )
        self._due_at = now + self.profile.program_time_s
        return ""

    def _accepts_image(self) -> bool:
        self._flush()
        return super()._accepts_image()

    def _flush(self) -> None:
        operation, self._buffered = self._buffered, None
        if operation is not None:
            self.store.flash.execute(operation)

    def _erase(self, now: float) -> str:
        self._buffered = None
        return super()._erase(now)

    def _boot(self, now: float) -> str:
        self._buffered = None
        return super()._boot(now)


@variant("dark-after-second-cut", "PW-02", also="PW-01")
class DarkAfterSecondCut(HangingDevice):
    """Hangs at the second power-up in a row without an application."""

    _dark_boots = 0
    _is_power_up = False

    def power_on(self, now: float) -> None:
        self._is_power_up = not self.has_power
        super().power_on(now)

    def _boot(self, now: float) -> str:
        detail = super()._boot(now)
        if not self._is_power_up:
            return detail
        self._is_power_up = False
        self._dark_boots = 0 if self._has_whole_application else self._dark_boots + 1
        if self._dark_boots < _DARK_BOOTS:
            return detail
        self._dark_boots = 0
        return self._hang()

    def _complete(self, now: float) -> str:
        self._dark_boots = 0
        return super()._complete(now)


@variant(
    "runs-new-application-once",
    "EN-01",
    also="CR-03 RS-01 RS-02 RS-03 RS-05 UP-02 UP-03 UP-04 UP-06 TX-03 EN-02 TM-05 PW-01 "
    "SE-01 SE-03 SE-04 CO-01 BU-02",
)
class RunsOnce(MockDevice):
    """Does not find the new application any more after the next restart."""

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


@variant("second-end-refused", "EN-02")
class RefusesSecondEnd(MockDevice):
    """Answers the end of transfer that follows complete with a NAK. Takes the second end of
    transfer for one that came too early.
    """

    def _complete_again(self, now: float) -> str:
        self._send(messages.Nak(self._transfer.total))
        return ""


@variant("believes-second-early-end", "EN-02")
class CompletesSecondEnd(MockDevice):
    """Refuses an early end of transfer once, and completes at the second one."""

    _refused = False

    def _erase(self, now: float) -> str:
        self._refused = False
        return super()._erase(now)

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        if event is not BootloaderEvent.END_EARLY:
            return event
        if self._refused and self._accepts_image():
            return BootloaderEvent.END_WHOLE
        self._refused = True
        return event


@variant("refusal-is-final", "EN-04", profile={"image_checksum": "crc32"})
class RefusalHangs(HangingDevice):
    """Ignores all messages after it has refused an image, until power is cut."""

    def _refuse_end(self, now: float) -> str:
        detail = super()._refuse_end(now)
        if self.state is BootloaderState.REFUSED:
            self._due_at = inf
        return detail

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        stuck = self.state is BootloaderState.REFUSED and event is not BootloaderEvent.END_AGAIN
        return BootloaderEvent.NO_CONCERN if stuck else event


@variant("any-end-byte", "EN-02")
class AnyEndByte(MockDevice):
    """Takes an end of transfer with another byte than 04."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        is_end = bad_write(row, Command.END_OF_TRANSFER)
        super()._take_row(messages.EndOfTransfer() if is_end else row, now)


@variant(
    "single-packet-image-fails",
    "EN-01",
)
class SinglePacketImageFails(MockDevice):
    """Refuses the end of transfer of an image of one packet. Looks for the last packet where one is
    stored, not where one comes first.
    """

    def _classify_end(self) -> BootloaderEvent:
        event = super()._classify_end()
        return (
            BootloaderEvent.END_EARLY
            if event is BootloaderEvent.END_WHOLE and self._transfer.total == 1
            else event
        )


@variant("record-erased-last", "PW-01")
class RecordErasedLast(_Trusting):
    """Erases the application first, and then the record that it is whole."""

    def erasing(self, size_bytes: int) -> list[Operation]:
        record, *pages = super().erasing(size_bytes)
        return [*pages, record]


@variant("complete-before-record", "PW-01")
class CompleteBeforeRecord(MockDevice):
    """Sends complete, and records that the image is whole when it starts it."""

    _owes_record = False
    in_ram = ("_owes_record",)

    def _record(self, now: float) -> str:
        self._send(messages.Complete())
        self._owes_record = True
        self._due_at = now
        return f"{self._transfer.size_bytes} bytes"

    def _complete(self, now: float) -> str:
        self._due_at = now + self.profile.start_delay_s
        return "the new application"

    def _start(self, now: float) -> str:
        self._pay_record()
        return super()._start(now)

    def _boot(self, now: float) -> str:
        self._pay_record()
        return super()._boot(now)

    def _pay_record(self) -> None:
        if self._owes_record:
            self._owes_record = False
            self.store.flash.execute(self.store.recording(self._transfer.size_bytes))
