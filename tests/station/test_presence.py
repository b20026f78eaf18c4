"""Whether a unit is in the socket, from frames and times alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.protocol.contents import VersionInformation
from flasher.protocol.fields import Text
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BMS, WMC, Mode
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split
from flasher.station.presence import Presence
from tests.station.unit_bench import UnitBench

TRAFFIC = Frame(0x720, b"\x55\xaa\x0c\x12\x10\x10\x00\x00")


@pytest.fixture
def presence(tmp_path: Path) -> Presence:
    bench = UnitBench(tmp_path)
    return Presence(bench.recipe.targets)


def test_nothing_is_said_before_it_is_known(presence: Presence) -> None:
    assert presence.change(0.0) is None
    assert presence.change(1.9) is None
    change = presence.change(2.0)
    assert change is not None
    assert not change.is_there


def test_traffic_is_a_unit_and_silence_its_removal(presence: Presence) -> None:
    presence(TRAFFIC, sent=False, now=1.0)
    change = presence.change(1.0)
    assert change is not None
    assert (change.is_there, change.how) == (True, "traffic")
    presence(TRAFFIC, sent=False, now=2.0)
    assert presence.change(3.9) is None
    gone = presence.change(4.0)
    assert gone is not None
    assert not gone.is_there


def test_a_boot_version_is_a_unit_that_was_switched_on(presence: Presence) -> None:
    message = BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)
    for frame in split(BMS.answer_id, encode(message)):
        presence(frame, sent=False, now=1.0)
    change = presence.change(1.0)
    assert change is not None
    assert change.how == "boot version"


def test_own_frames_and_those_of_others_are_no_unit(presence: Presence) -> None:
    presence(Frame(BMS.request_id, b"\x55"), sent=False, now=1.0)
    presence(Frame(WMC.answer_id, b"\x55"), sent=False, now=1.0)
    presence(TRAFFIC, sent=True, now=1.0)
    assert presence.change(1.0) is None


def test_it_is_asked_in_its_time(presence: Presence) -> None:
    first = presence.probe(0.0)
    assert {frame.can_id for frame in first} == {BMS.request_id}
    assert presence.probe(0.4) == []
    assert presence.probe(0.5) == first


def test_after_a_time_in_which_nothing_could_be_heard_nothing_is_known(presence: Presence) -> None:
    presence(TRAFFIC, sent=False, now=1.0)
    presence.change(1.0)
    presence.begin()
    assert presence.change(60.0) is None
    presence(TRAFFIC, sent=False, now=61.0)
    change = presence.change(61.0)
    assert change is not None
    assert change.is_there, "said once more, although it was there before"


def version_answer(serial: str) -> list[Frame]:
    texts = ("BM36", serial, "V1r2r0", "V1r0r0")
    content = VersionInformation(*(Text(encode_text(text, 16)) for text in texts))
    return split(0x720, encode(Message(0x720, Mode.REPORT, 0x1540, content.data())))


def test_a_version_answer_says_which_unit_it_is(presence: Presence) -> None:
    presence(TRAFFIC, sent=False, now=1.0)
    change = presence.change(1.0)
    assert change is not None
    assert change.serial is None, "not said yet"
    for serial in ("", "W2605002"):
        for frame in version_answer(serial):
            presence(frame, sent=False, now=1.5)
        change = presence.change(1.5)
        assert change is not None
        assert (change.is_there, change.serial) == (True, serial)
        assert presence.change(1.5) is None
    assert presence.change(9.0) is not None, "silent"
    presence(TRAFFIC, sent=False, now=10.0)
    change = presence.change(10.0)
    assert change is not None
    assert change.serial is None, "it may be another unit"


def test_a_unit_that_cannot_be_asked_is_said_to_be_unseen(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    loaded = bench.recipe.targets[0]
    profile = replace(loaded.profile, target=WMC, version_query=None)
    firmware = loaded.firmware.model_copy(update={"target": "wmc"})
    target = replace(loaded, firmware=firmware, profile=profile)
    assert not Presence([target]).sees_units
