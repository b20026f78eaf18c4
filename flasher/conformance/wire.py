"""Independent second implementation of the wire protocol, from sections 1 to 5 of the document.

The deliberate exception to "one fact, one place": if host and device model share a misreading of
the document, this module must not share it too. It imports nothing of `flasher.protocol`, which an
import contract enforces. Do not replace its constants by those of other modules.

`Encoder` builds the tool's messages, `DeviceDecoder` decodes the device's.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache
from itertools import groupby
from random import Random
from typing import Final, Literal, NamedTuple

READ: Final = 0x11
WRITE: Final = 0x16
REPORT: Final = 0x0C

RESET: Final = 0x4205
FEEDBACK: Final = 0x5503
BOOT_VERSION: Final = 0xC109
UPDATE: Final = 0xA10B
REQUEST: Final = 0xC402
PACKET: Final = 0xA385
ACK: Final = 0xC202
NAK: Final = 0xC302
END: Final = 0xA401
COMPLETE: Final = 0xC502
QUERY_VERSION: Final = 0x3300
VERSION_INFORMATION: Final = 0x1540
QUERY_MEMORY: Final = 0x4308
MEMORY: Final = 0x5688
MEMORY_BYTES: Final = 128
"""Most bytes in one memory query."""

FRAME_BYTES: Final = 8
_OVERHEAD_BYTES: Final = 9
"""Header, mode, length, CRC and tail."""
PACKET_BYTES: Final = 128
PACKET_FRAMES: Final = 18
"""CAN frames of a packet, all of them full."""
IMAGE_BYTES_MAX: Final = 65535 * PACKET_BYTES
START: Final = 0x01
END_MARK: Final = b"\x04"
RESET_TEXT: Final = b"RESET"
_VERSION: Final = re.compile(rb"V\d{1,2}r\d{1,2}r\d{1,2}_\d{8}")


class RawFrame(NamedTuple):
    """One CAN frame of any kind."""

    can_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    """`data` then only gives the requested length."""
    is_error: bool = False

    @property
    def is_payload(self) -> bool:
        """True for a standard data frame with data."""
        return bool(self.data) and not any(self[2:])


# -- checksum and framing -------------------------------------------------------------------------


def _table_entry(index: int) -> int:
    register = index << 24
    for _ in range(8):
        register = (register << 1) ^ (0x104C11DB7 if register & 0x80000000 else 0)
    return register


_TABLE: Final = tuple(_table_entry(index) for index in range(256))


def _stepped(table: tuple[int, ...]) -> tuple[int, ...]:
    """The registers of a table one step later."""
    return tuple((each << 8 & 0xFFFFFFFF) ^ _TABLE[each >> 24] for each in table)


# Four steps at once: the highest byte of the register takes all of them, the lowest one the last.
_TWICE: Final = _stepped(_TABLE)
_THREE_TIMES: Final = _stepped(_TWICE)
_FOUR_TIMES: Final = _stepped(_THREE_TIMES)


def crc(covered: bytes, *, start: int = 0xFFFFFFFF, steps: Literal[1, 4] = 4) -> int:
    """CRC of appendix 1: each byte enters the low end of the register, followed by four table
    steps. With one step it enters the high end, as in CRC-32/MPEG-2.
    """
    register = start
    for byte in covered:
        if steps == 4:
            first, second, third, last = (register ^ byte).to_bytes(4, "big")
            register = _FOUR_TIMES[first] ^ _THREE_TIMES[second] ^ _TWICE[third] ^ _TABLE[last]
        else:
            register = (register << 8 & 0xFFFFFFFF) ^ _TABLE[register >> 24 ^ byte]
    return register


@lru_cache(maxsize=16384)  # the same images are sent again and again
def message_crc(can_id: int, body: bytes) -> bytes:
    """The CRC field of a message; `body` is mode to last data byte."""
    return struct.pack(">I", crc(b"\x55\xaa" + struct.pack(">H", can_id) + body))


def build(can_id: int, mode: int, command: int, data: bytes = b"") -> bytes:
    """Build a message from header to tail, with the length of its data.

    A `command` whose second byte contradicts the data is kept, as a stimulus.
    """
    body = struct.pack(">BBH", mode, 2 + len(data), command) + data
    return b"\x55\xaa" + body + message_crc(can_id, body) + b"\xf0"


def is_intact(can_id: int, raw: bytes) -> bool:
    """True for one complete message with a correct CRC whose length and command match its data."""
    is_whole = len(raw) >= _OVERHEAD_BYTES + 2 and raw[3] == len(raw) - _OVERHEAD_BYTES
    if not is_whole or raw[5] != raw[3] - 2 or not raw.startswith(b"\x55\xaa"):
        return False
    return raw[-5:] == message_crc(can_id, raw[2:-5]) + b"\xf0"


def split(can_id: int, raw: bytes, size_bytes: int = 8) -> list[RawFrame]:
    """Split bytes into CAN frames of `size_bytes`, the last one shorter."""
    return [
        RawFrame(can_id, raw[start : start + size_bytes])
        for start in range(0, len(raw), size_bytes)
    ]


def joined(frames: Iterable[RawFrame]) -> bytes:
    return b"".join(frame.data for frame in frames)


def inverted(data: bytes | bytearray) -> bytes:
    """Invert every bit."""
    return bytes(byte ^ 0xFF for byte in data)


def packet_count(size_bytes: int) -> int:
    """Number of packets of an image."""
    return -(-size_bytes // PACKET_BYTES)


def packet_payload(image: bytes, number: int) -> bytes:
    """The 128 bytes of packet `number` (from 1), padded with FF."""
    start = (number - 1) * PACKET_BYTES
    return image[start : start + PACKET_BYTES].ljust(PACKET_BYTES, b"\xff")


def version_in(image: bytes) -> str | None:
    """Firmware version contained in an image; None for none or several different ones."""
    found = set(_VERSION.findall(image))
    return found.pop().decode("ascii") if len(found) == 1 else None


def padded_to_frame(frames: Sequence[RawFrame], filler: int = 0) -> list[RawFrame]:
    """Pad the last frame to 8 bytes."""
    last = frames[-1]
    return [*frames[:-1], last._replace(data=last.data.ljust(FRAME_BYTES, bytes((filler,))))]


# -- from the tool to the device -----------------------------------------------------------------


class _Names(NamedTuple):
    digit: int
    boot_name: str
    update_text: bytes
    has_version_query: bool


_TARGETS: Final = {
    "wmc": _Names(1, "WMC", b"WMC_UPD", has_version_query=False),
    "bms": _Names(2, "BMS", b"BMS_UPD", has_version_query=True),
    "obc": _Names(3, "PBU", b"OBC_UPD", has_version_query=False),
}
TARGET_NAMES: Final = tuple(_TARGETS)


def reported_version(target: str, image: bytes) -> str | None:
    """Version by which a device identifies `image`; None when it cannot."""
    return version_in(image) if _TARGETS[target].has_version_query else None


class Encoder:
    """Builds the tool's messages to one target as CAN frames, and knows the CAN ids of both.

    Raises KeyError for a target that is not in `TARGET_NAMES`.
    """

    def __init__(
        self, target: str, reset_command: int = RESET, reset_data: bytes = RESET_TEXT
    ) -> None:
        names = _TARGETS[target]
        self.target = target
        self.to_device: Final = 0x750 | names.digit
        self.to_tool: Final = 0x705 | names.digit << 4
        self.to_all: Final = 0x700 | names.digit << 4
        self.boot_name = names.boot_name
        self.update_text = names.update_text
        self.has_version_query = names.has_version_query
        self.reset_command = reset_command
        self.reset_data = reset_data

    def others(self) -> list[Encoder]:
        """Encoders for the other targets."""
        return [
            Encoder(name, self.reset_command, self.reset_data)
            for name in TARGET_NAMES
            if name != self.target
        ]

    def frames(self, raw: bytes, size_bytes: int = 8) -> list[RawFrame]:
        return split(self.to_device, raw, size_bytes)

    def frames_by_chance(self, raw: bytes, chance: Random) -> list[RawFrame]:
        """Split bytes into frames of random size, 1 to 8 bytes."""
        found: list[RawFrame] = []
        while raw:
            size = chance.randint(1, FRAME_BYTES)
            found.append(RawFrame(self.to_device, raw[:size]))
            raw = raw[size:]
        return found

    def message(self, mode: int, command: int, data: bytes = b"") -> list[RawFrame]:
        return self.frames(build(self.to_device, mode, command, data))

    def reset(self) -> list[RawFrame]:
        """Command that restarts the device into its bootloader."""
        return self.message(WRITE, self.reset_command, self.reset_data)

    def update(self, size_bytes: int, text: bytes | None = None) -> list[RawFrame]:
        """Update command for an image of this size."""
        name = self.update_text if text is None else text
        return self.message(WRITE, UPDATE, name + struct.pack("<I", size_bytes))

    def packet(
        self, number: int, total: int, payload: bytes, *, start: int = START
    ) -> list[RawFrame]:
        """A packet with 128 bytes of data."""
        return self.message(WRITE, PACKET, struct.pack("<BHH", start, number, total) + payload)

    def packet_of(self, image: bytes, number: int) -> list[RawFrame]:
        """Packet `number` (from 1) of an image."""
        return self.packet(number, packet_count(len(image)), packet_payload(image, number))

    def end(self) -> list[RawFrame]:
        """End of transfer."""
        return self.message(WRITE, END, END_MARK)

    def damaged_packet_of(self, image: bytes, number: int) -> list[RawFrame]:
        """Packet `number` of an image with an inverted CRC."""
        raw = joined(self.packet_of(image, number))
        return self.frames(raw[:-5] + inverted(raw[-5:-1]) + raw[-1:])

    def upgrade_messages(self, size_bytes: int) -> dict[str, list[RawFrame]]:
        """Each message of an upgrade once, by name."""
        return {
            "update command": self.update(size_bytes),
            "packet": self.packet(1, packet_count(size_bytes), bytes(PACKET_BYTES)),
            "end of transfer": self.end(),
        }

    def answer(self, command: int, data: bytes) -> list[RawFrame]:
        """A report from this target to the tool."""
        return split(self.to_tool, build(self.to_tool, REPORT, command, data))

    def query_version(self) -> list[RawFrame]:
        """Query the version information of the application."""
        return self.message(READ, QUERY_VERSION)

    def query_memory(self, start: int, end: int) -> list[RawFrame]:
        """Query the memory from `start` to before `end` (R5)."""
        return self.message(READ, QUERY_MEMORY, struct.pack("<II", start, end))


# -- from the device to the tool -----------------------------------------------------------------

_FIRMWARE_AT: Final = slice(48, 64)
"""The fourth of the four texts in version information."""
_PARTIAL_TIMEOUT_S: Final = 0.1
_BOOT_VERSION_TEXT: Final = re.compile(rb"V\d\.\d\.\d")


class Reply(Enum):
    """Kind of a message from the device; reports use the value."""

    FEEDBACK = "general feedback"
    BOOT_VERSION = "boot version"
    REQUEST = "request transfer"
    ACK = "ACK"
    NAK = "NAK"
    COMPLETE = "complete"
    VERSION_INFORMATION = "version information"
    MEMORY = "memory"
    APPLICATION = "a message of the application to other nodes"
    """On another id than the tool's and not part of the upgrade; usually ignored."""
    OTHER = "another message"
    """Any other message to the tool, or an upgrade message with a wrong id or form."""
    DAMAGED = "a damaged message"


_KINDS: Final = {
    FEEDBACK: (Reply.FEEDBACK, b"ACK"),
    BOOT_VERSION: (Reply.BOOT_VERSION, None),
    REQUEST: (Reply.REQUEST, b"\0\0"),
    ACK: (Reply.ACK, None),
    NAK: (Reply.NAK, None),
    COMPLETE: (Reply.COMPLETE, b"\0\0"),
    MEMORY: (Reply.MEMORY, None),
}
"""Commands from device to tool, with their data where the document defines it."""


@dataclass(frozen=True)
class Received:
    """A message from the device; the times of its first and last frame are in seconds."""

    kind: Reply
    first_at: float
    at: float
    can_id: int
    raw: bytes
    mode: int = 0
    command: int = 0
    data: bytes = b""
    padding: bytes = b""
    """Bytes after the tail in the last frame."""

    @property
    def number(self) -> int:
        return int.from_bytes(self.data[:2], "little")

    @property
    def firmware(self) -> str:
        """Firmware version in version information, up to its terminator."""
        text: bytes = self.data[_FIRMWARE_AT].partition(b".")[0]
        return text.decode("latin-1")

    @property
    def boot_name(self) -> str:
        return self.data[:3].decode("latin-1")

    @property
    def has_good_version_text(self) -> bool:
        """True when the text of a boot version has the form Vx.x.x."""
        return _BOOT_VERSION_TEXT.fullmatch(self.data[3:]) is not None

    def __str__(self) -> str:
        """Text for reports; device bytes are in hexadecimal or escaped."""
        if self.kind in (Reply.ACK, Reply.NAK):
            return f"{self.kind.value} {self.number}"
        if self.kind is Reply.BOOT_VERSION:
            return f"boot version {self.data.decode('latin-1')!a}"
        if self.kind is Reply.OTHER:
            return f"{self.can_id:03X} {self.command:04X} {self.data.hex().upper()}".rstrip()
        if self.kind is Reply.DAMAGED:
            return f"{self.kind.value} {self.can_id:03X} {self.raw.hex().upper()}"
        return str(self.kind.value)


class DeviceDecoder:
    """Assembles messages of the device per CAN id and ignores other senders. Bytes that do not form
    a message become `Reply.DAMAGED`.

    A message starts at the start of a CAN frame (R19); bytes after its tail are padding.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._ids = encoder
        self._partial: dict[int, tuple[float, float, bytes]] = {}

    def feed(self, frame: RawFrame, at: float) -> Iterator[Received]:
        """Yield the messages that end with this frame."""
        can_id = frame.can_id
        # The second digit of an id is the sender.
        if not frame.is_payload or can_id & 0x7F0 != self._ids.to_all:
            return
        first_at, last_at, so_far = self._partial.pop(can_id, (at, at, b""))
        if so_far and at - last_at > _PARTIAL_TIMEOUT_S:
            yield Received(Reply.DAMAGED, first_at, last_at, can_id, so_far)
            first_at, so_far = at, b""
        if not so_far and not frame.data.startswith(b"\x55\xaa"):
            yield Received(Reply.DAMAGED, at, at, can_id, frame.data)
            return
        raw = so_far + frame.data
        if len(raw) < 4 or len(raw) < _OVERHEAD_BYTES + raw[3]:
            self._partial[can_id] = (first_at, at, raw)
            return
        size = _OVERHEAD_BYTES + raw[3]
        reply = self._judge(raw[:size], first_at, at, can_id)
        yield replace(reply, padding=raw[size:]) if raw[size:] else reply

    def _judge(self, raw: bytes, first_at: float, at: float, can_id: int) -> Received:
        if not is_intact(can_id, raw):
            return Received(Reply.DAMAGED, first_at, at, can_id, raw)
        mode, command, data = raw[2], int.from_bytes(raw[4:6], "big"), raw[6:-5]
        kind = self._kind(can_id, mode, command, data)
        return Received(kind, first_at, at, can_id, raw, mode, command, data)

    def _kind(self, can_id: int, mode: int, command: int, data: bytes) -> Reply:
        if can_id != self._ids.to_tool and command not in _KINDS:
            is_version = can_id == self._ids.to_all and command == VERSION_INFORMATION
            return Reply.VERSION_INFORMATION if is_version and mode == REPORT else Reply.APPLICATION
        if mode != REPORT:
            return Reply.OTHER
        kind, fixed = _KINDS.get(command, (Reply.OTHER, None))
        if can_id != self._ids.to_tool or (fixed is not None and data != fixed):
            return Reply.OTHER
        return kind


def describe(replies: Sequence[Received]) -> str:
    """Messages in one line, with repetitions counted; "nothing" for none."""
    runs = [(text, len(list(same))) for text, same in groupby(map(str, replies))]
    shown = [text if count == 1 else f"{text} ({count} times)" for text, count in runs[:8]]
    if len(runs) > len(shown):
        shown.append(f"and {len(runs) - len(shown)} more")
    return ", ".join(shown) or "nothing"
