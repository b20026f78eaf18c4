"""Simulated bus of a plan: units with a supply, frames that go astray, an adapter with faults."""

from __future__ import annotations

import heapq
import random
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from math import inf
from typing import TYPE_CHECKING, Any, Final, Protocol

from flasher.bus.echoes import Echoes
from flasher.bus.link import AT_ONCE, VirtualClock
from flasher.bus.simulated import SimulatedBus, SimulatedLink
from flasher.mock.model import MockDevice
from flasher.mock.table import BootloaderState
from flasher.protocol.frame import Frame
from flasher.protocol.spec import OVERHEAD_SIZE, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.simulate import plan as plans
from flasher.simulate.independent import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    FEEDBACK,
    NAK,
    REPORT,
    REQUEST,
    VERSION,
    IndependentDevice,
    frames_of,
)

if TYPE_CHECKING:
    from flasher.simulate.subject import SubjectDevice

INBOX_FRAMES: Final = 4096
"""Frames that an adapter's driver keeps for a computer that pauses."""
ERROR_FRAME: Final = Frame(0x088, bytes.fromhex("0000020000000000"), is_error=True)
"""Form error of the bus, as Linux reports it."""
_ROUNDING_S: Final = 1e-9
_HEADER, _GENERAL_FEEDBACK = b"\x55\xaa", FEEDBACK.to_bytes(2, "big")
_BOOT_VERSION: Final = BOOT_VERSION.to_bytes(2, "big")
_VERSION: Final = VERSION.to_bytes(2, "big")
_COMPLETE: Final = COMPLETE.to_bytes(2, "big")
_REQUEST: Final = REQUEST.to_bytes(2, "big")
_ANSWERS: Final = (ACK.to_bytes(2, "big"), NAK.to_bytes(2, "big"))
_SHOWN: Final = 3
"""Answers too many that a bad line does not make of one device (docs/explanation/safety.md)."""
_NUMBERED_ANSWERS: Final = {"ack": ACK, "nak": NAK}


class KilledError(BaseException):
    """The host's process is gone; no code of the host may catch it."""


class OverdueError(Exception):
    """The host did not end."""


class Agenda:
    """Engine that calls functions, and sends frames of other traffic, at their times."""

    done = False

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Callable[[float], None]]] = []
        self._order = count()
        self._due: deque[Frame] = deque()

    def at(self, moment: float, act: Callable[[float], None]) -> None:
        heapq.heappush(self._heap, (moment, next(self._order), act))

    def send(self, frames: Iterable[Frame], moment: float) -> None:
        """Send frames that are nobody's: other traffic, a second tool, unsolicited messages."""
        sent = list(frames)
        self.at(moment, lambda _now: self._due.extend(sent))

    def clear(self) -> None:
        """Forget what is not done yet."""
        self._heap.clear()
        self._due.clear()

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        while self._heap and self._heap[0][0] <= now:
            heapq.heappop(self._heap)[2](now)

    def deadline(self) -> float | None:
        if self._due:
            return AT_ONCE
        return self._heap[0][0] if self._heap else None

    def next_frame(self, now: float) -> Frame | None:
        return self._due[0] if self._due else None

    def frame_sent(self, now: float) -> None:
        if self._due:
            self._due.popleft()

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> Sequence[object]:
        return ()


class Unit:
    """Engine of a device whose supply fails, whose processor hangs, and whose answers change."""

    done = False

    def __init__(
        self, engine: IndependentDevice | MockDevice | SubjectDevice, *, drift: float = 0.0
    ) -> None:
        self.engine = engine
        self.before = self.application
        """Application that it had at the beginning."""
        self._rate = 1.0 + drift
        """Seconds of its clock in one second."""
        self._hangs_until = -inf
        self._hung_s = 0.0
        """Time for which its clock has been stopped, or will be until the end of the hang."""
        self._answers: list[plans.Answer] = []
        self._late: deque[tuple[float, list[Frame]]] = deque()
        """Messages in the place of others, with their times."""
        self._under_way: deque[Frame] = deque()
        """Rest of such a message."""
        self._bytes_left = 0
        """Of the engine's own message that is being sent."""
        self._first = self._begun = self.operations_begun
        self.on_operation: Callable[[int, float], None] | None = None
        """Called with the number of each flash operation that begins, from 1."""

    @property
    def application(self) -> bytes | None:
        """Bootable content of the flash."""
        engine = self.engine
        if isinstance(engine, IndependentDevice):
            return engine.flash.application
        return engine.stored_image

    @property
    def runs_application(self) -> bool:
        return self.engine.state in ("application", BootloaderState.APPLICATION)

    @property
    def operations_begun(self) -> int:
        """Flash operations that have begun."""
        engine = self.engine
        if isinstance(engine, IndependentDevice):
            return engine.flash.operations
        if not isinstance(engine, MockDevice):
            return engine.flash_faults.operations
        return engine.operations_done + (engine.operation_reaches(0.0) is not None)

    @property
    def has_power(self) -> bool:
        return self.engine.has_power

    def power_cut(self, now: float) -> None:
        if self.engine.has_power:
            self.engine.power_cut(self._own_time(now))
        self._end_hang(now)
        self._late.clear()
        self._under_way.clear()
        self._bytes_left = 0

    def power_on(self, now: float) -> None:
        if not self.engine.has_power:
            self.engine.power_on(self._own_time(now))

    def hang(self, until: float, now: float) -> None:
        """Stop its processor, and with it its clock."""
        begins_at = max(now, self._hangs_until)
        if until > begins_at:
            self._hung_s += until - begins_at
            self._hangs_until = until

    def _end_hang(self, now: float) -> None:
        self._hung_s -= max(0.0, self._hangs_until - now)
        self._hangs_until = -inf

    def end_faults(self, now: float) -> None:
        """Run on without a fault; a power supply that is off stays off."""
        self._end_hang(now)
        self._answers.clear()
        self._late.clear()
        self.fail_flash(0)

    def fail_flash(self, count: int) -> None:
        """Make so many more flash operations fail; 0: none any more."""
        engine = self.engine
        if isinstance(engine, MockDevice):
            return
        flash = engine.flash if isinstance(engine, IndependentDevice) else engine.flash_faults
        flash.failures_left = count and flash.failures_left + count

    def change(self, answer: plans.Answer) -> None:
        """Change the next answers."""
        self._answers += [answer] * answer.count

    # -- the engine interface --------------------------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        if now >= self._hangs_until:
            self.engine.receive(frame, self._own_time(now))
            self._watch_flash(now)

    def tick(self, now: float) -> None:
        if now >= self._hangs_until:
            self.engine.tick(self._own_time(now))
            self._watch_flash(now)

    def deadline(self) -> float | None:
        due = self.engine.deadline()
        own = inf if due is None else due / self._rate + self._hung_s
        if self._under_way:
            own = AT_ONCE
        elif self._late:
            own = min(own, self._late[0][0])
        return None if own == inf else max(own, self._hangs_until)

    def next_frame(self, now: float) -> Frame | None:
        if now < self._hangs_until:
            return None
        if not (self._answers or self._late or self._under_way or self._bytes_left):
            return self.engine.next_frame(self._own_time(now))
        if not self._under_way and not self._bytes_left and self._late:
            due_at, frames = self._late[0]
            if due_at <= now:
                self._late.popleft()
                self._under_way.extend(frames)
        if self._under_way:
            return self._under_way[0]
        frame = self.engine.next_frame(self._own_time(now))
        if frame is None:
            return None
        if not self._bytes_left and frame.data[:3] == b"\x55\xaa\x0c":
            # Two confirmations of one message are those of two devices (R27).
            is_feedback = frame.data[4:6] == _GENERAL_FEEDBACK
            if self._answers and not (is_feedback and self._answers[0].becomes == "twice"):
                self._change_answer(now)
                return self.next_frame(now)
            self._bytes_left = frame.data[3] + OVERHEAD_SIZE
        self._bytes_left = max(0, self._bytes_left - len(frame.data))
        return frame

    def frame_sent(self, now: float) -> None:
        if self._under_way:
            self._under_way.popleft()
        else:
            self.engine.frame_sent(self._own_time(now))

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> Sequence[object]:
        return self.engine.take_events()

    def _own_time(self, now: float) -> float:
        """Time on its clock; a deadline is not missed by rounding."""
        if self._rate == 1.0 and not self._hung_s:
            return now
        own = (max(now, self._hangs_until) - self._hung_s) * self._rate
        due = self.engine.deadline()
        return due if due is not None and own < due < own + _ROUNDING_S else own

    def _watch_flash(self, now: float) -> None:
        if self.on_operation is not None:
            before, self._begun = self._begun, self.operations_begun
            # flasher's model does not count an operation that was torn.
            self._first -= max(0, before - self._begun)
            for number in range(before + 1, self._begun + 1):
                self.on_operation(number - self._first, now)

    def _change_answer(self, now: float) -> None:
        """Take a message from the engine, and queue the one that is sent in its place."""
        engine, change, own = self.engine, self._answers.pop(0), self._own_time(now)
        frames: list[Frame] = []
        size = inf
        while sum(len(each.data) for each in frames) < size:
            frame = engine.next_frame(own)
            if frame is None:
                break
            frames.append(frame)
            engine.frame_sent(own)
            size = frames[0].data[3] + OVERHEAD_SIZE
        wire = b"".join(frame.data for frame in frames)
        command, data = int.from_bytes(wire[4:6], "big"), wire[6:-5]
        if change.becomes == "silence":
            return
        if command in (ACK, NAK):
            command = _NUMBERED_ANSWERS.get(change.becomes, command)
            number = (int.from_bytes(data, "little") + change.shift) % 0x10000
            frames = frames_of(frames[0].can_id, REPORT, command, number.to_bytes(2, "little"))
        copies = 2 if change.becomes == "twice" else 1
        self._late.append((now + change.late, frames * copies))


class HostClock:
    """Clock of a host on a simulated bus, which goes on while the host waits: for an adapter that
    is away, for example.
    """

    def __init__(self, bus: SimulatedBus, *, is_disturbed: bool) -> None:
        self.speed = 1.0 if is_disturbed else inf
        """A host on its own looks up ten times a second of real time, of which none passes here,
        for what ends or pauses it; only where the plan does so (`is_disturbed`) the time counts.
        """
        self._bus = bus
        self.now = bus.clock.now

    def wait_until(self, moment: float) -> None:
        while self.now() < moment:
            self._bus.advance(moment)


class Watcher(Protocol):
    """Observer of each frame before it is delivered."""

    def __call__(self, frame: Frame, sender: plans.Sender | None, now: float) -> None: ...


class PlanBus(SimulatedBus):
    """Simulated bus that knows who sends, and disturbs frames."""

    def __init__(self, clock: VirtualClock, watch: Watcher) -> None:
        super().__init__(WELLING.bitrate_bps, clock)
        self.agenda = Agenda()
        self.attach(self.agenda)
        (self._agenda_node,) = self._devices
        self.units: list[Unit] = []
        """Units that have been connected."""
        self.frame_faults: list[FrameFault] = []
        self.host: PlanLink | None = None
        """Link of the tool that runs now."""
        self.is_garbled = False
        """The host's adapter has another bit rate: it receives error frames only."""
        self._alone: Counter[Any] = Counter()
        """How often each unit or engine began a message alone that reached the tool. General
        feedback does not count: an application sends it to all that is not for it. Nor does a
        request for the transfer: one device may repeat it (R16).
        """
        self._is_complete = False
        """A device reported completion: whoever answers after it is another one."""
        self.burst_ends_at = inf
        """Time up to which boot versions do not count either; set by the player. One device may
        continue its burst after the update command, or begin it anew.
        """
        self.awaits_burst = False
        """The next boot version begins a burst that does not count: one device may start its new
        application through the bootloader.
        """
        self.on_late: Callable[[float], None] = lambda _now: None
        """Called when a delayed frame of a device arrives."""
        self._watch = watch

    def _deliver(self, senders: Sequence[Any], frame: Frame | None) -> None:
        self._sending = None
        if frame is None:
            return
        sender = senders[0]
        if len(senders) > 1:
            # Of equal frames in the same bits the host's adapter returns its own as an echo.
            sender = next((each for each in senders if each in self._hosts), sender)
        ends_at = self._sending_ends_at
        self._delivered_at = ends_at
        self.frames_carried += 1
        host = self.host
        word: plans.Sender | None = "device"
        if sender in self._hosts:
            word = "host"  # a killed process may have left frames in its adapter
        elif sender is self._agenda_node:
            word = None
        self._watch(frame, word, ends_at)
        takes_part = self.faults.takes_part
        is_whole = True
        if self.frame_faults and word is not None:
            all_carried = self._disturbed(frame, word, sender, ends_at)
            is_whole = frame in all_carried
            for carried in all_carried:
                self._carry(carried, senders, ends_at)
        else:
            self._carry(frame, senders, ends_at)
        if self.is_garbled and host is not None:
            host.node.inbox.append(ERROR_FRAME)
        if word == "host":
            if host is not None and sender is host.node:
                host.echo(frame, ends_at)
        elif takes_part and is_whole and len(senders) == 1 and word is not None:
            self._hear(sender, frame.data, ends_at)

    def _hear(self, sender: Any, data: bytes, now: float) -> None:
        """Note a unit that sends what another one would not."""
        word = data[4:6]
        if data[:2] != _HEADER or word in (_GENERAL_FEEDBACK, _REQUEST):
            return
        if word == _BOOT_VERSION and self.awaits_burst:
            # It may pass through its bootloader twice.
            self.awaits_burst, self.burst_ends_at = False, now + DEFAULT_TIMINGS.announcing_on_s
        elif word == _VERSION:  # its application is running
            self.burst_ends_at = min(self.burst_ends_at, now)
        if word == _BOOT_VERSION and now <= self.burst_ends_at:
            return
        is_answer = word in _ANSWERS and not self._is_complete
        self._is_complete |= word == _COMPLETE
        self._alone[sender.engine] += 1 if is_answer else _SHOWN

    @property
    def heard(self) -> frozenset[Any]:
        """Units and engines that a bad line of one device cannot have made."""
        return frozenset(each for each, times in self._alone.items() if times >= _SHOWN)

    def forget_heard(self) -> None:
        """Begin with another transfer."""
        self._alone.clear()
        self._is_complete = False

    def _carry(self, frame: Frame, senders: Sequence[Any], now: float) -> None:
        if not frame.is_error:
            for device in self._devices:
                if device not in senders and device is not self._agenda_node:
                    device.engine.receive(frame, now)
        host = self.host
        if host is not None and self.faults.takes_part and host.node not in senders:
            host.node.inbox.append(frame)

    def _disturbed(
        self, frame: Frame, word: plans.Sender, sender: Any, now: float
    ) -> Sequence[Frame]:
        def arrive(late: Frame, at: float) -> None:
            self._carry(late, [sender], at)
            if word == "device":
                self.on_late(at)

        def arrive_later(late: Frame, after_s: float) -> None:
            self.agenda.at(now + after_s, lambda at: arrive(late, at))

        frames = [frame]
        for fault in tuple(self.frame_faults):
            if fault.is_over(now):
                self.frame_faults.remove(fault)
            else:
                frames = fault.apply(frames, word, arrive_later)
        return frames


class FrameFault:
    """Fault of frames that is in force."""

    def __init__(self, clause: plans.OnFrames | plans.Noise, now: float) -> None:
        self._clause = clause
        self._left = getattr(clause, "count", 0)
        self._until = now + getattr(clause, "seconds", inf)
        self._random = random.Random(getattr(clause, "seed", 0))
        self._held: list[Frame] = []
        """Swapped frame that waits for the next one of its sender; frames of a message that will
        come again.
        """
        self._sender = clause.sender

    def is_over(self, now: float) -> bool:
        if isinstance(self._clause, plans.Noise):
            return now >= self._until
        return self._left <= 0 and not self._held

    def apply(
        self,
        frames: list[Frame],
        sender: plans.Sender,
        later: Callable[[Frame, float], None],
    ) -> list[Frame]:
        """Return what arrives of frames in their place."""
        if not frames or self._sender not in ("any", sender):
            return frames
        self._left -= 1
        frame, rest = frames[0], frames[1:]
        match self._clause:
            case plans.Drop():
                return rest
            case plans.Double(whole=whole):
                return self._doubled(frame, rest, sender) if whole else [frame, frame, *rest]
            case plans.Swap():
                return self._swap(frame, rest, sender)
            case plans.Delay(seconds=seconds):
                later(frame, seconds)
                return rest
            case plans.Flip(bit=bit):
                return [_flipped(frame, bit), *rest]
            case plans.Truncate(to=size):
                return [frame._replace(data=frame.data[:size]), *rest]
            case plans.Noise(lost=lost, wrong=wrong, doubled=doubled, errors=errors):
                drawn = self._random.random()
                if drawn < lost:
                    return rest
                if drawn < lost + wrong:
                    return [_flipped(frame, self._random.randrange(64)), *rest]
                if drawn < lost + wrong + doubled:
                    return [frame, frame, *rest]
                return [ERROR_FRAME, *rest] if drawn < lost + wrong + doubled + errors else frames
        raise AssertionError(self._clause)

    def _doubled(self, frame: Frame, rest: list[Frame], sender: plans.Sender) -> list[Frame]:
        held = self._held
        if not held and frame.data[:2] != _HEADER:
            return [frame, *rest]
        held.append(frame)
        self._sender = sender
        if sum(len(each.data) for each in held) < held[0].data[3] + OVERHEAD_SIZE:
            return [frame, *rest]
        frames = [frame, *held, *rest]
        held.clear()
        self._sender = self._clause.sender
        return frames

    def _swap(self, frame: Frame, rest: list[Frame], sender: plans.Sender) -> list[Frame]:
        if self._held:
            frames = [frame, *self._held, *rest]
            self._held.clear()
            self._sender = self._clause.sender
            return frames
        self._held.append(frame)
        self._sender = sender
        return rest


def _flipped(frame: Frame, bit: int) -> Frame:
    data = bytearray(frame.data)
    if data:
        data[bit // 8 % len(data)] ^= 1 << bit % 8
    return frame._replace(data=bytes(data))


class _Inbox(deque[Frame]):
    """Frames that have arrived at an adapter, with the time of each."""

    def __init__(self, now: Callable[[], float]) -> None:
        super().__init__()
        self._now = now
        self._stamps: deque[float] = deque()
        self.stamp_s = 0.0
        """Arrival of the frame that was taken last."""

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


class PlanLink(SimulatedLink):
    """The host's adapter: returns its own frames as the plan has it, and pauses with its host."""

    def __init__(self, bus: PlanBus, adapter: plans.Adapter, overdue_at: float) -> None:
        super().__init__(bus, adapter.queue)
        self.node = self._host
        self.node.inbox = self._inbox = _Inbox(bus.clock.now)
        self._plan_bus = bus
        self._adapter = adapter
        self._echoes = Echoes()
        self._random = random.Random(adapter.seed)
        self._stalls_until = -inf
        self._suffers = self._is_killed = self._is_overdue = False
        self.on_send: Callable[[Frame, float], None] = lambda _frame, _now: None
        """Called when a frame is handed to the adapter."""
        bus.host = self
        bus.agenda.at(overdue_at, self._end)

    def stall(self, until: float) -> None:
        """Pause the host: no call returns before."""
        self._stalls_until = max(self._stalls_until, until)
        self._suffers = True

    def kill(self) -> None:
        """End the host's process at its next call."""
        self._is_killed = self._suffers = True

    def _end(self, _now: float) -> None:
        self._is_overdue = self._suffers = True

    def echo(self, frame: Frame, now: float) -> None:
        """Return a frame that has left."""
        adapter = self._adapter
        if not adapter.echoes:
            return
        draw = self._random.random
        if draw() < adapter.lost:
            return
        for _ in range(2 if draw() < adapter.doubled else 1):
            due_at = now + adapter.delay + adapter.jitter * draw()
            if due_at <= now:
                self._inbox.append(frame)
            else:
                self._plan_bus.agenda.at(due_at, lambda _now: self._inbox.append(frame))

    def _suffer(self) -> None:
        clock = self._plan_bus.clock
        if self._is_killed:
            raise KilledError
        while clock.now() < self._stalls_until:
            self._plan_bus.advance(self._stalls_until)
        if self._is_overdue:
            raise OverdueError
        self._suffers = False

    def send(self, frame: Frame) -> None:
        if self._suffers:
            self._suffer()
        super().send(frame)
        self._echoes.sent(frame)
        self.on_send(frame, self._plan_bus.clock.now())

    def receive(self, deadline: float) -> Frame | None:
        if self._suffers:
            self._suffer()
        frame = super().receive(deadline)
        if self._suffers:
            self._suffer()
        if frame is None:
            return None
        return self._echoes.mark(frame, self._inbox.stamp_s, is_rx=True)

    def reopen(self) -> None:
        if self._suffers:
            self._suffer()
        super().reopen()
        self._echoes.reopened()
