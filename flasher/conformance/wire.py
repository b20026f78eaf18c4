"""The protocol's bytes, written a second time from sections 1 to 5 of the document alone.

This is the one deliberate exception to "one fact, one place": a misreading that host and device
model of this project share must not hide here, so nothing of `flasher.protocol` is imported, and an
import contract holds that. Do not replace these constants by those of the other modules.

`Encoder` builds what the tool sends, `DeviceDecoder` names what the device sends.
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
from typing import Final, NamedTuple

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
"""What one memory query asks for at the most."""

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
    """One CAN frame, of any kind."""

    can_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    """Its data then only tell the length that it asks for."""
    is_error: bool = False

    @property
    def is_payload(self) -> bool:
        """True for a standard data frame with bytes in it."""
        return bool(self.data) and not any(self[2:])


# -- checksum and framing -------------------------------------------------------------------------


def _table_entry(index: int) -> int:
    register = index << 24
    for _ in range(8):
        register = (register << 1) ^ (0x104C11DB7 if register & 0x80000000 else 0)
    return register


_TABLE: Final = tuple(_table_entry(index) for index in range(256))


def crc(covered: bytes, *, start: int = 0xFFFFFFFF, steps: int = 4) -> int:
    """Appendix 1: a byte into the low end of the register, then four table steps. With one step the
    byte goes into the high end, as CRC-32/MPEG-2 has it.
    """
    register = start
    for byte in covered:
        register ^= byte if steps == 4 else byte << 24
        for _ in range(steps):
            register = (register << 8 & 0xFFFFFFFF) ^ _TABLE[register >> 24]
    return register


@lru_cache(maxsize=16384)  # the same images are sent again and again
def message_crc(can_id: int, body: bytes) -> bytes:
    """The CRC field of a message; `body` is mode to last data byte."""
    return struct.pack(">I", crc(b"\x55\xaa" + struct.pack(">H", can_id) + body))


def build(can_id: int, mode: int, command: int, data: bytes = b"") -> bytes:
    """A message, header to tail, with the length that its data has.

    A `command` whose second byte does not fit the data is sent as it is: that is a stimulus too.
    """
    body = struct.pack(">BBH", mode, 2 + len(data), command) + data
    return b"\x55\xaa" + body + message_crc(can_id, body) + b"\xf0"


def is_intact(can_id: int, raw: bytes) -> bool:
    """True for one whole message with the right CRC, in which length and command fit the data."""
    is_whole = len(raw) >= _OVERHEAD_BYTES + 2 and raw[3] == len(raw) - _OVERHEAD_BYTES
    if not is_whole or raw[5] != raw[3] - 2 or not raw.startswith(b"\x55\xaa"):
        return False
    return raw[-5:] == message_crc(can_id, raw[2:-5]) + b"\xf0"


def split(can_id: int, raw: bytes, size_bytes: int = 8) -> list[RawFrame]:
    """Bytes as consecutive CAN frames of `size_bytes`, the last one shorter."""
    return [
        RawFrame(can_id, raw[start : start + size_bytes])
        for start in range(0, len(raw), size_bytes)
    ]


def joined(frames: Iterable[RawFrame]) -> bytes:
    """The bytes that frames carry."""
    return b"".join(frame.data for frame in frames)


def inverted(data: bytes | bytearray) -> bytes:
    """The same bytes with every bit the other way round."""
    return bytes(byte ^ 0xFF for byte in data)


def packet_count(size_bytes: int) -> int:
    """How many packets an image of that size has."""
    return -(-size_bytes // PACKET_BYTES)


def packet_payload(image: bytes, number: int) -> bytes:
    """The 128 bytes of packet `number` (from 1), filled with FF."""
    start = (number - 1) * PACKET_BYTES
    return image[start : start + PACKET_BYTES].ljust(PACKET_BYTES, b"\xff")


def version_in(image: bytes) -> str | None:
    """The firmware version inside an image; None without one, or with two different ones."""
    found = set(_VERSION.findall(image))
    return found.pop().decode("ascii") if len(found) == 1 else None


def padded_to_frame(frames: Sequence[RawFrame], filler: int = 0) -> list[RawFrame]:
    """The frames, the last one filled up to 8 bytes."""
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
    """The version by which a device tells that it runs `image`; None where it cannot."""
    return version_in(image) if _TARGETS[target].has_version_query else None


class Encoder:
    """The messages of the tool to one target, as CAN frames, and the CAN ids of both directions.

    Raises KeyError for a target that is none of `TARGET_NAMES`.
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
        """Any bytes to this target."""
        return split(self.to_device, raw, size_bytes)

    def frames_by_chance(self, raw: bytes, chance: Random) -> list[RawFrame]:
        """Any bytes in frames of 1 to 8 bytes."""
        found: list[RawFrame] = []
        while raw:
            size = chance.randint(1, FRAME_BYTES)
            found.append(RawFrame(self.to_device, raw[:size]))
            raw = raw[size:]
        return found

    def message(self, mode: int, command: int, data: bytes = b"") -> list[RawFrame]:
        """Any message to this target."""
        return self.frames(build(self.to_device, mode, command, data))

    def reset(self) -> list[RawFrame]:
        """Restart into the bootloader."""
        return self.message(WRITE, self.reset_command, self.reset_data)

    def update(self, size_bytes: int, text: bytes | None = None) -> list[RawFrame]:
        """Update command for an image of that size."""
        name = self.update_text if text is None else text
        return self.message(WRITE, UPDATE, name + struct.pack("<I", size_bytes))

    def packet(
        self, number: int, total: int, payload: bytes, *, start: int = START
    ) -> list[RawFrame]:
        """A packet; `payload` is its 128 bytes."""
        return self.message(WRITE, PACKET, struct.pack("<BHH", start, number, total) + payload)

    def packet_of(self, image: bytes, number: int) -> list[RawFrame]:
        """Packet `number` (from 1) of an image."""
        return self.packet(number, packet_count(len(image)), packet_payload(image, number))

    def end(self) -> list[RawFrame]:
        """End of transfer."""
        return self.message(WRITE, END, END_MARK)

    def damaged_packet_of(self, image: bytes, number: int) -> list[RawFrame]:
        """The same with another CRC."""
        raw = joined(self.packet_of(image, number))
        return self.frames(raw[:-5] + inverted(raw[-5:-1]) + raw[-1:])

    def upgrade_messages(self, size_bytes: int) -> dict[str, list[RawFrame]]:
        """The messages of an upgrade to an image of that size, each once, by name."""
        return {
            "update command": self.update(size_bytes),
            "packet": self.packet(1, packet_count(size_bytes), bytes(PACKET_BYTES)),
            "end of transfer": self.end(),
        }

    def answer(self, command: int, data: bytes) -> list[RawFrame]:
        """What this target itself sends to the tool: a report."""
        return split(self.to_tool, build(self.to_tool, REPORT, command, data))

    def query_version(self) -> list[RawFrame]:
        """Ask the application for its version information."""
        return self.message(READ, QUERY_VERSION)

    def query_memory(self, start: int, end: int) -> list[RawFrame]:
        """Ask the application for the memory from `start` to before `end` (R5)."""
        return self.message(READ, QUERY_MEMORY, struct.pack("<II", start, end))


# -- from the device to the tool -----------------------------------------------------------------

_FIRMWARE_AT: Final = slice(48, 64)
"""The fourth of the four texts of version information."""
_BOOT_VERSION_TEXT: Final = re.compile(rb"V\d\.\d\.\d")


class MessageKind(Enum):
    """What a message from the device is; the value is how reports name it."""

    FEEDBACK = "general feedback"
    BOOT_VERSION = "boot version"
    REQUEST = "request transfer"
    ACK = "ACK"
    NAK = "NAK"
    COMPLETE = "complete"
    VERSION_INFORMATION = "version information"
    MEMORY = "memory"
    APPLICATION = "a message of the application to other nodes"
    """On another id than the tool's, and none of the upgrade's: mostly of no concern here."""
    OTHER = "another message"
    """To the tool and none of those above, or one of those on a wrong id or of a wrong form."""
    DAMAGED = "a damaged message"


_KINDS: Final = {
    FEEDBACK: (MessageKind.FEEDBACK, b"ACK"),
    BOOT_VERSION: (MessageKind.BOOT_VERSION, None),
    REQUEST: (MessageKind.REQUEST, b"\0\0"),
    ACK: (MessageKind.ACK, None),
    NAK: (MessageKind.NAK, None),
    COMPLETE: (MessageKind.COMPLETE, b"\0\0"),
    MEMORY: (MessageKind.MEMORY, None),
}
"""Commands from device to tool, with their data where the document fixes it."""


@dataclass(frozen=True)
class Received:
    """A message from the device, with the times of its first and last frame in seconds."""

    kind: MessageKind
    first_at: float
    at: float
    can_id: int
    raw: bytes
    mode: int = 0
    command: int = 0
    data: bytes = b""
    padding: bytes = b""
    """What follows the tail in the last frame."""

    @property
    def number(self) -> int:
        """The packet number of an ACK or NAK."""
        return int.from_bytes(self.data[:2], "little")

    @property
    def firmware(self) -> str:
        """The firmware text of version information, up to its terminator."""
        text: bytes = self.data[_FIRMWARE_AT].partition(b".")[0]
        return text.decode("latin-1")

    @property
    def boot_name(self) -> str:
        """The name in a boot version."""
        return self.data[:3].decode("latin-1")

    @property
    def has_good_version_text(self) -> bool:
        """True when a boot version's text is of the form Vx.x.x."""
        return _BOOT_VERSION_TEXT.fullmatch(self.data[3:]) is not None

    def __str__(self) -> str:
        """As reports name it; device bytes in hexadecimal or escaped."""
        if self.kind in (MessageKind.ACK, MessageKind.NAK):
            return f"{self.kind.value} {self.number}"
        if self.kind is MessageKind.BOOT_VERSION:
            return f"boot version {self.data.decode('latin-1')!a}"
        if self.kind is MessageKind.OTHER:
            return f"{self.can_id:03X} {self.command:04X} {self.data.hex().upper()}".rstrip()
        if self.kind is MessageKind.DAMAGED:
            return f"{self.kind.value} {self.can_id:03X} {self.raw.hex().upper()}"
        return str(self.kind.value)


class DeviceDecoder:
    """Reassembles the messages of the device, id by id; frames of other senders are ignored. Bytes
    that are no message become `Kind.DAMAGED`.

    A message starts with a CAN frame (R19); what follows its tail in the last frame is padding.
    """

    def __init__(self, encoder: Encoder, partial_timeout_s: float = 0.1) -> None:
        self._ids = encoder
        self._timeout_s = partial_timeout_s
        self._partial: dict[int, tuple[float, float, bytes]] = {}

    def feed(self, frame: RawFrame, at: float) -> Iterator[Received]:
        """The messages that end with this frame."""
        can_id = frame.can_id
        # The first digit behind the 7 is the sender.
        if not frame.is_payload or can_id & 0x7F0 != self._ids.to_all:
            return
        first_at, last_at, so_far = self._partial.pop(can_id, (at, at, b""))
        if so_far and at - last_at > self._timeout_s:
            yield Received(MessageKind.DAMAGED, first_at, last_at, can_id, so_far)
            first_at, so_far = at, b""
        if not so_far and not frame.data.startswith(b"\x55\xaa"):
            yield Received(MessageKind.DAMAGED, at, at, can_id, frame.data)
            return
        raw = so_far + frame.data
        if len(raw) < 4 or len(raw) < _OVERHEAD_BYTES + raw[3]:
            self._partial[can_id] = (first_at, at, raw)
            return
        size = _OVERHEAD_BYTES + raw[3]
        heard = self._judge(raw[:size], first_at, at, can_id)
        yield replace(heard, padding=raw[size:]) if raw[size:] else heard

    def _judge(self, raw: bytes, first_at: float, at: float, can_id: int) -> Received:
        if not is_intact(can_id, raw):
            return Received(MessageKind.DAMAGED, first_at, at, can_id, raw)
        mode, command, data = raw[2], int.from_bytes(raw[4:6], "big"), raw[6:-5]
        kind = self._kind(can_id, mode, command, data)
        return Received(kind, first_at, at, can_id, raw, mode, command, data)

    def _kind(self, can_id: int, mode: int, command: int, data: bytes) -> MessageKind:
        if can_id != self._ids.to_tool and command not in _KINDS:
            is_version = can_id == self._ids.to_all and command == VERSION_INFORMATION
            return (
                MessageKind.VERSION_INFORMATION
                if is_version and mode == REPORT
                else MessageKind.APPLICATION
            )
        if mode != REPORT:
            return MessageKind.OTHER
        kind, fixed = _KINDS.get(command, (MessageKind.OTHER, None))
        if can_id != self._ids.to_tool or (fixed is not None and data != fixed):
            return MessageKind.OTHER
        return kind


def describe(heard: Sequence[Received]) -> str:
    """Several messages in a line, repetitions counted; "nothing" for none."""
    runs = [(text, len(list(same))) for text, same in groupby(map(str, heard))]
    shown = [text if count == 1 else f"{text} ({count} times)" for text, count in runs[:8]]
    if len(runs) > len(shown):
        shown.append(f"and {len(runs) - len(shown)} more")
    return ", ".join(shown) or "nothing"
