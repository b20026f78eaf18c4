"""Wrong bootloaders in Python, and what is none, for `--subject`. Its imports are few, since
a process of their own loads it.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import struct
import zlib
from pathlib import Path

from flasher.conformance.dut import CanFrame, Host
from tests.peers.python_bootloader import PythonBootloader


class Hangs(PythonBootloader):
    def receive(self, frame: object) -> None:
        while self._stored == 2:
            pass
        super().receive(frame)  # type: ignore[arg-type]


class Raises(PythonBootloader):
    def _end(self) -> None:
        self.host.log("about to divide")
        self._size //= 0


class WritesTwice(PythonBootloader):
    def _store(self, data: bytes) -> None:
        super()._store(data)
        self.host.flash_write(0x1000, bytes(8))


class ReadsOutside(PythonBootloader):
    def _end(self) -> None:
        self.host.flash_read(0xFFF0, 32)


class EndsAtOnce(PythonBootloader):
    def start(self, host: object, cause: int) -> None:
        os._exit(3)


class SaysNothing(PythonBootloader):
    def next_frame(self) -> None:
        return None


class LogsForEver(PythonBootloader):
    def _end(self) -> None:
        while True:
            self.host.log("x" * 4096)


class EndsItsGroup(PythonBootloader):
    """Receives the signal that `timeout` or a cancelled build sends to the process group."""

    def _begin(self, size: int) -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(os.getpid(), number)
        super()._begin(size)


def raises() -> PythonBootloader:
    raise RuntimeError("no hardware today")


def returns_nothing() -> None:
    pass


NOT_CALLABLE = 5


class StartsWhatIsTorn(PythonBootloader):
    """Trusts a record that it writes before the packets."""

    def _begin(self, size: int) -> None:
        super()._begin(size)
        self.host.flash_erase(0)
        self.host.flash_write(0, bytes(8))

    def _end(self) -> None:
        self._send(b"\xc5\x02", bytes(2))
        self._is_starting = True

    def _is_whole(self) -> bool:
        return self.host.flash_read(0, 8) == bytes(8)


class WritesALog(PythonBootloader):
    """Is right: has many flash operations before end of transfer."""

    def _begin(self, size: int) -> None:
        super()._begin(size)
        for at in range(0x100, 0x200, 8):
            self.host.flash_write(at, bytes(8))


class RecordsBeforeTheLastPacket(WritesALog):
    """Trusts a record that it writes before the last packet."""

    def _store(self, data: bytes) -> None:
        if self._stored + 1 < -(-self._size // 128):
            super()._store(data)
            return
        self._stored, self._last = -(-self._size // 128), data[5:]
        self._send(b"\xc2\x02", struct.pack("<H", self._stored))

    def _end(self) -> None:
        self.host.flash_write(0, struct.pack("<IIII", 0x600DC0DE, self._size, 0, 0))
        self.host.flash_write(0x1000 + 128 * (self._stored - 1), self._last)
        self._send(b"\xc5\x02", bytes(2))
        self._start_application()

    def _is_whole(self) -> bool:
        return self.host.flash_read(0, 4) == struct.pack("<I", 0x600DC0DE)


class CompactsAfterComplete(WritesALog):
    """Has a journal that it writes when complete has left; a full one it erases with the record."""

    facts = dataclasses.replace(PythonBootloader.facts, abi=2)
    _is_due = False

    def _end(self) -> None:
        super()._end()
        self._is_due = self._is_starting

    def tick(self, now_us: int) -> int | None:
        if self._is_due and not self._frames and not self.host.transmit_pending():
            self._is_due = False
            used = len(self.host.flash_read(0x800, 0x800).rstrip(b"\xff")) + 7 >> 3
            if used < 24:
                self.host.flash_write(0x800 + 8 * used, bytes(8))
            else:
                record = self.host.flash_read(0, 16)
                self.host.flash_erase(0)
                self.host.flash_erase(0x800)
                self.host.flash_write(0, record)
        due_us = super().tick(now_us)
        return now_us + 100 if self._is_due else due_us


class ListensAfterItsBurst(PythonBootloader):
    """Is right: takes an update command only just after a burst, and makes a pause of 3 s
    between bursts without an application.
    """

    _listens_until = 0

    def _act(self, mode: int, command: bytes, data: bytes) -> None:
        if command != b"\xa1\x0b" or self._stored >= 0 or self._now < self._listens_until:
            super()._act(mode, command, data)

    def tick(self, now_us: int) -> int | None:
        is_due = now_us >= self._due_at and self._stored < 0 and not self._is_starting
        if is_due and self._announced == 4 and not self._is_whole():
            self._announced, self._due_at = 0, now_us + 3_000_000
        before = self._announced
        due_us = super().tick(now_us)
        if (before, self._announced) == (3, 4):
            self._listens_until = now_us + 200_000
        return due_us


class AnswersByFeedbackToo(PythonBootloader):
    """Is right: sends general feedback (R15), and ends a transfer a bit later."""

    _ends_at = -1

    def _act(self, mode: int, command: bytes, data: bytes) -> None:
        if mode == 0x16:
            self._send(b"\x55\x03", b"ACK")
        super()._act(mode, command, data)

    def _end(self) -> None:
        self._ends_at = self._now + 200

    def tick(self, now_us: int) -> int | None:
        if 0 <= self._ends_at <= now_us:
            self._ends_at = -1
            super()._end()
        return now_us + 100 if self._ends_at >= 0 else super().tick(now_us)


class WaitsForTheClock(PythonBootloader):
    """Polls the time, as code without timers does."""

    def _send(self, command: bytes, data: bytes) -> None:
        began_at = self.host.now_us()
        while self.host.now_us() < began_at + 1000:
            pass
        super()._send(command, data)


class LosesComplete(PythonBootloader):
    """Starts the application before its last answer has left."""

    def _end(self) -> None:
        super()._end()
        self.host.start_application()


class RecordsAfterComplete(PythonBootloader):
    """Writes the record of an image as soon as complete has left the controller."""

    def _end(self) -> None:
        self._send(b"\xc5\x02", bytes(2))
        self._start_application()

    def tick(self, now_us: int) -> int | None:
        is_due = self._is_starting and self._stored > 0
        if is_due and not self._frames and not self.host.transmit_pending():
            self._stored = 0
            check = zlib.crc32(self.host.flash_read(0x1000, self._size))
            self.host.flash_write(0, struct.pack("<IIII", 0x600DC0DE, self._size, check, 0))
        due_us = super().tick(now_us)
        return now_us + 100 if self._is_starting else due_us


class SendsWithoutEnd(PythonBootloader):
    """Always has another frame to send, with the number of pending frames, and never waits."""

    def tick(self, now_us: int) -> None:
        pass

    def next_frame(self) -> CanFrame:
        return CanFrame(0x725, bytes((self.host.transmit_pending(),)))


class Restarts(PythonBootloader):
    """Resets itself during a transfer."""

    def _store(self, data: bytes) -> None:
        if self._stored == 3:
            self.host.reset()
        super()._store(data)


class ErasesForEach(PythonBootloader):
    """Erases for 6 s for each update command before packet 1, and requests the transfer again."""

    facts = dataclasses.replace(PythonBootloader.facts, erase_us=3_000_000)

    def _begin(self, size: int) -> None:
        self._size = 0
        super()._begin(size)


class ClaimsToHandleErrors(PythonBootloader):
    """Ignores what the flash reports, like the bootloader for the older interface."""

    facts = dataclasses.replace(PythonBootloader.facts, abi=2)


class HandlesErrors(ClaimsToHandleErrors):
    """Rejects an image that the flash does not hold."""

    def start(self, host: Host, cause: int) -> None:
        super().start(host, cause)
        self._received = b""

    def _begin(self, size: int) -> None:
        super()._begin(size)
        self._received = b""

    def _store(self, data: bytes) -> None:
        before = self._stored
        super()._store(data)
        if self._stored > before:
            self._received += data[5:][: self._size - before * 128]

    def _end(self) -> None:
        if self.host.flash_read(0x1000, self._size) == self._received:
            check = zlib.crc32(self._received)
            record = struct.pack("<IIII", 0x600DC0DE, self._size, check, 0)
            if self.host.flash_write(0, record) and self._is_whole():
                self._send(b"\xc5\x02", bytes(2))
                self._start_application()
                return
        self._nak()
        self._stored, self._size, self._announced = -1, 0, 0


class RunsEachMillisecond(PythonBootloader):
    """Names no due time, like a main loop without timers, and polls the time in each pass."""

    def tick(self, now_us: int) -> int:
        super().tick(now_us)
        return self.host.now_us()


class SaysNothingEachMillisecond(PythonBootloader):
    def tick(self, now_us: int) -> int:
        return now_us

    def next_frame(self) -> None:
        return None


class PrintsForEver(PythonBootloader):
    def _end(self) -> None:
        while True:
            os.write(1, b"x" * 4096)


class IsSanitized(PythonBootloader):
    """Ends like a program stopped by AddressSanitizer."""

    def _end(self) -> None:
        os.write(2, b"ERROR: AddressSanitizer: stack-buffer-overflow\nSUMMARY: message.c:70\n")
        os.write(2, b"Shadow bytes around the buggy address:\n  0x10002bbe8e50: 00 00 f1\n")
        os._exit(1)


class ReadsForEver(PythonBootloader):
    def _end(self) -> None:
        while True:
            self.host.flash_read(0, 0x1000)


class AcceptsAnyName(PythonBootloader):
    def _act(self, mode: int, command: bytes, data: bytes) -> None:
        if command == b"\xa1\x0b":
            data = b"BMS_UPD" + data[7:]
        super()._act(mode, command, data)


class IgnoresAnEarlyEnd(PythonBootloader):
    def _end(self) -> None:
        if self._stored == -(-self._size // 128):
            super()._end()


class SpoilsSmallImages(PythonBootloader):
    def _end(self) -> None:
        if self._size == 128:
            self.host.flash_erase(0x1000)
            self.host.flash_write(0x1000, bytes(8))
        super()._end()


class WritesOldPacketsAgain(PythonBootloader):
    def _store(self, data: bytes) -> None:
        if data[1] <= self._stored:
            self.host.flash_write(0x1000, bytes(8))
        super()._store(data)


class BootsSlowly(PythonBootloader):
    """Announces itself 20 ms apart, which only a check of times finds."""

    def tick(self, now_us: int) -> int | None:
        due_at = super().tick(now_us)
        if self._announced and self._stored < 0 and due_at is not None:
            self._due_at = min(self._due_at, now_us + 20_000)
            return self._due_at
        return due_at


class AcceptsPacketsBeyondTheLast(PythonBootloader):
    def _store(self, data: bytes) -> None:
        if data[1] > -(-self._size // 128):
            self._send(b"\xc2\x02", data[1:3])
        else:
            super()._store(data)


class KillsItsSuite(PythonBootloader):
    def start(self, host: object, cause: int) -> None:
        spawner = Path(f"/proc/{os.getppid()}/stat").read_text("ascii")
        os.kill(int(spawner.split()[3]), signal.SIGKILL)


class StartsAtZero(PythonBootloader):
    """Its CRC starts with 0 in both directions."""

    crc_start = 0
