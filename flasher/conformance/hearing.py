"""What the device says, put together from frames and named; the other half of `wire`.

As there, every byte is judged from the document alone, and nothing of `flasher.protocol` is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from flasher.conformance.wire import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    FEEDBACK,
    NAK,
    REPORT,
    REQUEST,
    VERSION_INFORMATION,
    RawFrame,
    Words,
    message_crc,
)

_OVERHEAD_BYTES: Final = 9
"""Header, mode, length, CRC and tail."""
_FIRMWARE_AT: Final = slice(48, 64)
"""The fourth of the four texts of version information."""
_BOOT_VERSION_TEXT: Final = re.compile(rb"V\d\.\d\.\d")


class Kind(Enum):
    """What a message from the device is; the value is how reports name it."""

    FEEDBACK = "general feedback"
    BOOT_VERSION = "boot version"
    REQUEST = "request transfer"
    ACK = "ACK"
    NAK = "NAK"
    COMPLETE = "complete"
    VERSION_INFORMATION = "version information"
    APPLICATION = "a message of the application to other nodes"
    """On another id than the tool's, and none of the upgrade's: mostly of no concern here."""
    OTHER = "another message"
    """To the tool and none of those above, or one of those on a wrong id or of a wrong form."""
    DAMAGED = "a damaged message"


_KINDS: Final = {
    FEEDBACK: (Kind.FEEDBACK, b"ACK"),
    BOOT_VERSION: (Kind.BOOT_VERSION, None),
    REQUEST: (Kind.REQUEST, b"\0\0"),
    ACK: (Kind.ACK, None),
    NAK: (Kind.NAK, None),
    COMPLETE: (Kind.COMPLETE, b"\0\0"),
}
"""Commands from device to tool, with their data where the document fixes it."""


@dataclass(frozen=True)
class Heard:
    """A message that was heard: what it is, and when its first and last frame arrived (seconds)."""

    kind: Kind
    first_at: float
    at: float
    can_id: int
    raw: bytes
    mode: int = 0
    command: int = 0
    data: bytes = b""

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
        if self.kind in (Kind.ACK, Kind.NAK):
            return f"{self.kind.value} {self.number}"
        if self.kind is Kind.BOOT_VERSION:
            return f"boot version {self.data.decode('latin-1')!a}"
        if self.kind is Kind.OTHER:
            return f"{self.can_id:03X} {self.command:04X} {self.data.hex().upper()}".rstrip()
        if self.kind is Kind.DAMAGED:
            return f"{self.kind.value} {self.can_id:03X} {self.raw.hex().upper()}"
        return str(self.kind.value)


class Listener:
    """Puts the device's messages together, id by id; other senders are not heard. Tolerant: what
    is no message becomes `Kind.DAMAGED`.

    A message starts with a CAN frame (R19); what follows its tail in the last frame is padding.
    """

    def __init__(self, words: Words, partial_timeout_s: float = 0.1) -> None:
        self._words = words
        self._timeout_s = partial_timeout_s
        self._partial: dict[int, tuple[float, float, bytes]] = {}

    def feed(self, frame: RawFrame, at: float) -> Iterator[Heard]:
        """The messages that end with this frame."""
        can_id = frame.can_id
        # The first digit behind the 7 is the sender.
        if not frame.is_payload or can_id & 0x7F0 != self._words.to_all:
            return
        first_at, last_at, so_far = self._partial.pop(can_id, (at, at, b""))
        if so_far and at - last_at > self._timeout_s:
            yield Heard(Kind.DAMAGED, first_at, last_at, can_id, so_far)
            first_at, so_far = at, b""
        if not so_far and not frame.data.startswith(b"\x55\xaa"):
            yield Heard(Kind.DAMAGED, at, at, can_id, frame.data)
            return
        raw = so_far + frame.data
        if len(raw) < 4 or len(raw) < _OVERHEAD_BYTES + raw[3]:
            self._partial[can_id] = (first_at, at, raw)
            return
        yield self._judge(raw[: _OVERHEAD_BYTES + raw[3]], first_at, at, can_id)

    def _judge(self, raw: bytes, first_at: float, at: float, can_id: int) -> Heard:
        body, found_crc, tail = raw[2:-5], raw[-5:-1], raw[-1:]
        is_whole = raw[3] >= 2 and raw[5] == raw[3] - 2
        if not is_whole or tail != b"\xf0" or found_crc != message_crc(can_id, body):
            return Heard(Kind.DAMAGED, first_at, at, can_id, raw)
        mode, command, data = raw[2], int.from_bytes(raw[4:6], "big"), raw[6:-5]
        kind = self._kind(can_id, mode, command, data)
        return Heard(kind, first_at, at, can_id, raw, mode, command, data)

    def _kind(self, can_id: int, mode: int, command: int, data: bytes) -> Kind:
        if can_id != self._words.to_tool and command not in _KINDS:
            is_version = can_id == self._words.to_all and command == VERSION_INFORMATION
            return Kind.VERSION_INFORMATION if is_version and mode == REPORT else Kind.APPLICATION
        if mode != REPORT:
            return Kind.OTHER
        kind, fixed = _KINDS.get(command, (Kind.OTHER, None))
        if can_id != self._words.to_tool or (fixed is not None and data != fixed):
            return Kind.OTHER
        return kind


def describe(heard: Sequence[Heard]) -> str:
    """Several messages in a line, repetitions counted; "nothing" for none."""
    parts: list[tuple[str, int]] = []
    for text in map(str, heard):
        if parts and parts[-1][0] == text:
            parts[-1] = (text, parts[-1][1] + 1)
        else:
            parts.append((text, 1))
    shown = [text if count == 1 else f"{text} ({count} times)" for text, count in parts[:8]]
    if len(parts) > len(shown):
        shown.append(f"and {len(parts) - len(shown)} more")
    return ", ".join(shown) or "nothing"
