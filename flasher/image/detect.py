"""Which format a file has, by its content first and its suffix second.

The safe direction is never to send text as if it were a program: a damaged or unknown text file is
refused, and only what cannot be anything else is taken for a raw binary.
"""

from __future__ import annotations

import codecs
import re
from enum import Enum
from pathlib import PurePath
from typing import Final

from flasher.errors import ImageError
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
_CONTAINERS: Final = {
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b\x08": "a gzip file",
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive",
    b"UF2\n": "a UF2 file",
    b"DfuSe": "a DfuSe file",
    b"%PDF": "a PDF document",
}
_TEXT: Final = bytes(range(0x20, 0x7F)) + b"\t\n\v\f\r"
_MARKS: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_MARKED_SIZE: Final = 64


def detect(head: bytes, source: str) -> Format:
    """The format of a file that starts with `head` (its first `HEAD_SIZE` bytes).

    Raises ImageError for what is certainly no firmware: another container, or any other text.
    """
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
    _refuse_others(head, source)
    return Format.BIN


def _is_mostly_text(head: bytes) -> bool:
    """A damaged text file still is; a program that happens to begin like a record is not."""
    return 2 * len(head.translate(None, _TEXT)) <= len(head)


def _is_a_text(head: bytes) -> bool:
    """Text of more than one line; a few printable bytes may be an image."""
    return b"\n" in head and not head.translate(None, _TEXT)


def _refuse_others(head: bytes, source: str) -> None:
    what = next((name for magic, name in _CONTAINERS.items() if head.startswith(magic)), None)
    if head.startswith(_MARKS) and head[:_MARKED_SIZE].decode("utf-16", "ignore").isascii():
        what = "a text in UTF-16"
    elif _is_a_text(head):
        what = "a text"
    if what:
        raise ImageError(
            f"{source} is {what}, and neither Intel HEX, S-record, ELF nor a raw binary",
            cause="the wrong file, or a file whose first lines were lost",
            remedy="name the firmware file itself; if these really are the bytes to send, say so "
            "with --format bin",
        )
