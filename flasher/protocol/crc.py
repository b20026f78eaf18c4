"""CRC-32 of appendix 1, computed with zlib for speed.

The appendix XORs each byte into the *low* end of a 32-bit register and then steps four times. That
is CRC-32/MPEG-2 over every byte widened to a big-endian 32-bit word (00 00 00 b). zlib computes the
mirrored CRC-32, so both ends are mirrored: the bits of every input byte and of the result are
reversed, and zlib's final XOR is undone.
"""

from __future__ import annotations

import zlib
from typing import Final

_MIRROR: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32(data: bytes) -> int:
    """CRC of appendix 1 over `data` (55 AA, the CAN id high byte first, mode .. last data byte)."""
    widened = bytearray(4 * len(data))
    widened[3::4] = data.translate(_MIRROR)
    mirrored = zlib.crc32(widened) ^ 0xFFFFFFFF
    return int.from_bytes(mirrored.to_bytes(4, "little").translate(_MIRROR), "big")
