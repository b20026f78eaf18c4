"""ASCII text fields of messages, firmware and boot versions, and safe display of malformed texts.

A field contains its text, `.` as terminator, then spaces (chapter 3). A text that breaks this rule
is shown as received, with control characters escaped (R20).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

from flasher.errors import printable as printable  # noqa: PLC0414  most have it from here
from flasher.protocol.spec import TEXT_END, TEXT_FILLER

FIRMWARE_VERSION_FORM: Final = "Vxrxrx_YYYYMMDD"
"""Naming rule of firmware versions, as printed in the documents (table 5)."""
BOOT_VERSION_FORM: Final = "Vx.x.x"
"""Format of boot versions, as printed in the documents (table 9)."""
_FIRMWARE_VERSION: Final = re.compile(
    rb"V([0-9]{1,2})r([0-9]{1,2})r([0-9]{1,2})"
    rb"_([0-9]{4}(?:0[1-9]|1[0-2])(?:0[1-9]|[12][0-9]|3[01]))"
)
"""Matches `FIRMWARE_VERSION_FORM`; each number may have two digits."""
_FORMULA_STARTS: Final = ("=", "+", "-", "@", "\t", "\r")
"""First characters that make a spreadsheet interpret a cell as a formula."""
_BOOT_VERSION: Final = re.compile(r"V([0-9])\.([0-9])\.([0-9])")


@dataclass(frozen=True, order=True)
class FirmwareVersion:
    """Firmware version by the naming rule, ordered by its three numbers, then by date."""

    major: int
    minor: int
    revision: int
    date: str
    """YYYYMMDD."""

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """Parse a whole text; None if it breaks the naming rule."""
        match = _FIRMWARE_VERSION.fullmatch(text.encode("ascii", "replace"))
        if match is None:
            return None
        major, minor, revision, date = match.groups()
        return cls(int(major), int(minor), int(revision), date.decode("ascii"))


def boot_version_number(text: str) -> tuple[int, int, int] | None:
    """Return the three numbers of a boot version `Vx.x.x`; None for any other text."""
    match = _BOOT_VERSION.fullmatch(text)
    return None if match is None else (int(match[1]), int(match[2]), int(match[3]))


def encode_text(text: str, size_bytes: int) -> bytes:
    """Encode `text` as an ASCII field of `size_bytes`.

    Raises ValueError if the text is not printable ASCII, contains the terminator, or is too long.
    """
    raw = text.encode("ascii", "replace") if text.isascii() else b""
    if len(raw) != len(text) or not text.isprintable():
        raise ValueError(f"{text!a} is not printable ASCII")
    if TEXT_END in raw:
        raise ValueError(f"{text!a} contains {TEXT_END.decode()!r}, the terminator of a field")
    if len(raw) >= size_bytes:
        raise ValueError(f"{text!a} is longer than {size_bytes - 1} characters")
    return (raw + TEXT_END).ljust(size_bytes, TEXT_FILLER)


def decode_text(field: bytes) -> str:
    """Decode an ASCII field up to its terminator, or whole if malformed, with escapes."""
    text, end, rest = field.partition(TEXT_END)
    if end and rest.strip(TEXT_FILLER):
        text = field
    return printable(text.decode("latin-1")).rstrip()


def find_firmware_version(data: bytes) -> str | None:
    """Find the firmware version `Vxrxrx_YYYYMMDD` in an image; None if it has none or several
    different ones. A version needs no separators around it, because a packed structure has none.
    """
    found = {data[start:end] for start, end in firmware_version_spans(data)}
    return found.pop().decode("ascii") if len(found) == 1 else None


def firmware_version_spans(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield start and end offset of each firmware version in `data`."""
    return (match.span() for match in _FIRMWARE_VERSION.finditer(data))


def no_formula(text: str) -> str:
    """Quote a CSV cell that a spreadsheet would interpret as a formula."""
    return f"'{text}" if text.startswith(_FORMULA_STARTS) else text
