"""ASCII fields of the protocol, and a safe way to show whatever a device sends instead.

A field holds its text, `.` as terminator, then spaces (5.1). R20: a text that breaks the rule is
shown as it is, with everything that could disturb a terminal or a page escaped.
"""

from __future__ import annotations

import re
from typing import Final

from flasher.protocol.spec import TEXT_END, TEXT_FILLER

_FIRMWARE_VERSION: Final = re.compile(
    rb"V[0-9]{1,2}r[0-9]{1,2}r[0-9]{1,2}_[0-9]{4}(?:0[1-9]|1[0-2])(?:0[1-9]|[12][0-9]|3[01])"
)
"""`Vxrxrx_YYYYMMDD`, the naming rule of firmware versions (5.1, version information); a number of
two digits is found too."""


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


def printable(text: str) -> str:
    """`text` with everything but printable ASCII escaped."""
    return "".join(
        char if char.isascii() and char.isprintable() else char.encode("unicode_escape").decode()
        for char in text
    )


def find_firmware_version(data: bytes) -> str | None:
    """The firmware version `Vxrxrx_YYYYMMDD` inside an image; None when there is none, or more
    than one different.

    It is looked for without regard to its surroundings: in a packed structure there is no
    separator before or behind it.
    """
    found = set(_FIRMWARE_VERSION.findall(data))
    return found.pop().decode("ascii") if len(found) == 1 else None
