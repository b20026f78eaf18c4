"""Frame lengths in bit times, against a reference that builds every frame bit by bit."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.protocol.bittime import fixed_bits, frame_bits, frame_tables, message_bits, stream_bits
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Ack, Packet
from flasher.protocol.wire import encode, split
from tests.loops import each


def _bits(value: int, width: int) -> list[int]:
    return [value >> shift & 1 for shift in reversed(range(width))]


def _crc15(bits: list[int]) -> list[int]:
    register = [0] * 15
    for bit in bits:
        feedback = bit ^ register[0]
        register = [*register[1:], 0]
        if feedback:
            register = [old ^ tap for old, tap in zip(register, _bits(0x4599, 15), strict=True)]
    return register


def _stuffed(bits: list[int]) -> list[int]:
    out: list[int] = []
    run: list[int] = []
    for bit in bits:
        out.append(bit)
        run = [*run, bit] if run[-1:] == [bit] else [bit]
        if len(run) == 5:
            out.append(1 - bit)
            run = [1 - bit]
    return out


def _reference_bits(can_id: int, data: bytes) -> int:
    start_of_frame, remote, extended, reserved = [0], [0], [0], [0]
    bits = start_of_frame + _bits(can_id, 11) + remote + extended + reserved + _bits(len(data), 4)
    for byte in data:
        bits += _bits(byte, 8)
    crc_delimiter, acknowledge, end_of_frame, interframe_space = 1, 2, 7, 3
    unstuffed = crc_delimiter + acknowledge + end_of_frame + interframe_space
    return len(_stuffed(bits + _crc15(bits))) + unstuffed


_PATHOLOGICAL: Final = [
    *(bytes((fill,)) * size for size in range(9) for fill in (0x00, 0xFF, 0x0F, 0xF0, 0x55, 0xAA)),
    *(bytes((fill,)) * 8 for fill in (0x1F, 0x3E, 0x7C, 0xF8, 0xF1, 0xE3, 0xC7, 0x8F, 0x3C, 0xC3)),
    *(bytes(range(start, start + 8)) for start in range(0, 248, 31)),
]


@each("can_id", [0x000, 0x7FF, 0x0F0, 0x70F, 0x78F, 0x751, 0x725])
def test_pathological_frames_have_the_length_of_the_reference(can_id: int) -> None:
    for data in _PATHOLOGICAL:
        assert frame_bits(Frame(can_id, data)) == _reference_bits(can_id, data), data.hex()


@pytest.mark.slow
def test_random_frames_of_all_ids_and_sizes_have_the_length_of_the_reference() -> None:
    rng = random.Random(2)
    for _ in range(3000):
        can_id, data = rng.randrange(0x800), rng.randbytes(rng.randrange(9))
        assert frame_bits(Frame(can_id, data)) == _reference_bits(can_id, data), (can_id, data)


@pytest.mark.slow
@each("can_id", [0x000, 0x715, 0x752, 0x7FF])
def test_a_stream_has_the_lengths_of_its_frames(can_id: int) -> None:
    full = [data for data in _PATHOLOGICAL if len(data) == 8]
    stream = b"".join(full) + random.Random(3).randbytes(8 * 500)
    lengths = stream_bits(can_id, stream)
    expected = [
        _reference_bits(can_id, stream[start : start + 8]) for start in range(0, len(stream), 8)
    ]
    assert list(lengths) == expected


def test_an_empty_stream_has_no_lengths() -> None:
    assert stream_bits(0x752, b"") == b""


@each("size_bytes", [1, 7, 9, 143])
def test_a_stream_of_broken_frames_is_refused(size_bytes: int) -> None:
    with pytest.raises(ValueError, match=f"{size_bytes} bytes are not a whole number"):
        stream_bits(0x752, bytes(size_bytes))


@each("size_bytes, bits", [(0, 47), (1, 55), (5, 87), (8, 111)])
def test_without_stuffing_a_frame_is_47_bits_and_its_data(size_bytes: int, bits: int) -> None:
    assert fixed_bits(size_bytes) == bits


@each("size_bytes, least, most", [(8, 111, 135), (5, 87, 105)])
def test_a_frame_lies_between_no_stuffing_and_a_stuff_bit_in_four(
    size_bytes: int, least: int, most: int
) -> None:
    rng = random.Random(4)
    lengths = [
        frame_bits(Frame(rng.randrange(0x800), rng.randbytes(size_bytes))) for _ in range(3000)
    ]
    lengths += [frame_bits(Frame(0, data)) for data in _PATHOLOGICAL if len(data) == size_bytes]
    assert least <= min(lengths)
    assert max(lengths) <= most


@each(
    "can_id, data, bits",
    [
        (0x751, "f5a5555555555555", 111),
        (0x752, "9e9ad55555555555", 111),
        (0x753, "dabcd55555555555", 111),
        (0x715, "b793555555555555", 111),
        (0x715, "ec2b555555", 87),
        (0x725, "731b555555", 87),
    ],
)
def test_frames_without_a_stuff_bit_exist_on_the_upgrades_ids(
    can_id: int, data: str, bits: int
) -> None:
    frame = Frame(can_id, bytes.fromhex(data))
    assert frame_bits(frame) == _reference_bits(*frame[:2]) == bits


@each(
    "can_id, data, bits",
    [
        # The bound of a stuff bit in four (135, 105) is out of reach: RTR, IDE, r0 and the size
        # interrupt the alternation. These are the longest frames there are, over all ids and over
        # the upgrade's, found by an exhaustive search over stuffing state and CRC register.
        (0x000, "01e1e1e1e1e1e1e1", 133),
        (0x751, "3e0f0f0f0ffc1e1e", 130),
        (0x752, "1fffc3c3c3c3c3c0", 130),
        (0x725, "3c3c3c3c3df0f0be", 130),
        (0x000, "ff841e1e18", 102),
        (0x715, "f0f0ff83e0", 99),
        (0x725, "f0f0f08010", 99),
    ],
)
def test_the_longest_frames_have_the_length_of_the_reference(
    can_id: int, data: str, bits: int
) -> None:
    frame = Frame(can_id, bytes.fromhex(data))
    assert frame_bits(frame) == _reference_bits(*frame[:2]) == bits


def _mean_bits_of_packet_and_ack(payload: Callable[[], bytes]) -> float:
    count = 600
    total = 0
    for number in range(1, count + 1):
        packet = encode(Packet(number, count, payload()).to_message(0x752))
        ack = encode(Ack(number).to_message(0x725))
        total += message_bits(split(0x752, packet)) + message_bits(split(0x725, ack))
    return total / count


def test_a_packet_of_random_data_and_its_ack_take_about_2255_bits() -> None:
    rng = random.Random(5)
    mean = _mean_bits_of_packet_and_ack(lambda: rng.randbytes(128))
    assert mean == pytest.approx(2255, rel=0.005)


def test_a_packet_of_ff_and_its_ack_take_about_2418_bits() -> None:
    mean = _mean_bits_of_packet_and_ack(lambda: b"\xff" * 128)
    assert mean == pytest.approx(2418, rel=0.005)


def test_a_message_is_as_long_as_its_frames_together() -> None:
    frames = split(0x752, encode(Packet(1, 2, bytes(range(128))).to_message(0x752)))
    assert len(frames) == 18
    assert message_bits(frames) == sum(_reference_bits(*frame[:2]) for frame in frames)
    assert message_bits([]) == 0


def test_eight_mebibytes_take_less_than_two_seconds() -> None:
    stream = random.Random(6).randbytes(8 * 1024 * 1024)
    began_at = time.process_time()
    lengths = stream_bits(0x752, stream)
    took_s = time.process_time() - began_at
    assert took_s < 2.0
    assert len(lengths) == len(stream) // 8
    for frame in (0, 1, 524_287, 1_048_575):
        data = stream[8 * frame : 8 * frame + 8]
        assert lengths[frame] == _reference_bits(0x752, data)


def _bits_by_tables(frame: Frame) -> int:
    """As another language counts them, with nothing but the tables."""
    tables: Any = frame_tables([frame.can_id])
    state, inserted, crc = tables["heads"][frame.can_id][len(frame.data)]
    for byte in frame.data:
        for nibble in (byte >> 4, byte & 15):
            inserted += tables["inserted"][state << 4 | nibble]
            state = tables["next_state"][state << 4 | nibble]
        crc = (crc << 8 & 0x7FFF) ^ tables["crc"][crc >> 7 ^ byte]
    inserted += tables["top_inserted"][state << 3 | crc >> 12]
    state = tables["top_next_state"][state << 3 | crc >> 12]
    for shift in (8, 4, 0):
        inserted += tables["inserted"][state << 4 | crc >> shift & 15]
        state = tables["next_state"][state << 4 | crc >> shift & 15]
    return int(tables["fixed"][len(frame.data)] + inserted + tables["full_run"][state])


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_the_tables_are_all_that_counting_needs(can_id: int, data: bytes) -> None:
    frame = Frame(can_id, data)
    assert _bits_by_tables(frame) == frame_bits(frame)


def test_the_tables_have_a_row_for_each_size_of_a_frame() -> None:
    tables: Any = frame_tables([0x752])
    assert tables["fixed"] == [fixed_bits(size) for size in range(9)]
    assert len(tables["heads"][0x752]) == 9
