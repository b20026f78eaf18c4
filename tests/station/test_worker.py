"""The process of a socket, in this process: what it asks, what it tells, and when it stops."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from math import inf
from pathlib import Path
from typing import Any, NoReturn

import pytest

from flasher.api import Connection
from flasher.bus.detect import DetectedAdapter
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus, SimulatedLink
from flasher.errors import BusError, UsageError
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import WELLING
from flasher.station.config import MockUnits, SocketConfig
from flasher.station.events import StepEnded, StepStarted
from flasher.station.messages import (
    AdapterDown,
    AdapterReady,
    Ask,
    Beat,
    FromWorker,
    JournalError,
    JournalWrite,
    PresenceChanged,
    Stop,
    ToWorker,
    VirtualUnits,
    WorkerSetup,
    WriteReply,
    packed,
)
from flasher.station.presence import SILENCE_S
from flasher.station.records.model import (
    Claim,
    RunId,
    RunKind,
    RunResult,
    RunState,
    StepName,
    WriteId,
)
from flasher.station.unit_run import UnitRun
from flasher.station.unit_steps import UnitSteps
from flasher.station.virtual_units import Health, VirtualSocket, make_device
from flasher.station.worker import (
    StationPipe,
    Worker,
    load_same,
    load_when_whole,
    open_socket,
    work_on,
)
from tests.loops import each
from tests.station.factory import DAY, USUAL, make_recipe
from tests.station.unit_bench import WRITES


class FakeChannel:
    """The pipe; `answer` is the station's side, and may raise OSError when it is dead."""

    def __init__(self, answer: Callable[[FakeChannel, FromWorker], None]) -> None:
        self.waiting: deque[ToWorker] = deque()
        self.sent: list[FromWorker] = []
        self.is_broken = False
        self._answer = answer

    def send(self, obj: Any, /) -> None:
        if self.is_broken:
            raise BrokenPipeError
        self.sent.append(obj)
        self._answer(self, obj)

    def recv(self) -> Any:
        if self.is_broken:
            raise EOFError
        return self.waiting.popleft()

    def poll(self, timeout: float = 0.0) -> bool:
        return self.is_broken or bool(self.waiting)

    def of(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.sent if isinstance(message, kind)]


def claim(serial: str, trace: Path, presence: int = 0) -> Claim:
    return Claim(RunId(1), RunKind.PRODUCTION, serial, DAY, trace=trace, presence=presence)


class Socket:
    """A worker with virtual units, and a station that says yes to everything."""

    def __init__(self, folder: Path, units: MockUnits | None = None) -> None:
        self.recipe = make_recipe(folder, USUAL + WRITES)
        self.trace = folder / "run-1.log"
        virtual = VirtualUnits(units or MockUnits(), speed=0, count=1)
        files = {str(path): sha256 for path, sha256 in self.recipe.files.items()}
        self.setup = WorkerSetup("A", self.recipe.path, files, None, virtual)
        self.channel = FakeChannel(self.answer)
        self.line = StationPipe(self.channel, time.perf_counter)
        self.virtual = VirtualSocket(self.recipe, virtual)
        self.error = ""

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        match message:
            case PresenceChanged(True, _, label):
                channel.waiting.append(claim(label, self.trace))
            case Ask(number):
                channel.waiting.append(WriteReply(number, WriteId(number), self.error))
            case RunResult():
                channel.waiting.append(Stop(ends_process=True))

    def work(self) -> RunResult | None:
        worker = Worker(self.setup, self.recipe, self.line, self.virtual.connection, self.virtual)
        worker.work()
        ended = self.channel.of(RunResult)
        return ended[-1] if ended else None


def test_a_unit_that_comes_is_run_and_its_trace_is_closed(tmp_path: Path) -> None:
    socket = Socket(tmp_path)
    ended = socket.work()
    assert ended is not None
    assert ended.outcome is RunState.PASS, ended.text
    assert ended.trace_sha256 is not None
    lines = gzip.decompress(packed(socket.trace).read_bytes()).decode("ascii").splitlines()
    assert len(lines) > 50
    assert not socket.trace.exists()
    assert isinstance(socket.channel.sent[0], AdapterReady)
    assert socket.channel.of(Beat)
    assert socket.channel.of(StepStarted)


def test_it_does_nothing_before_the_reply(tmp_path: Path) -> None:
    socket = Socket(tmp_path)
    socket.error = "RECORD NOT SAVED: the disk is full."
    ended = socket.work()
    assert ended is not None
    assert ended.code == "RECORD_NOT_SAVED"
    device = socket.virtual.devices["bms"].device
    assert device.erase_count == 0


@pytest.mark.parametrize("asks", [1, 4, 5, 8])
def test_when_the_station_dies_it_ends_without_another_act(tmp_path: Path, asks: int) -> None:
    socket = Socket(tmp_path)

    def die(channel: FakeChannel, message: FromWorker) -> None:
        if len(channel.of(Ask)) == asks:
            channel.is_broken = True
        else:
            Socket.answer(socket, channel, message)

    socket.channel._answer = die
    assert socket.work() is None
    assert socket.line.is_gone
    device = socket.virtual.devices["bms"].device
    # The fourth ask is the intent to flash: without its reply nothing was erased.
    assert (device.erase_count == 0) == (asks <= 4)


def test_a_person_aborts_between_two_messages(tmp_path: Path) -> None:
    socket = Socket(tmp_path)

    def abort(channel: FakeChannel, message: FromWorker) -> None:
        Socket.answer(socket, channel, message)
        if (
            isinstance(message, Ask)
            and isinstance(message.what, JournalWrite)
            and not message.what.write_id
        ):
            channel.waiting.append(Stop())

    socket.channel._answer = abort
    ended = socket.work()
    assert ended is not None
    assert ended.outcome is RunState.ABORTED


def test_a_trace_that_cannot_be_written_is_no_pass(tmp_path: Path) -> None:
    socket = Socket(tmp_path)
    socket.trace = tmp_path / "not there" / "run-1.log"
    ended = socket.work()
    assert ended is not None
    assert (ended.code, ended.trace_sha256) == ("TRACE_NOT_SAVED", None)


def test_a_bug_in_a_run_does_not_end_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket = Socket(tmp_path)

    def fall(*_args: object, **_kwargs: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("flasher.station.worker.UnitRun.run", fall)
    ended = socket.work()
    assert ended is not None
    assert (ended.outcome, ended.code) == (RunState.ERROR, "INTERNAL")


def test_a_station_that_does_not_save_in_time_is_not_waited_for() -> None:
    now = [0.0]

    def clock() -> float:
        now[0] += 1.0
        return now[0]

    pipe = StationPipe(FakeChannel(lambda _channel, _message: None), clock)
    with pytest.raises(JournalError, match="did not save within 60 s"):
        pipe.intent("bms", "flash", "V1")


def test_another_recipe_than_the_stations_is_refused(tmp_path: Path) -> None:
    socket = Socket(tmp_path)
    assert load_same(socket.setup).sha256 == socket.recipe.sha256
    (tmp_path / "bms.bin.toml").write_bytes((tmp_path / "bms.bin.toml").read_bytes() + b"\n")
    with pytest.raises(UsageError, match="was changed"):
        load_same(socket.setup)


# -- a real adapter -------------------------------------------------------------------------------


class RealAdapter(Socket):
    """A socket with an adapter on a simulated bus, whose time passes while it waits for the
    station.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.clock = VirtualClock()
        self.bus = SimulatedBus(WELLING.bitrate_bps, self.clock)
        self.line = StationPipe(self.channel, self.clock.now)
        self.ready_at: list[float] = []

        def poll(timeout: float = 0.0) -> bool:
            until = self.clock.now() + timeout
            while self.clock.now() < until:
                self.bus.advance(until)
            return bool(self.channel.waiting)

        vars(self.channel)["poll"] = poll

    @property
    def kinds(self) -> list[str]:
        return [type(m).__name__ for m in self.channel.sent if not isinstance(m, Beat)]

    def connection(self) -> Connection:
        return Connection(self.bus.link(), self.clock, "a bus")

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, AdapterReady):
            self.ready_at.append(self.clock.now())
            if channel.of(AdapterDown):
                channel.waiting.append(Stop(ends_process=True))
            else:
                self.bus.unplug(back_after_s=2.5)


def test_an_adapter_that_goes_is_reported_with_what_helps_and_opened_again(tmp_path: Path) -> None:
    socket = RealAdapter(tmp_path)
    Worker(socket.setup, socket.recipe, socket.line, socket.connection()).work()
    assert socket.kinds == ["AdapterReady", "AdapterDown", "AdapterDown", "AdapterReady"]
    lost, closed = (each.reason for each in socket.channel.of(AdapterDown))
    assert "no such device" in lost
    assert closed == "The adapter cannot be opened: it is not there. Plug it in."
    assert 2.5 <= socket.ready_at[-1] < 3.6


def test_an_adapter_that_goes_while_no_unit_acknowledges_is_reported(tmp_path: Path) -> None:
    """The usual state of an empty socket: its queue is full, and it is opened again."""
    socket = RealAdapter(tmp_path)
    connection = socket.connection()
    reopen = connection.link.reopen

    def answer(channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, AdapterReady) and channel.of(AdapterDown):
            channel.waiting.append(Stop(ends_process=True))

    def go_first() -> None:
        if not socket.channel.of(AdapterDown):
            socket.bus.unplug(back_after_s=2.5)
        reopen()

    socket.channel._answer = answer
    socket.bus.is_unacknowledged = True
    connection.link.reopen = go_first  # type: ignore[method-assign]
    Worker(socket.setup, socket.recipe, socket.line, connection).work()
    kinds = [kind for kind in socket.kinds if kind != "PresenceChanged"]
    assert kinds == ["AdapterReady", "AdapterDown", "AdapterReady"]


@pytest.mark.slow
def test_python_can_prints_nothing_into_the_table_of_the_station() -> None:
    program = (
        "import logging, flasher.station.worker as worker\n"
        "worker.load_when_whole = lambda pipe, setup: None\n"
        "worker.worker_main(None, None)\n"
        "logging.getLogger('can.interfaces.socketcan').error('Could not access SocketCAN device')"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert not done.stderr


def test_an_adapter_that_cannot_be_opened_is_reported_once_and_tried_again(tmp_path: Path) -> None:
    socket = RealAdapter(tmp_path)
    tries: list[float] = []

    @contextmanager
    def opened() -> Iterator[tuple[Connection, None]]:
        tries.append(socket.clock.now())
        if len(tries) < 4:
            raise BusError("It is not there.")
        yield socket.connection(), None

    work_on(socket.line, socket.setup, socket.recipe, opened)
    assert socket.kinds == ["AdapterDown", "AdapterReady"]
    assert [after - before for before, after in pairwise(tries)] == pytest.approx(
        [1.0] * 3, abs=0.1
    )


def opened_by(
    socket: RealAdapter, found: list[DetectedAdapter], monkeypatch: pytest.MonkeyPatch
) -> list[dict[str, Any]]:
    """Have these adapters found. Returns a list that gets how each is opened."""
    opened: list[dict[str, Any]] = []

    @contextmanager
    def connect(_dialect: object, **bus: Any) -> Iterator[Connection]:
        opened.append(bus)
        yield socket.connection()

    monkeypatch.setattr("flasher.station.worker.connect", connect)
    monkeypatch.setattr("flasher.station.adapters.network_adapters", lambda _network: found)
    return opened


def test_an_adapter_that_has_another_name_now_is_still_the_sockets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process was started again, or did not find it at first."""
    socket = RealAdapter(tmp_path)
    setup = replace(
        socket.setup, adapter=SocketConfig(name="A", interface="socketcan", serial_number="7")
    )
    found: list[DetectedAdapter] = []
    opened = opened_by(socket, found, monkeypatch)
    with (
        pytest.raises(BusError, match="no socketcan adapter with the serial number 7"),
        open_socket(setup, socket.recipe),
    ):
        pass
    for name in ("can2", "can3"):
        found[:] = [DetectedAdapter("socketcan", name, {"serial_number": "7"})]
        with open_socket(setup, socket.recipe):
            pass
    assert [bus["channel"] for bus in opened] == ["can2", "can3"]
    assert not any(bus["by_place"] for bus in opened)


def test_the_adapter_of_a_socket_that_names_a_place_is_opened_again_by_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket = RealAdapter(tmp_path)
    place = SocketConfig(name="A", interface="socketcan", usb_path="1-1")
    found = [DetectedAdapter("socketcan", "can2", {"serial_number": "7", "usb_path": "1-1"})]
    opened = opened_by(socket, found, monkeypatch)
    with open_socket(replace(socket.setup, adapter=place), socket.recipe):
        pass
    assert [(bus["channel"], bus["by_place"]) for bus in opened] == [("can2", True)]


def test_a_socket_that_cannot_be_used_is_reported_and_not_tried_again(tmp_path: Path) -> None:
    socket = RealAdapter(tmp_path)

    def opened() -> NoReturn:
        raise UsageError("There is no such interface.")

    work_on(socket.line, socket.setup, socket.recipe, opened)
    assert [each.is_final for each in socket.channel.of(AdapterDown)] == [True]


def test_a_damaged_copy_of_the_plants_recipe_is_reported_once_and_loaded_when_it_is_whole(
    tmp_path: Path,
) -> None:
    socket = RealAdapter(tmp_path)
    file, poll = tmp_path / "bms.bin.toml", socket.channel.poll
    whole = file.read_bytes()
    file.write_bytes(whole + b"\n")
    os.utime(socket.setup.recipe, (1, 1))

    def fetched_after_7_s(timeout: float = 0.0) -> bool:
        if socket.clock.now() > 7.0:
            file.write_bytes(whole)
        return poll(timeout)

    vars(socket.channel)["poll"] = fetched_after_7_s
    loaded = load_when_whole(socket.line, replace(socket.setup, is_from_plant=True))
    assert loaded is not None
    assert loaded.files == socket.recipe.files
    assert socket.kinds == ["AdapterDown"]
    changed = socket.setup.recipe.stat().st_mtime > 1
    assert changed, "the process that fetches has to read files that a disk damaged"
    assert "is fetched again" in socket.channel.of(AdapterDown)[0].reason
    assert socket.clock.now() == pytest.approx(10.0, abs=0.2)


def test_a_damaged_copy_is_not_waited_for_when_another_recipe_was_approved(tmp_path: Path) -> None:
    socket = RealAdapter(tmp_path)
    (tmp_path / "bms.bin.toml").unlink()
    socket.channel.waiting.append(Stop(ends_process=True))
    assert load_when_whole(socket.line, replace(socket.setup, is_from_plant=True)) is None
    assert socket.kinds == ["AdapterDown"]


def test_a_local_recipe_that_was_changed_is_not_tried_again(tmp_path: Path) -> None:
    socket = RealAdapter(tmp_path)
    (tmp_path / "bms.bin.toml").unlink()
    assert load_when_whole(socket.line, socket.setup) is None
    assert [each.is_final for each in socket.channel.of(AdapterDown)] == [True]


# -- the unit of the label ------------------------------------------------------------------------


class RealSocket(Socket):
    """A socket without virtual units: a battery talks on its bus, and a test pulls it out."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.clock = VirtualClock()
        self.bus = SimulatedBus(WELLING.bitrate_bps, self.clock)
        self.bus.attach(self.unit("NONE"))

    def unit(self, number: str) -> MockDevice:
        target = self.recipe.targets[0]
        return make_device(target.target, WELLING, Health.GOOD, target.release, number)

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, PresenceChanged):
            if message.is_there and message.serial is not None and not channel.of(RunResult):
                self.begin()
        else:
            super().answer(channel, message)

    def begin(self) -> None:
        self.channel.waiting.append(claim("W2605002", self.trace))

    def work(self) -> RunResult | None:
        connection = Connection(self.bus.link(), self.clock, "a bus")
        Worker(self.setup, self.recipe, self.line, connection).work()
        ended: RunResult = self.channel.of(RunResult)[-1]
        return ended


class Renamed(SimulatedLink):
    channel = "can2"

    def reopen(self) -> None:
        super().reopen()
        self.channel = "can3"

    def __str__(self) -> str:
        return f"socketcan {self.channel}"


def test_the_records_name_the_adapter_as_it_came_back(tmp_path: Path) -> None:
    """The old name may be the adapter of another socket."""
    socket = RealSocket(tmp_path)
    link = Renamed(socket.bus, 10)
    link.reopen()
    connection = Connection(link, socket.clock, "socketcan can2", channel="can2")
    Worker(socket.setup, socket.recipe, socket.line, connection).work()
    steps = [ask.what for ask in socket.channel.of(Ask) if isinstance(ask.what, StepEnded)]
    assert next(each.text for each in steps if each.step is StepName.CONNECT) == "socketcan can3"


class Pulled(RealSocket):
    """The unit is pulled out when its label is scanned, or a moment later; the next one follows."""

    pulled_after_s = 0.0
    gap_s = 0.3

    def begin(self) -> None:
        (old,) = (each.engine for each in self.bus._devices)
        assert isinstance(old, MockDevice)
        self.bus.detach(old)
        pulled_at = self.clock.now() + self.pulled_after_s
        self.other = Visitor(self.unit("NONE"), pulled_at + self.gap_s)
        self.bus.attach(Visitor(old, -inf, pulled_at))
        self.bus.attach(self.other)
        super().begin()


class Visitor:
    """A unit that is in the socket from one moment to another; an engine."""

    def __init__(self, device: MockDevice, put_at: float, pulled_at: float = inf) -> None:
        self.device, self.put_at, self.pulled_at = device, put_at, pulled_at
        if put_at > -inf:
            device.power_cut(0.0)

    def _is_in(self, now: float) -> bool:
        if now >= self.put_at > -inf:
            self.put_at = -inf
            self.device.power_on(now)
        if now >= self.pulled_at and self.device.has_power:
            self.device.power_cut(now)
        return self.put_at == -inf and now < self.pulled_at

    def receive(self, frame: Frame, now: float) -> None:
        if self._is_in(now):
            self.device.receive(frame, now)

    def tick(self, now: float) -> None:
        if self._is_in(now):
            self.device.tick(now)

    def deadline(self) -> float | None:
        if not self.device.has_power:
            return self.put_at if self.put_at > -inf else None
        wanted = self.device.deadline()
        return min(inf if wanted is None else wanted, self.pulled_at)

    def next_frame(self, now: float) -> Frame | None:
        return self.device.next_frame(now) if self.device.has_power else None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)


def test_a_unit_that_stays_is_run_at_once(tmp_path: Path) -> None:
    ended = RealSocket(tmp_path).work()
    assert ended is not None
    assert ended.outcome is RunState.PASS, ended.text


class PulledAfterItsRun(RealSocket):
    """The unit is pulled out once it is detected after its run, and missed some time later."""

    pulled_at = gone_at = inf

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if not channel.of(RunResult):
            super().answer(channel, message)
        elif isinstance(message, PresenceChanged) and message.is_there:
            self.bus.detach(self.bus._devices[0].engine)
            self.pulled_at = self.clock.now()
        elif isinstance(message, PresenceChanged) or self.clock.now() > self.pulled_at + 60.0:
            self.gone_at = self.clock.now()
            channel.waiting.append(Stop(ends_process=True))


def test_a_unit_that_is_pulled_after_its_run_is_missed_soon(tmp_path: Path) -> None:
    """The run does not watch for units: that is no pause of the watch after it."""
    socket = PulledAfterItsRun(tmp_path)
    socket.line = StationPipe(socket.channel, socket.clock.now)
    socket.work()
    assert socket.gone_at - socket.pulled_at < SILENCE_S + 0.2


class InBootloader(RealSocket):
    """Its unit has no application."""

    def unit(self, number: str) -> MockDevice:
        target = self.recipe.targets[0].target
        profile = DeviceProfile(serial_number=number, application_area_bytes=8192)
        rate = WELLING.bitrate_bps
        return MockDevice(target, bitrate_bps=rate, profile=profile, has_application=False)

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if not isinstance(message, PresenceChanged):
            super().answer(channel, message)
        elif not channel.of(RunResult):
            self.begin()


class StandsStill(InBootloader):
    """This computer stalls before the order arrives, which was given before that."""

    is_ordered = False

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, PresenceChanged) and not self.is_ordered:
            self.is_ordered = True
            until = self.clock.now() + 1.0
            while self.clock.now() < until:
                self.bus.advance(until)
            channel.waiting.append(claim("W2605002", self.trace, message.number))
        elif not isinstance(message, PresenceChanged):
            super().answer(channel, message)


def test_an_order_from_before_a_pause_of_this_computer_is_not_carried_out(tmp_path: Path) -> None:
    ended = StandsStill(tmp_path).work()
    assert ended is not None
    assert ended.code == "NOT_OBSERVED", ended.text
    assert "did not listen before the run began" in ended.text


class Suspends(RealSocket):
    """This computer is suspended for a minute, which its clock does not count; a unit that is alike
    is put in meanwhile, and its announcement is not received.
    """

    def __init__(self, folder: Path, when: str, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(folder)
        self.when, self.boot_s = when, 60.0
        time_of = {time.CLOCK_BOOTTIME: lambda: self.boot_s, time.CLOCK_MONOTONIC: lambda: 0.0}
        monkeypatch.setattr(time, "clock_gettime", lambda clock: time_of[clock]())

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, AdapterDown):
            channel.waiting.append(Stop(ends_process=True))
            return
        if self.when == "write" and isinstance(message, StepStarted) and message.step == "write":
            self.boot_s += 60.0
        super().answer(channel, message)

    def begin(self) -> None:
        if self.when != "write":
            self.boot_s += 60.0
        if self.when != "idle":
            super().begin()


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="a clock of Linux")
@pytest.mark.parametrize("when", ["order", "write"])
def test_a_run_in_which_this_computer_is_suspended_is_not_observed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    socket = Suspends(tmp_path, when, monkeypatch)
    ended = socket.work()
    assert ended is not None
    assert ended.code == "NOT_OBSERVED", ended.text
    assert not [each for each in socket.channel.of(Ask) if isinstance(each.what, JournalWrite)][2:]


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="a clock of Linux")
def test_a_socket_is_out_of_service_after_this_computer_was_suspended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket = Suspends(tmp_path, "idle", monkeypatch)
    connection = Connection(socket.bus.link(), socket.clock, "a bus")
    Worker(socket.setup, socket.recipe, socket.line, connection).work()
    assert [each.reason for each in socket.channel.of(AdapterDown)] == [
        "This computer was suspended."
    ]


class SlowRecords(InBootloader):
    """The station takes 2 s to save something."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.line = StationPipe(self.channel, self.clock.now)
        self.channel.poll = self.poll  # type: ignore[method-assign]
        self.due: list[tuple[float, Ask]] = []

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, Ask):
            self.due.append((self.clock.now() + 2.0, message))
        else:
            super().answer(channel, message)

    def poll(self, timeout: float = 0.0) -> bool:
        until = self.clock.now() + timeout
        while self.due and self.clock.now() < until:
            self.bus.advance(until)
        if self.due and self.clock.now() >= self.due[0][0]:
            super().answer(self.channel, self.due.pop(0)[1])
        return bool(self.channel.waiting)


def test_it_listens_while_the_station_saves(tmp_path: Path) -> None:
    """A slow disk is no pause: a unit in its bootloader is seen to stay."""
    ended = SlowRecords(tmp_path).work()
    assert ended is not None
    assert ended.code == "OK", ended.text


class Exchanged(RealSocket):
    """The unit is exchanged, and the process has reported that, when the order arrives that was
    given before it.
    """

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if isinstance(message, PresenceChanged) and message.serial is not None:
            if self.numbers:
                number = self.numbers[self.known]
                self.channel.waiting.append(claim("W2605002", self.trace, number))
            else:
                (old,) = (each.engine for each in self.bus._devices)
                self.bus.detach(old)
                self.bus.attach(Visitor(self.unit("NONE"), self.clock.now() + 0.3))
            self.numbers.append(message.number)
        elif not isinstance(message, PresenceChanged):
            super().answer(channel, message)

    def knowing(self, known: int) -> Exchanged:
        """An order of somebody who knows so many reports of a number."""
        self.known = known
        self.numbers: list[int] = []
        return self


def test_an_order_that_crosses_the_report_of_an_exchange_is_not_carried_out(
    tmp_path: Path,
) -> None:
    ended = Exchanged(tmp_path).knowing(0).work()
    assert ended is not None
    assert ended.code == "UNIT_CHANGED", ended.text
    assert "before the run began" in ended.text


@pytest.mark.slow
@each("gap_s", [0.3, 0.5, 1.0, 3.5])
@each("pulled_after_s", [0.0, 0.04, 0.06, 0.08, 0.1, 0.13, 0.15, 0.2, 0.3])
def test_a_label_is_not_for_the_unit_that_is_put_in_after_it(
    tmp_path: Path, gap_s: float, pulled_after_s: float
) -> None:
    """From the scan to the moment at which the unit is identified, and on to its reset."""
    folder = tmp_path / f"{gap_s} {pulled_after_s}"
    folder.mkdir()
    socket = Pulled(folder)
    socket.gap_s, socket.pulled_after_s = gap_s, pulled_after_s
    ended = socket.work()
    assert ended is not None
    assert ended.outcome is not RunState.PASS
    # No unit answers, and none comes as long as the run waits.
    codes = ("UNIT_CHANGED", "NO_ANSWER") if gap_s > 0.5 else ("UNIT_CHANGED",)
    assert ended.code in codes, ended.text
    assert socket.other.device.program_count == 0


class Empty(RealSocket):
    """The socket is empty when its label is scanned, and a unit comes later."""

    after_s = 0.0

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.bus.detach(self.bus._devices[0].engine)

    def answer(self, channel: FakeChannel, message: FromWorker) -> None:
        if not isinstance(message, PresenceChanged):
            super().answer(channel, message)
        elif not message.is_there and not channel.of(RunResult):
            self.other = Visitor(self.unit("NONE"), self.clock.now() + self.after_s)
            self.bus.attach(self.other)
            self.begin()


@each("after_s", [0.0, 0.05, 0.3, 0.5, 0.9])
def test_a_run_is_not_for_the_unit_that_comes_after_it_began(
    tmp_path: Path, after_s: float
) -> None:
    """Its label was scanned for an empty socket, twice."""
    folder = tmp_path / f"{after_s}"
    folder.mkdir()
    socket = Empty(folder)
    socket.after_s = after_s
    ended = socket.work()
    assert ended is not None
    assert ended.code == "UNIT_CHANGED", ended.text
    assert "was silent when the run began" in ended.text
    assert socket.other.device.program_count == 0


def test_a_slow_start_of_a_run_is_no_pause_of_a_unit_in_its_bootloader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This computer plans the image, and does not listen meanwhile."""
    socket = InBootloader(tmp_path)
    real = UnitRun._steps

    def steps(run: UnitRun) -> UnitSteps:
        until = socket.clock.now() + 1.0
        while socket.clock.now() < until:
            socket.bus.advance(until)
        return real(run)

    monkeypatch.setattr(UnitRun, "_steps", steps)
    ended = socket.work()
    assert ended is not None
    assert ended.outcome is RunState.PASS, ended.text
