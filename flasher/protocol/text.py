"""ASCII fields of the protocol, and a safe way to show whatever a device sends instead.

A field holds its text, `.` as terminator, then spaces (5.1). R20: a text that breaks the rule is
shown as it is, with everything that could disturb a terminal or a page escaped.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

from flasher.errors import printable as printable  # noqa: PLC0414  most have it from here
from flasher.protocol.spec import TEXT_END, TEXT_FILLER

FIRMWARE_VERSION_FORM: Final = "Vxrxrx_YYYYMMDD"
"""The naming rule of firmware versions, as the documents print it (5.1, version information)."""
BOOT_VERSION_FORM: Final = "Vx.x.x"
"""The form of a bootloader's version, as the documents print it (4.1, boot version)."""
_FIRMWARE_VERSION: Final = re.compile(
    rb"V([0-9]{1,2})r([0-9]{1,2})r([0-9]{1,2})"
    rb"_([0-9]{4}(?:0[1-9]|1[0-2])(?:0[1-9]|[12][0-9]|3[01]))"
)
"""`FIRMWARE_VERSION_FORM`; a number of two digits is found too."""
_FORMULA_STARTS: Final = ("=", "+", "-", "@", "\t", "\r")
"""A spreadsheet takes a cell that begins so for a formula."""
_BOOT_VERSION: Final = re.compile(r"V([0-9])\.([0-9])\.([0-9])")


@dataclass(frozen=True, order=True)
class FirmwareVersion:
    """A firmware version of the naming rule. The newer one is the greater one: the three numbers
    decide first, the date after them.
    """

    major: int
    minor: int
    revision: int
    date: str
    """YYYYMMDD."""

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """The version that the whole of `text` names; None when it breaks the naming rule."""
        match = _FIRMWARE_VERSION.fullmatch(text.encode("ascii", "replace"))
        if match is None:
            return None
        major, minor, revision, date = match.groups()
        return cls(int(major), int(minor), int(revision), date.decode("ascii"))


def boot_version_number(text: str) -> tuple[int, int, int] | None:
    """The three numbers of a boot version `Vx.x.x`, comparable; None for any other text."""
    match = _BOOT_VERSION.fullmatch(text)
    return None if match is None else (int(match[1]), int(match[2]), int(match[3]))


def encode_text(text: str, size_bytes: int) -> bytes:
    """`text` as a field of `size_bytes`.

    Raises ValueError when the text is not printable ASCII, holds the terminator, or is too long.
    """
    raw = text.encode("ascii", "replace") if text.isascii() else b""
    if len(raw) != len(text) or not text.isprintable():
        raise ValueError(f"{text!a} is not printable ASCII")
    if TEXT_END in raw:
        raise ValueError(f"{text!a} holds {TEXT_END.decode()!r}, which ends a field")
    if len(raw) >= size_bytes:
        raise ValueError(f"{text!a} is longer than {size_bytes - 1} characters")
    return (raw + TEXT_END).ljust(size_bytes, TEXT_FILLER)


def decode_text(field: bytes) -> str:
    """The text of a field, safe to show: up to the terminator, or the whole field without one."""
    text, end, rest = field.partition(TEXT_END)
    if end and rest.strip(TEXT_FILLER):
        text = field
    return printable(text.decode("latin-1")).rstrip()


def find_firmware_version(data: bytes) -> str | None:
    """The firmware version `Vxrxrx_YYYYMMDD` inside an image; None when there is none, or more
    than one different.

    It is looked for without regard to its surroundings: in a packed structure there is no
    separator before or behind it.
    """
    found = {data[start:end] for start, end in firmware_version_spans(data)}
    return found.pop().decode("ascii") if len(found) == 1 else None


def firmware_version_spans(data: bytes) -> Iterator[tuple[int, int]]:
    """Where `data` holds firmware versions: the offset of the first byte, and one past the last."""
    return (match.span() for match in _FIRMWARE_VERSION.finditer(data))


def no_formula(text: str) -> str:
    """`text` as a cell that a spreadsheet takes for text, whatever it begins with."""
    return f"'{text}" if text.startswith(_FORMULA_STARTS) else text
