"""The bus of a plan: units with a supply, frames that go astray, a second tool, an adapter that
gives frames back late, a computer that stands still.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from math import inf
from typing import Any, Final, Protocol

from flasher.bus.echoes import Echoes
from flasher.bus.health import LinkHealth
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus, SimulatedLink
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import WELLING
from tests.campaigns.world import plans
from tests.campaigns.world.stranger import Stranger

INBOX_FRAMES: Final = 4096
"""What an adapter's driver keeps for a computer that stands still."""
_COMMANDS: Final = {b"\x42\x05": "reset", b"\xa1\x0b": "update", b"\xa3\x85": "packet"} | {
    b"\xa4\x01": "end"
}

_BEGINS, _GENERAL_FEEDBACK = b"\x55\xaa", b"\x55\x03"


class Killed(BaseException):
    """The host's process is gone."""


class OverdueError(Exception):
    """The host did not end."""


class Timers:
    """On the bus for its time only: calls what is due."""

    done = False

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Callable[[float], None]]] = []
        self._order = count()

    def at(self, moment: float, act: Callable[[float], None]) -> None:
        heapq.heappush(self._heap, (moment, next(self._order), act))

    def clear(self) -> None:
        self._heap.clear()

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        while self._heap and self._heap[0][0] <= now:
            heapq.heappop(self._heap)[2](now)

    def deadline(self) -> float | None:
        return self._heap[0][0] if self._heap else None

    def next_frame(self, now: float) -> Frame | None:
        return None

    def frame_sent(self, now: float) -> None:
        pass

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> tuple[object, ...]:
        return ()


class Voice(Timers):
    """Sends frames at their times: other traffic, a second tool, messages that nobody asked for."""

    def __init__(self) -> None:
        super().__init__()
        self._due: deque[Frame] = deque()

    def say(self, frames: Iterable[Frame], moment: float) -> None:
        frames = list(frames)
        self.at(moment, lambda _now: self._due.extend(frames))

    def next_frame(self, now: float) -> Frame | None:
        return self._due[0] if self._due else None

    def frame_sent(self, now: float) -> None:
        if self._due:
            self._due.popleft()


class Unit:
    """A device with a supply that can fail and a processor that can hang."""

    done = False

    def __init__(self, engine: Stranger | MockDevice) -> None:
        self.engine = engine
        self.before = self.application
        """The application that it had at the beginning."""
        self._hangs_until = -inf

    @property
    def application(self) -> bytes | None:
        """What its flash holds, if that can be started."""
        engine = self.engine
        return engine.flash.application if isinstance(engine, Stranger) else engine.stored_image

    @property
    def has_power(self) -> bool:
        return self.engine.has_power

    def power_cut(self, now: float) -> None:
        if self.engine.has_power:
            self.engine.power_cut(now)
        self._hangs_until = -inf

    def power_on(self, now: float) -> None:
        if not self.engine.has_power:
            self.engine.power_on(now)

    def hang(self, until: float) -> None:
        self._hangs_until = until

    def receive(self, frame: Frame, now: float) -> None:
        if now >= self._hangs_until:
            self.engine.receive(frame, now)

    def tick(self, now: float) -> None:
        if now >= self._hangs_until:
            self.engine.tick(now)

    def deadline(self) -> float | None:
        due = self.engine.deadline()
        return None if due is None else max(due, self._hangs_until)

    def next_frame(self, now: float) -> Frame | None:
        return self.engine.next_frame(now) if now >= self._hangs_until else None

    def frame_sent(self, now: float) -> None:
        self.engine.frame_sent(now)

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> Sequence[object]:
        return self.engine.take_events()


class Watcher(Protocol):
    """Sees each frame before it is delivered."""

    def __call__(self, frame: Frame, sender: str, now: float) -> None: ...


class WorldBus(SimulatedBus):
    """A simulated bus that knows who sends."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__(WELLING.bitrate_bps, clock, self._carried)
        self.timers = Timers()
        self.attach(self.timers)
        self.watch: Watcher | None = None
        self.faults_of_frames: list[_FrameFault] = []
        self.host: SimulatedLink | None = None
        """The tool that runs now: what it sends is the host's."""
        self.on_echo: Callable[[Frame, float], None] | None = None
        self.heard: set[Any] = set()
        """Who has begun a message alone that reached the tool; the player empties it. General
        feedback is none: an application sends it to all that is not for it.
        """
        self._sender: Any = None

    def _deliver(self, senders: Sequence[Any], frame: Frame | None) -> None:
        self._sender = senders[0]
        super()._deliver(senders, frame)
        if frame is None:
            return
        if self.on_echo is not None and self._is_host(senders[0]):
            self.on_echo(frame, self._sending_ends_at)
        is_alone = len(senders) == 1 and self.faults.takes_part
        if is_alone and frame.data[:2] == _BEGINS and frame.data[4:6] != _GENERAL_FEEDBACK:
            self.heard.add(getattr(senders[0], "engine", None))

    def _is_host(self, sender: Any) -> bool:
        return self.host is not None and sender is self.host._host

    def _carried(self, frame: Frame, now: float) -> Iterable[Frame]:
        sender = self._sender
        word = "host" if self._is_host(sender) else "device"
        if isinstance(getattr(sender, "engine", None), Voice):
            word = "voice"
        if self.watch is not None:
            self.watch(frame, word, now)
        frames = [frame]
        for fault in tuple(self.faults_of_frames):
            if fault.is_over(now):
                self.faults_of_frames.remove(fault)
            elif frames and word != "voice" and fault.concerns(word):
                frames = fault.apply(frames, lambda late, at: self._deliver_late(sender, late, at))
        return frames

    def _deliver_late(self, sender: Any, frame: Frame, moment: float) -> None:
        def arrive(now: float) -> None:
            for device in self._devices:
                if device is not sender:
                    device.engine.receive(frame, now)
            for host in self._hosts:
                if host is not sender and self.faults.takes_part:
                    host.inbox.append(frame)

        self.timers.at(self.clock.now() + moment, arrive)


class _FrameFault:
    """A clause of a plan that is in force."""

    def __init__(self, clause: plans.OnFrames | plans.Noise, now: float) -> None:
        self._clause = clause
        self._left = getattr(clause, "count", 0)
        self._until = now + getattr(clause, "seconds", inf)
        self._random = random.Random(getattr(clause, "seed", 0))

    def is_over(self, now: float) -> bool:
        if isinstance(self._clause, plans.Noise):
            return now >= self._until
        return self._left <= 0

    def concerns(self, sender: str) -> bool:
        return self._clause.sender in ("any", sender)

    def apply(self, frames: list[Frame], later: Callable[[Frame, float], None]) -> list[Frame]:
        self._left -= 1
        frame, rest = frames[0], frames[1:]
        match self._clause:
            case plans.Lose():
                return rest
            case plans.Double():
                return [frame, frame, *rest]
            case plans.Delay(seconds=seconds):
                later(frame, seconds)
                return rest
            case plans.Flip(bit=bit):
                return [_flipped(frame, bit), *rest]
            case plans.Cut(to=size):
                return [frame._replace(data=frame.data[:size]), *rest]
            case plans.Noise(lost=lost, wrong=wrong, doubled=doubled):
                drawn = self._random.random()
                if drawn < lost:
                    return rest
                if drawn < lost + wrong:
                    return [_flipped(frame, self._random.randrange(64)), *rest]
                return [frame, frame, *rest] if drawn < lost + wrong + doubled else frames
        raise AssertionError(self._clause)


def frame_fault(clause: plans.OnFrames | plans.Noise, now: float) -> _FrameFault:
    return _FrameFault(clause, now)


def _flipped(frame: Frame, bit: int) -> Frame:
    data = bytearray(frame.data)
    if data:
        data[bit // 8 % len(data)] ^= 1 << bit % 8
    return frame._replace(data=bytes(data))


def message_begun(frame: Frame) -> tuple[str, int] | None:
    """The host's message that begins with this frame, and the packet's number."""
    data = frame.data
    if data[:3] != b"\x55\xaa\x16" or len(data) < 8:
        return None
    name = _COMMANDS.get(data[4:6])
    return None if name is None else (name, data[7] if name == "packet" else 0)


class _Inbox(deque[Frame]):
    """What has arrived at an adapter, with the time of each frame."""

    def __init__(self, now: Callable[[], float]) -> None:
        super().__init__()
        self._now = now
        self._stamps: deque[float] = deque()
        self.stamp_s = 0.0
        """When the frame that was taken last had arrived."""

    def append(self, frame: Frame) -> None:
        if len(self) < INBOX_FRAMES:
            super().append(frame)
            self._stamps.append(self._now())

    def popleft(self) -> Frame:
        self.stamp_s = self._stamps.popleft()
        return super().popleft()

    def clear(self) -> None:
        super().clear()
        self._stamps.clear()


class WorldLink:
    """The host's adapter: gives own frames back as it pleases, and stands still with its host."""

    def __init__(self, bus: WorldBus, adapter: plans.Adapter) -> None:
        self._bus = bus
        self._inner = bus.link()
        self._inner._host.inbox = self._inbox = _Inbox(bus.clock.now)
        self._adapter = adapter
        self._echoes = Echoes()
        self._random = random.Random(adapter.seed)
        self.stalls_s = 0.0
        """The host stands still for so long at its next call."""
        self.is_killed = False
        self.overdue_at = inf
        bus.host = self._inner
        bus.on_echo = self._echo

    def __str__(self) -> str:
        return str(self._inner)

    def _echo(self, frame: Frame, now: float) -> None:
        adapter, draw = self._adapter, self._random.random
        if not adapter.echoes or draw() < adapter.lost:
            return
        for _ in range(2 if draw() < adapter.doubled else 1):
            due_at = now + adapter.delay + adapter.jitter * draw()
            if due_at <= now:
                self._inbox.append(frame)
            else:
                self._bus.timers.at(due_at, lambda _now: self._inbox.append(frame))

    def _live(self) -> None:
        bus = self._bus
        if self.is_killed:
            raise Killed
        if self.stalls_s:
            until, self.stalls_s = bus.clock.now() + self.stalls_s, 0.0
            while bus.clock.now() < until:
                bus.advance(until)
        if bus.clock.now() > self.overdue_at:
            raise OverdueError

    def send(self, frame: Frame) -> None:
        self._live()
        self._inner.send(frame)
        self._echoes.sent(frame)

    def receive(self, deadline: float) -> Frame | None:
        self._live()
        frame = self._inner.receive(deadline)
        if frame is None:
            return None
        return self._echoes.mark(frame, self._inbox.stamp_s, is_rx=True)

    def drain(self) -> int:
        return self._inner.drain()

    def close(self) -> None:
        self._inner.close()

    def reopen(self) -> None:
        self._live()
        self._inner.reopen()
        self._echoes.reopened()

    @property
    def is_physical(self) -> bool:
        return self._inner.is_physical

    @property
    def is_off(self) -> bool:
        return self._inner.is_off

    def health(self) -> LinkHealth:
        return self._inner.health()
