"""The one loop: what it owes to an engine, a link and a clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import pytest

from flasher import events
from flasher.bus.health import HealthKeeper, LinkHealth
from flasher.bus.link import VirtualClock
from flasher.driver import drive
from flasher.errors import BusError
from flasher.protocol.frame import Frame


class FakeLink:
    """Frames that arrive at given times, on a virtual clock; records what is sent."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.arrivals: deque[tuple[float, Frame]] = deque()
        self.sent: list[tuple[float, Frame]] = []
        self.drained = 0
        self.send_takes_s = 0.0
        self.fail_after_frames: int | None = None

    def send(self, frame: Frame) -> None:
        if self.fail_after_frames is not None and len(self.sent) >= self.fail_after_frames:
            raise BusError("The adapter failed while sending: unplugged.")
        self.clock.wait_until(self.clock.now() + self.send_takes_s)
        self.sent.append((self.clock.now(), frame))

    def receive(self, deadline: float) -> Frame | None:
        if self.arrivals and self.arrivals[0][0] <= max(deadline, self.clock.now()):
            at, frame = self.arrivals.popleft()
            self.clock.wait_until(at)
            return frame
        if deadline > self.clock.now():
            self.clock.wait_until(deadline)
        return None

    def drain(self) -> int:
        self.drained += 1
        return 0

    def close(self) -> None:
        pass

    def reopen(self) -> None:
        pass

    is_off = False
    is_physical = True

    def health(self) -> LinkHealth:
        return HealthKeeper().health()


class Recorder:
    """An engine that records its calls and ends after a number of ticks."""

    def __init__(self, *, ticks: int = 1, every_s: float = 1.0) -> None:
        self.calls: list[tuple[str, float]] = []
        self.outbox: deque[Frame] = deque()
        self._ticks = ticks
        self._every_s = every_s
        self._next = every_s
        self.cancelled_at: float | None = None
        self.events: list[object] = []
        self.on_tick: Callable[[float], None] | None = None
        self.on_receive: Callable[[], None] | None = None

    @property
    def done(self) -> bool:
        return self._ticks <= 0 or self.cancelled_at is not None

    def receive(self, frame: Frame, now: float) -> None:
        self.calls.append((f"receive {frame.can_id:03X}", now))
        if self.on_receive is not None:
            self.on_receive()

    def tick(self, now: float) -> None:
        self.calls.append(("tick", now))
        self._ticks -= 1
        self._next = now + self._every_s
        if self.on_tick is not None:
            self.on_tick(now)

    def deadline(self) -> float | None:
        return self._next

    def next_frame(self, now: float) -> Frame | None:
        return self.outbox[0] if self.outbox else None

    def frame_sent(self, now: float) -> None:
        self.calls.append((f"sent {self.outbox.popleft().can_id:03X}", now))

    def cancel(self, now: float) -> None:
        self.cancelled_at = now

    def take_events(self) -> list[object]:
        taken, self.events = self.events, []
        return taken


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def link(clock: VirtualClock) -> FakeLink:
    return FakeLink(clock)


def test_the_link_is_drained_before_anything_else(clock: VirtualClock, link: FakeLink) -> None:
    drive(Recorder(), link, clock)
    assert link.drained == 1


def test_the_engine_is_ticked_at_its_deadline(clock: VirtualClock, link: FakeLink) -> None:
    engine = Recorder(ticks=3)
    drive(engine, link, clock)
    assert [at for _, at in engine.calls] == pytest.approx([1.0, 2.0, 3.0])


def test_everything_that_waits_is_received_before_a_due_tick(
    clock: VirtualClock, link: FakeLink
) -> None:
    """A stall of the computer must not become a timeout of the device."""
    engine = Recorder()
    for number in range(3):
        link.arrivals.append((0.5, Frame(0x720 + number, b"x")))
    clock.wait_until(5.0)
    drive(engine, link, clock)
    assert [what for what, _ in engine.calls] == [
        "receive 720",
        "receive 721",
        "receive 722",
        "tick",
    ]


def test_a_stall_after_the_last_poll_does_not_make_a_tick_late(clock: VirtualClock) -> None:
    """Frames that come while the computer stalls are received before a timer that expired then."""

    class StallingLink(FakeLink):
        def receive(self, deadline: float) -> Frame | None:
            came = super().receive(deadline)
            if deadline < 0.0 and clock.now() == 1.5:  # the first poll
                self.arrivals.append((2.0, Frame(0x725, b"answer")))
                clock.wait_until(4.0)
            return came

    engine = Recorder(ticks=2, every_s=1.0)
    clock.wait_until(1.5)
    drive(engine, StallingLink(clock), clock)
    assert engine.calls == [("tick", 1.5), ("receive 725", 4.0), ("tick", 4.0)]


def test_what_waits_is_received_before_anything_is_sent(
    clock: VirtualClock, link: FakeLink
) -> None:
    """EN-05: what had come before must not look like the answer to what is sent next."""
    engine = Recorder(ticks=2)
    link.arrivals.extend([(0.5, Frame(0x725, b"1")), (0.5, Frame(0x726, b"2"))])
    engine.on_receive = lambda: engine.outbox.append(Frame(0x752, b"answer"))
    drive(engine, link, clock)
    assert [what for what, _ in engine.calls[:4]] == [
        "receive 725",
        "receive 726",
        "sent 752",
        "sent 752",
    ]


def test_a_babbling_bus_does_not_stop_the_timers(clock: VirtualClock, link: FakeLink) -> None:
    engine = Recorder()
    link.arrivals.extend((0.0, Frame(0x001, b"x")) for _ in range(30_000))
    clock.wait_until(5.0)
    drive(engine, link, clock)
    assert engine.calls.index(("tick", 5.0)) == 10_000


def test_no_frame_is_lost_when_a_babbling_bus_is_interrupted_for_the_timers(
    clock: VirtualClock, link: FakeLink
) -> None:
    engine = Recorder(ticks=2)
    link.arrivals.extend((0.0, Frame(number % 0x700, b"x")) for number in range(10_003))
    clock.wait_until(5.0)
    drive(engine, link, clock)
    received = [what for what, _ in engine.calls if what != "tick"]
    assert received == [f"receive {number % 0x700:03X}" for number in range(10_003)]


def test_a_frame_that_waited_has_the_time_at_which_the_engine_was_ready_for_it(
    clock: VirtualClock, link: FakeLink
) -> None:
    engine = Recorder()
    link.arrivals.extend([(0.5, Frame(0x725, b"1")), (0.5, Frame(0x726, b"2"))])
    engine.on_receive = lambda: clock.wait_until(clock.now() + 0.25)
    drive(engine, link, clock)
    assert engine.calls[:2] == [("receive 725", 0.5), ("receive 726", 0.75)]


def test_a_deadline_that_begins_when_a_frame_has_left_is_kept(
    clock: VirtualClock, link: FakeLink
) -> None:
    class Waiting(Recorder):
        def frame_sent(self, now: float) -> None:
            super().frame_sent(now)
            self._next = now + 0.03

    engine = Waiting(every_s=60.0)
    engine.outbox.append(Frame(0x752, b"1"))
    drive(engine, link, clock)
    assert engine.calls == [("sent 752", 0.0), ("tick", 0.03)]


def test_frames_go_out_one_at_a_time_and_the_engine_learns_when_each_was_accepted(
    clock: VirtualClock, link: FakeLink
) -> None:
    engine = Recorder()
    engine.outbox.extend([Frame(0x752, b"1"), Frame(0x753, b"2")])
    link.send_takes_s = 0.1
    drive(engine, link, clock)
    assert [what for what, _ in engine.calls[:2]] == ["sent 752", "sent 753"]
    assert [at for _, at in engine.calls[:2]] == pytest.approx([0.1, 0.2])


def test_taps_see_every_frame_in_both_directions(clock: VirtualClock, link: FakeLink) -> None:
    engine = Recorder()
    engine.outbox.append(Frame(0x752, b"1"))
    link.arrivals.append((0.2, Frame(0x725, b"2")))
    seen: list[tuple[int, bool, float]] = []

    def tap(frame: Frame, *, sent: bool, now: float) -> None:
        seen.append((frame.can_id, sent, now))

    drive(engine, link, clock, taps=[tap])
    assert seen == [(0x752, True, 0.0), (0x725, False, 0.2)]


def test_taps_see_frames_that_waited_for_a_due_tick(clock: VirtualClock, link: FakeLink) -> None:
    engine = Recorder()
    link.arrivals.append((0.2, Frame(0x725, b"2")))
    clock.wait_until(3.0)
    seen: list[tuple[int, bool, float]] = []

    def tap(frame: Frame, *, sent: bool, now: float) -> None:
        seen.append((frame.can_id, sent, now))

    drive(engine, link, clock, taps=[tap])
    assert seen == [(0x725, False, 3.0)]


def test_events_are_handed_on_as_they_come(clock: VirtualClock, link: FakeLink) -> None:
    engine = Recorder()
    engine.on_tick = lambda now: engine.events.append(f"at {now:g}")
    seen: list[object] = []
    drive(engine, link, clock, on_event=seen.append)
    assert seen == ["at 1"]


class FastClock(VirtualClock):
    """Its seconds pass ten times as fast as real ones."""

    speed = 10.0  # type: ignore[misc]


@pytest.mark.parametrize(("clock", "within_s"), [(VirtualClock(), 0.1), (FastClock(), 1.0)])
def test_a_cancellation_is_seen_within_a_tenth_of_a_real_second(
    clock: VirtualClock, within_s: float
) -> None:
    engine = Recorder(every_s=3600.0)
    asked: list[float] = []

    def is_cancelled() -> bool:
        asked.append(clock.now())
        return clock.now() >= 30.0

    drive(engine, FakeLink(clock), clock, cancelled=is_cancelled)
    assert engine.cancelled_at == pytest.approx(30.0, abs=within_s)
    assert asked[1] - asked[0] == within_s


def test_an_engine_is_cancelled_once_and_goes_on_to_its_message_boundary(
    clock: VirtualClock, link: FakeLink
) -> None:
    class Finishing(Recorder):
        done = property(lambda self: self._ticks <= 0)

    engine = Finishing(ticks=2)
    drive(engine, link, clock, cancelled=lambda: clock.now() >= 0.5)
    assert engine.cancelled_at == 0.5
    assert [at for _, at in engine.calls] == [1.0, 2.0]


def test_a_failing_adapter_ends_the_loop_with_its_error(
    clock: VirtualClock, link: FakeLink
) -> None:
    """BU-05."""
    engine = Recorder()
    engine.outbox.extend([Frame(0x752, b"1")] * 5)
    link.fail_after_frames = 3
    with pytest.raises(BusError, match="unplugged"):
        drive(engine, link, clock)
    assert len(link.sent) == 3


# -- a computer that pauses -----------------------------------------------------------------------


class PausingLink(FakeLink):
    """The computer pauses once while it waits for a frame."""

    def __init__(self, clock: VirtualClock, pause_s: float) -> None:
        super().__init__(clock)
        self.pause_s = pause_s

    def receive(self, deadline: float) -> Frame | None:
        came = super().receive(deadline)
        if deadline > 0.0 and self.pause_s:
            self.clock.wait_until(self.clock.now() + self.pause_s)
            self.pause_s = 0.0
        return came


@pytest.mark.parametrize(
    ("pause_s", "reported_s"),
    [(2.0, [2.0]), (0.31256, [0.313]), (0.26, [0.26]), (0.25, []), (0.0, [])],
)
def test_a_pause_of_the_computer_is_reported(
    clock: VirtualClock, pause_s: float, reported_s: list[float]
) -> None:
    """Where it is longer than half the time that a device has for an ACK (R12)."""
    noted: list[object] = []
    drive(Recorder(ticks=2), PausingLink(clock, pause_s), clock, on_event=noted.append)
    assert noted == [events.HostStalled(each) for each in reported_s]


def test_a_pause_is_reported_in_real_seconds() -> None:
    clock = FastClock()
    noted: list[object] = []
    drive(Recorder(ticks=2), PausingLink(clock, 20.0), clock, on_event=noted.append)
    assert noted == [events.HostStalled(2.0)]


def test_a_slow_adapter_does_not_hide_a_pause_of_the_same_turn(
    clock: VirtualClock, link: FakeLink
) -> None:
    """Whoever asks whether to cancel takes half a second, and the adapter a second and a half."""
    engine = Recorder()
    clock.wait_until(100.0)
    engine.outbox.append(Frame(0x752, b"\x01"))
    link.send_takes_s = 1.5
    noted: list[object] = []
    pauses_s = iter([0.5])

    def is_cancelled() -> bool:
        clock.wait_until(clock.now() + next(pauses_s, 0.0))
        return False

    drive(engine, link, clock, on_event=noted.append, cancelled=is_cancelled)
    assert noted == [events.HostStalled(0.5)]


def test_a_slow_callback_is_a_pause_and_a_slow_adapter_is_none(
    clock: VirtualClock, link: FakeLink
) -> None:
    engine = Recorder()
    link.send_takes_s = 1.5
    engine.outbox.append(Frame(0x752, b"\x01"))
    engine.events = ["slow"]
    noted: list[object] = []

    def on_event(event: object) -> None:
        noted.append(event)
        if event == "slow":
            clock.wait_until(clock.now() + 0.5)

    drive(engine, link, clock, on_event=on_event)
    assert noted == ["slow", events.HostStalled(0.5)]
