"""The smallest honest beginning of an image, for tests of something else than its look."""

from __future__ import annotations

import struct
from typing import Final

VECTORS: Final = struct.pack("<4I", 0x2000_5000, 0x0800_4101, 0, 0)
"""A Cortex-M vector table: stack pointer, reset vector, no NMI and no hard fault handler."""
