"""The smallest honest beginning of an image, for tests of something else than its look."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Final

from intelhex import IntelHex

VECTORS: Final = struct.pack("<4I", 0x2000_5000, 0x0800_4101, 0, 0)
"""A Cortex-M vector table: stack pointer, reset vector, no NMI and no hard fault handler."""
_SHORT_SIZE: Final = 4096
"""In bytes."""


def shorten(sample: Path, to: Path) -> None:
    """Write the beginning of a sample, with the texts in it, as .hex and .bin."""
    whole = IntelHex(f"{sample}.hex")
    short = whole[whole.minaddr() : whole.minaddr() + _SHORT_SIZE]
    short.write_hex_file(f"{to}.hex")
    short.tobinfile(f"{to}.bin")
