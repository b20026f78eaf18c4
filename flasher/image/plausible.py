"""Plausibility check: whether the bytes of an image can be a program for the device.

An image is either certainly something else (another file type, a text, one repeated byte, a program
for another processor), or has no plausible Cortex-M vector table. The latter may be correct: the
documents name no processor, and an image may be encrypted.
"""

from __future__ import annotations

import codecs
import re
from enum import Enum
from typing import Final, NamedTuple

from flasher.errors import ErrorCode, ImageError
from flasher.image.cortexm import vector_table
from flasher.image.elf import EM_ARM, machine_name
from flasher.image.image import Image

_MAGICS: Final = {
    b"PK\x03\x04": "a zip archive",
    b"PK\x05\x06": "a zip archive",
    b"\x1f\x8b\x08": "a gzip file",
    b"BZh": "a bzip2 file",
    b"\xfd7zXZ\0": "an xz file",
    b"\x28\xb5\x2f\xfd": "a zstd file",
    b"7z\xbc\xaf\x27\x1c": "a 7-Zip archive",
    b"Rar!\x1a\x07": "a RAR archive",
    b"!<arch>\n": "a library of object files",
    b"\x89PNG\r\n\x1a\n": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"GIF8": "a GIF picture",
    b"%PDF": "a PDF document",
    b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1": "an Office document",
    b"SQLite format 3\0": "an SQLite database",
    b"UF2\n": "a UF2 file",
    b"DfuSe": "a DfuSe file",
    b"\x7fELF": "an ELF file read as a raw binary",
    b"\xca\xfe\xba\xbe": "a Java class or a Mach-O program",
    b"\xcf\xfa\xed\xfe": "a Mach-O program",
    b"\xce\xfa\xed\xfe": "a Mach-O program",
    b"LOGG": "a BLF trace",
    b"MDF     ": "an MDF trace",
}
_TAR: Final = (257, b"ustar")
_PE_HEADER_AT: Final = 0x3C
_HTML: Final = re.compile(rb"\s*(<!--|<!doctype|<html|<head|<body)", re.IGNORECASE)
_XML: Final = re.compile(rb"\s*<\?xml")
_UTF_16: Final = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_UTF_16_EXAMINED: Final = 64
_CONTROLS: Final = bytes(byte for byte in range(0x20) if byte not in b"\t\n\v\f\r\x1b") + b"\x7f"
_OTHER_ENCODING_SIZE: Final = 256
"""Number of bytes without control character that count as text in some encoding. The probability
for random bytes is 10^-13."""
LIKELY_CAUSES: Final = "the wrong file, an encrypted image, a header in front, or another processor"
"""Causes of an image without vector table, for messages."""
_OTHER_WAIVERS: Final = (
    ", as does a manifest of these very bytes (flasher manifest create --allow-implausible), or "
    'cpu = "other" in the target\'s profile'
)


class Cpu(Enum):
    """Processor type in a target profile."""

    CORTEX_M = "cortex-m"
    OTHER = "other"


class Doubt(NamedTuple):
    """Reason why an image is implausible; `text` completes "the image ...".

    `is_certain`: the bytes are another file type, and no profile or manifest can waive the check.
    `other_waivers` names what waives it besides --allow-implausible.
    """

    text: str
    is_certain: bool

    @property
    def other_waivers(self) -> str:
        return "" if self.is_certain else _OTHER_WAIVERS


def find_doubt(image: Image) -> Doubt | None:
    """Find the reason why an image is implausible; None for a plausible program."""
    foreign = _foreign(image)
    if foreign is not None:
        return Doubt(f"is {foreign}", is_certain=True)
    table = vector_table(image)
    if table is None:
        return Doubt("is too short to begin with a vector table", is_certain=False)
    if table.plausible:
        return None
    problems = "; ".join(table.problems)
    return Doubt(f"begins with no Cortex-M vector table: {problems}", is_certain=False)


def check_plausible(image: Image) -> None:
    """Raise ImageError for an implausible image, for commands without manifest and profile."""
    found = find_doubt(image)
    if found is not None:
        raise ImageError(
            f"{image.source} {found.text}: not plausible as firmware.",
            cause="the wrong file" if found.is_certain else LIKELY_CAUSES,
            remedy="Name the firmware file itself."
            if found.is_certain
            else "Name the firmware file itself; if these really are the bytes to send, add "
            "--allow-implausible.",
            code=ErrorCode.IMAGE_IMPLAUSIBLE,
        )


def _foreign(image: Image) -> str | None:
    """Name the file type of bytes that are certainly no program for the device."""
    data = image.data
    if image.elf_machine not in (None, EM_ARM):
        return f"a program for another processor ({machine_name(image.elf_machine)})"
    if len(data) > 1 and data.count(data[:1]) == len(data):
        return f"one repeated byte (0x{data[0]:02X})"
    name = file_type(data)
    if name is not None:
        return name
    at, mark = _TAR
    if data[at : at + len(mark)] == mark:
        return "a tar archive"
    if data.startswith(b"MZ") and _is_pe(data):
        return "a Windows program"
    return _text(data)


def file_type(head: bytes) -> str | None:
    """Name a file type by the first bytes of a file; None if they are of no known one."""
    if _HTML.match(head):
        return "an HTML page"
    return next((name for magic, name in _MAGICS.items() if head.startswith(magic)), None)


def _is_pe(data: bytes) -> bool:
    at = int.from_bytes(data[_PE_HEADER_AT : _PE_HEADER_AT + 4], "little")
    return data[at : at + 4] == b"PE\0\0"


def _text(data: bytes) -> str | None:
    if _XML.match(data):
        return "an XML document"
    if data.startswith(_UTF_16):
        if data[:_UTF_16_EXAMINED].decode("utf-16", "ignore").isascii():
            return "a text in UTF-16"
        return None
    # A dump of a flash memory that contains a text is padded with FF or 00.
    body = data.rstrip(b"\0\xff")
    if not body or body.translate(None, _CONTROLS) != body:
        return None
    if _is_utf_8(body):
        return "a text"
    return "a text" if len(body) >= _OTHER_ENCODING_SIZE and b"\n" in body else None


def _is_utf_8(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True
