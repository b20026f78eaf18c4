"""The fast CRC against a literal transcription of appendix 1."""

from __future__ import annotations

import random
from typing import Final

from flasher.protocol.crc import crc32
from tests.loops import each

_POLYNOMIAL: Final = 0x04C11DB7


def _table_entry(index: int) -> int:
    """What eight shifts leave of a register that starts with `index` in its top byte."""
    register = index << 24
    for _ in range(8):
        carry = register & 0x80000000
        register = register << 1 & 0xFFFFFFFF
        if carry:
            register ^= _POLYNOMIAL
    return register


_TABLE: Final = [_table_entry(index) for index in range(256)]


def _crc_of_the_appendix(data: bytes) -> int:
    """Each byte into the low end, then four table steps."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(4):
            from_table = _TABLE[register >> 24 & 0xFF]
            register = register << 8 & 0xFFFFFFFF
            register ^= from_table
    return register


@each(
    "index, entry",
    [
        # The first rows of the printed table, the corners of some others, and its last entry.
        (0, 0x00000000),
        (1, 0x04C11DB7),
        (2, 0x09823B6E),
        (3, 0x0D4326D9),
        (4, 0x130476DC),
        (5, 0x17C56B6B),
        (6, 0x1A864DB2),
        (12, 0x350C9B64),
        (16, 0x4C11DB70),
        (24, 0x6A1936C8),
        (30, 0x709F7B7A),
        (36, 0x8B27C03C),
        (48, 0xD4326D90),
        (66, 0x3D044B19),
        (90, 0x571D7DD1),
        (138, 0x46863638),
        (192, 0x5D8A9099),
        (234, 0xEA23F0AF),
        (246, 0x933EB0BB),
        (252, 0xBCB4666D),
        (255, 0xB1F740B4),
    ],
)
def test_the_reference_table_is_the_printed_one(index: int, entry: int) -> None:
    assert _TABLE[index] == entry


def test_the_documents_example_has_the_documents_result() -> None:
    covered = bytes.fromhex("55 AA 07 12 11 03 22 01 00")
    assert crc32(covered) == 0x01295122
    assert _crc_of_the_appendix(covered) == 0x01295122


def test_nothing_at_all_leaves_the_start_value() -> None:
    assert crc32(b"") == 0xFFFFFFFF


def test_every_single_byte_agrees_with_the_appendix() -> None:
    for byte in range(256):
        assert crc32(bytes((byte,))) == _crc_of_the_appendix(bytes((byte,))), byte


def test_random_data_of_every_length_to_300_agree_with_the_appendix() -> None:
    rng = random.Random(1)
    for size_bytes in range(301):
        data = rng.randbytes(size_bytes)
        assert crc32(data) == _crc_of_the_appendix(data), data.hex()


def test_it_is_not_the_common_crc_over_bytes_that_are_not_widened() -> None:
    # CRC-32/MPEG-2 of the nine digits, as every catalogue of CRCs lists it.
    assert crc32(b"123456789") != 0x0376E6E7
