"""A bootloader in Python that follows the document, for `--subject`; written without flasher's own
protocol. Its flaws, one function each, are what the suite has to tell from it.
"""

from __future__ import annotations

import struct
import zlib

from flasher.conformance.dut import CanFrame, Facts, Host

_REQUEST_ID = 0x752
_ANSWER_ID = 0x725
_AREA = 0x1000
"""The first sector holds the record of the whole application, the area follows it."""
_AREA_BYTES = 0xF000
_SECTOR = 0x800
_MAGIC = 0x600DC0DE
_BURST = 4
_SPACING_US = 50_000
_WINDOW_US = 200_000
_PAUSE_US = 5_000_000
_FRAME_GAP_US = 100_000
_DRAIN_US = 100_000
"""Alone on the bus, frames wait for ever; the application does not."""


def _crc_table() -> list[int]:
    table = []
    for index in range(256):
        value = index << 24
        for _ in range(8):
            value = (value << 1) ^ (0x104C11DB7 if value & 0x80000000 else 0)
        table.append(value)
    return table


_TABLE = _crc_table()


def _crc(covered: bytes, start: int) -> bytes:
    register = start
    for byte in covered:
        register ^= byte
        for _ in range(4):
            register = (register << 8) & 0xFFFFFFFF ^ _TABLE[register >> 24]
    return struct.pack(">I", register)


class PythonBootloader:
    """Takes an image, stores it, and starts it when it is whole."""

    facts = Facts(
        flash_bytes=0x10000,
        sector_bytes=_SECTOR,
        write_bytes=8,
        application_offset=_AREA,
        application_bytes=_AREA_BYTES,
        name="python bootloader",
    )

    crc_start = 0xFFFFFFFF

    def __init__(self) -> None:
        self._buffer = b""
        self._last_frame_at = 0
        self._frames: list[CanFrame] = []
        self._now = 0
        self._is_starting = False
        self._size = 0
        self._stored = -1
        """Packets stored; -1 while there is no transfer."""

    def start(self, host: Host, cause: int) -> None:
        self.host = host
        self._announced = 0
        self._due_at = host.now_us()

    def receive(self, frame: CanFrame) -> None:
        self._now = self.host.now_us()
        if frame.can_id != _REQUEST_ID or frame.is_extended or frame.is_remote or not frame.data:
            return
        if self._now - self._last_frame_at > _FRAME_GAP_US:
            self._buffer = b""
        self._last_frame_at = self._now
        if not self._buffer:
            start = frame.data.find(b"\x55\xaa")
            if start < 0 and not frame.data.endswith(b"\x55"):
                return
            self._buffer = frame.data[start:] if start >= 0 else b"\x55"
        else:
            self._buffer += frame.data
        self._take_messages()

    def _take_messages(self) -> None:
        while True:
            start = self._buffer.find(b"\x55\xaa")
            if start < 0:
                self._buffer = self._buffer[-1:] if self._buffer.endswith(b"\x55") else b""
                return
            self._buffer = self._buffer[start:]
            if len(self._buffer) < 4:
                return
            size = self._buffer[3]
            if size < 2:
                self._buffer = self._buffer[2:]
                continue
            if len(self._buffer) >= 6 and self._buffer[5] != size - 2:
                self._buffer = self._buffer[2:]
                continue
            whole = size + 9
            if len(self._buffer) < whole:
                return
            message = self._buffer[:whole]
            covered = message[:2] + struct.pack(">H", _REQUEST_ID) + message[2 : whole - 5]
            is_intact = message[-1] == 0xF0 and message[-5:-1] == _crc(covered, self.crc_start)
            self._buffer = self._buffer[whole if is_intact else 2 :]
            if is_intact:
                self._act(message[2], message[4:6], message[6 : whole - 5])
            elif message[4:6] == b"\xa3\x85" and self._stored >= 0:
                self._nak()

    def _act(self, mode: int, command: bytes, data: bytes) -> None:
        if mode != 0x16 or self._is_starting:
            return
        if command == b"\xa1\x0b" and len(data) == 11 and data[:7] == b"BMS_UPD":
            self._begin(struct.unpack_from("<I", data, 7)[0])
        elif command == b"\xa3\x85" and len(data) == 133 and self._stored >= 0:
            self._store(data)
        elif command == b"\xa4\x01" and data == b"\x04" and self._stored >= 0:
            self._end()

    def _begin(self, size: int) -> None:
        if not 0 < size <= _AREA_BYTES:
            return
        self._due_at = self._now + _PAUSE_US
        if self._stored or size != self._size:
            self.host.flash_erase(0)
            for sector in range(_AREA, _AREA + size, _SECTOR):
                self.host.flash_erase(sector)
        self._size, self._stored = size, 0
        self._due_at = self.host.now_us() + _PAUSE_US
        self._send(b"\xc4\x02", bytes(2))

    def _store(self, data: bytes) -> None:
        mark, number, total = struct.unpack_from("<BHH", data)
        packets = -(-self._size // 128)
        self._due_at = self._now + _PAUSE_US
        if mark != 1 or total != packets or not 0 < number <= min(packets, self._stored + 1):
            self._nak()
            return
        if number > self._stored:
            at = self._stored * 128
            kept = data[5:][: self._size - at]
            self.host.flash_write(_AREA + at, kept.ljust(-(-len(kept) // 8) * 8, b"\xff"))
            self._stored = number
        self._send(b"\xc2\x02", struct.pack("<H", number))

    def _end(self) -> None:
        self._due_at = self._now + _PAUSE_US
        if self._stored != -(-self._size // 128):
            self._nak()
            return
        check = zlib.crc32(self.host.flash_read(_AREA, self._size))
        self.host.flash_write(0, struct.pack("<IIII", _MAGIC, self._size, check, 0))
        self._send(b"\xc5\x02", bytes(2))
        self._start_application()

    def _start_application(self) -> None:
        self._is_starting = True
        self._due_at = self._now + _DRAIN_US

    def _nak(self) -> None:
        wanted = min(self._stored + 1, -(-self._size // 128))
        self._send(b"\xc3\x02", struct.pack("<H", wanted))

    def _is_whole(self) -> bool:
        magic, size, check, _ = struct.unpack("<IIII", self.host.flash_read(0, 16))
        if magic != _MAGIC or size > _AREA_BYTES:
            return False
        return zlib.crc32(self.host.flash_read(_AREA, size)) == int(check)

    def tick(self, now_us: int) -> int | None:
        self._now = now_us
        if self._is_starting:
            all_sent = not self._frames and not self.host.transmit_pending()
            if all_sent or now_us >= self._due_at:
                self.host.start_application()
            return now_us
        if now_us < self._due_at:
            return self._due_at
        if self._stored >= 0:
            self._stored, self._size, self._announced = -1, 0, 0
        if self._announced >= _BURST and self._is_whole():
            self._start_application()
            return now_us
        self._send(b"\xc1\x09", b"BMSV1.0.0")
        self._announced += 1
        is_last = self._announced == _BURST and self._is_whole()
        self._due_at = now_us + (_WINDOW_US if is_last else _SPACING_US)
        return self._due_at

    def _send(self, command: bytes, data: bytes) -> None:
        body = b"\x0c" + bytes((2 + len(data),)) + command + data
        head = b"\x55\xaa"
        raw = (
            head
            + body
            + _crc(head + struct.pack(">H", _ANSWER_ID) + body, self.crc_start)
            + b"\xf0"
        )
        self._frames += [CanFrame(_ANSWER_ID, raw[at : at + 8]) for at in range(0, len(raw), 8)]

    def next_frame(self) -> CanFrame | None:
        return self._frames.pop(0) if self._frames else None
