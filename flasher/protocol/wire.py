"""Message framing on CAN: encoding, and reassembly of frames to messages (2.2.1, 2.2.3).

`Reassembler` joins the frames of one CAN id to intact messages and classified damage. It never
raises and buffers at most one message and one frame. After damage it skips the header and scans its
buffer again, so that it finds the next intact message wherever it starts.

Redundancy distinguishes a header from the same two bytes inside data (2.2.1): the length must be at
least 2, and the command's second byte must be the length minus 2. CRC and tail decide then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Final, NamedTuple

from flasher.protocol.crc import crc32
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    COMMAND_SIZE,
    CRC_SIZE,
    FRAME_DATA_SIZE,
    HEADER,
    LENGTH_MAX,
    MESSAGE_MAX_SIZE,
    OVERHEAD_SIZE,
    PREFIX_SIZE,
    TAIL,
    data_size,
)


class Message(NamedTuple):
    """Intact message: `can_id` (sender and receiver), mode byte, 16-bit command, data."""

    can_id: int
    mode: int
    command: int
    data: bytes


class DamageReason(Enum):
    """Reason why received bytes are not a valid message."""

    JUNK = "junk"
    BAD_LENGTH = "bad_length"
    BAD_CRC = "bad_crc"
    BAD_TAIL = "bad_tail"
    INCOMPLETE = "incomplete"


@dataclass(frozen=True)
class Damage:
    """Received bytes of one CAN id that are not a valid message; `data` starts at the header."""

    can_id: int
    reason: DamageReason
    data: bytes


# -- sending ------------------------------------------------------------------------------------


def encode(message: Message) -> bytes:
    """Encode a message from header to tail.

    Raises ValueError if the data have another size than the command specifies.
    """
    can_id, mode, command, data = message
    if len(data) != data_size(command):
        raise ValueError(
            f"command {command:04X} carries {data_size(command)} data bytes, not {len(data)}"
        )
    length = COMMAND_SIZE + len(data)
    if length > LENGTH_MAX:
        raise ValueError(f"command {command:04X} exceeds the length field")
    body = bytes((mode, length)) + command.to_bytes(2, "big") + data
    crc = crc32(HEADER + can_id.to_bytes(2, "big") + body)
    return HEADER + body + crc.to_bytes(CRC_SIZE, "big") + TAIL


def split(can_id: int, wire: bytes) -> list[Frame]:
    """Split an encoded message into CAN frames of 8 bytes; the last one may be shorter (2.2.3)."""
    return [
        Frame(can_id, wire[start : start + FRAME_DATA_SIZE])
        for start in range(0, len(wire), FRAME_DATA_SIZE)
    ]


# -- receiving ----------------------------------------------------------------------------------

_HEAD_SIZE: Final = PREFIX_SIZE + COMMAND_SIZE
"""Number of bytes needed to check a header."""
_NOTHING: Final[tuple[Message | Damage, ...]] = ()


class Reassembler:
    """Reassembles the messages of one CAN id from the data of its frames.

    Call `tick` at `due_at` or later. An unfinished message is dropped `inter_frame_timeout_s`
    after its last frame (R12), but only by `tick`: frames that were queued while the computer was
    busy are not late.
    """

    def __init__(self, can_id: int, inter_frame_timeout_s: float) -> None:
        self.can_id = can_id
        self._timeout_s = inter_frame_timeout_s
        self._buffer = bytearray()
        self._junk = bytearray()
        self._needed = len(HEADER)
        self.due_at = inf
        """Time of the next `tick`; infinite while the buffer is empty."""

    @property
    def buffered_bytes(self) -> int:
        """Number of buffered bytes."""
        return len(self._buffer) + len(self._junk)

    def feed(self, payload: bytes, now: float) -> Sequence[Message | Damage]:
        """Add the data of a frame; return what it completes, usually no message and no damage."""
        if not payload:
            return _NOTHING
        self._buffer += payload
        self.due_at = now + self._timeout_s
        if len(self._buffer) < self._needed:
            return _NOTHING
        found = self._scan()
        if not self._buffer and not self._junk:
            self.due_at = inf
        return found

    def tick(self, now: float) -> Sequence[Message | Damage]:
        """Drop bytes that waited too long; return the damage and messages among them."""
        if now < self.due_at:
            return _NOTHING
        self.due_at = inf
        found: list[Message | Damage] = []
        while self._buffer:
            if len(self._buffer) > len(HEADER):
                self._damage(DamageReason.INCOMPLETE, len(self._buffer), found)
                found += self._scan()
            else:
                self._junk += self._buffer
                self._buffer.clear()
        self._flush_junk(found)
        self._needed = len(HEADER)
        return found

    def reset(self) -> None:
        self._buffer.clear()
        self._junk.clear()
        self._needed = len(HEADER)
        self.due_at = inf

    def _scan(self) -> list[Message | Damage]:
        found: list[Message | Damage] = []
        while self._align() and len(self._buffer) >= self._needed:
            if not self._judge_head(found):
                continue
            size = OVERHEAD_SIZE + self._buffer[PREFIX_SIZE - 1]
            if len(self._buffer) < size:
                self._needed = size
                break
            self._judge_message(size, found)
        if len(self._junk) >= MESSAGE_MAX_SIZE:
            self._flush_junk(found)
        return found

    def _align(self) -> bool:
        """Move all bytes before the next header to the junk; False if the buffer is empty then."""
        buffer = self._buffer
        if not buffer.startswith(HEADER):
            start = buffer.find(HEADER)
            if start < 0:
                start = len(buffer) - buffer.endswith(HEADER[:1])
            self._junk += buffer[:start]
            del buffer[:start]
        self._needed = _HEAD_SIZE if len(buffer) >= len(HEADER) else len(HEADER)
        return bool(buffer)

    def _judge_head(self, found: list[Message | Damage]) -> bool:
        buffer = self._buffer
        length = buffer[PREFIX_SIZE - 1]
        if buffer[PREFIX_SIZE + 1] == length - COMMAND_SIZE:  # so the length is not 0 or 1
            return True
        self._damage(DamageReason.BAD_LENGTH, _HEAD_SIZE, found)
        return False

    def _judge_message(self, size: int, found: list[Message | Damage]) -> None:
        wire = bytes(self._buffer[:size])
        if wire[-1:] != TAIL:
            self._damage(DamageReason.BAD_TAIL, size, found)
            return
        if not self._crc_fits(wire):
            self._damage(DamageReason.BAD_CRC, size, found)
            return
        self._flush_junk(found)
        del self._buffer[:size]
        command = int.from_bytes(wire[PREFIX_SIZE:_HEAD_SIZE], "big")
        data = wire[_HEAD_SIZE : -CRC_SIZE - len(TAIL)]
        found.append(Message(self.can_id, wire[len(HEADER)], command, data))

    def _crc_fits(self, wire: bytes) -> bool:
        body = wire[len(HEADER) : -CRC_SIZE - len(TAIL)]
        crc = crc32(HEADER + self.can_id.to_bytes(2, "big") + body)
        return crc == int.from_bytes(wire[-CRC_SIZE - len(TAIL) : -len(TAIL)], "big")

    def _damage(self, reason: DamageReason, size: int, found: list[Message | Damage]) -> None:
        """Report `size` bytes as damaged and skip only their header: the rest is scanned again.

        Bytes between that header and the next one belong to this report.
        """
        self._flush_junk(found)
        found.append(Damage(self.can_id, reason, bytes(self._buffer[:size])))
        del self._buffer[: len(HEADER)]
        self._align()
        self._junk.clear()

    def _flush_junk(self, found: list[Message | Damage]) -> None:
        if self._junk:
            found.append(Damage(self.can_id, DamageReason.JUNK, bytes(self._junk)))
            self._junk.clear()
