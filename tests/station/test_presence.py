"""Whether a unit is in the socket, from frames and times alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.protocol.contents import VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BMS, WMC, Mode
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split
from flasher.station.messages import PresenceChanged
from flasher.station.presence import Presence, TargetWatcher
from tests.loops import each
from tests.station.unit_bench import UnitBench

TRAFFIC = Frame(0x720, b"\x55\xaa\x0c\x12\x10\x10\x00\x00")


@pytest.fixture
def presence(tmp_path: Path) -> Presence:
    bench = UnitBench(tmp_path)
    return Presence([each.profile for each in bench.recipe.targets])


def test_nothing_is_claimed_before_it_is_known(presence: Presence) -> None:
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


def test_the_end_of_an_announcement_is_no_unit_that_the_next_one_replaces(
    presence: Presence,
) -> None:
    frames = split(BMS.answer_id, encode(BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)))
    for frame in frames[1:]:
        presence(frame, sent=False, now=1.0)
    assert presence.change(1.0) is None
    for frame in frames:
        presence(frame, sent=False, now=1.05)
    change = presence.change(1.05)
    assert change is not None
    assert (change.how, presence.exchanged_number) == ("boot version", 0)


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


def test_after_a_time_in_which_nothing_could_be_received_nothing_is_known(
    presence: Presence,
) -> None:
    presence(TRAFFIC, sent=False, now=1.0)
    presence.change(1.0)
    presence.begin()
    assert presence.change(60.0) is None
    presence(TRAFFIC, sent=False, now=61.0)
    change = presence.change(61.0)
    assert change is not None
    assert change.is_there, "reported once more, although it was there before"


def version_answer(serial: str) -> list[Frame]:
    texts = ("BM36", serial, "V1r2r0", "V1r0r0")
    content = VersionInformation(*(WireText(encode_text(text, 16)) for text in texts))
    return split(0x720, encode(Message(0x720, Mode.REPORT, 0x1540, content.data())))


def test_a_version_answer_identifies_its_unit(presence: Presence) -> None:
    presence(TRAFFIC, sent=False, now=1.0)
    change = presence.change(1.0)
    assert change is not None
    assert change.serial is None, "not reported yet"
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


def test_a_unit_that_cannot_be_asked_is_reported_to_be_unseen(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    profile = replace(bench.recipe.targets[0].profile, target=WMC, version_query=None)
    assert not Presence([profile]).sees_units


# -- power-ups ------------------------------------------------------------------------------------


def announce(presence: Presence, *times: float) -> list[tuple[bool, bool]]:
    """Announcements at these times: of each change whether it is a power-up, and whether the unit
    is in its bootloader.
    """
    changes = []
    for now in times:
        message = BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)
        for frame in split(BMS.answer_id, encode(message)):
            presence(frame, sent=False, now=now)
        change = presence.change(now)
        if change is not None:
            changes.append((change.is_power_up, change.is_in_bootloader))
    return changes


def test_an_announcement_of_a_unit_that_is_there_is_an_arrival(presence: Presence) -> None:
    for frame in version_answer("W2605002"):
        presence(frame, sent=False, now=1.0)
    presence.change(1.0)
    assert announce(presence, 1.5, 1.55, 1.6, 1.65) == [(True, True)], "once for the burst"
    for frame in version_answer("W2605002"):
        presence(frame, sent=False, now=2.0)
    change = presence.change(2.0)
    assert change is not None
    assert (change.serial, change.is_power_up, change.is_in_bootloader) == (
        "W2605002", False, False,
    )  # fmt: skip


def test_what_was_received_before_a_power_up_is_not_of_this_unit(presence: Presence) -> None:
    for frame in version_answer("W2605002"):
        presence(frame, sent=False, now=1.0)
    presence.change(1.0)
    announce(presence, 1.4)
    presence(TRAFFIC, sent=False, now=1.9)
    change = presence.change(1.9)
    assert change is not None
    assert (change.serial, change.is_in_bootloader) == (None, False)


def hear(presence: Presence, frames: list[Frame], now: float) -> PresenceChanged | None:
    for frame in frames:
        presence(frame, sent=False, now=now)
    return presence.change(now)


@each("announced_s", [0.9, 1.2])
def test_a_unit_that_only_announced_itself_and_has_an_application_now_is_another_one(
    tmp_path: Path, announced_s: float
) -> None:
    presence = Presence([UnitBench(tmp_path).recipe.targets[0].profile])
    announce(presence, *(1.0 + 0.05 * at for at in range(round(announced_s / 0.05) + 1)))
    change = hear(presence, version_answer(""), 1.2 + announced_s)
    assert change is not None
    assert change.is_power_up == (announced_s > 1.0), "one that starts goes on for less than 1 s"
    assert change.serial == ""
    assert presence.exchanged_number == (change.number if announced_s > 1.0 else 0)


def test_changes_are_numbered_and_the_last_exchange_is_known(presence: Presence) -> None:
    found = [hear(presence, version_answer("W2605002"), 1.0)]
    assert presence.exchanged_number == 0
    found.append(hear(presence, version_answer("W2605003"), 1.5))
    assert presence.exchanged_number == 2
    found.append(presence.change(4.0))
    assert presence.exchanged_number == 3
    found.append(hear(presence, version_answer(""), 5.0))
    assert [None if each is None else each.number for each in found] == [1, 2, 3, 4]
    assert presence.exchanged_number == 3, "it was put into an empty socket"
    presence.begin()
    assert presence.exchanged_number == 0


def test_a_number_from_before_a_power_up_is_forgotten_however_late_it_is_looked(
    presence: Presence,
) -> None:
    hear(presence, version_answer("W2605002"), 1.0)
    message = BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)
    for frame in split(BMS.answer_id, encode(message)):
        presence(frame, sent=False, now=1.4)
    change = hear(presence, version_answer("W2605003"), 1.42)
    assert change is not None
    assert (change.serial, change.is_power_up) == ("W2605003", True), "the answer is the new one's"


def test_a_pause_after_one_announcement_is_judged_by_the_next_one(presence: Presence) -> None:
    announce(presence, 1.0)
    assert announce(presence, 1.4) == []
    assert announce(presence, 1.45) == [(True, True)], "its pace is another one: another unit"


def test_a_pause_like_the_last_one_is_no_pace_after_a_longer_burst(presence: Presence) -> None:
    announce(presence, 1.0, 1.05, 1.1)
    assert announce(presence, 1.7) == [(True, True)]
    assert announce(presence, *(1.75 + 0.05 * at for at in range(14))) == []
    assert announce(presence, 3.0) == [(True, True)]


def test_time_in_which_no_one_listened_is_no_silence(presence: Presence) -> None:
    hear(presence, version_answer("W2605002"), 1.0)
    presence.miss(4.0, 6.9)
    assert presence.change(6.9) is None
    assert presence.change(7.0) is not None


def test_time_in_which_no_one_listened_is_no_pause(presence: Presence) -> None:
    announce(presence, 1.0, 1.05)
    for watcher in presence.watchers:
        watcher.miss(2.0)
    assert announce(presence, 3.1) == []
    assert announce(presence, 3.6) == [(True, True)]


def test_a_bootloader_that_no_one_listened_to_may_be_another_one(presence: Presence) -> None:
    announce(presence, 1.0, 1.05)
    presence.miss(0.2, 1.3)
    assert presence.change(1.3) is None, "no person exchanges it so fast"
    presence.miss(1.0, 2.3)
    change = presence.change(2.3)
    assert change is not None
    assert (change.is_there, change.was_missed, change.is_power_up) == (True, True, False)
    assert (presence.missed_number, presence.exchanged_number) == (change.number, 0)
    hear(presence, version_answer("W2605002"), 2.4)
    presence.miss(1.0, 3.5)
    assert presence.change(3.5) is None, "an application would announce its restart"


def test_announcements_that_are_read_late_may_be_of_two_units(presence: Presence) -> None:
    """One was pulled, and another one put in, while this computer stalled: no pause is seen."""
    assert presence.change(0.0) is None
    assert presence.change(2.0) is not None, "empty"
    presence.miss(0.4, 2.4)
    assert presence.change(2.4) is None, "nothing was read yet"
    assert announce(presence, 2.41) == [(True, True)]
    announce(presence, 2.42)
    assert presence.missed_number > 1


def test_announcements_long_after_a_stall_are_of_one_unit(presence: Presence) -> None:
    presence.change(2.0)
    presence.miss(0.4, 2.4)
    for now in (2.4, 2.45, 2.5):
        presence.change(now)
    announce(presence, 2.55, 2.6)
    assert presence.missed_number == 0


@each(
    "cadence_s",
    [0.05, 0.24, 0.4, 1.0],
)
def test_a_bootloader_that_goes_on_announcing_powers_up_once(
    tmp_path: Path, cadence_s: float
) -> None:
    presence = Presence([UnitBench(tmp_path).recipe.targets[0].profile])
    times = [1.0 + cadence_s * at for at in range(20)]
    changes = announce(presence, *times)
    assert changes[0] == (True, True)
    # Of a very slow one the first pause may be an exchange.
    assert len(changes) <= (1 if cadence_s < 1.0 else 2)
    assert announce(presence, times[-1] + cadence_s + 0.65) == [(True, True)], "another one"


def bursts(count: int, pause_s: float, announcements: int = 4) -> list[float]:
    """Times of announcements 50 ms apart, in bursts with pauses of this length between them."""
    cycle_s = 0.05 * (announcements - 1) + pause_s
    return [
        1.0 + cycle_s * burst + 0.05 * at for burst in range(count) for at in range(announcements)
    ]


@each("pause_s", [0.3, 0.6, 1.4])
@each("announcements", [2, 4, 10])
def test_units_that_are_exchanged_at_equal_intervals_are_no_bootloader_with_pauses(
    tmp_path: Path, pause_s: float, announcements: int
) -> None:
    presence = Presence([UnitBench(tmp_path).recipe.targets[0].profile])
    changes = announce(presence, *bursts(3, pause_s, announcements))
    assert changes == [(True, True)] * 3


@each("pause_s", [0.3, 0.6, 1.4])
def test_a_bootloader_that_announces_itself_in_bursts_is_one_unit_in_the_end(
    tmp_path: Path, pause_s: float
) -> None:
    presence = Presence([UnitBench(tmp_path).recipe.targets[0].profile])
    times = bursts(20, pause_s)
    assert announce(presence, *times) == [(True, True)] * 3
    assert announce(presence, times[-1] + 1.25 * pause_s) == [(True, True)], "another one"


def test_a_pause_in_which_an_application_has_sent_is_no_pace(presence: Presence) -> None:
    announce(presence, 1.0, 1.05)
    hear(presence, version_answer(""), 1.5)
    assert announce(presence, 2.0, 2.05) == [(True, True)]
    assert announce(presence, 3.0) == [(True, True)]


def test_a_pause_that_is_a_silence_is_no_pace(tmp_path: Path) -> None:
    watcher = TargetWatcher(UnitBench(tmp_path).recipe.targets[0].profile)
    for now in bursts(5, 4.0, 1):
        for frame in split(BMS.answer_id, encode(BootVersion("BMS", "V1.0.0").to_message(0x725))):
            watcher(frame, sent=False, now=now)
    assert watcher.power_ups == 5
