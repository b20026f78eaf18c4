"""What a firmware file comes down to: the bytes to be sent, and where they came from."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Self

from flasher.protocol.spec import TARGETS, Target
from flasher.protocol.text import find_firmware_version, firmware_version_spans

ADDRESS_SPACE: Final = 1 << 32
"""One past the highest address that a file can name."""


@dataclass(frozen=True)
class AddressSpan:
    """A run of bytes of the file."""

    start: int
    size_bytes: int

    @property
    def end(self) -> int:
        """One past the last address."""
        return self.start + self.size_bytes

    def __str__(self) -> str:
        last = self.end - 1
        return f"0x{self.start:08X}..0x{last:08X} ({self.size_bytes} bytes)"


@dataclass(frozen=True)
class Image:
    """The bytes to be sent, from the first to the last (R8), and what is known about them."""

    data: bytes = field(repr=False)
    """The very bytes to be sent; gaps are filled."""
    base: int | None
    """Address of `data[0]`; None for a raw binary whose base is not known."""
    format: str
    """The format that the file was read as, in words: "Intel HEX", "raw binary", ..."""
    source: str
    """File name as given, for messages."""
    segments: tuple[AddressSpan, ...]
    """Where the file has bytes; offsets instead of addresses when `base` is None."""
    filled_bytes: int
    """How many bytes of `data` are filler and not from the file."""
    version: str | None = None
    """The firmware version `Vxrxrx_YYYYMMDD` inside; None when there is none, or several."""
    elf_machine: int | None = field(default=None, compare=False)
    """The kind of processor that an ELF file names; None for the other formats."""

    @classmethod
    def from_bytes(cls, data: bytes, *, base: int | None = None, source: str = "(memory)") -> Self:
        """An image of bytes that are at hand, as a raw binary of them would load."""
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
        """SHA-256 of `data`, in hex digits."""
        return hashlib.sha256(self.data).hexdigest()

    @cached_property
    def named_targets(self) -> frozenset[Target]:
        """The targets that `data` names by itself; empty when it names none."""
        return named_targets(self.data)


# -- which targets an image names -----------------------------------------------------------------

# Only strong evidence counts, since a wrong guess would refuse a good image: the name of a device
# right beside a firmware version, or the whole text of an update command.

NEIGHBOURHOOD_SIZE: Final = 64
"""In bytes, before and behind a firmware version: a name in there belongs to it."""


def _whole_words(texts: dict[str, Target]) -> re.Pattern[bytes]:
    """Finds each of these texts where no letter, digit or underscore touches it."""
    choice = "|".join(map(re.escape, texts)).encode("ascii")
    return re.compile(rb"(?<![A-Za-z0-9_])(?:" + choice + rb")(?![A-Za-z0-9_])")


_NAMES: Final = {
    name: target for target in TARGETS.values() for name in (target.node.name, target.boot_name)
}
_UPDATE_TEXTS: Final = {target.update_text: target for target in TARGETS.values()}
_NAME: Final = _whole_words(_NAMES)
_UPDATE_TEXT: Final = _whole_words(_UPDATE_TEXTS)


def named_targets(data: bytes) -> frozenset[Target]:
    """The targets that an image names; empty when it names none, several for mixed texts."""
    found = {_UPDATE_TEXTS[match[0].decode("ascii")] for match in _UPDATE_TEXT.finditer(data)}
    for start, end in firmware_version_spans(data):
        # The version itself ends a word: in a packed structure nothing else separates them.
        before = _NAME.finditer(data, max(0, start - NEIGHBOURHOOD_SIZE), start)
        behind = _NAME.finditer(data[end : end + NEIGHBOURHOOD_SIZE + 1])
        found |= {_NAMES[match[0].decode("ascii")] for match in before}
        found |= {
            _NAMES[match[0].decode("ascii")]
            for match in behind
            if match.end() <= NEIGHBOURHOOD_SIZE
        }
    return frozenset(found)
