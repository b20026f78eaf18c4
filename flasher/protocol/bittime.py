"""Exact length of classic CAN frames on the wire, in bit times.

A frame (ISO 11898-1, base format) is: SOF, 11 id bits, RTR, IDE, r0, 4 DLC bits, the data, 15 CRC
bits. These are stuffed: after five equal bits the complement is inserted, and counts for the next
run. CRC delimiter, ACK slot, ACK delimiter, 7 bits of EOF and 3 bits of interframe space follow
unstuffed.

Tables process one frame a byte at a time, or many frames at once a nibble at a time. For many, a
column of bytes (one byte per frame) goes through the same tables by `bytes.translate`, and columns
are combined as big integers, so that the C library does the work for a whole image.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache, lru_cache
from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.spec import FRAME_DATA_SIZE

_CRC_POLYNOMIAL: Final = 0x4599
_CRC_BITS: Final = 15
_UNSTUFFED_TAIL_BITS: Final = 1 + 1 + 1 + 7 + 3
_HEAD_BITS: Final = 1 + 11 + 1 + 1 + 1 + 4
_RUN_BEFORE_STUFFING: Final = 5

# The stuffing state is the last bit and the length of its run (1 to 5). It fits a nibble, so state
# and next nibble together index a table of 256 bytes.


def _stuff(state: int, bits: int, width: int) -> tuple[int, int]:
    """Insert stuff bits into `width` bits; return the new stuffing state and their number."""
    last, run = state >> 3, state & 7
    inserted = 0
    for shift in range(width - 1, -1, -1):
        if run == _RUN_BEFORE_STUFFING:
            last, run, inserted = last ^ 1, 1, inserted + 1
        bit = bits >> shift & 1
        last, run = bit, run + 1 if bit == last else 1
    return last << 3 | run, inserted


_STATES: Final = [_stuff(index >> 4, index & 15, 4) for index in range(256)]
_NEXT_STATE: Final = bytes(state & 15 for state, _ in _STATES)
_INSERTED: Final = bytes(inserted for _, inserted in _STATES)
# State and next byte, for a frame in a loop: the high nibble leads to the index of the low one.
_LOW_INDEX: Final = [_NEXT_STATE[index >> 4] << 4 | index & 15 for index in range(4096)]
_BYTE_NEXT_STATE: Final = bytes(_NEXT_STATE[low] for low in _LOW_INDEX)
_BYTE_INSERTED: Final = bytes(
    _INSERTED[index >> 4] + _INSERTED[low] for index, low in enumerate(_LOW_INDEX)
)


def _crc_steps(register: int, steps: int) -> int:
    for _ in range(steps):
        register <<= 1
        if register >> _CRC_BITS:
            register ^= 1 << _CRC_BITS | _CRC_POLYNOMIAL
    return register


_CRC_BYTE: Final = [_crc_steps(byte << _CRC_BITS - 8, 8) for byte in range(256)]
_CRC_HIGH: Final = bytes(value >> 8 for value in _CRC_BYTE)
_CRC_LOW: Final = bytes(value & 0xFF for value in _CRC_BYTE)
_HIGH_NIBBLE: Final = bytes(byte >> 4 for byte in range(256))
_LOW_NIBBLE: Final = bytes(byte & 15 for byte in range(256))


@cache
def _head(can_id: int, size: int) -> tuple[int, int, int]:
    """Stuffing state, stuff bits and CRC register of a frame after its DLC field."""
    bits = can_id << 7 | size
    state, inserted = _stuff(0, bits, _HEAD_BITS)
    crc = 0
    for shift in range(_HEAD_BITS - 1, -1, -1):
        crc = _crc_steps(crc ^ (bits >> shift & 1) << _CRC_BITS - 1, 1)
    return state, inserted, crc


_TOP_CRC: Final = [_stuff(index >> 3, index & 7, 3) for index in range(128)]
"""The 15-bit CRC is processed as three bits, then three nibbles."""
_TOP_NEXT_STATE: Final = bytes(state & 15 for state, _ in _TOP_CRC).ljust(256, b"\0")
_TOP_INSERTED: Final = bytes(inserted for _, inserted in _TOP_CRC).ljust(256, b"\0")
_FULL_RUN: Final = bytes(state & 7 == _RUN_BEFORE_STUFFING for state in range(256))
"""Stuffing states in which the CRC ends with five equal bits, so that one more stuff bit
follows."""


def fixed_bits(size: int) -> int:
    """Bit times of a frame with `size` data bytes and interframe space, without stuff bits."""
    return _HEAD_BITS + 8 * size + _CRC_BITS + _UNSTUFFED_TAIL_BITS


@lru_cache(maxsize=4096)  # a repeated message, an image that is sent again and again
def frame_bits(frame: Frame) -> int:
    """Length of a CAN frame in bit times: stuff bits and interframe space included."""
    can_id, data = frame[0], frame[1]
    state, inserted, crc = _head(can_id, len(data))
    for byte in data:
        index = state << 8 | byte
        inserted += _BYTE_INSERTED[index]
        state = _BYTE_NEXT_STATE[index]
        crc = (crc << 8 & 0x7FFF) ^ _CRC_BYTE[crc >> 7 ^ byte]
    index = state << 3 | crc >> 12
    inserted += _TOP_INSERTED[index]
    index = _TOP_NEXT_STATE[index] << 4 | crc >> 8 & 15
    inserted += _INSERTED[index]
    index = _NEXT_STATE[index] << 8 | crc & 0xFF
    return (
        fixed_bits(len(data))
        + inserted
        + _BYTE_INSERTED[index]
        + _FULL_RUN[_BYTE_NEXT_STATE[index]]
    )


def frame_tables(can_ids: Iterable[int]) -> dict[str, object]:
    """Lookup tables of `frame_bits` for these CAN ids, for the generated Wireshark script."""
    return {
        "fixed": [fixed_bits(size) for size in range(FRAME_DATA_SIZE + 1)],
        "heads": {
            can_id: [list(_head(can_id, size)) for size in range(FRAME_DATA_SIZE + 1)]
            for can_id in can_ids
        },
        "next_state": _NEXT_STATE,
        "inserted": _INSERTED,
        "crc": _CRC_BYTE,
        "top_next_state": _TOP_NEXT_STATE,
        "top_inserted": _TOP_INSERTED,
        "full_run": _FULL_RUN,
    }


def message_bits(frames: Iterable[Frame]) -> int:
    """Length in bit times of consecutive CAN frames, without idle time between them."""
    return sum(map(frame_bits, frames))


class _Columns:
    """Lengths of `count` CAN frames with one id and size, computed a byte column at a time."""

    def __init__(self, can_id: int, size: int, count: int) -> None:
        state, inserted, crc = _head(can_id, size)
        self._count = count
        self._state = bytes((state,)) * count
        self._bits = self._number(bytes((fixed_bits(size) + inserted,)) * count)
        self._crc_high = bytes((crc >> 8,)) * count
        self._crc_low = bytes((crc & 0xFF,)) * count

    def feed(self, column: bytes) -> None:
        """Process the next data byte of every frame."""
        self._nibbles(column.translate(_HIGH_NIBBLE))
        self._nibbles(column.translate(_LOW_NIBBLE))
        high, low = self._number(self._crc_high), self._number(self._crc_low)
        ones = self._number(b"\1" * self._count)
        index = self._column(high << 1 ^ low >> 7 & ones ^ self._number(column))
        shifted = low & ones * 0x7F
        self._crc_high = self._column(shifted ^ self._number(index.translate(_CRC_HIGH)))
        self._crc_low = index.translate(_CRC_LOW)

    def finish(self) -> bytes:
        """Return the length of every frame in bit times, one byte each."""
        high, low = self._crc_high, self._crc_low
        top = self._number(high.translate(_HIGH_NIBBLE))
        index = self._column(self._number(self._state) << 3 | top)
        self._bits += self._number(index.translate(_TOP_INSERTED))
        self._state = index.translate(_TOP_NEXT_STATE)
        self._nibbles(high.translate(_LOW_NIBBLE))
        self._nibbles(low.translate(_HIGH_NIBBLE))
        self._nibbles(low.translate(_LOW_NIBBLE))
        self._bits += self._number(self._state.translate(_FULL_RUN))
        return self._column(self._bits)

    def _nibbles(self, nibbles: bytes) -> None:
        index = self._column(self._number(self._state) << 4 | self._number(nibbles))
        self._bits += self._number(index.translate(_INSERTED))
        self._state = index.translate(_NEXT_STATE)

    def _number(self, column: bytes) -> int:
        return int.from_bytes(column, "little")

    def _column(self, number: int) -> bytes:
        return number.to_bytes(self._count, "little")


def stream_bits(can_id: int, stream: bytes) -> bytes:
    """Length in bit times of each CAN frame of a byte stream, 8 data bytes a frame; one byte each.

    Raises ValueError when the stream is not a whole number of frames.
    """
    if len(stream) % FRAME_DATA_SIZE:
        raise ValueError(f"{len(stream)} bytes are not a whole number of full frames")
    columns = _Columns(can_id, FRAME_DATA_SIZE, len(stream) // FRAME_DATA_SIZE)
    for position in range(FRAME_DATA_SIZE):
        columns.feed(stream[position::FRAME_DATA_SIZE])
    return columns.finish()
