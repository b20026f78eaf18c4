"""The simulated bus: exact bit times, arbitration, disturbances, and paced real time."""

from __future__ import annotations

import time
from collections import deque
from math import inf

import pytest

from flasher.bus.link import (
    SEND_LIMIT_S,
    MonotonicClock,
    SteadyClock,
    VirtualClock,
)
from flasher.bus.simulated import SimulatedBus
from flasher.errors import TransmitBlockedError
from flasher.protocol.bittime import frame_bits
from flasher.protocol.frame import Frame

BITRATE = 250_000


class Talker:
    """A device that sends what it is given and remembers what it hears."""

    def __init__(self, *frames: Frame, wake_at: float | None = None) -> None:
        self.outbox = deque(frames)
        self.heard: list[tuple[float, Frame]] = []
        self.wake_at = wake_at
        self.woken_at: float | None = None
        self.reports: list[object] = []

    @property
    def done(self) -> bool:
        return False

    def receive(self, frame: Frame, now: float) -> None:
        self.heard.append((now, frame))

    def tick(self, now: float) -> None:
        self.woken_at, self.wake_at = now, None
        self.reports.append("woken")

    def deadline(self) -> float | None:
        return -inf if self.outbox else self.wake_at

    def next_frame(self, now: float) -> Frame | None:
        return self.outbox[0] if self.outbox else None

    def frame_sent(self, now: float) -> None:
        self.outbox.popleft()

    def cancel(self, now: float) -> None:
        raise AssertionError("a bus cancels no engine")

    def take_events(self) -> list[object]:
        taken, self.reports = self.reports, []
        return taken


class Babbler(Talker):
    """Never lets anybody else speak."""

    def deadline(self) -> float:
        return -inf

    def next_frame(self, now: float) -> Frame | None:
        return Frame(0x000, bytes(8))

    def frame_sent(self, now: float) -> None:
        pass


def seconds(*frames: Frame) -> float:
    return sum(frame_bits(frame) for frame in frames) / BITRATE


def test_a_frame_arrives_after_exactly_its_bits() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    frame = Frame(0x725, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00")
    bus.attach(Talker(frame))
    assert bus.link().receive(1.0) == frame
    assert clock.now() == pytest.approx(seconds(frame))


def test_frames_follow_each_other_without_a_gap() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    frames = [Frame(0x725, bytes([number] * 8)) for number in range(5)]
    bus.attach(Talker(*frames))
    link = bus.link()
    assert [link.receive(1.0) for _ in frames] == frames
    assert clock.now() == pytest.approx(seconds(*frames))
    assert bus.busy_s == pytest.approx(seconds(*frames))
    assert bus.frames_carried == 5


def test_a_frame_after_a_silence_takes_its_time_too() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    listener = Talker()
    bus.attach(listener)
    link = bus.link()
    frame = Frame(0x752, b"12345678")
    for moment in (0.0, 0.5):
        link.receive(moment)
        link.send(frame)
    link.receive(1.0)
    assert [at for at, _ in listener.heard] == pytest.approx([seconds(frame), 0.5 + seconds(frame)])


def test_the_lowest_id_wins_and_nothing_is_lost() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    low, high = Frame(0x100, b"low"), Frame(0x700, b"high")
    bus.attach(Talker(high))
    bus.attach(Talker(low))
    link = bus.link()
    assert [link.receive(1.0), link.receive(1.0)] == [low, high]


def test_everybody_but_the_sender_receives_a_frame() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    one, two = Talker(Frame(0x725, b"x")), Talker()
    bus.attach(one)
    bus.attach(two)
    link = bus.link()
    link.send(Frame(0x752, b"y"))
    assert link.receive(1.0) == Frame(0x725, b"x")
    assert link.receive(1.0) is None
    assert [frame for _, frame in one.heard] == [Frame(0x752, b"y")]
    assert {frame.can_id for _, frame in two.heard} == {0x725, 0x752}


def test_a_full_transmit_queue_makes_the_sender_wait_and_loses_nothing() -> None:
    """BU-03."""
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    listener = Talker()
    bus.attach(listener)
    link = bus.link(queue_frames=3)
    frames = [Frame(0x752, bytes([number])) for number in range(10)]
    for frame in frames:
        link.send(frame)
    assert clock.now() == pytest.approx(seconds(*frames[:7]))
    link.receive(1.0)
    assert [frame for _, frame in listener.heard] == frames


def test_a_bus_without_room_ends_the_wait_in_bounded_time() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    bus.attach(Babbler())
    link = bus.link(queue_frames=1)
    link.send(Frame(0x752, b"x"))
    with pytest.raises(TransmitBlockedError, match="took no frame"):
        link.send(Frame(0x752, b"y"))
    assert clock.now() < SEND_LIMIT_S + 0.1


def test_a_device_is_ticked_when_it_wants_to_be() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    sleeper = Talker(wake_at=0.25)
    noted: list[object] = []
    bus.attach(sleeper, noted.append)
    assert bus.link().receive(1.0) is None
    assert sleeper.woken_at == pytest.approx(0.25)
    assert noted == ["woken"]
    assert clock.now() == pytest.approx(1.0)


def test_two_devices_report_to_their_own_listeners() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    first: list[object] = []
    second: list[object] = []
    bus.attach(Talker(wake_at=0.1), first.append)
    bus.attach(Talker(wake_at=0.2), second.append)
    bus.link().receive(1.0)
    assert (first, second) == (["woken"], ["woken"])


def test_a_disturbance_decides_what_becomes_of_a_frame() -> None:
    lost, doubled, changed = Frame(0x101, b"1"), Frame(0x102, b"2"), Frame(0x103, b"3")

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        return {0x101: [], 0x102: [frame, frame], 0x103: [frame._replace(data=b"?")]}[frame.can_id]

    bus = SimulatedBus(BITRATE, VirtualClock(), disturb)
    bus.attach(Talker(lost, doubled, changed))
    link = bus.link()
    assert [link.receive(1.0) for _ in range(3)] == [doubled, doubled, Frame(0x103, b"?")]
    assert link.receive(1.0) is None


def test_drain_forgets_what_has_arrived() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    bus.attach(Talker(Frame(0x725, b"a"), Frame(0x725, b"b")))
    link = bus.link()
    link.receive(0.00001)
    bus.advance(1.0)
    bus.advance(1.0)
    assert link.drain() == 2
    assert link.receive(0.0) is None
    link.close()


def test_a_bus_with_a_steady_clock_takes_the_real_time_divided_by_its_speed() -> None:
    speed = 50.0
    frames = [Frame(0x725, bytes([number % 256] * 8)) for number in range(1000)]
    began = time.perf_counter()
    clock = SteadyClock(speed)
    bus = SimulatedBus(BITRATE, clock)
    bus.attach(Talker(*frames))
    link = bus.link()
    for _ in frames:
        link.receive(clock.now() + 10.0)
    took_s = time.perf_counter() - began
    assert took_s >= seconds(*frames) / speed * 0.98
    assert bus.busy_s == pytest.approx(seconds(*frames))


def test_the_clocks_only_go_forward_and_do_not_wait_for_the_past() -> None:
    for clock in (MonotonicClock(), SteadyClock(2.0), VirtualClock()):
        before = clock.now()
        clock.wait_until(before - 100.0)
        clock.wait_until(before + 0.001)
        assert clock.now() >= before + 0.001


def test_a_pause_of_this_computer_pauses_a_steady_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    real_s, slept_s = 100.0, 0.0

    def sleep(seconds: float) -> None:
        nonlocal real_s, slept_s
        real_s, slept_s = real_s + seconds, slept_s + seconds

    monkeypatch.setattr("flasher.bus.link.time.perf_counter", lambda: real_s)
    monkeypatch.setattr("flasher.bus.link.time.sleep", sleep)
    clock = SteadyClock(10.0)
    clock.wait_until(1.0)
    assert slept_s == pytest.approx(0.1)
    real_s += 0.05
    assert clock.now() == 1.0
    clock.wait_until(2.0)
    assert slept_s == pytest.approx(0.15), "it hurries after a short pause"
    real_s += 60.0
    assert clock.now() == 2.0
    clock.wait_until(4.0)
    assert slept_s == pytest.approx(0.25), "and goes on from where it is after a long one"
    clock.wait_until(5.0)
    assert slept_s == pytest.approx(0.35)


# -- several senders of one id --------------------------------------------------------------------


def test_the_same_frame_of_two_senders_in_the_same_bits_is_one() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    frame = Frame(0x725, b"\x55\xaa\x0c")
    one, two, third = Talker(frame), Talker(frame), Talker()
    for talker in (one, two, third):
        bus.attach(talker)
    link = bus.link()
    assert link.receive(1.0) == frame
    assert link.receive(1.0) is None
    assert len(third.heard) == 1
    assert not one.heard
    assert not two.heard
    assert not one.outbox
    assert not two.outbox


def test_different_frames_of_one_id_collide_until_one_sender_is_error_passive() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(BITRATE, clock)
    low, high = Frame(0x725, b"\x55\x01"), Frame(0x725, b"\x55\x02")
    bus.attach(Talker(high))
    bus.attach(Talker(low))
    link = bus.link()
    assert link.receive(1.0) == low  # the first bit that differs is dominant
    assert clock.now() > 16 * 30 / BITRATE  # sixteen tries in vain
    assert link.receive(1.0) == high
    assert bus.frames_carried == 2


def test_a_controller_that_loses_again_and_again_goes_off_and_comes_back() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock())
    loser = Talker(Frame(0x725, b"\xff"), Frame(0x725, b"\xfe\x01"))
    bus.attach(Talker(*(Frame(0x725, bytes([number])) for number in range(20))))
    bus.attach(loser)
    link = bus.link()
    heard = [link.receive(1.0) for _ in range(21)]
    assert Frame(0x725, b"\xff") not in heard  # it was lost with the reset of the controller
    assert Frame(0x725, b"\xfe\x01") in heard


def test_on_a_virtual_network_senders_of_one_id_take_turns() -> None:
    bus = SimulatedBus(BITRATE, VirtualClock(), collides=False)
    frame, other = Frame(0x725, b"\x55\x02"), Frame(0x725, b"\x55\x01")
    bus.attach(Talker(frame))
    bus.attach(Talker(other))
    link = bus.link()
    assert [link.receive(1.0), link.receive(1.0)] == [frame, other]
