"""The same for programs with an event loop: what differs is the waiting alone."""

from __future__ import annotations

import asyncio
import random
import threading
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import flasher
from flasher import api, events
from flasher.bus.link import Link
from flasher.errors import BusError, FlasherError, NoAnswerError, WrongDeviceError
from flasher.protocol import contents
from flasher.protocol.frame import Frame
from tests.api.battery import ANSWERS, Battery, wire_to
from tests.firmware import VECTORS

IMAGE = flasher.Image.from_bytes(VECTORS + random.Random(7).randbytes(1000))


def test_a_device_is_flashed_while_the_event_loop_goes_on() -> None:
    seen: list[object] = []
    turns = 0

    async def work() -> flasher.Result:
        nonlocal turns
        with flasher.connect_mock("bms", speed=0) as connection:
            job = asyncio.create_task(
                connection.async_device("bms").flash(IMAGE, on_event=seen.append)
            )
            while not job.done():
                turns += 1
                await asyncio.sleep(0)
            return await job

    result = asyncio.run(work())
    assert result.ok
    assert turns > 10
    packets = [each.number for each in seen if isinstance(each, events.PacketAcknowledged)]
    assert packets == list(range(1, 1 + result.outcome.total_packets))


def test_the_loop_gets_what_the_blocking_device_gets() -> None:
    noted: dict[str, list[object]] = {"blocking": [], "async": []}
    with flasher.connect_mock("bms", speed=0) as connection:
        connection.device("bms").flash(IMAGE, on_event=noted["blocking"].append)

    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            await connection.async_device("bms").flash(IMAGE, on_event=noted["async"].append)

    asyncio.run(work())
    assert noted["async"] == noted["blocking"]


def test_items_and_memory_are_read_and_written() -> None:
    battery = Battery()

    async def work() -> None:
        device = wire_to(battery).async_device("bms")
        running = await device.read(contents.RunningInformation)
        assert running.voltage_mv == 36_000
        assert isinstance(await device.version(), contents.VersionInformation)
        written = await device.write("user-string-1", "RACK 7")
        assert not written.differences
        assert await device.read_memory(0x1000, 0x1100) == battery.memory[:0x100]
        assert (await device.identify()).is_there

    asyncio.run(work())


def test_silence_is_the_same_error() -> None:
    async def work() -> None:
        device = wire_to(Battery(silent=frozenset(ANSWERS))).async_device("bms")
        with pytest.raises(NoAnswerError):
            await device.read("history")

    asyncio.run(work())


def test_a_cancelled_task_ends_at_a_message_boundary_and_leaves_the_bus_free() -> None:
    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            device = connection.async_device("bms")
            begun = asyncio.Event()

            def note(event: object) -> None:
                if isinstance(event, events.PacketAcknowledged):
                    begun.set()

            job = asyncio.create_task(device.upgrade(IMAGE, on_event=note))
            await begun.wait()
            job.cancel()
            with pytest.raises(asyncio.CancelledError):
                await job
            # The device sits in its bootloader, and the next upgrade finds it there.
            assert (await device.rescue(IMAGE, verify="none")).ok

    asyncio.run(work())


def test_an_adapter_is_opened_and_closed_outside_of_the_loop() -> None:
    async def work() -> str:
        async with flasher.aconnect(interface="virtual", channel="aconnect") as connection:
            return connection.name

    assert "aconnect" in asyncio.run(work())


def test_the_wrong_device_is_refused_with_the_typed_error() -> None:
    async def work() -> None:
        with flasher.connect_mock("wmc", speed=0) as connection:
            device = connection.async_device("wmc")
            named = flasher.Image.from_bytes(VECTORS + b"BMS_UPD" + bytes(100))
            with pytest.raises(WrongDeviceError):
                await device.flash(named)

    asyncio.run(work())


def test_calls_of_several_tasks_wait_for_each_other() -> None:
    """A question in the midst of an upgrade would take its frames, and be in its way."""

    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            device = connection.async_device("bms")
            result, running = await asyncio.gather(
                device.flash(IMAGE), device.read(contents.RunningInformation)
            )
            assert result.ok
            assert result.outcome.statistics.repetitions == 0
            assert running.voltage_mv > 0

    asyncio.run(work())


# -- the property: the same calls, frames, events and results --------------------------------------

Call = tuple[str, tuple[Any, ...], dict[str, Any]]
CALLS: list[Call] = [
    ("identify", (), {}),
    ("is_present", (), {}),
    ("version", (), {}),
    ("read", ("running-information",), {}),
    ("read", (contents.History,), {}),
    ("read", ("nonsense",), {}),
    ("read_memory", (0x1000, 0x1180), {}),
    ("read_memory", (0x1000, 0x1000), {}),
    ("write", ("user-string-1", "RACK 7"), {}),
    ("write", ("serial-number", "X"), {"manufacturer": True}),
    ("reset", (), {}),
    ("verify", (IMAGE, "none"), {}),
]
BATTERIES = st.fixed_dictionaries(
    {
        "silent": st.frozensets(st.sampled_from([*ANSWERS, 0x3A10, 0x4308, 0x4205]), max_size=3),
        "deaf_messages": st.integers(0, 6),
        "delay_s": st.sampled_from([0.0, 0.002, 0.19, 0.3]),
        "copies": st.integers(1, 2),
        "loses_writes": st.booleans(),
        "damages": st.booleans(),
    }
)
UPGRADES: list[Call] = [
    ("flash", (IMAGE,), {}),
    ("flash", (IMAGE,), {"verify": "none", "in_session": True}),
    ("flash", (flasher.Image.from_bytes(VECTORS + b"WMC_UPD" + bytes(100)),), {}),
    ("rescue", (IMAGE,), {}),
    ("upgrade", (IMAGE,), {"options": flasher.UpgradeOptions(timeout_s=1.2)}),
]


class Watched:
    """What calls on a connection came to: frames with their times, events, results."""

    def __init__(self, ends_after: int | None) -> None:
        self.seen: list[object] = []
        self._frames_left = ends_after
        self.watch: api.CallOptions = {
            "taps": [self._tap],
            "on_event": self.seen.append,
            "cancelled": lambda: self._frames_left is not None and self._frames_left <= 0,
        }

    def _tap(self, frame: Frame, *, sent: bool, now: float) -> None:
        self.seen.append((frame, sent, round(now, 9)))
        if self._frames_left is not None:
            self._frames_left -= 1

    def returned(self, value: object) -> None:
        if isinstance(value, flasher.DeviceInfo):  # a survey is like itself only
            value = (value.readings, value.survey.heard, value.is_there)
        self.seen.append(value)

    def failed(self, error: FlasherError) -> None:
        self.seen.append((type(error), str(error)))


def blocking(connection: flasher.Connection, calls: list[Call], ends_after: int | None) -> object:
    watched = Watched(ends_after)
    device = connection.device("bms", **watched.watch)
    for name, args, choices in calls:
        try:
            watched.returned(getattr(device, name)(*args, **choices))
        except FlasherError as error:
            watched.failed(error)
    return watched.seen


def awaited(connection: flasher.Connection, calls: list[Call], ends_after: int | None) -> object:
    watched = Watched(ends_after)

    async def work() -> None:
        device = connection.async_device("bms", **watched.watch)
        for name, args, choices in calls:
            try:
                watched.returned(await getattr(device, name)(*args, **choices))
            except FlasherError as error:
                watched.failed(error)

    asyncio.run(work())
    return watched.seen


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    calls=st.lists(st.sampled_from(CALLS), min_size=1, max_size=3),
    battery=BATTERIES,
    ends_after=st.none() | st.integers(0, 30),
)
def test_every_call_is_that_of_the_blocking_device(
    calls: list[Call], battery: dict[str, Any], ends_after: int | None
) -> None:
    first = blocking(wire_to(Battery(**battery)), calls, ends_after)
    assert awaited(wire_to(Battery(**battery)), calls, ends_after) == first


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(
    calls=st.lists(st.sampled_from(UPGRADES), min_size=1, max_size=2),
    ends_after=st.none() | st.integers(0, 300),
    has_application=st.booleans(),
)
def test_every_upgrade_is_that_of_the_blocking_device(
    calls: list[Call], ends_after: int | None, *, has_application: bool
) -> None:
    seen = []
    for way in (blocking, awaited):
        with flasher.connect_mock("bms", speed=0, has_application=has_application) as connection:
            seen.append(way(connection, calls, ends_after))
    assert seen[0] == seen[1]


def test_it_has_every_method_of_the_blocking_device() -> None:
    def public(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert public(flasher.AsyncDevice) == public(flasher.Device)
    for name in public(flasher.Device) - {"plan", "target"}:
        assert asyncio.iscoroutinefunction(getattr(flasher.AsyncDevice, name)), name
        assert getattr(flasher.AsyncDevice, name).__doc__, name


# -- between the thread and the loop ---------------------------------------------------------------


def begun_at(count: int) -> tuple[asyncio.Event, Callable[[object], None]]:
    """Set when so many packets were acknowledged, and the handler that does it."""
    begun = asyncio.Event()
    acknowledged = 0

    def note(event: object) -> None:
        nonlocal acknowledged
        acknowledged += isinstance(event, events.PacketAcknowledged)
        if acknowledged == count:
            begun.set()

    return begun, note


def test_a_handler_is_called_in_the_loop_and_the_device_waits_for_it() -> None:
    where: set[int] = set()
    under_way: list[object] = []
    frames_meanwhile: list[int] = []
    frames = 0

    def tap(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001
        nonlocal frames
        frames += 1

    def note(event: object) -> None:
        where.add(threading.get_ident())
        before = frames
        under_way.append(event)
        for _ in range(1000):
            pass
        frames_meanwhile.append(frames - before)

    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            await connection.async_device("bms").flash(IMAGE, on_event=note, taps=[tap])

    asyncio.run(work())
    assert where == {threading.get_ident()}
    assert len(under_way) > 10
    assert not any(frames_meanwhile)


def test_what_a_handler_raises_ends_the_call() -> None:
    def note(event: object) -> None:
        if isinstance(event, events.PacketAcknowledged):
            raise ZeroDivisionError

    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            device = connection.async_device("bms")
            with pytest.raises(ZeroDivisionError):
                await device.flash(IMAGE, on_event=note)
            assert (await device.rescue(IMAGE, verify="none")).ok

    asyncio.run(work())


def test_a_task_that_a_loop_cancels_at_its_end_has_ended_before_the_connection_closes() -> None:
    """As asyncio.run does with every task that is left."""
    with flasher.connect_mock("bms", speed=0) as connection:

        async def work() -> None:
            begun, note = begun_at(2)
            job = asyncio.create_task(connection.async_device("bms").flash(IMAGE, on_event=note))
            await begun.wait()
            assert not job.done()

        asyncio.run(work())
        assert connection.device("bms").rescue(IMAGE, verify="none").ok


def test_a_cancelled_task_has_left_its_thread() -> None:
    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            begun, note = begun_at(1)
            job = asyncio.create_task(connection.async_device("bms").flash(IMAGE, on_event=note))
            await begun.wait()
            job.cancel()
            job.cancel()
            await asyncio.wait([job])
            assert job.cancelled()
            # No other call waits: the turn was given back by the thread.
            assert (connection.device("bms").rescue(IMAGE, verify="none")).ok

    asyncio.run(work())


def test_any_number_of_calls_are_under_way_at_the_same_time() -> None:
    """A loop's own threads are no more than 32, and as few as five on a small computer."""
    count = 40
    meeting = threading.Barrier(count, timeout=30)

    async def asked() -> bool:
        met = False

        def meet(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001
            nonlocal met
            if not met:
                met = True
                meeting.wait()

        with flasher.connect_mock("bms", speed=0) as connection:
            device = connection.async_device("bms")
            await device.version(taps=[meet])
            return met

    async def work() -> list[bool]:
        return await asyncio.gather(*(asked() for _ in range(count)))

    assert asyncio.run(work()) == [True] * count


class Unplugged:
    """A link that is lost in the third packet, and is away for ever."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.frames_left = 60
        self.tries = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)

    def send(self, frame: Frame) -> None:
        self.frames_left -= 1
        if self.frames_left < 0:
            raise BusError("the adapter is gone")
        self._link.send(frame)

    def reopen(self) -> None:
        self.tries += 1
        raise BusError("there is no adapter")


def test_a_cancelled_task_does_not_go_on_waiting_for_a_lost_adapter() -> None:
    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            link = Unplugged(connection.link)
            lost = flasher.Connection(link, connection.clock, "a mock")
            away = asyncio.Event()

            def note(event: object) -> None:
                if isinstance(event, events.AdapterAwaited):
                    away.set()

            device = lost.async_device("bms")
            options = flasher.UpgradeOptions(adapter_return_s=1e6, timeout_s=1e7)
            job = asyncio.create_task(device.flash(IMAGE, on_event=note, options=options))
            await away.wait()
            job.cancel()
            await asyncio.wait([job])
            assert job.cancelled()
            tries = link.tries
            await asyncio.sleep(0.02)
            assert link.tries == tries < 1000

    asyncio.run(work())


def test_a_write_that_was_begun_is_read_back_before_its_task_ends() -> None:
    """As for a user who interrupts the blocking one."""
    battery = Battery(delay_s=0.01)

    async def work() -> None:
        def tap(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001
            if sent and frame.data[4:6] == b"\x3a\x10":
                loop.call_soon_threadsafe(job.cancel)

        loop = asyncio.get_running_loop()
        device = wire_to(battery).async_device("bms")
        job = asyncio.create_task(device.write("user-string-1", "RACK 7", taps=[tap]))
        await asyncio.wait([job])
        assert job.cancelled()

    asyncio.run(work())
    assert [command for command, _ in battery.received][-2:] == [0x3A10, 0x3900]


@pytest.mark.parametrize("closes", [True, False])
def test_a_loop_that_is_left_alone_ends_the_call(
    closes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without asyncio.run, nothing cancels what is left: the thread would wait for ever."""
    monkeypatch.setattr(api, "_LOOP_GONE_S", 0.01)
    with flasher.connect_mock("bms", speed=0) as connection:
        loop = asyncio.new_event_loop()

        async def work() -> asyncio.Task[flasher.Result]:
            begun, note = begun_at(2)
            job = asyncio.create_task(connection.async_device("bms").flash(IMAGE, on_event=note))
            await begun.wait()
            return job

        job = loop.run_until_complete(work())
        if closes:
            loop.set_exception_handler(lambda *_: None)  # that a task was never ended
            loop.close()
        # The thread gives the turn back by itself, at a message boundary.
        assert connection._turn.acquire(timeout=20)
        connection._turn.release()
        assert connection.device("bms").rescue(IMAGE, verify="none").ok
        if not closes:
            job.cancel()
            loop.run_until_complete(asyncio.wait([job]))
            loop.close()
