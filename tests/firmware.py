"""The smallest honest beginning of an image, for tests of something else than its look."""

from __future__ import annotations

import struct
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Final

from intelhex import IntelHex

VECTORS: Final = struct.pack("<4I", 0x2000_5000, 0x0800_4101, 0, 0)
"""A Cortex-M vector table: stack pointer, reset vector, no NMI and no hard fault handler."""
_SHORT_SIZE: Final = 4096
"""In bytes."""


def shorten(sample: Path, to: Path) -> None:
    """Write the beginning of a sample, with the texts in it, as .hex and .bin."""
    for suffix, written in _shortened(sample).items():
        Path(f"{to}{suffix}").write_bytes(written)


@cache
def _shortened(sample: Path) -> dict[str, bytes]:
    whole = IntelHex(f"{sample}.hex")
    short = whole[whole.minaddr() : whole.minaddr() + _SHORT_SIZE]
    lines = StringIO()
    short.write_hex_file(lines)
    return {".hex": lines.getvalue().encode(), ".bin": short.tobinstr()}
