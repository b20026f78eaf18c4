"""Firmware image: the bytes to send, their addresses, hash, version and target names."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Self

from flasher.errors import UsageError
from flasher.protocol.spec import TARGETS, Target
from flasher.protocol.text import find_firmware_version, firmware_version_spans

ADDRESS_SPACE: Final = 1 << 32
"""One past the highest address of any format."""


@dataclass(frozen=True)
class AddressSpan:
    """Contiguous address range of a firmware file."""

    start: int
    size_bytes: int

    @property
    def end(self) -> int:
        """One past the last address."""
        return self.start + self.size_bytes

    def __str__(self) -> str:
        last = self.end - 1
        unit = "byte" if self.size_bytes == 1 else "bytes"
        return f"0x{self.start:08X}..0x{last:08X} ({self.size_bytes} {unit})"


@dataclass(frozen=True)
class Image:
    """Firmware image: the bytes to send (R8), and the file and address that they come from."""

    data: bytes = field(repr=False)
    """The bytes to send, gaps filled."""
    base: int | None
    """Address of `data[0]`; None for a raw binary with unknown base."""
    format: str
    """File format, such as "Intel HEX" or "raw binary"."""
    source: str
    """File name as given, for messages."""
    segments: tuple[AddressSpan, ...]
    """Address ranges with bytes in the file; offsets if `base` is None."""
    filled_bytes: int
    """Number of filler bytes in `data`."""
    version: str | None = None
    """Firmware version `Vxrxrx_YYYYMMDD` in `data`; None if it has none or several."""
    elf_machine: int | None = field(default=None, compare=False)
    """Processor of an ELF file; None for other formats."""

    @classmethod
    def from_bytes(cls, data: bytes, *, base: int | None = None, source: str = "(memory)") -> Self:
        """Create an image from bytes, as from a raw binary file. Raises UsageError for a base that
        leaves no 32-bit addresses for them.
        """
        data = bytes(memoryview(data))  # the caller may fill a bytearray again
        if base is not None and not 0 <= base <= ADDRESS_SPACE - len(data):
            raise UsageError(f"{source} is not inside 32-bit addresses with the base {base:#x}")
        return cls(
            data=data,
            base=base,
            format="raw binary",
            source=source,
            segments=(AddressSpan(base or 0, len(data)),),
            filled_bytes=0,
            version=find_firmware_version(data),
        )

    @property
    def size_bytes(self) -> int:
        return len(self.data)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of `data`, lower-case hexadecimal."""
        return hashlib.sha256(self.data).hexdigest()

    @cached_property
    def named_targets(self) -> frozenset[Target]:
        """Targets whose names are in `data`; may be empty."""
        return named_targets(self.data)


# -- targets named inside an image ----------------------------------------------------------------

# Only strong evidence counts, since a wrong guess would refuse a good image: the name of a device
# right beside a firmware version, or the whole text of an update command.

NEIGHBOURHOOD_SIZE: Final = 64
"""Maximum distance in bytes between a firmware version and the device name that belongs to it."""


def _whole_words(texts: dict[str, Target]) -> re.Pattern[bytes]:
    """Compile a pattern that matches any of these texts as a whole word."""
    choice = "|".join(map(re.escape, texts)).encode("ascii")
    return re.compile(rb"(?<![A-Za-z0-9_])(?:" + choice + rb")(?![A-Za-z0-9_])")


_NAMES: Final = {
    name: target for target in TARGETS.values() for name in (target.node.name, target.boot_name)
}
_UPDATE_TEXTS: Final = {target.update_text: target for target in TARGETS.values()}
_NAME: Final = _whole_words(_NAMES)
_UPDATE_TEXT: Final = _whole_words(_UPDATE_TEXTS)


def named_targets(data: bytes) -> frozenset[Target]:
    """Targets named in an image; several if its texts contradict each other."""
    found = {_UPDATE_TEXTS[match[0].decode("ascii")] for match in _UPDATE_TEXT.finditer(data)}
    for start, end in firmware_version_spans(data):
        # The version itself ends a word: packed structures have no separators.
        before = _NAME.finditer(data, max(0, start - NEIGHBOURHOOD_SIZE), start)
        after = _NAME.finditer(data[end : end + NEIGHBOURHOOD_SIZE + 1])
        found |= {_NAMES[match[0].decode("ascii")] for match in before}
        found |= {
            _NAMES[match[0].decode("ascii")] for match in after if match.end() <= NEIGHBOURHOOD_SIZE
        }
    return frozenset(found)
