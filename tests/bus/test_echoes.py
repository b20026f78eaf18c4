"""Echoes of own frames: recognised by the back end's flag or by content and order, never by age."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import can
import can.interfaces
import pytest
from hypothesis import given, strategies

from flasher.bus.echoes import (
    DOUBLE_LIMIT_S,
    FLAGGED_SENDER,
    REORDER_FRAMES,
    Echoes,
    Sender,
)
from flasher.protocol.frame import Frame
from tests.loops import each

OWN = Frame(0x752, b"\x01")
ECHO = OWN._replace(is_echo=True)


def numbered(count: int, first: int = 0) -> list[Frame]:
    """Frames with different contents."""
    return [
        Frame(0x752, number.to_bytes(4, "big"), False) for number in range(first, first + count)
    ]


def sent(*frames: Frame, echoes: Echoes | None = None) -> Echoes:
    echoes = echoes or Echoes()
    for frame in frames:
        echoes.sent(frame)
    return echoes


def is_echo(echoes: Echoes, frame: Frame, stamp_s: float = 0.0, *, is_rx: bool = True) -> bool:
    return echoes.mark(frame, stamp_s, is_rx=is_rx).is_echo


# -- by content and order -------------------------------------------------------------------------


@each("read_at_s", [0.0, 0.6, 2.0, 86_400.0])
def test_an_echo_is_one_however_late_it_is_read(read_at_s: float) -> None:
    frames = numbered(36)
    echoes = sent(*frames)
    assert all(is_echo(echoes, frame, read_at_s) for frame in frames)


@each("frame", [Frame(0x752, b"\x02"), Frame(0x751, b"\x01"), Frame(0x752, b"\x01", True)])
def test_a_frame_that_was_not_sent_is_no_echo(frame: Frame) -> None:
    assert not is_echo(sent(OWN), frame)


def test_a_frame_that_comes_before_it_is_sent_is_no_echo() -> None:
    """A second tool that sends the same image and is ahead of us."""
    frames = numbered(3)
    assert not is_echo(sent(*frames[:2]), frames[2])


def test_the_same_frame_sent_again_has_its_own_echo() -> None:
    echoes = Echoes()
    for stamp_s in (1.0, 1.2, 1.4):
        echoes.sent(OWN)
        assert is_echo(echoes, OWN, stamp_s)


def test_a_frame_whose_echo_was_lost_long_ago_in_the_order_is_a_strangers() -> None:
    """A RESET of the beginning does not hide a second tool's in the middle of the transfer."""
    reset, *frames = numbered(66)
    echoes = sent(reset, *frames)
    assert is_echo(echoes, frames[-1])
    assert not is_echo(echoes, reset)


def test_an_echo_may_be_out_of_order_by_some_packets() -> None:
    late, *frames = numbered(65)
    echoes = sent(late, *frames)
    assert is_echo(echoes, frames[-1])
    assert is_echo(echoes, late)


@each("frames_later", [1023, 1024])
def test_frames_without_any_echo_are_forgotten_by_number(frames_later: int) -> None:
    echoes = sent(OWN, *numbered(frames_later))
    assert is_echo(echoes, OWN) == (frames_later == 1023)


@each("later_s", [0.0, DOUBLE_LIMIT_S, DOUBLE_LIMIT_S + 0.001, -0.001, -0.2])
def test_a_second_copy_bears_nearly_the_same_stamp(later_s: float) -> None:
    echoes = sent(OWN)
    assert is_echo(echoes, OWN, 0.0)
    assert is_echo(echoes, OWN, later_s) == (abs(later_s) <= 0.1)


@each("others", [63, 64])
def test_a_second_copy_comes_soon_in_the_order(others: int) -> None:
    """For adapters that stamp nothing, or all alike."""
    frames = numbered(others)
    echoes = sent(OWN, *frames)
    assert all(is_echo(echoes, frame) for frame in (OWN, *frames))
    assert is_echo(echoes, OWN) == (others == 63)


def test_a_second_copy_comes_soon_after_the_latest_of_equal_frames() -> None:
    frames = numbered(100)
    echoes = sent(OWN, *frames[:40], OWN, *frames[40:])
    for number, frame in enumerate((OWN, *frames[:40], OWN, *frames[40:])):
        assert is_echo(echoes, frame, number * 1.0)
    assert is_echo(echoes, OWN, 41.0)


FATE = strategies.tuples(
    strategies.sampled_from([1, 1, 1, 0, 2]),  # copies
    strategies.integers(0, REORDER_FRAMES // 4),  # places later
    strategies.floats(0, 100),  # read later, in seconds
)


@pytest.mark.slow
@given(
    strategies.integers(0, 40).flatmap(
        lambda most: strategies.lists(
            strategies.tuples(strategies.integers(0, most), FATE), max_size=300
        )
    ),
    strategies.integers(1, 80),
)
def test_no_delay_loss_doubling_or_reordering_makes_an_own_frame_a_strangers(
    frames: list[tuple[int, tuple[int, int, float]]], in_flight: int
) -> None:
    """Frames are sent in bursts, and the echoes of a burst are read any time after it. A frame
    that was never sent is a stranger's meanwhile, also between two echoes.
    """
    echoes = Echoes()
    read_at_s = 0.0
    for start in range(0, len(frames), in_flight):
        burst = frames[start : start + in_flight]
        for content, _ in burst:
            echoes.sent(Frame(0x752, bytes([content])))
        places = sorted(
            (place + later, content, copies, delay_s)
            for place, (content, (copies, later, delay_s)) in enumerate(burst)
        )
        for place, content, copies, delay_s in places:
            read_at_s += delay_s
            for copy in range(copies):
                own = Frame(0x752, bytes([content]))
                assert is_echo(echoes, own, place * 1e-3 + copy * DOUBLE_LIMIT_S / 2)
            assert not is_echo(echoes, Frame(0x752, bytes([content, 0])), place * 1e-3)


@pytest.mark.slow
@given(strategies.lists(strategies.integers(0, 3), max_size=60))
def test_never_more_echoes_than_frames_sent_once_second_copies_are_too_late(
    contents: list[int],
) -> None:
    echoes = sent(*(Frame(0x752, bytes([content])) for content in contents))
    seen: Counter[int] = Counter()
    for turn in range(len(contents) + 4):
        for content in range(4):
            seen[content] += is_echo(echoes, Frame(0x752, bytes([content])), turn * 1.0)
    assert all(seen[content] <= contents.count(content) for content in range(4))


# -- by the back end's flag -----------------------------------------------------------------------


def test_where_the_flag_means_this_handle_it_decides() -> None:
    echoes = sent(OWN, echoes=Echoes(Sender.THIS_HANDLE))
    assert not is_echo(echoes, OWN, is_rx=True)
    assert is_echo(echoes, Frame(0x752, b"\x07"), is_rx=False)


def test_what_comes_over_the_wire_is_no_echo_where_the_flag_means_this_computer() -> None:
    echoes = sent(OWN, echoes=Echoes(Sender.THIS_COMPUTER))
    assert not is_echo(echoes, OWN, is_rx=True)
    assert is_echo(echoes, OWN, is_rx=False)
    assert not is_echo(echoes, Frame(0x752, b"\x07"), is_rx=False)


def test_a_socket_that_receives_nothing_of_its_own_has_no_echoes() -> None:
    """A second program on this computer that sends the very same frames."""
    echoes = sent(OWN, echoes=Echoes(Sender.THIS_COMPUTER, gives_own=False))
    assert not is_echo(echoes, OWN, is_rx=False)


def test_what_the_drivers_queue_held_is_an_echo_for_the_handle_that_is_opened_anew() -> None:
    """A kernel's queue keeps the frames, and sends them when the controller has restarted."""
    echoes = sent(OWN, echoes=Echoes(Sender.THIS_COMPUTER, gives_own=False))
    echoes.reopened()
    echoes.reopened()
    assert is_echo(echoes, OWN, 100.0, is_rx=False)
    assert not is_echo(echoes, OWN, 101.0, is_rx=False)


@pytest.mark.slow
def test_every_back_end_of_python_can_that_sets_the_flag_is_in_the_table() -> None:
    """python-can's own source is the referee: one that begins to set `is_rx` has to be judged."""
    packages = {"ics_neovi": "neovi"}
    setting = set()
    folder = Path(can.interfaces.__file__).parent
    for path in folder.rglob("*.py"):
        values = [
            node.value
            for node in ast.walk(ast.parse(path.read_text()))
            if (isinstance(node, ast.keyword) and node.arg == "is_rx")
            or (
                isinstance(node, ast.Assign)
                and isinstance(node.targets[0], ast.Attribute)
                and node.targets[0].attr == "is_rx"
            )
        ]
        if any(not isinstance(value, ast.Constant) for value in values):
            name = path.relative_to(folder).parts[0].removesuffix(".py")
            setting.add(packages.get(name, name))
    assert setting == set(FLAGGED_SENDER)
    assert set(FLAGGED_SENDER) <= can.VALID_INTERFACES
