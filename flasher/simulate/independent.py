"""Independent device model, written from the protocol document alone.

Bootloader, application and flash share nothing with the rest of flasher but the type of a frame, so
that a misreading in the protocol package is not repeated here. What the document leaves open is a
field of `Choices`. An engine for a simulated bus (`flasher.protocol.engine`).
"""

from __future__ import annotations

import heapq
import re
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from math import inf
from typing import Final, Literal

from flasher.protocol.frame import Frame

READ, WRITE, REPORT = 0x11, 0x16, 0x0C
RESET, FEEDBACK, BOOT_VERSION = 0x4205, 0x5503, 0xC109
UPDATE, REQUEST, PACKET = 0xA10B, 0xC402, 0xA385
ACK, NAK, END, COMPLETE = 0xC202, 0xC302, 0xA401, 0xC502
READ_VERSION, VERSION = 0x3300, 0x1540
READ_RUNNING, RUNNING = 0x3400, 0x1010
PACKET_SIZE: Final = 128
GAP_LIMIT_S: Final = 0.1
"""Frames of one message are not further apart (R12)."""
_DIGITS: Final = {"wmc": (1, b"WMC", b"WMC_UPD"), "bms": (2, b"BMS", b"BMS_UPD")} | {
    "obc": (3, b"PBU", b"OBC_UPD")
}
AT_REST: Final = bytes.fromhex("A08C0000 10271027 41500064 00000000")
"""Running information of a battery that nobody uses: 36 V, no current, 80 %."""
_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_VERSION_TEXT: Final = re.compile(rb"V\dr\dr\d_\d{8}")


def crc_of(can_id: int, head_and_data: bytes) -> bytes:
    """The checksum of a message (section 3), by zlib and reversed bits."""
    covered = b"\x55\xaa" + can_id.to_bytes(2, "big") + head_and_data
    widened = bytearray(4 * len(covered))
    widened[3::4] = covered.translate(_REVERSED)
    value = zlib.crc32(widened) ^ 0xFFFFFFFF
    return int(f"{value:032b}"[::-1], 2).to_bytes(4, "big")


def frames_of(can_id: int, mode: int, command: int, data: bytes) -> list[Frame]:
    """A message as CAN frames (section 2)."""
    body = bytes((mode, len(data) + 2)) + command.to_bytes(2, "big") + data
    wire = b"\x55\xaa" + body + crc_of(can_id, body) + b"\xf0"
    return [Frame(can_id, wire[at : at + 8]) for at in range(0, len(wire), 8)]


@dataclass(frozen=True)
class Choices:
    """What the document leaves to the device; times in seconds."""

    late: float = 0.0
    """Sends everything by this much later than another unit of its kind."""
    restart: float = 0.05
    """From reset or power to the first announcement."""
    spacing: float = 0.05
    listens: Literal["always", "after_burst"] = "always"
    """When it takes an update command (R2)."""
    window: float = 0.2
    """How long it listens after the fourth announcement."""
    empty: Literal["announces", "listens"] = "announces"
    """After the window, without an application (R14)."""
    erase: float = 0.3
    deaf_in_erase: bool = False
    """The processor halts while its flash is erased."""
    update_again: Literal["requests", "erases", "ignored"] = "requests"
    """Update command before packet 1 (R25)."""
    update_in_transfer: Literal["starts_over", "ignored"] = "starts_over"
    bad_packet: Literal["nak_wanted", "nak_received", "silent"] = "nak_wanted"
    older_packet: Literal["ack", "nak", "silent"] = "ack"
    store: float = 0.002
    """From packet to ACK."""
    session: float = 5.0
    """It announces itself after this silence in a transfer; 0: never."""
    reset_in_boot: Literal["ignored", "restarts"] = "ignored"
    confirms_writes: bool = False
    """General feedback comes beside the bootloader's answers (R15)."""
    check: float = 0.05
    """From end of transfer to complete."""
    end_again: Literal["answers", "silent"] = "answers"
    """End of transfer after complete."""
    after_complete: Literal["starts", "restarts"] = "starts"
    start: float = 0.1
    """From the end of the bootloader to an application that answers."""
    after_refusal: Literal["announces", "waits"] = "announces"
    answers: bool = True
    """The application answers version requests."""
    app_upgrade: Literal["confirms", "silent"] = "confirms"
    """Upgrade messages to the application (R17)."""


class Flash:
    """Cells that are erased as a whole and programmed once, and a mark that they are valid.

    An operation takes effect at its end; power lost before leaves half of it.
    """

    def __init__(self, content: bytes | None) -> None:
        self.cells = bytearray(content or b"")
        self.is_valid = content is not None
        self.operations = 0
        """Operations that have begun."""
        self.failures_left = 0
        """Operations that will fail."""
        self._under_way: tuple[int, bytes] | None = None
        """Address and data of a program operation."""

    @property
    def application(self) -> bytes | None:
        """What would be started."""
        return bytes(self.cells) if self.is_valid else None

    def begin_to_erase(self) -> None:
        self.operations += 1
        self.is_valid = False
        self.cells[: len(self.cells) // 2] = b"\xff" * (len(self.cells) // 2)

    def erase(self, size_bytes: int) -> bool:
        """End the erasing; False if it failed."""
        if self._fails():
            return False
        self.cells = bytearray(b"\xff" * size_bytes)
        return True

    def begin_to_program(self, at: int, data: bytes) -> None:
        self.operations += 1
        self._under_way = (at, data)

    def program(self) -> bool:
        """End the program operation; False if it failed."""
        under_way, self._under_way = self._under_way, None
        if under_way is None or self._fails():
            return False
        self._write(*under_way)
        return True

    def begin_to_mark(self) -> None:
        self.operations += 1

    def mark(self) -> bool:
        """Mark the content as valid; False if that failed."""
        self.is_valid = not self._fails()
        return self.is_valid

    def tear(self) -> None:
        """Lose power: half of the data under way is stored."""
        if self._under_way is not None:
            (at, data), self._under_way = self._under_way, None
            self._write(at, data[: len(data) // 2])

    def _write(self, at: int, data: bytes) -> None:
        cells = self.cells[at : at + len(data)]
        size = len(cells)
        programmed = int.from_bytes(cells, "big") & int.from_bytes(data[:size], "big")
        self.cells[at : at + size] = programmed.to_bytes(size, "big")

    def _fails(self) -> bool:
        if not self.failures_left:
            return False
        self.failures_left -= 1
        return True


class IndependentDevice:
    """One device. `application` is what its flash holds; None: its bootloader is alone."""

    done = False

    def __init__(self, target: str, choices: Choices, application: bytes | None) -> None:
        digit, self._name, self._update_text = _DIGITS[target]
        self._hears_id, self._says_id = 0x750 + digit, 0x705 + digit * 0x10
        self._reports_id = 0x700 + digit * 0x10
        self._has_queries = target == "bms"
        self._choices = choices
        self.flash = Flash(application)
        self.state = "off"
        self._alarms: list[tuple[float, int, Callable[[float], None]]] = []
        self._order = count()
        self._outbox: deque[tuple[float, Frame]] = deque()
        self._partial = bytearray()
        self._partial_at = -inf
        self._is_busy = False
        self._announced = 0
        self._size_bytes = 0
        self._wanted = 1
        """The packet that it waits for."""
        self._heard_at = 0.0

    # -- its supply ------------------------------------------------------------------------------

    @property
    def has_power(self) -> bool:
        return self.state != "off"

    def power_on(self, now: float) -> None:
        """A power-up passes through the bootloader (R19)."""
        if not self.has_power:
            self._restart(now)

    def power_cut(self, now: float) -> None:
        self.flash.tear()
        self._forget()
        self.state = "off"

    def run_application(self, now: float) -> None:
        """It was switched on long ago."""
        self.state = "application"

    def _forget(self) -> None:
        self._alarms.clear()
        self._outbox.clear()
        self._partial.clear()
        self._is_busy = False

    # -- the engine ------------------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        if frame.can_id != self._hears_id or not frame.is_payload or self.state == "off":
            return
        if self.state == "erasing" and self._choices.deaf_in_erase:
            return
        partial = self._partial
        if now - self._partial_at > GAP_LIMIT_S:
            partial.clear()
        self._partial_at = now
        if not partial and frame.data[:2] != b"\x55\xaa":
            return
        partial += frame.data
        if len(partial) >= 4 and len(partial) >= (size := 4 + partial[3] + 5):
            self._take_message(size, now)

    def _take_message(self, size: int, now: float) -> None:
        partial = self._partial
        wire = bytes(partial[:size])
        restart = bytes(partial)
        partial.clear()
        body, crc, tail = wire[2:-5], wire[-5:-1], wire[-1]
        if tail == 0xF0 and crc == crc_of(self._hears_id, body) and body[1] == len(body) - 2:
            self._hear(body[0], int.from_bytes(body[2:4], "big"), body[4:], now)
            return
        # A frame may have been lost: the next message begins at one of the frames that came.
        for at in range(8, len(restart), 8):
            if restart[at : at + 2] == b"\x55\xaa":
                partial += restart[at:]
                break
        self._hear_damaged(now)

    def tick(self, now: float) -> None:
        while self._alarms and self._alarms[0][0] <= now:
            at, _, act = heapq.heappop(self._alarms)
            act(at)

    def deadline(self) -> float | None:
        due = self._alarms[0][0] if self._alarms else inf
        if self._outbox and self._outbox[0][0] < due:
            due = self._outbox[0][0]
        return None if due == inf else due

    def next_frame(self, now: float) -> Frame | None:
        if self._outbox and self._outbox[0][0] <= now:
            return self._outbox[0][1]
        return None

    def frame_sent(self, now: float) -> None:
        if self._outbox:
            self._outbox.popleft()

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> tuple[object, ...]:
        return ()

    def _alarm(self, at: float, act: Callable[[float], None]) -> None:
        heapq.heappush(self._alarms, (at, next(self._order), act))

    def _say(self, command: int, data: bytes, now: float, can_id: int | None = None) -> None:
        frames = frames_of(self._says_id if can_id is None else can_id, REPORT, command, data)
        self._outbox.extend((now + self._choices.late, frame) for frame in frames)

    # -- what it receives ------------------------------------------------------------------------

    def _hear(self, mode: int, command: int, data: bytes, now: float) -> None:
        if self.state in ("application", "starting"):
            if self.state == "application":
                self._hear_in_application(mode, command, data, now)
            return
        if mode != WRITE or self.state == "restarting":
            return
        if self._choices.confirms_writes:
            self._say(FEEDBACK, b"ACK", now)
        match command:
            case 0x4205:
                if self._choices.reset_in_boot == "restarts" and data == b"RESET":
                    self._restart(now)
            case 0xA10B:
                self._hear_update(data, now)
            case 0xA385:
                self._hear_packet(data, now)
            case 0xA401:
                self._hear_end(data, now)

    def _hear_damaged(self, now: float) -> None:
        if self.state == "transfer" and not self._is_busy:
            self._heard_at = now
            if self._choices.bad_packet != "silent":
                self._say(NAK, self._wanted.to_bytes(2, "little"), now)

    def _hear_in_application(self, mode: int, command: int, data: bytes, now: float) -> None:
        if mode == READ and self._has_queries and self._choices.answers:
            if command == READ_VERSION:
                self._say(VERSION, self._version_information(), now, self._reports_id)
            elif command == READ_RUNNING:
                self._say(RUNNING, AT_REST, now, self._reports_id)
        elif mode == WRITE and command in (UPDATE, PACKET, END):
            if self._choices.app_upgrade == "confirms":
                self._say(FEEDBACK, b"ACK", now)
        elif mode == WRITE:
            self._say(FEEDBACK, b"ACK", now)
            if command == RESET and data == b"RESET":
                self._restart(now, keeps_answer=True)

    def _version_information(self) -> bytes:
        found = _VERSION_TEXT.search(self.flash.application or b"")
        firmware = found[0] if found else b"unknown"
        fields = (b"BM36", b"W2605001", b"V1r2r0_20220512", firmware)
        return b"".join((field + b".").ljust(16) for field in fields)

    # -- the bootloader --------------------------------------------------------------------------

    def _restart(self, now: float, *, keeps_answer: bool = False) -> None:
        answer = list(self._outbox) if keeps_answer else []
        self._forget()
        self._outbox.extend(answer)
        self.state = "restarting"
        self._alarm(now + self._choices.restart, self._announcing)

    def _announcing(self, now: float) -> None:
        self.state, self._announced = "announcing", 0
        self._announce(now)

    def _announce(self, now: float) -> None:
        if self.state != "announcing":
            return
        self._announced += 1
        self._say(BOOT_VERSION, self._name + b"V1.0.0", now)
        is_over = self._announced >= 4
        if not is_over:
            self._alarm(now + self._choices.spacing, self._announce)
        else:
            self._alarm(now + self._choices.window, self._window_over)

    def _window_over(self, now: float) -> None:
        if self.state != "announcing":
            return
        if self.flash.is_valid:
            self._start(now)
        elif self._choices.empty == "announces":
            self._announcing(now)
        else:
            self.state = "listening"

    def _start(self, now: float) -> None:
        self.state = "starting"
        self._alarm(now + self._choices.start, self._started)

    def _started(self, now: float) -> None:
        if self.state == "starting":
            self.state = "application"

    def _hear_update(self, data: bytes, now: float) -> None:
        choices, size = self._choices, int.from_bytes(data[7:11], "little")
        if data[:7] != self._update_text or len(data) != 11 or not 0 < size <= 1 << 20:
            return
        match self.state:
            case "announcing":
                if choices.listens == "after_burst" and self._announced < 4:
                    return
                self._begin_to_erase(size, now)
            case "listening":
                self._begin_to_erase(size, now)
            case "transfer" if self._wanted == 1 and not self._is_busy:
                if choices.update_again == "erases":
                    self._begin_to_erase(size, now)
                elif choices.update_again == "requests" and size == self._size_bytes:
                    self._heard_at = now
                    self._say(REQUEST, b"\0\0", now)
            case "transfer" | "refused" if choices.update_in_transfer == "starts_over":
                self._begin_to_erase(size, now)

    def _begin_to_erase(self, size_bytes: int, now: float) -> None:
        self._forget()
        self.state, self._size_bytes = "erasing", size_bytes
        self.flash.begin_to_erase()
        self._alarm(now + self._choices.erase, self._erased)

    def _erased(self, now: float) -> None:
        if not self.flash.erase(self._size_bytes):
            self._restart(now)  # no document says what a device does that cannot erase
            return
        self.state, self._wanted, self._heard_at = "transfer", 1, now
        self._say(REQUEST, b"\0\0", now)
        self._watch_session(now)

    def _watch_session(self, now: float) -> None:
        if not self._choices.session or self.state != "transfer":
            return
        over_at = self._heard_at + self._choices.session
        if now >= over_at and not self._is_busy:
            self._restart(now)
        else:
            self._alarm(max(over_at, now + 0.01), self._watch_session)

    @property
    def _total(self) -> int:
        return -(-self._size_bytes // PACKET_SIZE)

    def _hear_packet(self, data: bytes, now: float) -> None:
        if self.state != "transfer" or self._is_busy:
            return
        self._heard_at = now
        choices = self._choices
        number = int.from_bytes(data[1:3], "little")
        total = int.from_bytes(data[3:5], "little")
        if len(data) != 5 + PACKET_SIZE or data[0] != 1 or total != self._total:
            if choices.bad_packet != "silent":
                self._say(NAK, self._wanted.to_bytes(2, "little"), now)
        elif number == self._wanted <= total:
            self._is_busy = True
            used = data[5:][: self._size_bytes - (number - 1) * PACKET_SIZE]
            self.flash.begin_to_program((number - 1) * PACKET_SIZE, used)
            self._alarm(now + choices.store, lambda at: self._stored(number, at))
        elif number == self._wanted - 1 and number:
            self._say(ACK, data[1:3], now)
        elif 0 < number < self._wanted:
            if choices.older_packet != "silent":
                command = ACK if choices.older_packet == "ack" else NAK
                self._say(command, data[1:3], now)
        elif choices.bad_packet != "silent":
            wanted = self._wanted.to_bytes(2, "little")
            self._say(NAK, wanted if choices.bad_packet == "nak_wanted" else data[1:3], now)

    def _stored(self, number: int, now: float) -> None:
        self._is_busy = False
        self._heard_at = now
        if not self.flash.program():
            self._say(NAK, number.to_bytes(2, "little"), now)
            return
        self._wanted = number + 1
        self._say(ACK, number.to_bytes(2, "little"), now)

    def _hear_end(self, data: bytes, now: float) -> None:
        if self.state in ("complete", "checking"):
            if self.state == "complete" and self._choices.end_again == "answers":
                self._say(COMPLETE, b"\0\0", now)
            return
        if self.state == "refused":
            self._say(NAK, self._wanted.to_bytes(2, "little"), now)
            return
        if self.state != "transfer" or self._is_busy:
            return
        self._heard_at = now
        if data != b"\x04" or self._wanted != self._total + 1:
            self._refuse(now)
            return
        self.state = "checking"
        self.flash.begin_to_mark()
        self._alarm(now + self._choices.check, self._checked)

    def _refuse(self, now: float) -> None:
        self._say(NAK, self._wanted.to_bytes(2, "little"), now)
        self.state = "refused"
        if self._choices.after_refusal == "announces":
            self._alarm(now + 1.0, self._restart)

    def _checked(self, now: float) -> None:
        if not self.flash.mark():
            self._refuse(now)
            return
        self.state = "complete"
        self._say(COMPLETE, b"\0\0", now)
        self._alarm(now + self._choices.start, self._leave)

    def _leave(self, now: float) -> None:
        if self._choices.after_complete == "restarts":
            self._restart(now)
        else:
            self.state = "application"
