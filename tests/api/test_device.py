"""`Device`: what is asked by type, verified, restarted and refused before anything is sent."""

from __future__ import annotations

import copy
import dataclasses
import random
from collections.abc import Callable
from typing import Any

import pytest

import flasher
from flasher import contents
from flasher.errors import InterruptedByUserError, NoAnswerError, UsageError
from tests.api.battery import Battery, wire_to
from tests.firmware import VECTORS
from tests.loops import each

IMAGE = flasher.Image.from_bytes(VECTORS + random.Random(3).randbytes(500))


def test_what_is_asked_for_by_its_class_has_that_class() -> None:
    running = wire_to(Battery()).device().read(contents.RunningInformation)
    assert running.voltage_mv == 36_000


def test_a_class_that_several_items_have_is_asked_for_by_name() -> None:
    with pytest.raises(UsageError, match="UserString is the content of 3 items") as caught:
        wire_to(Battery()).device().read(contents.UserString)
    assert "user-string-1, user-string-2, user-string-3" in caught.value.remedy


def test_a_class_without_a_query_is_refused() -> None:
    with pytest.raises(UsageError, match="Faults is the content of no items of the BMS"):
        wire_to(Battery()).device().read(contents.Faults)


def test_the_version_is_that_of_the_document() -> None:
    version = wire_to(Battery()).device().version()
    assert isinstance(version, contents.VersionInformation)
    assert str(version.hardware_version) == "V1r2r0_20220512"


def test_a_target_without_a_version_query_is_named() -> None:
    with pytest.raises(NoAnswerError, match="wmc cannot be asked for its version"):
        wire_to().device("wmc").version()


@each("target", ["wmc", "obc"])
def test_only_the_memory_of_the_battery_is_read(target: str) -> None:
    with pytest.raises(UsageError, match="no way to read memory"):
        wire_to().device(target).read_memory(0, 16)


def test_a_battery_is_restarted_and_a_target_without_a_documented_reset_is_not() -> None:
    with flasher.connect_mock("bms", speed=0) as connection:
        connection.device("bms").reset()
    with pytest.raises(NoAnswerError, match="no reset for the obc"):
        wire_to().device("obc").reset()


def test_a_product_with_a_reset_of_its_own_is_not_restarted_by_the_documents() -> None:
    own = flasher.Profile(flasher.make_plan(IMAGE, "bms").target, reset_data=b"START")
    battery = Battery()
    with pytest.raises(NoAnswerError):
        wire_to(battery).device(profile=own).reset()
    assert battery.received == []


def test_what_a_device_runs_is_verified_without_flashing_it() -> None:
    image = dataclasses.replace(IMAGE, version="V1r0r0_20220512")
    device = wire_to(Battery()).device()
    assert device.verify(image).ok
    other = device.verify(dataclasses.replace(IMAGE, version="V9r0r0_20300101"))
    assert not other.ok
    assert other.running_version == "V1r0r0_20220512"
    assert device.verify(image, "none").ok


def test_memory_is_verified_after_the_version() -> None:
    battery = Battery()
    right = flasher.Image.from_bytes(battery.memory[:300], base=0x1000)
    wrong = flasher.Image.from_bytes(battery.memory[:299] + b"\x00", base=0x1000)
    device = wire_to(battery).device()
    assert device.verify(right, "memory").ok
    assert "0x0000112B" in device.verify(wrong, "memory").detail


def test_verifying_can_be_cancelled() -> None:
    with pytest.raises(InterruptedByUserError):
        wire_to(Battery()).device().verify(IMAGE, cancelled=lambda: True)


def test_a_plan_for_another_target_is_refused() -> None:
    with pytest.raises(UsageError, match="The plan is for a BMS, and this device is a WMC"):
        wire_to().device("wmc").upgrade(flasher.make_plan(IMAGE, "bms"))


def test_a_plan_that_was_copied_or_came_from_another_process_is_that_of_the_device() -> None:
    plan = copy.deepcopy(flasher.make_plan(IMAGE, "bms"))
    with flasher.connect_mock("bms", speed=0) as connection:
        assert connection.device("bms").upgrade(plan).ok


def test_a_device_without_an_application_is_rescued() -> None:
    with flasher.connect_mock("wmc", speed=0, has_application=False) as connection:
        assert connection.device("wmc").rescue(IMAGE).ok


def test_who_has_the_bus_alone_need_not_listen_first() -> None:
    wire = wire_to(Battery(delay_s=0.0))
    wire.device(is_alone=True).read("history")
    assert wire.clock.now() < 0.05


def test_a_call_from_within_another_one_is_refused_and_does_no_harm() -> None:
    refused: list[UsageError] = []
    with flasher.connect_mock("bms", speed=0) as connection:
        device = connection.device("bms")

        def ask(event: object) -> None:
            if isinstance(event, flasher.events.PacketAcknowledged) and not refused:
                with pytest.raises(UsageError, match="Another call is under way") as caught:
                    device.read("history")
                refused.append(caught.value)

        assert device.flash(IMAGE, on_event=ask).ok
        assert "one call after the other" in refused[0].remedy
        device.read("history")


def test_a_misspelled_keyword_is_refused_and_not_ignored() -> None:
    connection = wire_to(Battery())
    calls: list[Callable[..., object]] = [
        connection.device("bms").flash,
        connection.device("bms").verify,
        lambda _image, **watch: connection.device("bms").read("model", **watch),
        lambda _image, **watch: connection.device("bms", **watch),
        lambda _image, **watch: connection.async_device("bms", **watch),
    ]
    for call in calls:
        with pytest.raises(TypeError, match="unexpected keyword argument 'verfy'"):
            call(IMAGE, verfy="memory")


@pytest.mark.parametrize("name", ["cancelled", "taps", "in_session", "profile"])
def test_flash_refuses_what_only_a_device_takes(name: str) -> None:
    keywords: dict[str, Any] = {name: None}
    with pytest.raises(TypeError, match=f"flash.. does not take '{name}'"):
        flasher.flash(IMAGE, "bms", mock=True, **keywords)
