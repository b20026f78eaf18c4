"""A place on the bus from which a device is taken, and into which another one is put."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from flasher.mock.faults import AtTime, FaultInjector, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.place import Place
from flasher.protocol.spec import BMS, WELLING
from tests.mock.bench import QUICK
from tests.mock.talk import READ, START_S, Talk

VERSION: Final = 0x3300


def device(serial_number: str) -> FaultInjector:
    profile = replace(QUICK, serial_number=serial_number)
    made = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)
    return FaultInjector(made)


def test_an_empty_place_takes_frames_and_sends_none() -> None:
    place = Place()
    talk = Talk(place)
    assert talk.ask(0x752, READ, VERSION) == []
    talk.run(60.0)
    place.tick(talk.now)
    place.frame_sent(talk.now)
    place.cancel(talk.now)
    assert place.deadline() is None
    assert place.done
    assert talk.events == []


def test_the_device_that_is_in_the_place_answers() -> None:
    place = Place()
    talk = Talk(place)
    for serial_number in ("W2605001", "W2605002"):
        place.device = device(serial_number)
        (answer,) = talk.ask(0x752, READ, VERSION)
        assert serial_number.encode() in answer.data
        assert not place.done
    place.device = None
    assert talk.ask(0x752, READ, VERSION) == []


def test_a_place_wants_a_tick_at_its_own_time_or_sooner_for_its_device() -> None:
    place, inside = Place(), device("W2605001")
    place.due_at = START_S + 5.0
    assert place.deadline() == START_S + 5.0
    place.device = inside
    inside.set(PowerCut(off_s=None), AtTime(START_S + 1.0))
    assert place.deadline() == START_S + 1.0
    place.tick(START_S + 1.0)
    assert not inside.device.has_power
    assert place.deadline() == START_S + 5.0
