"""Time of a whole line: each socket has a bus and a clock of its own, and all of them reach the
same moment before anything happens that is not on a bus.

The process of a socket runs in a greenlet, up to the `horizon` that it is given; it stops sooner
where it waits for the station. Nothing here reads a real clock, so that the same story takes the
same course each time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from greenlet import getcurrent, greenlet  # type: ignore[import-untyped]

from flasher.api import Connection
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus, SimulatedLink
from flasher.mock.bms import BmsApplication
from flasher.mock.model import MockDevice
from flasher.mock.table import BootloaderState
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    COMMAND_SIZE,
    FRAME_DATA_SIZE,
    HEADER,
    MODE_SIZE,
    PREFIX_SIZE,
    WELLING,
    Mode,
)
from flasher.station.messages import Ask, FromWorker, ToWorker, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import RunResult
from flasher.station.worker import StationGoneError, StationPipe, work_on

_WRITE: Final = HEADER + Mode.WRITE.to_bytes(MODE_SIZE, "big")


class SocketBus(SimulatedBus):
    """The bus of a socket: nothing on it passes the horizon."""

    def __init__(self) -> None:
        self.horizon = 0.0
        self.wire_clock = VirtualClock()
        super().__init__(WELLING.bitrate_bps, self.wire_clock)
        self._link: SimulatedLink | None = None
        self.on_command: Callable[[int, float], None] | None = None
        """Called with each command that the host writes, when its first frame has been carried."""
        self.stop: Callable[[], None] = lambda: None
        """Called at the horizon; it returns when there is a later one."""

    def advance(self, limit: float) -> None:
        while self.clock.now() >= self.horizon:
            if limit <= self.clock.now():
                super().advance(limit)
                return
            self.stop()
        super().advance(min(limit, self.horizon))

    def _deliver(self, senders: Sequence[Any], frame: Frame | None) -> None:
        if (
            self.on_command is not None
            and frame is not None
            and senders[0] in self._hosts
            and frame.data.startswith(_WRITE)
        ):
            command = frame.data[PREFIX_SIZE : PREFIX_SIZE + COMMAND_SIZE]
            self.on_command(int.from_bytes(command, "big"), self._sending_ends_at)
        for part in (getattr(sender, "engine", None) for sender in senders):
            if isinstance(part, _Part) and frame is not None:
                part.frame_carried(frame, self._sending_ends_at, is_received=self._is_received())
        super()._deliver(senders, frame)

    def _is_received(self) -> bool:
        """A process listens; what comes before it opens a lost adapter again is discarded."""
        link, faults = self._link, self.faults
        return link is not None and link._opened_at == faults.times_unplugged and faults.takes_part

    def idle(self, until: float) -> None:
        """Let time pass without an adapter."""
        while self.clock.now() < until:
            super().advance(until)

    def put(self, unit: PaperUnit) -> None:
        for part in unit.parts:
            self.attach(part)

    def pull(self, unit: PaperUnit) -> None:
        """Take a unit off, in the middle of a frame if it sends one."""
        if self._sending is not None:
            senders, _ = self._sending
            if any(getattr(sender, "engine", None) in unit.parts for sender in senders):
                self._sending = None
        for part in unit.parts:
            self.detach(part)

    @contextmanager
    def opened(self) -> Iterator[tuple[Connection, None]]:
        """The adapter of the socket. Raises BusError while it is not plugged in."""
        self.close_adapter()
        self._link = link = self.link()
        link.reopen()
        yield Connection(link, self.clock, "an adapter"), None

    def close_adapter(self) -> None:
        """What the process of the socket had still to send is gone with it."""
        self._silence_hosts()
        self._link = None
        for host in self._hosts:
            self._nodes.remove(host)
        self._hosts.clear()


class Pipe:
    """Both ends of the pipe between the station and the process of a socket."""

    def __init__(self, bus: SocketBus, on_sent: Callable[[FromWorker], None]) -> None:
        self._bus = bus
        self._on_sent = on_sent
        self.to_worker: deque[ToWorker] = deque()
        self.to_station: deque[FromWorker] = deque()
        self.is_broken = False

    # -- the end of the process -------------------------------------------------------------------

    def send(self, message: Any) -> None:
        if self.is_broken:
            raise OSError("the station is gone")
        self.to_station.append(message)
        self._on_sent(message)
        if isinstance(message, Ask | RunResult):
            self._bus.stop()  # the station answers at once

    def recv(self) -> Any:
        if not self.to_worker:
            raise EOFError
        return self.to_worker.popleft()

    def poll(self, timeout: float = 0.0) -> bool:
        until = self._bus.clock.now() + timeout
        while not self.to_worker and not self.is_broken:
            if self._bus.clock.now() >= until:
                return False
            self._bus.advance(until)
        return True


class Process:
    """The process of a socket, as the supervisor has it (a `Port`)."""

    waitable = None

    def __init__(
        self,
        setup: WorkerSetup,
        recipe: LoadedRecipe,
        bus: SocketBus,
        on_sent: Callable[[FromWorker], None],
    ) -> None:
        self._bus = bus
        self._pipe = Pipe(bus, on_sent)
        self.has_asked = False
        """It waits for the station."""
        self.stalled_until = 0.0

        def main() -> None:
            pipe = StationPipe(self._pipe, bus.clock.now)
            with suppress(StationGoneError):
                work_on(pipe, setup, recipe, bus.opened)

        self._greenlet = greenlet(main)
        bus.stop = self._stop

    def _stop(self) -> None:
        self.has_asked = self._bus.clock.now() < self._bus.horizon
        self._greenlet.parent.switch()

    @property
    def is_over(self) -> bool:
        return bool(self._greenlet.dead)

    def go_on(self, horizon: float) -> None:
        """Run until this time, or until it waits for the station."""
        self._bus.horizon, self.has_asked = horizon, False
        if horizon <= self.stalled_until:
            self._bus.idle(horizon)
        if not self.is_over and self._bus.clock.now() < horizon:
            self._greenlet.parent = getcurrent()
            self._greenlet.switch()
        if self.is_over:
            self._bus.idle(horizon)

    # -- the station's end ------------------------------------------------------------------------

    def send(self, message: ToWorker) -> bool:
        if not (self.is_over or self._pipe.is_broken):
            self._pipe.to_worker.append(message)
        return not self.is_over

    def receive(self) -> FromWorker | None:
        if self._pipe.to_station:
            return self._pipe.to_station.popleft()
        if self.is_over:
            raise EOFError
        return None

    def kill(self) -> None:
        """End it where it is."""
        if not self.is_over:
            self._greenlet.throw()
        self._bus.close_adapter()

    def join(self, limit_s: float) -> bool:
        return self.is_over

    def lose_station(self) -> None:
        """The station is dead: it finds the pipe broken."""
        self._pipe.is_broken = True


class PaperUnit:
    """A unit as it lies on the table: its devices and a paper label, on whichever bus it is put."""

    def __init__(self, devices: Sequence[MockDevice], label: str) -> None:
        self.parts = [_Part(each, self) for each in devices]
        self.label = label
        self.engine = devices[0]
        """The battery where there is one."""
        self.sleeps_until = float("-inf")
        self.gave_up_at = float("-inf")
        """When a device ended a transfer that was not continued, and began to announce itself."""
        self.on_sent: Callable[[float], None] = lambda _now: None
        self.last_word: BootloaderState | None = None
        """State of its `engine` when its last message was received since its power came; None while
        it has sent none, or is in the middle of one.
        """
        self.sent_at = 0.0
        """When its last frame was received."""
        self._seen = self.memory

    @property
    def memory(self) -> tuple[object, int]:
        """The number of its battery, and `operations`."""
        number = None
        for part in self.parts:
            if isinstance(part.engine.application, BmsApplication):
                number = part.engine.application.kept["serial number"]
        return number, self.operations

    @property
    def is_in_transfer(self) -> bool:
        """A device waits for the next message of a transfer."""
        return any(part.engine.state is BootloaderState.TRANSFER for part in self.parts)

    @property
    def operations(self) -> int:
        """How often the flash of its devices was erased or written."""
        return sum(part.engine.operations_done for part in self.parts)

    def has_not_changed(self) -> bool:
        """Since it was asked last, as far as `memory` goes."""
        before, self._seen = self._seen, self.memory
        return before[0] is self._seen[0] and before[1] == self._seen[1]

    def power_on(self, now: float) -> None:
        self.last_word = None
        for part in self.parts:
            if not part.engine.has_power:
                part.engine.power_on(now)

    def power_cut(self, now: float) -> None:
        for part in self.parts:
            if part.engine.has_power:
                part.engine.power_cut(now)


class _Part:
    """A device of a unit."""

    done = False

    def __init__(self, engine: MockDevice, unit: PaperUnit) -> None:
        self.engine = engine
        self._unit = unit

    def receive(self, frame: Frame, now: float) -> None:
        if now >= self._unit.sleeps_until:
            self.engine.receive(frame, now)

    def tick(self, now: float) -> None:
        if now < self._unit.sleeps_until:
            return
        before = self.engine.state
        self.engine.tick(now)
        if (before, self.engine.state) == (BootloaderState.TRANSFER, BootloaderState.ANNOUNCING):
            self._unit.gave_up_at = now

    def deadline(self) -> float | None:
        due_at = self.engine.deadline()
        return None if due_at is None else max(due_at, self._unit.sleeps_until)

    def next_frame(self, now: float) -> Frame | None:
        return self.engine.next_frame(now) if now >= self._unit.sleeps_until else None

    def frame_sent(self, now: float) -> None:
        self.engine.frame_sent(now)

    def frame_carried(self, frame: Frame, now: float, *, is_received: bool) -> None:
        """Its frame has been on the bus to its end. The station knows only of received ones."""
        if not is_received:
            return
        if self.engine is self._unit.engine:
            is_last = len(frame.data) < FRAME_DATA_SIZE
            self._unit.last_word = self.engine.state if is_last else None
            self._unit.sent_at = now
        self._unit.on_sent(now)

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> Sequence[object]:
        return self.engine.take_events()
