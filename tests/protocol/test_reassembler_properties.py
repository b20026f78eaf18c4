"""What holds for any bytes in any split: nothing raises, nothing grows, nothing intact is lost."""

from __future__ import annotations

import itertools
import random
from typing import Final

from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.protocol.wire import Damage, DamageReason, Message, encode
from tests.loops import each

from .cases import HELD_MAX, case, feed_all, make_reassembler, messages_of, pieces

_ID: Final = 0x725
_ACK: Final = case("bms ACK 1")
_PACKET: Final = case("bms packet 1/613")


@st.composite
def _messages(draw: st.DrawFn) -> Message:
    data = draw(st.one_of(st.binary(max_size=40), st.binary(min_size=120, max_size=253)))
    serial = draw(st.integers(0, 255))
    return Message(_ID, draw(st.integers(0, 255)), serial << 8 | len(data), data)


# Bytes that look like the protocol's own are what misleads a reassembler.
_TRICKY: Final = st.lists(
    st.one_of(
        st.binary(min_size=1, max_size=8),
        st.sampled_from(
            [
                b"\x55",
                b"\x55\xaa",
                b"\x55\x55\xaa",
                b"\x55\xaa\x0c\x04\xc2\x02",
                b"\x55\xaa\x16\xff\x77\xfd",
                b"\x55\xaa\x16\x87\xa3\x85",
                b"\x55\xaa\x11\x02\x33\x00",
                b"\xf0",
                _ACK.wire,
                _ACK.wire[:-1],
                _PACKET.wire[:50],
            ]
        ),
    ),
    max_size=40,
).map(b"".join)


def _split(wire: bytes, sizes: list[int]) -> list[bytes]:
    """`wire` in pieces of these sizes, again and again."""
    payloads = []
    for size_bytes in itertools.cycle(sizes):
        if not wire:
            break
        payloads.append(wire[:size_bytes])
        wire = wire[size_bytes:]
    return payloads


_SIZES: Final = st.lists(st.integers(1, 8), min_size=1, max_size=10)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(messages=st.lists(_messages(), max_size=5), sizes=_SIZES)
def test_valid_messages_in_any_split_come_back_as_they_were(
    messages: list[Message], sizes: list[int]
) -> None:
    stream = b"".join(encode(message) for message in messages)
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, _split(stream, sizes)) == messages
    assert reassembler.buffered_bytes == 0


@settings(max_examples=150, deadline=None, derandomize=True)
@given(noise=_TRICKY, sizes=_SIZES)
def test_after_any_noise_and_silence_the_next_message_is_found(
    noise: bytes, sizes: list[int]
) -> None:
    reassembler = make_reassembler(_ID)
    feed_all(reassembler, _split(noise, sizes))
    reassembler.tick(0.101)
    assert reassembler.buffered_bytes == 0
    assert feed_all(reassembler, _ACK.payloads, now=0.2) == [_ACK.message]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(noise=_TRICKY, sizes=_SIZES)
def test_a_message_straight_after_any_noise_is_found_by_the_silence_after_it(
    noise: bytes, sizes: list[int]
) -> None:
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, [*_split(noise, sizes), *_ACK.payloads])
    found += reassembler.tick(0.101)
    assert messages_of(found)[-1:] == [_ACK.message]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(noise=_TRICKY, sizes=_SIZES)
def test_what_is_decoded_does_not_depend_on_the_split(noise: bytes, sizes: list[int]) -> None:
    results = []
    for payloads in (_split(noise, sizes), pieces(noise, 1), pieces(noise, 8)):
        reassembler = make_reassembler(_ID)
        found = feed_all(reassembler, payloads)
        found += reassembler.tick(0.1)
        results.append(messages_of(found))
    assert results[0] == results[1] == results[2]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(noise=_TRICKY.filter(bool), sizes=_SIZES)
def test_no_noise_goes_by_without_a_message_or_a_report(noise: bytes, sizes: list[int]) -> None:
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, _split(noise, sizes))
    found += reassembler.tick(0.1)
    assert found
    assert all(item.data for item in found if isinstance(item, Damage))
    assert all(item.can_id == _ID for item in found)


@each(
    "pattern",
    [
        b"\x00",
        b"\x55",
        b"\xaa",
        b"\x55\xaa",
        b"\x55\x55\xaa",
        b"\x55\xaa\x16\xff\x77\xfd",
        b"\x55\xaa\x16\x87\xa3\x85",
        b"\x55\xaa\x0c\x04\xc2\x02\xf0",
    ],
)
@each("size_bytes", [1, 3, 7, 8])
def test_endless_bytes_of_no_use_do_not_fill_the_memory(pattern: bytes, size_bytes: int) -> None:
    # SE-01, without any silence.
    reassembler = make_reassembler(_ID)
    reported = 0
    for payload in pieces((pattern * 3000)[:3000], size_bytes):
        reported += len(reassembler.feed(payload, 0.0))
        assert reassembler.buffered_bytes <= HELD_MAX
    assert reported


def test_endless_random_bytes_do_not_fill_the_memory() -> None:
    rng = random.Random(7)
    reassembler = make_reassembler(_ID)
    for _ in range(3000):
        reassembler.feed(
            rng.choice([rng.randbytes(8), b"\x55\xaa", b"\x55\xaa\x0c\xff\xc2\xfd"]), 0
        )
        assert reassembler.buffered_bytes <= HELD_MAX


# -- what the checksum catches (CR-01, CR-02, CR-03) ------------------------------------------


def _accepted(can_id: int, wire: bytes) -> list[Message]:
    reassembler = make_reassembler(can_id)
    found = feed_all(reassembler, [wire])
    found += reassembler.tick(0.1)
    return messages_of(found)


def test_no_packet_with_a_single_flipped_bit_is_accepted() -> None:
    accepted = []
    for bit in range(8 * len(_PACKET.wire)):
        damaged = bytearray(_PACKET.wire)
        damaged[bit // 8] ^= 0x80 >> bit % 8
        accepted += _accepted(_PACKET.message.can_id, bytes(damaged))
    assert accepted == []


def test_no_packet_with_a_burst_within_eight_bits_is_accepted() -> None:
    rng = random.Random(8)
    size_bits = 8 * len(_PACKET.wire)
    intact = int.from_bytes(_PACKET.wire, "big")
    for _ in range(3000):
        burst = rng.randrange(1, 256) << rng.randrange(size_bits - 7)
        damaged = (intact ^ burst).to_bytes(len(_PACKET.wire), "big")
        assert _accepted(_PACKET.message.can_id, damaged) == [], damaged.hex()


def test_no_two_frames_of_a_packet_may_change_places() -> None:
    for first, second in itertools.combinations(range(18), 2):
        payloads = list(_PACKET.payloads)
        payloads[first], payloads[second] = payloads[second], payloads[first]
        assert _accepted(_PACKET.message.can_id, b"".join(payloads)) == []


def test_a_crc_for_another_id_or_in_the_other_order_is_refused() -> None:
    ack = _ACK.wire
    other_id = bytes.fromhex("55 AA 0C 04 C2 02 01 00 32 BC 87 EE F0")
    little_endian = ack[:-5] + ack[-5:-1][::-1] + ack[-1:]
    assert other_id == case("wmc ACK 1").wire
    assert _accepted(_ID, ack) == [_ACK.message]
    assert _accepted(_ID, other_id) == []
    assert _accepted(_ID, little_endian) == []


def test_a_crc_that_leaves_out_the_id_is_refused() -> None:
    # The CRC over 55 AA 0C 04 C2 02 01 00 alone is 808928A9.
    without_id = bytes.fromhex("55 AA 0C 04 C2 02 01 00 80 89 28 A9 F0")
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, [without_id]) == [Damage(_ID, DamageReason.BAD_CRC, without_id)]
