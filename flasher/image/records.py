"""What Intel HEX and S-record files have in common: lines of hex digits with a check sum.

Every record is checked and decoded in one pass, in constant memory. Libraries that read these
formats accept a missing end record, addresses that wrap around and bytes that contradict each
other, and hold a file many times over; in the tests they are the referees.
"""

from __future__ import annotations

from binascii import Error as HexError
from binascii import unhexlify
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final

from flasher.errors import ImageError
from flasher.image.image import ADDRESS_SPACE

LINES_MAX: Final = 1_100_000
"""The largest image has 1,048,560 records of eight bytes, and programs write 16 or 32. Bounds the
time that a file takes which is none: its lines may be blank."""
_LINE_MAX: Final = 1024
"""Longer than any record of either format."""
_SHOWN_MAX: Final = 40


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
            if self.line > LINES_MAX:
                raise self.refuse(
                    f"it has more than {LINES_MAX:,} lines",
                    "not such a file, or one with records of very few bytes",
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
            where=self.place(0),
            cause=cause or "damaged while it was copied, or edited by hand",
            remedy="copy or make the file again",
        )

    def place(self, _address: int) -> str:
        """Where the record read last stands."""
        return f"line {self.line}"


def shown(text: str) -> str:
    """A line for a message: escaped, and not too long."""
    cut = text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."
    return ascii(cut)
