"""Bootloader under test that is compiled for this computer or written in Python.

`flasher_dut.h` documents the interface; `flasher_dut_process.c` makes a program of a bootloader in
C that implements it. This module is the same interface for Python: `--subject MODULE:FACTORY` names
a function without arguments that returns a `Bootloader`. It is called for every start of the
device, since RAM is lost, each time in a new process; its module is loaded once for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol


class SubjectError(Exception):
    """The given subject is not a usable bootloader; the text says why."""


class CanFrame(NamedTuple):
    """A classic CAN frame; a remote frame has a length code but no data."""

    can_id: int
    data: bytes = b""
    is_extended: bool = False
    is_remote: bool = False
    length: int | None = None
    """Length code; None means the length of `data`."""


@dataclass(frozen=True)
class Facts:
    """Properties of the device, like `flasher_dut_facts` in the header. Raises ValueError for sizes
    that contradict each other.
    """

    flash_bytes: int
    sector_bytes: int
    write_bytes: int
    application_offset: int
    application_bytes: int
    erase_us: int = 20_000
    write_us: int = 50
    receive_frames: int = 3
    name: str = ""
    abi: int = 1
    """FLASHER_DUT_ABI of the header that it follows. From 2 on it handles errors of `flash_erase`
    and `flash_write`, so the suite makes them fail.
    """

    def __post_init__(self) -> None:
        sizes = (self.flash_bytes, self.sector_bytes, self.write_bytes)
        if min(sizes) <= 0 or any(more % less for more, less in pairwise(sizes)):
            raise ValueError(
                f"a flash of {self.flash_bytes} bytes, sectors of {self.sector_bytes} and units "
                f"of {self.write_bytes}: each must be a multiple of the next"
            )
        if not 0 < self.application_bytes <= self.flash_bytes - self.application_offset:
            raise ValueError(
                f"an application of {self.application_bytes} bytes at offset "
                f"{self.application_offset} exceeds a flash of {self.flash_bytes} bytes"
            )


class Host(Protocol):
    """Hardware functions, like `flasher_host` in the header; `flash_erase` and `flash_write` return
    False when the flash reports an error.
    """

    def now_us(self) -> int: ...
    def flash_read(self, offset: int, size_bytes: int) -> bytes: ...
    def flash_erase(self, offset: int) -> bool: ...
    def flash_write(self, offset: int, data: bytes) -> bool: ...
    def transmit_pending(self) -> int: ...
    def start_application(self) -> None: ...
    def reset(self) -> None: ...
    def log(self, text: str) -> None: ...


class Bootloader(Protocol):
    """A bootloader in Python: the five functions of the header as methods."""

    facts: Facts

    def start(self, host: Host, cause: int) -> None: ...
    def receive(self, frame: CanFrame) -> None: ...
    def tick(self, now_us: int) -> int | None:
        """Return the time of the next call; None when only a frame can change anything."""

    def next_frame(self) -> CanFrame | None: ...
