"""A station whose sockets' processes are scripted: no bus, a stopped clock."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any, TypeVar

from flasher.station.events import SocketState, StationEvent, StepEnded
from flasher.station.gate import Gate
from flasher.station.label_printer import LabelPrinter
from flasher.station.messages import (
    AdapterReady,
    Ask,
    FromWorker,
    JournalWrite,
    PresenceChanged,
    ToWorker,
    WorkerSetup,
    WriteReply,
    packed,
)
from flasher.station.operators import Crew
from flasher.station.records.model import (
    Claim,
    Measurement,
    RunResult,
    RunState,
    StepName,
    StepState,
    Verified,
)
from flasher.station.station import Station, StationOptions
from tests.station.factory import Bench

Event = TypeVar("Event")


def tried(step: StepName) -> StepEnded:
    """A good try of a step."""
    target = "bms" if step is StepName.FLASH else ""
    return StepEnded("", "", step, 1, StepState.PASS, 1.0, target=target)


class ScriptedPort:
    """The process of a socket, as a script."""

    def __init__(self, setup: WorkerSetup) -> None:
        self.setup = setup
        self.reported: deque[FromWorker] = deque()
        self.heard: list[ToWorker] = []
        self.is_gone = False
        self.killed = 0

    @property
    def waitable(self) -> Any:
        return None

    def send(self, message: ToWorker) -> bool:
        if not self.is_gone:
            self.heard.append(message)
        return not self.is_gone

    def receive(self) -> FromWorker | None:
        if self.reported:
            return self.reported.popleft()
        if self.is_gone:
            raise EOFError
        return None

    def kill(self) -> None:
        self.killed += 1
        self.is_gone = True

    def join(self, limit_s: float) -> bool:
        return True


class AtOnce(Executor):
    """Does what it is given at once, in the same thread; while `holds`, when `go_on` is called."""

    def __init__(self) -> None:
        self.holds = False
        self.waiting: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self.done = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.waiting.append((future, lambda: fn(*args, **kwargs)))
        if not self.holds:
            self.go_on()
        return future

    def go_on(self) -> None:
        """Do the first of what waits."""
        future, do = self.waiting.popleft()
        self.done += 1
        future.set_result(do())


class LineBench:
    """A station with sockets A, B, ...; at the start the processes say that they are empty."""

    def __init__(
        self,
        bench: Bench,
        sockets: str = "AB",
        *,
        sees_units: bool = True,
        are_empty: bool = True,
        scans_labels: bool = False,
        mixes_virtual: bool = False,
        needs_golden: bool = False,
        crew: Crew | None = None,
        labels: LabelPrinter | None = None,
        gate: Gate | None = None,
    ) -> None:
        self.bench = bench
        self.sees_units = sees_units
        self.events: list[StationEvent] = []
        self.ports: dict[str, ScriptedPort] = {}
        self.checker = AtOnce()
        setups = [WorkerSetup(name, bench.recipe.path, {}, None) for name in sockets]
        self.station = Station(
            bench.store,
            bench.recipe,
            setups,
            operator="jo" if crew is None else "",
            crew=crew,
            labels=labels,
            on_event=self.events.append,
            options=StationOptions(
                arrival_limit_s=5.0,
                end_limit_s=0.0,
                scans_labels=scans_labels,
                mixes_virtual=mixes_virtual,
                needs_golden=needs_golden,
            ),
            clock=bench.clock,
            launch=self._launch,
            checker=self.checker,
            gate=gate,
        )
        self.station.timer = lambda: 0.0  # a slow computer of the tests is no stall
        self.station.start()
        for name in sockets:
            self.say(name, AdapterReady(sees_units=sees_units))
            if sees_units and are_empty:
                self.leave(name)

    def _launch(self, setup: WorkerSetup) -> ScriptedPort:
        self.ports[setup.socket] = ScriptedPort(setup)
        return self.ports[setup.socket]

    def turn(self) -> None:
        self.station.turn(0.0)

    def say(self, socket: str, message: FromWorker) -> None:
        self.ports[socket].reported.append(message)
        self.turn()

    def arrive(self, socket: str, serial: str | None = "") -> None:
        """A unit that reports this serial number: empty, it has none; None, not reported yet.
        A person needs a moment to connect it.
        """
        self.bench.clock.go_on(2.0)
        self.say(socket, PresenceChanged(is_there=True, how="traffic", serial=serial))

    def leave(self, socket: str) -> None:
        self.say(socket, PresenceChanged(is_there=False, is_certain=True))

    def fall_silent(self, socket: str) -> None:
        """The unit is silent: it was removed, or it sleeps."""
        self.say(socket, PresenceChanged(is_there=False))

    def scan(self, text: str) -> None:
        self.station.submit(text)
        self.turn()

    def text(self, socket: str) -> str:
        shown = self.station.line.sockets[socket].shown
        return "" if shown is None else shown[2]

    def state(self, socket: str) -> SocketState:
        return self.station.line.sockets[socket].state

    def of(self, kind: type[Event]) -> list[Event]:
        """The events of a kind so far."""
        return [event for event in self.events if isinstance(event, kind)]

    def last(self, kind: type[Event]) -> Event:
        return self.of(kind)[-1]

    # -- what a process does ----------------------------------------------------------------------

    def order(self, socket: str) -> Claim:
        return next(m for m in reversed(self.ports[socket].heard) if isinstance(m, Claim))

    def ask(
        self,
        socket: str,
        what: JournalWrite | StepEnded,
        measurements: tuple[Measurement, ...] = (),
    ) -> WriteReply:
        """Ask the station to save something; its reply."""
        port = self.ports[socket]
        number = 1 + sum(isinstance(message, WriteReply) for message in port.heard)
        self.say(socket, Ask(number, what, measurements))
        reply = port.heard[-1]
        assert isinstance(reply, WriteReply)
        assert reply.number == number
        return reply

    def work(self, socket: str) -> None:
        """A good run, up to its last step."""
        write = JournalWrite("bms", "flash", "V1")
        reply = self.ask(socket, write)
        assert reply.write_id is not None, reply.error
        self.ask(socket, replace(write, write_id=reply.write_id, read_back="V1"))
        self.ask(socket, tried(StepName.FLASH), (Measurement("bms version", text="V1"),))

    def trace(self, socket: str) -> str:
        """Write the trace of its run; the hash."""
        claim = self.order(socket)
        path = packed(claim.trace)
        self.bench.traced(claim.serial).replace(path)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    def end(self, socket: str, outcome: RunState = RunState.PASS, code: str = "OK") -> None:
        verified = {"bms": Verified.VERSION} if outcome is RunState.PASS else {}
        trace = self.trace(socket)
        self.say(socket, RunResult(outcome, code, "what happened", 2.0, verified, trace))
        if self.sees_units:
            self.say(socket, PresenceChanged(is_there=True, how="traffic"))

    def make(self, socket: str, serial: str) -> None:
        """A whole good run of a unit that comes."""
        self.scan(serial)
        self.arrive(socket)
        self.work(socket)
        self.end(socket)
