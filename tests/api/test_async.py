"""The same for programs with an event loop: what differs is the waiting alone."""

from __future__ import annotations

import asyncio
import random

import pytest

import flasher
from flasher import events
from flasher.errors import NoAnswerError, WrongDeviceError
from flasher.protocol import contents
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


def test_what_the_loop_is_told_is_what_the_blocking_device_tells() -> None:
    told: dict[str, list[object]] = {"blocking": [], "async": []}
    with flasher.connect_mock("bms", speed=0) as connection:
        connection.device("bms").flash(IMAGE, on_event=told["blocking"].append)

    async def work() -> None:
        with flasher.connect_mock("bms", speed=0) as connection:
            await connection.async_device("bms").flash(IMAGE, on_event=told["async"].append)

    asyncio.run(work())
    assert told["async"] == told["blocking"]


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
