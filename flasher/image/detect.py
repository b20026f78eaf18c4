"""Which format a file has, by its content first and its suffix second.

A damaged text file of records is still one, and is refused as such by its reader. What is none of
the formats is taken for a raw binary; whether it can be a program is judged by
`flasher.image.plausible`.
"""

from __future__ import annotations

import codecs
import re
from enum import Enum
from pathlib import PurePath
from typing import Final

from flasher.image import elf

HEAD_SIZE: Final = 65_536
"""How much of a file `detect` wants to see, in bytes."""
_LINES_JUDGED: Final = 100


class Format(Enum):
    """The formats; the value is the option's word, `title` what it is called in messages."""

    HEX = "hex"
    BIN = "bin"
    SREC = "srec"
    ELF = "elf"

    @property
    def title(self) -> str:
        return _TITLES[self]


_TITLES: Final = {
    Format.HEX: "Intel HEX",
    Format.BIN: "raw binary",
    Format.SREC: "Motorola S-record",
    Format.ELF: "ELF",
}
_SUFFIXES: Final = {
    **dict.fromkeys((".hex", ".ihx", ".ihex", ".h86", ".mcs"), Format.HEX),
    **dict.fromkeys(
        (".s19", ".s28", ".s37", ".srec", ".sre", ".s", ".mot", ".mhx", ".sx", ".s1", ".s2", ".s3"),
        Format.SREC,
    ),
    **dict.fromkeys((".elf", ".axf"), Format.ELF),
}
_RECORDS: Final = {
    Format.HEX: re.compile(rb":[0-9A-Fa-f]{8}"),
    Format.SREC: re.compile(rb"S[0-9][0-9A-Fa-f]{4}"),
}
_STARTS: Final = {Format.HEX: re.compile(rb":"), Format.SREC: re.compile(rb"S[0-9]")}
_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\n\v\f\r"


def detect(head: bytes, source: str) -> Format:
    """The format of a file that starts with `head` (its first `HEAD_SIZE` bytes)."""
    if head.startswith(elf.MAGIC):
        return Format.ELF
    body = head.removeprefix(codecs.BOM_UTF8).lstrip()
    if _is_mostly_text(body):
        for form, start in _STARTS.items():
            if start.match(body):
                return form
    lines = [line.strip() for line in body.splitlines()[:_LINES_JUDGED]]
    for form, record in _RECORDS.items():
        matching = sum(record.match(line) is not None for line in lines)
        if 2 * matching > len(lines):
            return form
    suffix = PurePath(source).suffix.lower()
    if suffix in _SUFFIXES:
        return _SUFFIXES[suffix]
    return Format.BIN


def _is_mostly_text(head: bytes) -> bool:
    """A damaged text file still is; a program that happens to begin like a record is not."""
    return 2 * len(head.translate(None, _TEXT)) <= len(head)
