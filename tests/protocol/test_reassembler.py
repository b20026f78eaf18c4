"""Damage on the wire: each kind is named, and the next intact message is found (FR, CR)."""

from __future__ import annotations

from math import inf
from typing import Final

import pytest

from flasher.protocol.wire import Damage, DamageReason, Message, encode
from tests.loops import each

from .cases import (
    INTER_FRAME_TIMEOUT_S,
    case,
    feed_all,
    make_reassembler,
    messages_of,
    pieces,
    reasons_of,
)

_ID: Final = 0x752
_RESET: Final = case("bms reset")
_PACKET: Final = case("bms packet 300/613")
_END: Final = case("bms end of transfer")


def _packet(payload: bytes) -> Message:
    """Packet 1 of 1 with these first bytes; payload byte 5 is the first of the third frame."""
    return Message(_ID, 0x16, 0xA385, b"\x01\x01\x00\x01\x00" + payload.ljust(128, b"\x00"))


# -- before and between messages --------------------------------------------------------------


@each(
    "junk",
    [b"\x00", b"\x01\x02\x03", b"\x55", b"\x55\x55", b"\xaa", b"\xf0" * 8, b"\x55\x00\xaa" * 5],
)
@each("size_bytes", range(1, 9))
def test_junk_before_a_header_is_reported_and_skipped(junk: bytes, size_bytes: int) -> None:
    found = feed_all(make_reassembler(_ID), pieces(junk + _RESET.wire, size_bytes))
    assert found == [Damage(_ID, DamageReason.JUNK, junk), _RESET.message]


def test_a_lone_55_at_the_end_of_a_frame_is_not_half_a_header_of_the_next_message() -> None:
    found = feed_all(make_reassembler(_ID), [b"\x01\x02\x55", *_RESET.payloads])
    assert found == [Damage(_ID, DamageReason.JUNK, b"\x01\x02\x55"), _RESET.message]


def test_a_lone_header_before_a_message_is_reported_as_a_bad_length() -> None:
    # 55 AA 55 AA: the length of the first would be AA, its command's second byte does not fit.
    found = feed_all(make_reassembler(_ID), [b"\x55\xaa", *_RESET.payloads])
    assert reasons_of(found) == [DamageReason.BAD_LENGTH]
    assert messages_of(found) == [_RESET.message]


def test_a_frame_without_bytes_changes_nothing() -> None:
    reassembler = make_reassembler(_ID)
    interleaved = [part for payload in _RESET.payloads for part in (b"", payload, b"")]
    assert feed_all(reassembler, interleaved) == [_RESET.message]
    assert reassembler.due_at == inf


# -- header and tail inside data (FR-03) ------------------------------------------------------


@each("position", range(128))
def test_a_header_inside_data_starts_nothing(position: int) -> None:
    message = _packet(bytes(position) + b"\x55\xaa")
    if position == 127:
        message = _packet(bytes(127) + b"\x55")
    wire = encode(message)
    assert feed_all(make_reassembler(_ID), pieces(wire * 2, 8)) == [message] * 2


def test_a_tail_at_every_place_in_data_ends_nothing() -> None:
    message = _packet(b"\xf0" * 128)
    assert feed_all(make_reassembler(_ID), pieces(encode(message), 8)) == [message]


@each("position", [0, 4, 5, 13, 60])
def test_a_whole_message_inside_data_is_data(position: int) -> None:
    message = _packet(bytes(position) + _END.wire)
    assert feed_all(make_reassembler(_ID), pieces(encode(message), 8)) == [message]


def test_headers_with_a_fitting_length_inside_a_damaged_packet_do_not_hide_what_follows() -> None:
    # Each false header claims a whole packet, so it is judged only when that many bytes are there.
    damaged = bytearray(encode(_packet(bytes.fromhex("55 AA 16 87 A3 85 01 00") * 16)))
    damaged[-2] ^= 0x01
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, pieces(bytes(damaged) + _RESET.wire + _END.wire, 8))
    found += reassembler.tick(INTER_FRAME_TIMEOUT_S)
    assert messages_of(found) == [_RESET.message, _END.message]
    assert DamageReason.BAD_CRC in reasons_of(found)
    assert reassembler.buffered_bytes == 0


# -- damaged fields ---------------------------------------------------------------------------


def test_a_wrong_crc_is_reported_with_the_whole_message() -> None:
    damaged = bytearray(_PACKET.wire)
    damaged[-3] ^= 0x10
    found = feed_all(make_reassembler(_ID), pieces(bytes(damaged) + _RESET.wire, 8))
    assert found == [Damage(_ID, DamageReason.BAD_CRC, bytes(damaged)), _RESET.message]


def test_junk_before_a_damaged_message_is_reported_apart_from_it_and_before_it() -> None:
    damaged = bytearray(_RESET.wire)
    damaged[-3] ^= 0x10
    found = feed_all(make_reassembler(_ID), pieces(b"\x01\x02\x03" + bytes(damaged), 8))
    assert found == [
        Damage(_ID, DamageReason.JUNK, b"\x01\x02\x03"),
        Damage(_ID, DamageReason.BAD_CRC, bytes(damaged)),
    ]


def test_a_wrong_tail_is_reported_with_the_whole_message() -> None:
    damaged = _PACKET.wire[:-1] + b"\xf1"
    found = feed_all(make_reassembler(_ID), pieces(damaged + _RESET.wire, 8))
    assert found == [Damage(_ID, DamageReason.BAD_TAIL, damaged), _RESET.message]


def test_after_a_wrong_tail_the_rest_is_scanned_again() -> None:
    # FR-04: the message that a damaged length swallowed is still found.
    swallowed = b"\x55\xaa\x16\x0b\x42\x09" + _END.wire
    found = feed_all(make_reassembler(_ID), pieces(swallowed + bytes(8), 8))
    assert reasons_of(found)[0] is DamageReason.BAD_TAIL
    assert messages_of(found) == [_END.message]


@each(
    "head",
    [
        "55 AA 16 00 42 05",
        "55 AA 16 00 42 FE",
        "55 AA 16 01 42 05",
        "55 AA 16 01 42 FF",
        "55 AA 16 06 42 05",
        "55 AA 16 08 42 05",
        "55 AA 16 FF 77 05",
        "55 AA 16 FF 77 FF",
        "55 AA 16 02 42 05",
    ],
)
def test_a_length_that_does_not_fit_the_command_is_refused_at_once(head: str) -> None:
    damaged = bytes.fromhex(head)
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, [damaged]) == [Damage(_ID, DamageReason.BAD_LENGTH, damaged)]
    assert feed_all(reassembler, _RESET.payloads) == [_RESET.message]


def test_a_length_of_255_with_an_unknown_command_waits_for_no_more_than_264_bytes() -> None:
    head = bytes.fromhex("55 AA 16 FF 77 FD")
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, pieces(head + bytes(257), 8)) == []
    assert reassembler.buffered_bytes == 263
    found = feed_all(reassembler, [b"\xf0"])
    assert found == [Damage(_ID, DamageReason.BAD_CRC, head + bytes(257) + b"\xf0")]
    found = feed_all(reassembler, _RESET.payloads)
    assert messages_of(found) == [_RESET.message]


def test_an_intact_message_with_an_unknown_mode_and_command_is_handed_on() -> None:
    # FR-10: what to do with it is not for the reassembler to say.
    message = Message(_ID, 0x99, 0x7701, b"\x00")
    assert feed_all(make_reassembler(_ID), pieces(encode(message), 8)) == [message]


# -- lost, doubled and swapped frames ---------------------------------------------------------


@each("lost", range(18))
def test_after_a_lost_frame_the_next_message_is_found(lost: int) -> None:
    payloads = [*_PACKET.payloads[:lost], *_PACKET.payloads[lost + 1 :]]
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, payloads)
    found += reassembler.tick(INTER_FRAME_TIMEOUT_S)
    assert messages_of(found) == []
    assert reasons_of(found)
    assert feed_all(reassembler, _PACKET.payloads, now=1.0) == [_PACKET.message]


@each("lost", range(18))
def test_after_a_lost_frame_the_next_message_is_found_without_silence_too(lost: int) -> None:
    payloads = [*_PACKET.payloads[:lost], *_PACKET.payloads[lost + 1 :], *_RESET.payloads]
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, payloads)
    found += reassembler.tick(INTER_FRAME_TIMEOUT_S)
    assert messages_of(found) == [_RESET.message]
    assert reasons_of(found)


@each("doubled", range(18))
def test_a_packet_with_a_doubled_frame_is_not_accepted(doubled: int) -> None:
    payloads = [*_PACKET.payloads[: doubled + 1], *_PACKET.payloads[doubled:]]
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, [*payloads, *_RESET.payloads])
    found += reassembler.tick(INTER_FRAME_TIMEOUT_S)
    intact_too = [_PACKET.message] if doubled in {0, 17} else []
    assert messages_of(found) == [*intact_too, _RESET.message]
    assert reasons_of(found)


@each("swapped", range(17))
def test_a_packet_with_two_swapped_frames_is_not_accepted(swapped: int) -> None:
    payloads = list(_PACKET.payloads)
    payloads[swapped : swapped + 2] = reversed(payloads[swapped : swapped + 2])
    reassembler = make_reassembler(_ID)
    found = feed_all(reassembler, [*payloads, *_RESET.payloads])
    found += reassembler.tick(INTER_FRAME_TIMEOUT_S)
    assert messages_of(found) == [_RESET.message]
    assert reasons_of(found)


# -- time (R12) -------------------------------------------------------------------------------


def test_a_partial_message_waits_until_just_before_the_timeout() -> None:
    reassembler = make_reassembler(_ID)
    reassembler.feed(_RESET.payloads[0], 5.0)
    assert reassembler.due_at == pytest.approx(5.1)
    assert list(reassembler.tick(5.0999)) == []
    assert list(reassembler.feed(_RESET.payloads[1], 5.0999)) == [_RESET.message]


@each("late_s", [0.0, 0.0001, 1000.0])
def test_a_partial_message_is_dropped_at_the_timeout_and_after(late_s: float) -> None:
    reassembler = make_reassembler(_ID)
    reassembler.feed(_RESET.payloads[0], 5.0)
    deadline = reassembler.due_at
    assert deadline < inf
    found = list(reassembler.tick(deadline + late_s))
    assert found == [Damage(_ID, DamageReason.INCOMPLETE, _RESET.payloads[0])]
    assert reassembler.buffered_bytes == 0
    assert reassembler.due_at == inf
    assert feed_all(reassembler, _RESET.payloads, now=6.0) == [_RESET.message]


def test_every_frame_starts_the_wait_anew() -> None:
    reassembler = make_reassembler(_ID)
    found: list[Message | Damage] = []
    for index, payload in enumerate(_PACKET.payloads):
        found += reassembler.tick(0.09 * index)
        found += reassembler.feed(payload, 0.09 * index)
    assert found == [_PACKET.message]


def test_frames_that_waited_while_the_computer_was_busy_are_not_late() -> None:
    reassembler = make_reassembler(_ID)
    reassembler.feed(_RESET.payloads[0], 0.0)
    assert list(reassembler.feed(_RESET.payloads[1], 60.0)) == [_RESET.message]


def test_a_message_after_a_partial_one_is_found_at_the_timeout() -> None:
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, [*_PACKET.payloads[:3], *_RESET.payloads]) == []
    found = list(reassembler.tick(INTER_FRAME_TIMEOUT_S))
    assert reasons_of(found) == [DamageReason.INCOMPLETE]
    assert messages_of(found) == [_RESET.message]


@each("junk", [b"\x01", b"\x55", b"\x01\x02\x03", b"\x55\xaa", b"\x00" * 20])
def test_junk_is_reported_after_silence_at_the_latest(junk: bytes) -> None:
    reassembler = make_reassembler(_ID)
    assert feed_all(reassembler, [junk]) == []
    found = list(reassembler.tick(INTER_FRAME_TIMEOUT_S))
    assert found == [Damage(_ID, DamageReason.JUNK, junk)]
    assert reassembler.due_at == inf


def test_without_anything_held_there_is_nothing_to_wait_for() -> None:
    reassembler = make_reassembler(_ID)
    assert reassembler.due_at == inf
    assert list(reassembler.tick(1e9)) == []


def test_a_lone_header_dropped_by_silence_leaves_no_trace() -> None:
    reassembler = make_reassembler(_ID)
    feed_all(reassembler, [b"\x55\xaa"])
    reassembler.tick(INTER_FRAME_TIMEOUT_S)
    feed_all(reassembler, [b"\x01\x02\x03"], now=1.0)
    found = list(reassembler.tick(1.0 + INTER_FRAME_TIMEOUT_S))
    assert found == [Damage(_ID, DamageReason.JUNK, b"\x01\x02\x03")]


# -- forgetting -------------------------------------------------------------------------------


def test_reset_forgets_what_was_held() -> None:
    reassembler = make_reassembler(_ID)
    feed_all(reassembler, [b"\x01\x02", *_PACKET.payloads[:5]])
    reassembler.reset()
    assert reassembler.buffered_bytes == 0
    assert reassembler.due_at == inf


def test_the_first_message_after_a_reset_in_the_midst_of_a_packet_is_found() -> None:
    reassembler = make_reassembler(_ID)
    feed_all(reassembler, _PACKET.payloads[:5])
    reassembler.reset()
    assert feed_all(reassembler, _RESET.payloads) == [_RESET.message]
