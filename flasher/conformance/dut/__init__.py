"""A bootloader that is compiled for the computer, or written in Python, as a device under test.

`flasher_dut.h` is the interface, with the meaning of every call; `flasher_dut_process.c` makes a
program of a bootloader that implements it. What stands here is the same interface for Python:
`--subject MODULE:FACTORY` names a function without arguments that returns a `Bootloader`. It is
called once for each start, as RAM is lost with the power.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, Protocol


class SubjectError(Exception):
    """What was named is no bootloader; the text says why."""


class CanFrame(NamedTuple):
    """A classical CAN frame; a remote frame has no data, but a length code."""

    can_id: int
    data: bytes = b""
    is_extended: bool = False
    is_remote: bool = False
    length: int | None = None
    """The length code; None for as many bytes as there are data."""


@dataclass(frozen=True)
class Facts:
    """What the suite has to know of the device: as `flasher_dut_facts` of the header. Raises
    ValueError for sizes that do not fit each other.
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

    def __post_init__(self) -> None:
        sizes = (self.flash_bytes, self.sector_bytes, self.write_bytes)
        if min(sizes) <= 0 or any(more % less for more, less in pairwise(sizes)):
            raise ValueError(
                f"a flash of {self.flash_bytes} bytes, sectors of {self.sector_bytes} and units "
                f"of {self.write_bytes}: each has to be a multiple of the next"
            )
        if not 0 < self.application_bytes <= self.flash_bytes - self.application_offset:
            raise ValueError(
                f"an application of {self.application_bytes} bytes from offset "
                f"{self.application_offset} on does not lie in a flash of {self.flash_bytes} bytes"
            )


class Host(Protocol):
    """The hardware, as `flasher_host` of the header."""

    def now_us(self) -> int: ...
    def flash_read(self, offset: int, size_bytes: int) -> bytes: ...
    def flash_erase(self, offset: int) -> None: ...
    def flash_write(self, offset: int, data: bytes) -> None: ...
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
        """Returns when it wants the next one; None when only a frame can change anything."""

    def next_frame(self) -> CanFrame | None: ...
