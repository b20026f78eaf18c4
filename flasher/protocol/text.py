"""ASCII fields of the protocol, and a safe way to show whatever a device sends instead.

A field holds its text, `.` as terminator, then spaces (5.1). R20: a text that breaks the rule is
shown as it is, with everything that could disturb a terminal or a page escaped.
"""

from __future__ import annotations

from flasher.protocol.spec import TEXT_END, TEXT_FILLER


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
