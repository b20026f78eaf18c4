"""Reading memory piece by piece (0x4308), as an engine; a piece is 128 bytes at the most."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flasher.errors import UsageError
from flasher.host.query import Queries, Request
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import MEMORY_PIECE_SIZE, Memory, ReadMemory
from flasher.protocol.spec import BMS
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

ADDRESS_MAX: Final = 0xFFFF_FFFF
READ_MEMORY: Final = BY_KEY[BMS.request_id, 0x4308]


def memory_requests(start: int, end: int) -> Iterator[Request]:
    """The questions for the bytes from `start` up to `end`, `end` exclusive (R5)."""
    for at in range(start, end, MEMORY_PIECE_SIZE):
        yield Request(READ_MEMORY, ReadMemory(at, min(at + MEMORY_PIECE_SIZE, end)))


def piece_of(answer: Memory) -> bytes:
    """The bytes that an answer gives, without the filler behind them (R5)."""
    return answer.content[: answer.end - answer.start]


def check_range(start: int, end: int) -> None:
    """Raises UsageError for a range of addresses that the message cannot say."""
    if not 0 <= start < end <= ADDRESS_MAX:
        raise UsageError(
            f"0x{start:08X} to 0x{end:08X} is no range of memory to read.",
            remedy=f"The end is exclusive, above the start, 0x{ADDRESS_MAX:08X} at the most.",
        )


class MemoryRead(Queries):
    """Reads the bytes from `start` up to `end`; an engine that ends at the first silence.

    Raises UsageError for a range that the message cannot say.
    """

    def __init__(
        self, start: int, end: int, *, bitrate_bps: int, timings: Timings = DEFAULT_TIMINGS
    ) -> None:
        check_range(start, end)
        self.start = start
        self.end = end
        super().__init__(
            memory_requests(start, end),
            bitrate_bps=bitrate_bps,
            timings=timings,
            stop_at_silence=True,
        )

    @property
    def data(self) -> bytes:
        """What was read so far, from `start` on."""
        return b"".join(piece_of(a) for a in self.answers if isinstance(a, Memory))

    @property
    def complete(self) -> bool:
        """True when every byte was read."""
        return self.done and len(self.data) == self.end - self.start
