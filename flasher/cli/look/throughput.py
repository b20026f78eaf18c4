"""Speed of an adapter, measured with version queries to the battery, which change nothing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil
from typing import Final

from flasher.api import Device
from flasher.errors import NoAnswerError
from flasher.host.query import Query, Request
from flasher.host.runner import Runner, Stage
from flasher.image.image import Image
from flasher.protocol.bittime import message_bits
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, FRAMES_PER_PACKET, PACKET_DATA_SIZE, Command
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler
from flasher.trace.figures import Distribution

QUERIES: Final = 20
"""Queries whose round trip is measured, one after the other."""
BURSTS: Final = 5
"""Bursts of as many frames as a packet has."""
STALL_S: Final = 0.02
"""Pause of this computer after which a measurement is set aside."""
_UNANSWERED_MAX: Final = 3
_QUIET_S: Final = 0.2
"""Silence that ends a burst's answers."""
_WATCH_S: Final = 0.002
ASK_VERSION: Final = Request(BY_KEY[BMS.request_id, Command.READ_VERSION])


@dataclass(frozen=True)
class Throughput:
    """Measured speed of an adapter; times in seconds, without samples of a paused computer."""

    frames_sent: int
    """Frames sent for the measurement, all of them version queries to the BMS."""
    queries: int
    answered: int
    round_trip: Distribution | None
    """From the last frame of a query to the last frame of its answer, the device's own time
    included. Null without answers."""
    frames_out_per_s: float | None
    """Frames a second that the adapter accepts in a burst; null if it takes no time."""
    line_frames_per_s: float
    """Frames a second that the bit rate allows, of the same frames."""
    worst_gap_out_s: float | None
    """Longest time between two frames of a burst."""
    frames_in_per_s: float | None
    """Frames a second received within an answer; null without answers, or if they came at once."""
    worst_gap_in_s: float | None
    """Longest time between two frames of an answer."""
    echo_delay: Distribution | None
    """From sending a frame to its echo; null for an adapter that returns none."""
    worst_pause_s: float
    """Longest pause of this computer while measuring, whatever the adapter did."""
    set_aside: int
    """Samples that were set aside because this computer paused for more than 0.02 s."""
    packet_s: float | None
    """Time of a packet and its answer over this adapter, by these figures."""
    line_packet_s: float
    """The same on a bus that never waits."""


def measure(device: Device, *, is_real_time: bool = True) -> Throughput:
    """Measure the adapter of a battery. Raises BusError and InterruptedByUserError."""
    samples = _Samples()
    frames = Query(ASK_VERSION).frames
    burst = list(frames) * ceil(FRAMES_PER_PACKET / len(frames))
    plan = device.plan(Image.from_bytes(bytes(PACKET_DATA_SIZE)))
    bitrate_bps = plan.bitrate_bps
    line_per_s = bitrate_bps * len(burst) / message_bits(burst)
    with _pauses_watched(is_real_time=is_real_time) as worst_pause:
        for _ in range(QUERIES):
            if not samples.answered and samples.queries == _UNANSWERED_MAX:
                break
            tap = _Tap()
            samples.queries += 1
            with suppress(NoAnswerError):
                device.ask(ASK_VERSION, taps=(tap,))
                samples.answered += 1
            samples.take(tap, worst_pause(), is_burst=False)
        for _ in range(BURSTS):
            tap = _Tap()
            device.run(
                Runner(lambda run: _send_burst(run, burst), bitrate_bps=bitrate_bps), taps=(tap,)
            )
            samples.take(tap, worst_pause(), is_burst=True)
    round_trip = Distribution.of(samples.round_trips)
    out_per_s = _rate(samples.gaps_out)
    packet_s = None
    if round_trip is not None:
        packet_s = FRAMES_PER_PACKET / min(out_per_s or line_per_s, line_per_s)
        packet_s += round_trip.median_s
    return Throughput(
        frames_sent=samples.sent,
        queries=samples.queries,
        answered=samples.answered,
        round_trip=round_trip,
        frames_out_per_s=out_per_s,
        line_frames_per_s=round(line_per_s, 1),
        worst_gap_out_s=max(samples.gaps_out, default=None),
        frames_in_per_s=_rate(samples.gaps_in),
        worst_gap_in_s=max(samples.gaps_in, default=None),
        echo_delay=Distribution.of(samples.echo_delays),
        worst_pause_s=samples.worst_pause_s,
        set_aside=samples.set_aside,
        packet_s=packet_s,
        line_packet_s=plan.transfer_wire_s,
    )


def _rate(gaps_s: list[float]) -> float | None:
    return round(len(gaps_s) / sum(gaps_s), 1) if sum(gaps_s) > 0 else None


def _send_burst(run: Runner[None], burst: list[Frame]) -> Stage[None]:
    run.send(burst)
    yield None  # until it was sent
    until = run.now + _QUIET_S
    while run.now < until and not run.is_cancelled:
        yield until


class _Tap:
    """Times of the frames of one query or burst, and of the answers to it."""

    def __init__(self) -> None:
        self.sent: list[tuple[Frame, float]] = []
        self.query_left_at = 0.0
        """Time of the last frame sent before the first answer."""
        self.answers: list[list[float]] = []
        """Times of the frames of each answer."""
        self.echo_delays: list[float] = []
        self._unreturned: list[tuple[Frame, float]] = []
        self._expected = ASK_VERSION.answer_item
        self._reassembler = Reassembler(
            self._expected.can_id, DEFAULT_TIMINGS.inter_frame_timeout_s
        )
        self._frames: list[float] = []

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent:
            self.sent.append((frame, now))
            if not self.answers:
                self.query_left_at = now
            self._unreturned.append((frame, now))
        elif frame.is_echo:
            for index, (own, at) in enumerate(self._unreturned):
                if own.can_id == frame.can_id and own.data == frame.data:
                    del self._unreturned[index]
                    self.echo_delays.append(now - at)
                    break
        elif frame.can_id == self._expected.can_id and frame.is_payload:
            self._frames.append(now)
            for found in self._reassembler.feed(frame.data, now):
                if isinstance(found, Message) and found.command == self._expected.command:
                    self.answers.append(self._frames)
                self._frames = []


@dataclass
class _Samples:
    queries: int = 0
    answered: int = 0
    sent: int = 0
    round_trips: list[float] = field(default_factory=list)
    gaps_out: list[float] = field(default_factory=list)
    gaps_in: list[float] = field(default_factory=list)
    echo_delays: list[float] = field(default_factory=list)
    worst_pause_s: float = 0.0
    set_aside: int = 0

    def take(self, tap: _Tap, pause_s: float, *, is_burst: bool) -> None:
        """Add the times of a query or burst, unless this computer paused meanwhile."""
        self.sent += len(tap.sent)
        self.worst_pause_s = max(self.worst_pause_s, pause_s)
        if pause_s > STALL_S:
            self.set_aside += 1
            return
        self.echo_delays += tap.echo_delays
        for answer in tap.answers:
            self.gaps_in += [late - early for early, late in pairwise(answer)]
        if is_burst:
            self.gaps_out += [late - early for (_, early), (_, late) in pairwise(tap.sent)]
        elif tap.answers:
            self.round_trips.append(tap.answers[0][-1] - tap.query_left_at)


@contextmanager
def _pauses_watched(*, is_real_time: bool) -> Iterator[Callable[[], float]]:
    """Yield a function that returns the longest pause of this computer since its last call, as a
    thread sees it that only sleeps. Simulated time has none.
    """
    worst_s = 0.0
    ended = threading.Event()

    def watch() -> None:
        nonlocal worst_s
        before = time.perf_counter()
        while not ended.wait(_WATCH_S):
            now = time.perf_counter()
            worst_s = max(worst_s, now - before - _WATCH_S)
            before = now

    def take() -> float:
        nonlocal worst_s
        found, worst_s = worst_s, 0.0
        return found

    thread = threading.Thread(target=watch, daemon=True)
    if is_real_time:
        thread.start()
    try:
        yield take
    finally:
        ended.set()
        if is_real_time:
            thread.join()
