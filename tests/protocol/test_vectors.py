"""One case table, every complete message of it in both directions and cut in every way (CR-04)."""

from __future__ import annotations

import itertools
import random
from math import inf

from flasher.protocol.wire import Damage, DamageReason, encode, split
from tests.loops import each

from .cases import CASES, Case, feed_all, make_reassembler, pieces

every_case = each("vector", CASES)


def test_the_case_table_holds_all_three_targets_and_enough_messages() -> None:
    assert len(CASES) == 69
    assert {0x751, 0x752, 0x753, 0x715, 0x725, 0x735} <= {found.message.can_id for found in CASES}


@every_case
def test_a_message_is_encoded_byte_for_byte(vector: Case) -> None:
    assert encode(vector.message) == vector.wire


@every_case
def test_a_message_is_split_into_the_frames_of_the_table(vector: Case) -> None:
    frames = split(vector.message.can_id, vector.wire)
    assert [bytes(frame.data) for frame in frames] == vector.payloads
    assert {frame.can_id for frame in frames} == {vector.message.can_id}
    assert all(frame.is_payload for frame in frames)


@every_case
def test_the_frames_of_the_table_are_decoded(vector: Case) -> None:
    reassembler = make_reassembler(vector.message.can_id)
    assert feed_all(reassembler, vector.payloads) == [vector.message]
    assert reassembler.buffered_bytes == 0
    assert reassembler.due_at == inf


@every_case
def test_frames_of_any_one_size_are_decoded_alike(vector: Case) -> None:
    for size_bytes in range(1, 9):
        reassembler = make_reassembler(vector.message.can_id)
        found = feed_all(reassembler, pieces(vector.wire, size_bytes))
        assert found == [vector.message], size_bytes


@every_case
def test_a_message_is_there_with_its_last_byte_and_not_before(vector: Case) -> None:
    reassembler = make_reassembler(vector.message.can_id)
    *early, last = pieces(vector.wire, 1)
    assert feed_all(reassembler, early) == []
    assert reassembler.buffered_bytes == len(vector.wire) - 1
    assert feed_all(reassembler, [last]) == [vector.message]


@every_case
def test_a_message_split_at_random_is_decoded_alike(vector: Case) -> None:
    rng = random.Random(vector.name)
    for _ in range(10):
        reassembler = make_reassembler(vector.message.can_id)
        payloads = []
        rest = vector.wire
        while rest:
            size_bytes = rng.randint(1, 8)
            payloads.append(rest[:size_bytes])
            rest = rest[size_bytes:]
        assert feed_all(reassembler, payloads) == [vector.message]


@every_case
def test_bytes_after_a_message_do_not_touch_it(vector: Case) -> None:
    for trailing in (b"\x00\x00", b"\xff" * 7, b"\xf0", b"\x55", b"\x55\xaa"):
        reassembler = make_reassembler(vector.message.can_id)
        assert feed_all(reassembler, [vector.wire + trailing]) == [vector.message], trailing


@every_case
def test_the_last_frame_may_be_padded_to_eight_bytes(vector: Case) -> None:
    reassembler = make_reassembler(vector.message.can_id)
    padded = [payload.ljust(8, b"\xcc") for payload in vector.payloads]
    found = feed_all(reassembler, padded * 2)
    padding_size = 8 - len(vector.payloads[-1])
    padding = Damage(vector.message.can_id, DamageReason.JUNK, b"\xcc" * padding_size)
    assert found == [vector.message, *([padding] if padding_size else []), vector.message]


@every_case
def test_two_messages_back_to_back_are_both_decoded(vector: Case) -> None:
    for size_bytes in range(1, 9):
        reassembler = make_reassembler(vector.message.can_id)
        found = feed_all(reassembler, pieces(vector.wire * 2, size_bytes))
        assert found == [vector.message] * 2, size_bytes


def test_all_messages_of_one_id_in_a_row_are_decoded_in_order() -> None:
    ordered = sorted(CASES, key=lambda found: found.message.can_id)
    for can_id, group in itertools.groupby(ordered, key=lambda found: found.message.can_id):
        same_id = list(group)
        stream = b"".join(found.wire for found in same_id)
        found = feed_all(make_reassembler(can_id), pieces(stream, 8))
        assert found == [vector.message for vector in same_id]


@every_case
def test_a_message_on_another_id_is_refused_by_its_crc(vector: Case) -> None:
    reassembler = make_reassembler(vector.message.can_id ^ 0x001)
    found = feed_all(reassembler, [vector.wire])
    assert found == [Damage(reassembler.can_id, DamageReason.BAD_CRC, vector.wire)]
