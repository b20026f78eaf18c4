"""Watching a bus: nothing is sent, filters, limits, changes and rates."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.protocol.frame import Frame
from flasher.trace.decoder import BusEvent, Kind
from flasher.trace.watcher import (
    Filter,
    MessageHistory,
    MessageTable,
    Pulse,
    TimedFrame,
    Watcher,
    replay,
)
from tests.loops import each
from tests.trace import traffic


def at(moment: float, frames: Iterable[Frame]) -> list[tuple[float, Frame]]:
    return [(moment, frame) for frame in frames]


def replayed(watcher: Watcher, frames: Iterable[tuple[float, Frame]]) -> list[object]:
    events: list[object] = []
    replay(watcher, frames, events.append)
    return events


def titles(events: Iterable[object]) -> list[str]:
    return [event.title for event in events if isinstance(event, BusEvent)]


MIXED = [
    *at(0.0, traffic.running()),
    *at(0.1, traffic.handshake()),
    *at(0.2, traffic.reset("wmc")),
    *at(0.3, traffic.nak("bms")),
    *at(0.4, [Frame(0x123, b"abc")]),
]


@each(
    "shown, expected",
    [
        (Filter(), ["running information", "handshake", "reset", "NAK", "foreign frame"]),
        (Filter(nodes=frozenset({"WMC"})), ["handshake", "reset"]),
        (Filter(nodes=frozenset({"WMC", "CDL"})), ["handshake", "reset", "NAK"]),
        (Filter(words=("INFORMATION",)), ["running information"]),
        (Filter(words=("nak", "hand")), ["handshake", "NAK"]),
        (Filter(trouble_only=True), ["NAK"]),
        (Filter(nodes=frozenset({"WMC"}), trouble_only=True), []),
    ],
)
def test_filters_let_through_what_they_name(shown: Filter, expected: list[str]) -> None:
    assert titles(replayed(Watcher(shown), MIXED)) == expected


def test_it_ends_after_the_number_of_things_shown() -> None:
    watcher = Watcher(Filter(nodes=frozenset({"WMC"})), count=1)
    assert titles(replayed(watcher, MIXED)) == ["handshake"]
    assert watcher.done


def test_it_ends_after_its_time() -> None:
    watcher = Watcher(duration_s=0.25)
    assert titles(replayed(watcher, MIXED)) == ["running information", "handshake", "reset"]
    assert watcher.done


def test_raw_frames_come_before_their_message() -> None:
    events = replayed(Watcher(raw=True), at(0.0, traffic.reset()))
    assert [type(event) for event in events] == [TimedFrame, TimedFrame, BusEvent]


def test_a_message_that_a_trace_cuts_short_is_reported_at_its_end() -> None:
    events = replayed(Watcher(), at(5.0, traffic.running()[:2]))
    assert [event.kind for event in events if isinstance(event, BusEvent)] == [Kind.DAMAGED]


def test_a_late_frame_does_not_complete_a_message() -> None:
    first, *rest = traffic.handshake()
    events = replayed(Watcher(), [*at(0.0, [first]), *at(10.0, rest)])
    kinds = [event.kind for event in events if isinstance(event, BusEvent)]
    assert kinds == [Kind.DAMAGED, Kind.DAMAGED]


def test_times_that_run_backwards_stand_still() -> None:
    events = replayed(Watcher(), [*at(9.0, traffic.reset()), *at(3.0, traffic.handshake())])
    assert [event.at for event in events if isinstance(event, BusEvent)] == [9.0, 9.0]


def test_years_between_two_frames_take_no_time() -> None:
    events = replayed(Watcher(), [*at(0.0, traffic.reset()), *at(1.8e9, traffic.handshake())])
    assert titles(events) == ["reset", "handshake"]


def test_a_replay_ends_when_the_user_wants_it() -> None:
    events: list[object] = []
    replay(Watcher(), MIXED, events.append, cancelled=lambda: bool(events))
    assert titles(events) == ["running information"]


def test_on_a_live_bus_it_sends_nothing_and_pulses() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(250_000, clock)
    talker, ear = bus.link(), bus.link()
    for frame in traffic.running():
        talker.send(frame)
    events: list[object] = []
    watcher = Watcher(duration_s=1.0, pulse_s=0.25)
    drive(watcher, ear, clock, on_event=events.append)
    assert titles(events) == ["running information"]
    assert sum(isinstance(event, Pulse) for event in events) in (4, 5)
    assert clock.now() == pytest.approx(1.0, abs=0.21)
    assert bus.frames_carried == watcher.frames == len(traffic.running())


def test_cancelling_ends_it_at_once() -> None:
    watcher = Watcher()
    watcher.cancel(3.0)
    assert watcher.done
    assert watcher.deadline() is None
    assert watcher.next_frame(3.0) is None


# -- the board -----------------------------------------------------------------------------------


def board_of(frames: Iterable[tuple[float, Frame]]) -> tuple[MessageTable, list[frozenset[str]]]:
    board = MessageTable()
    changes = [board.add(e) for e in replayed(Watcher(), frames) if isinstance(e, BusEvent)]
    return board, changes


def test_the_first_sight_of_a_message_is_no_change() -> None:
    assert board_of(at(0.0, traffic.running()))[1] == [frozenset()]


def test_only_what_differs_from_the_last_time_is_changed() -> None:
    other = b"\x9f\x8c" + traffic.RUNNING_DATA[2:]
    frames = [*at(0.0, traffic.running()), *at(1.0, traffic.running(other)),
              *at(2.0, traffic.running(other))]  # fmt: skip
    board, changes = board_of(frames)
    assert changes == [frozenset(), frozenset({"voltage_mv"}), frozenset()]
    (line,) = board.lines()
    assert line.changed(1.5) == {"voltage_mv"}
    assert line.changed(2.5) == set()


def test_the_same_message_with_the_same_title_of_two_nodes_has_two_lines() -> None:
    frames = [*at(0.0, traffic.frames(0x712, 0x11, 0x3300, b"")),
              *at(0.1, traffic.frames(0x732, 0x11, 0x5200, b""))]  # fmt: skip
    board, _ = board_of(frames)
    assert [line.event.can_id for line in board.lines()] == [0x712, 0x732]


def test_the_rate_counts_the_last_five_seconds() -> None:
    frames = [pair for tenth in range(100) for pair in at(tenth / 10, traffic.handshake())]
    board, _ = board_of(frames)
    (line,) = board.lines()
    assert line.count == 100
    assert line.rate_hz(9.9) == pytest.approx(10.0, rel=0.05)
    assert line.rate_hz(12.4) == pytest.approx(5.0, rel=0.05)
    assert line.rate_hz(60.0) == 0.0


def test_one_message_has_no_rate() -> None:
    board, _ = board_of(at(0.0, traffic.handshake()))
    (line,) = board.lines()
    assert line.rate_hz(1.0) is None


def test_two_messages_at_the_same_time_have_no_rate() -> None:
    board, _ = board_of(at(0.0, traffic.handshake() + traffic.handshake()))
    (line,) = board.lines()
    assert line.rate_hz(0.0) is None


def test_a_babbling_bus_does_not_fill_the_memory() -> None:
    board = MessageTable()
    for number in range(1000):
        board.add(BusEvent(0.0, Kind.FOREIGN, number, "foreign frame"))
        board.add(BusEvent(0.0, Kind.UNKNOWN, 0x720, "unknown message", command=number))
    assert len(board) == 2


def test_lines_come_in_the_order_of_ids_with_foreign_frames_last() -> None:
    frames = [*at(0.0, [Frame(0x123, b"abc")]), *at(0.1, traffic.reset()),
              *at(0.2, traffic.running())]  # fmt: skip
    board, _ = board_of(frames)

    def title(line: MessageHistory) -> str:
        return line.event.title

    assert list(map(title, board.lines())) == ["running information", "reset", "foreign frame"]
