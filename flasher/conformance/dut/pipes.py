"""Messages between the suite and the bootloader process; documented in `flasher_dut_process.c`."""

from __future__ import annotations

import os
from dataclasses import astuple
from enum import IntEnum
from struct import Struct
from typing import Final

from flasher.conformance.dut import CanFrame, Facts

ABI: Final = 2
"""FLASHER_DUT_ABI of the header."""
ABI_WITH_ERRORS: Final = 2
"""The first one whose flash operations report errors."""
TRANSMIT_FRAMES: Final = 3
"""FLASHER_TRANSMIT_FRAMES of the header."""
HEADER: Final = Struct("<B3xI")
FACTS: Final = Struct("<9I")
TURN: Final = Struct("<QI")
FRAME: Final = Struct("<IBBBx8s")
RANGE: Final = Struct("<II")
PLACE: Final = Struct("<QI")
TIME: Final = Struct("<Q")
TICK: Final = Struct("<QIQ")
FLASH_RESULT: Final = Struct("<QI")
DONE: Final = Struct("<QQ")
TURN_US: Final = 1000
"""Time of the next pass of a bootloader that names none."""
NEVER: Final = 0xFFFF_FFFF_FFFF_FFFF
"""Next tick of a bootloader that only waits for frames."""
_READ_SIZE: Final = 1 << 16
_SIZES: Final = tuple(Facts.__dataclass_fields__)[:8]
"""Fields of the facts that are numbers."""


class PipeMessage(IntEnum):
    """Type of a message: its first byte."""

    FACTS = ord("f")
    START = ord("S")
    RECEIVE = ord("R")
    TICK = ord("T")
    FLASH_READ = ord("r")
    FLASH_DATA = ord("d")
    FLASH_ERASE = ord("e")
    FLASH_WRITE = ord("w")
    FLASH_DONE = ord("k")
    LOG = ord("l")
    APPLICATION = ord("a")
    RESET = ord("z")
    DONE = ord(".")


_KINDS: Final = {kind.value: kind for kind in PipeMessage}


class Pipe:
    """Reads and writes messages on two file descriptors."""

    def __init__(self, read_fd: int, write_fd: int) -> None:
        self.read_fd = read_fd
        self._write_fd = write_fd
        self._buffer = bytearray()

    def write(self, kind: PipeMessage, *parts: bytes) -> None:
        """Send a message. Raises BrokenPipeError when the other side has ended."""
        data = b"".join(parts)
        view = memoryview(HEADER.pack(kind, len(data)) + data)
        while view:
            view = view[os.write(self._write_fd, view) :]

    def take(self) -> tuple[PipeMessage, bytes] | None:
        """Return a complete message or None. Raises ValueError for bytes that are not a message."""
        if len(self._buffer) < HEADER.size:
            return None
        kind, size = HEADER.unpack_from(self._buffer)
        found = _KINDS.get(kind)
        if found is None:
            wrote = bytes(self._buffer[:16])
            raise ValueError(f"it wrote {wrote!r}, which is not a message")
        end = HEADER.size + size
        if len(self._buffer) < end:
            return None
        data = bytes(self._buffer[HEADER.size : end])
        del self._buffer[:end]
        return found, data

    def fill(self) -> bool:
        """Wait for more bytes; False when the other side has ended."""
        data = os.read(self.read_fd, _READ_SIZE)
        self._buffer += data
        return bool(data)

    def close(self) -> None:
        os.close(self.read_fd)
        os.close(self._write_fd)


def pack_frame(frame: CanFrame) -> bytes:
    length = len(frame.data) if frame.length is None else frame.length
    return FRAME.pack(frame.can_id, length, frame.is_extended, frame.is_remote, frame.data)


def unpack_frame(data: bytes) -> CanFrame:
    can_id, length, is_extended, is_remote, content = FRAME.unpack(data)
    payload = b"" if is_remote else content[:length]
    return CanFrame(can_id, payload, bool(is_extended), bool(is_remote), length)


def pack_facts(facts: Facts) -> bytes:
    numbers = astuple(facts)[: len(_SIZES)]
    return FACTS.pack(facts.abi, *numbers) + facts.name.encode()


def unpack_facts(data: bytes) -> Facts:
    """Raises ValueError for another ABI version or contradictory facts."""
    if len(data) < FACTS.size:
        raise ValueError("the facts are truncated")
    abi, *numbers = FACTS.unpack_from(data)
    if not 1 <= abi <= ABI:
        raise ValueError(
            f"it was built with version {abi} of flasher_dut.h, and this flasher has version {ABI}"
        )
    sizes = dict(zip(_SIZES, numbers, strict=True))
    return Facts(**sizes, name=data[FACTS.size :].decode(errors="replace"), abi=abi)
