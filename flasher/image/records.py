"""What Intel HEX and S-record files have in common: lines of hex digits with a check sum.

The libraries that read these formats accept some damage in silence and hold a file many times over.
So a streaming scan of ours stands before them. It checks every record and cuts the file into runs:
consecutive records whose bytes follow each other, at most `RUN_MAX_BYTES`. Each run goes through
the library alone, and scan and library must agree about it.
"""

from __future__ import annotations

from binascii import Error as HexError
from binascii import unhexlify
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, Final

from flasher.errors import ImageError
from flasher.image.image import ADDRESS_SPACE

RUN_MAX_BYTES: Final = 16_384
_LINE_MAX: Final = 1024
"""Longer than any record of either format."""
_SHOWN_MAX: Final = 40


@dataclass
class Run:
    """Records that follow each other without a gap: `size_bytes` from address `start` on."""

    start: int
    size_bytes: int = 0
    lines: list[str] = field(default_factory=list)
    """The records as they stand in the file, without line ends."""
    places: list[tuple[int, int]] = field(default_factory=list)
    """Address and line number of each record."""

    @property
    def end(self) -> int:
        return self.start + self.size_bytes

    def place(self, address: int) -> str:
        """The line that holds an address of this run."""
        index = bisect_right(self.places, address, key=lambda place: place[0]) - 1
        return f"line {self.places[index][1]}"


class Runs:
    """Collects records into runs; what is complete is handed out by `add` and `take`."""

    def __init__(self) -> None:
        self._run: Run | None = None

    def add(self, address: int, size_bytes: int, text: str, line: int) -> Iterator[Run]:
        """Take a record; the run before it, if it does not belong to that one."""
        run = self._run
        if run is None or run.end != address or run.size_bytes + size_bytes > RUN_MAX_BYTES:
            yield from self.take()
            run = self._run = Run(address)
        run.lines.append(text)
        run.places.append((address, line))
        run.size_bytes += size_bytes

    def take(self) -> Iterator[Run]:
        """What has been collected, if anything."""
        if self._run:
            yield self._run
        self._run = None


@dataclass
class Scanner:
    """The lines of one file, and the refusals that both formats share."""

    file: BinaryIO
    source: str
    format: str
    line: int = 0
    """Number of the line read last, from 1."""
    ended: bool = False
    """The end record has been read."""
    counted: bool = False
    """The last record was a right count of all records: as good as an end, if nothing follows."""

    def lines(self) -> Iterator[str]:
        """The lines that are not blank, without line ends and blanks around.

        Raises ImageError on a line longer than a record, on other characters than ASCII, on
        anything after the end record, and at the end of a file that has none.
        """
        while raw := self.file.readline(_LINE_MAX):
            self.line += 1
            if len(raw) == _LINE_MAX:
                raise self.refuse(
                    "the line is longer than any record", "not such a file, or lost line ends"
                )
            text = raw.strip()
            if not text:
                continue
            if self.ended:
                raise self.refuse(
                    "there is more after the end record",
                    "two files joined into one, or a file written over a longer one",
                )
            if not text.isascii():
                raise self.refuse("the line holds bytes that are no ASCII text")
            yield text.decode("ascii")
        if not (self.ended or self.counted):
            raise self.refuse(
                "the end record is missing: this is where the file ends",
                "the file was cut off while it was written or copied",
            )

    def unhex(self, digits: str, text: str) -> bytes:
        """The bytes of a record's digits; raises ImageError when they are not pairs of digits."""
        try:
            return unhexlify(digits)
        except (HexError, ValueError):
            raise self.refuse(f"{shown(text)} is not made of pairs of hex digits") from None

    def check_end(self, end: int) -> None:
        """Raises ImageError when bytes lie beyond the 32-bit address space."""
        if end > ADDRESS_SPACE:
            raise self.refuse("the record runs past the last 32-bit address, 0xFFFFFFFF")

    def refuse(self, what: str, cause: str = "") -> ImageError:
        """The error for the line read last."""
        return ImageError(
            f"{self.source} is a damaged {self.format} file: {what}",
            where=f"line {self.line}",
            cause=cause or "damaged while it was copied, or edited by hand",
            remedy="copy or make the file again",
        )

    def agreed(self, run: Run, read: Callable[[Run], tuple[int, bytes]]) -> bytes:
        """The bytes of a run by the library; raises ImageError if it sees another run."""
        start, data = read(run)
        if (start, len(data)) != (run.start, run.size_bytes):
            raise ImageError(
                f"{self.source}: two ways of reading the {self.format} file disagree",
                where=f"{run.place(run.start)}: {run.size_bytes} bytes at 0x{run.start:08X}, "
                f"or {len(data)} bytes at 0x{start:08X}",
                remedy="convert the file to another format, and report this file",
            )
        return data


def shown(text: str) -> str:
    """A line for a message: escaped, and not too long."""
    cut = text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."
    return ascii(cut)
