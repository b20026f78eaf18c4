"""The protocol's bytes, written a second time from sections 1 to 5 of the document alone.

This is the one deliberate exception to "one fact, one place": a misreading that host and device
model of this project share must not hide here, so nothing of `flasher.protocol` is imported, and an
import contract holds that. Do not replace these constants by those of the other modules.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
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

PACKET_BYTES: Final = 128
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


def crc(covered: bytes) -> int:
    """Appendix 1: a byte into the low end of the register, then four table steps."""
    register = 0xFFFFFFFF
    for byte in covered:
        register ^= byte
        for _ in range(4):
            register = (register << 8 & 0xFFFFFFFF) ^ _TABLE[register >> 24]
    return register


@lru_cache(maxsize=4096)  # the same images are sent again and again
def message_crc(can_id: int, body: bytes) -> bytes:
    """The CRC field of a message; `body` is mode to last data byte."""
    return struct.pack(">I", crc(b"\x55\xaa" + struct.pack(">H", can_id) + body))


def build(can_id: int, mode: int, command: int, data: bytes = b"") -> bytes:
    """A message, header to tail, with the length that its data has.

    A `command` whose second byte does not fit the data is sent as it is: that is a stimulus too.
    """
    body = struct.pack(">BBH", mode, 2 + len(data), command) + data
    return b"\x55\xaa" + body + message_crc(can_id, body) + b"\xf0"


def split(can_id: int, raw: bytes, size_bytes: int = 8) -> list[RawFrame]:
    """Bytes as consecutive CAN frames of `size_bytes`, the last one shorter."""
    return [
        RawFrame(can_id, raw[start : start + size_bytes])
        for start in range(0, len(raw), size_bytes)
    ]


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


# -- the words of one target ----------------------------------------------------------------------


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


class Words:
    """What the tool says to one target, as CAN frames, and the ids it says and hears it on.

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

    def others(self) -> list[Words]:
        """The words of the other targets."""
        return [
            Words(name, self.reset_command, self.reset_data)
            for name in TARGET_NAMES
            if name != self.target
        ]

    def message(self, mode: int, command: int, data: bytes = b"") -> list[RawFrame]:
        """Any message to this target."""
        return split(self.to_device, build(self.to_device, mode, command, data))

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

    def end(self) -> list[RawFrame]:
        """End of transfer."""
        return self.message(WRITE, END, END_MARK)

    def query_version(self) -> list[RawFrame]:
        """Ask the application for its version information."""
        return self.message(READ, QUERY_VERSION)
