"""Messages out, one frame at a time: order, gaps, and when a message has really left (R12)."""

from __future__ import annotations

from math import inf
from typing import Final

import pytest

from flasher.protocol.bittime import frame_bits, message_bits
from flasher.protocol.engine import Transmitter
from flasher.protocol.frame import Frame

_BITRATE_BPS: Final = 250_000
_FIRST: Final = [Frame(0x752, bytes((1, index)) * 4) for index in range(3)]
_SECOND: Final = [Frame(0x752, bytes((2, index)) * 4) for index in range(2)]
_THIRD: Final = [Frame(0x752, b"\x03")]


def _wire_s(frames: list[Frame]) -> float:
    return message_bits(frames) / _BITRATE_BPS


def _send_all(transmitter: Transmitter, now: float) -> list[Frame]:
    """Send what can be sent at `now`, all at this one moment."""
    sent = []
    while (frame := transmitter.next_frame(now)) is not None:
        sent.append(frame)
        transmitter.frame_sent(now)
    return sent


def _send_at_bus_pace(transmitter: Transmitter, now: float) -> tuple[list[Frame], float]:
    """Send frame after frame, each accepted when the one before it is gone; with the end's time."""
    sent = []
    while (frame := transmitter.next_frame(now)) is not None:
        sent.append(frame)
        transmitter.frame_sent(now)
        now += frame_bits(frame) / _BITRATE_BPS
    return sent, now


def test_with_nothing_to_send_it_is_idle() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    assert transmitter.idle
    assert transmitter.due_at == inf
    assert transmitter.next_frame(1e9) is None
    assert transmitter.left_at == float("-inf")


def test_messages_leave_whole_and_in_the_order_in_which_they_were_queued() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    for message in (_FIRST, _SECOND, _THIRD):
        transmitter.queue(message)
    assert transmitter.due_at == 0.0
    assert _send_all(transmitter, 0.0) == [*_FIRST, *_SECOND, *_THIRD]
    assert transmitter.idle
    assert transmitter.next_frame(0.0) is None


def test_a_message_queued_in_the_midst_of_another_waits_for_its_end() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.frame_sent(0.0)
    transmitter.queue(_SECOND)
    assert _send_all(transmitter, 0.0) == [*_FIRST[1:], *_SECOND]


def test_the_same_frame_is_given_until_it_was_sent() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    assert [transmitter.next_frame(now) for now in (0.0, 0.0, 5.0)] == [_FIRST[0]] * 3
    transmitter.frame_sent(5.0)
    assert [transmitter.next_frame(now) for now in (5.0, 6.0)] == [_FIRST[1]] * 2


def test_it_reports_when_the_last_frame_of_a_message_was_accepted() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.queue(_THIRD)
    assert [transmitter.frame_sent(0.0) for _ in range(4)] == [False, False, True, True]


def test_a_message_is_begun_from_its_first_frame_to_its_last() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    begun = [transmitter.begun]
    for _ in _FIRST:
        transmitter.frame_sent(0.0)
        begun.append(transmitter.begun)
    assert begun == [False, True, True, False]


def test_a_frame_that_leaves_after_its_message_was_given_up_ends_no_message() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_THIRD)
    transmitter.abandon(0.0)
    assert not transmitter.frame_sent(0.0)
    assert transmitter.left_at == float("-inf")


def test_the_tag_of_the_message_that_has_left_is_known_with_its_last_frame() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_SECOND, tag="second")
    transmitter.queue(_THIRD)
    tags = [transmitter.left_tag]
    for _ in range(3):
        transmitter.frame_sent(0.0)
        tags.append(transmitter.left_tag)
    assert tags == [None, None, "second", None]


# -- waiting ----------------------------------------------------------------------------------


def test_a_frame_gap_keeps_the_frames_of_one_message_apart() -> None:
    transmitter = Transmitter(_BITRATE_BPS, frame_gap_s=0.002)
    transmitter.queue(_FIRST)
    assert _send_all(transmitter, 1.0) == _FIRST[:1]
    assert transmitter.due_at == pytest.approx(1.002)
    assert transmitter.next_frame(1.0019) is None
    assert _send_all(transmitter, 1.002) == _FIRST[1:2]
    assert _send_all(transmitter, 1.5) == _FIRST[2:]
    assert transmitter.idle


def test_a_frame_gap_does_not_part_messages() -> None:
    transmitter = Transmitter(_BITRATE_BPS, frame_gap_s=0.002)
    transmitter.queue(_THIRD)
    transmitter.queue(_SECOND)
    assert _send_all(transmitter, 1.0) == [*_THIRD, _SECOND[0]]


def test_a_message_does_not_start_before_its_time() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST, not_before=2.0)
    assert transmitter.due_at == 2.0
    assert transmitter.next_frame(1.999) is None
    assert _send_all(transmitter, 2.0) == _FIRST


def test_the_time_of_a_later_message_does_not_hold_up_the_one_before() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.queue(_SECOND, not_before=2.0)
    assert _send_all(transmitter, 0.0) == _FIRST
    assert transmitter.due_at == 2.0
    assert not transmitter.idle
    assert _send_all(transmitter, 1.9) == []
    assert _send_all(transmitter, 2.0) == _SECOND


def test_the_time_of_an_earlier_message_does_not_hold_up_the_one_after() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST, not_before=2.0)
    assert _send_all(transmitter, 2.0) == _FIRST
    transmitter.queue(_SECOND)
    assert _send_all(transmitter, 2.0) == _SECOND


# -- giving up --------------------------------------------------------------------------------


def test_dropping_forgets_all_that_no_frame_was_sent_of() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST, not_before=9.0)
    transmitter.queue(_SECOND)
    transmitter.drop_unstarted()
    assert transmitter.idle
    assert transmitter.due_at == inf
    transmitter.queue(_THIRD)
    assert _send_all(transmitter, 0.0) == _THIRD


def test_dropping_lets_a_message_that_was_begun_be_finished() -> None:
    transmitter = Transmitter(_BITRATE_BPS, frame_gap_s=0.001)
    transmitter.queue(_FIRST)
    transmitter.queue(_SECOND)
    assert _send_all(transmitter, 0.0) == _FIRST[:1]
    transmitter.drop_unstarted()
    assert not transmitter.idle
    assert _send_all(transmitter, 0.1) == _FIRST[1:2]
    assert _send_all(transmitter, 0.2) == _FIRST[2:]
    assert transmitter.idle


def test_what_follows_a_message_that_was_given_up_waits_until_its_receiver_has_dropped_it() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.frame_sent(1.0)
    transmitter.abandon(1.15)
    assert transmitter.idle
    assert not transmitter.begun
    assert transmitter.next_frame(9.0) is None
    transmitter.queue(_SECOND)
    assert transmitter.due_at == 1.15
    assert _send_all(transmitter, 1.15) == _SECOND


def test_the_rest_of_the_last_message_is_hurried_on_without_gaps() -> None:
    transmitter = Transmitter(_BITRATE_BPS, frame_gap_s=0.01)
    transmitter.queue(_FIRST)
    assert _send_all(transmitter, 1.0) == _FIRST[:1]
    transmitter.send_without_gaps()
    assert transmitter.due_at == 0.0
    assert _send_all(transmitter, 1.0) == _FIRST[1:]


def test_a_message_that_has_not_begun_is_not_hurried_before_its_time() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST, not_before=2.0)
    transmitter.send_without_gaps()
    assert transmitter.due_at == 2.0


def test_dropping_nothing_is_allowed() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.drop_unstarted()
    assert transmitter.idle


# -- when it has left -------------------------------------------------------------------------


def test_from_an_adapter_that_takes_all_frames_at_once_a_message_leaves_after_its_wire_time() -> (
    None
):
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    _send_all(transmitter, 10.0)
    assert transmitter.left_at == pytest.approx(10.0 + _wire_s(_FIRST))


def test_to_an_adapter_at_bus_pace_a_message_leaves_with_its_last_frame() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    _, ended_at = _send_at_bus_pace(transmitter, 10.0)
    assert transmitter.left_at == pytest.approx(ended_at)


def test_a_slow_adapter_moves_the_end_to_its_last_frame() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    for now in (10.0, 10.1, 10.2):
        transmitter.frame_sent(now)
    assert transmitter.left_at == pytest.approx(10.2 + _wire_s(_FIRST[-1:]))


def test_a_message_taken_while_the_one_before_is_on_the_wire_leaves_after_both() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.queue(_SECOND)
    _send_all(transmitter, 10.0)
    assert transmitter.left_at == pytest.approx(10.0 + _wire_s(_FIRST) + _wire_s(_SECOND))


def test_a_wire_time_that_the_caller_knows_is_taken_as_given() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST, wire_s=0.25)
    _send_all(transmitter, 1.0)
    assert transmitter.left_at == pytest.approx(1.25)


def test_half_a_message_has_not_left() -> None:
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    transmitter.frame_sent(10.0)
    assert transmitter.left_at == float("-inf")


def test_a_message_has_left_at_the_latest_when_its_answer_comes() -> None:
    """A bus in one computer is faster than the bit rate says."""
    transmitter = Transmitter(_BITRATE_BPS)
    transmitter.queue(_FIRST)
    _send_all(transmitter, 10.0)
    transmitter.limit_left_at(10.0001)
    assert transmitter.left_at == 10.0001
    transmitter.limit_left_at(11.0)
    assert transmitter.left_at == 10.0001


def test_at_half_the_bit_rate_a_message_takes_twice_as_long() -> None:
    transmitter = Transmitter(125_000)
    transmitter.queue(_FIRST)
    _send_all(transmitter, 0.0)
    assert transmitter.left_at == pytest.approx(2 * _wire_s(_FIRST))


@pytest.mark.parametrize(("pause_s", "is_sent_anew"), [(0.1, False), (0.101, True), (60.0, True)])
def test_a_message_that_its_receiver_has_dropped_meanwhile_is_sent_anew_after_a_silence(
    pause_s: float, is_sent_anew: bool
) -> None:
    """The computer paused between two frames (R12)."""
    transmitter = Transmitter(_BITRATE_BPS, dropped_after_s=0.1)
    dropped: list[bool] = []
    transmitter.on_message_dropped = lambda: dropped.append(True)
    transmitter.queue(_FIRST)
    assert transmitter.next_frame(0.0) == _FIRST[0]
    transmitter.frame_sent(0.0)
    assert (transmitter.next_frame(pause_s) is None) is is_sent_anew
    assert dropped == [True] * is_sent_anew
    if not is_sent_anew:
        assert _send_all(transmitter, pause_s) == _FIRST[1:]
        return
    assert transmitter.next_frame(pause_s) is None
    assert not transmitter.begun
    silent_until = transmitter.due_at
    assert silent_until == pytest.approx(pause_s + 0.15)
    assert _send_all(transmitter, silent_until) == _FIRST
    assert transmitter.idle


def test_the_message_after_one_that_was_sent_anew_follows_it() -> None:
    transmitter = Transmitter(_BITRATE_BPS, dropped_after_s=0.1)
    transmitter.queue(_FIRST)
    transmitter.queue(_SECOND)
    transmitter.frame_sent(0.0)
    assert transmitter.next_frame(1.0) is None
    assert _send_all(transmitter, 2.0) == [*_FIRST, *_SECOND]
