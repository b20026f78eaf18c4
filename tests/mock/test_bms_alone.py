"""What the BMS says without being asked: faults, and the shutdown handshake."""

from __future__ import annotations

from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.events import ShutdownAnnounced, ShutdownEnded
from flasher.mock.battery import Battery
from flasher.mock.bms import BmsApplication
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol.contents import BatteryFault
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WMC
from tests.loops import each
from tests.mock.talk import READ, REPORT, START_S, WRITE, Talk

FIVE = [0.0, 0.2, 0.4, 0.6, 0.8]
FAULTS, SHUTDOWN = (0x720, 0x1204), (0x720, 0x1308)
WMC_READY = (0x710, REPORT, 0x1305, b"READY")
OBC_READY = (0x730, REPORT, 0x1405, b"READY")
HMI_READY = (0x740, REPORT, 0x1305, b"READY")


def battery(**options: Any) -> Talk:
    plain: dict[str, Any] = {"battery_use": "resting"}
    return Talk(MockDevice(BMS, bitrate_bps=250_000, profile=DeviceProfile(**plain | options)))


def device_of(talk: Talk) -> MockDevice:
    assert isinstance(talk.engine, MockDevice)
    return talk.engine


def application_of(talk: Talk) -> BmsApplication:
    application = device_of(talk).application
    assert isinstance(application, BmsApplication)
    return application


# -- faults ---------------------------------------------------------------------------------------


def test_faults_are_reported_every_200_ms_while_any_is_set() -> None:
    talk = battery()
    talk.run(1.0)
    assert talk.take() == []
    application_of(talk).set_faults(
        BatteryFault.CHARGE_OVER_VOLTAGE_WARNING
        | BatteryFault.MOS_OVER_TEMPERATURE_WARNING
        | BatteryFault.SHORT_CIRCUIT_PROTECTION
        | BatteryFault.MCU_FAULT,
        talk.now,
    )
    talk.run(0.9)
    heard = talk.take()
    assert [one.at_s - START_S - 1.0 for one in heard] == pytest.approx(FIVE)
    # Low byte first: the protections' half, then the warnings'.
    assert {one[1:] for one in heard} == {(0x720, REPORT, 0x1204, bytes.fromhex("04800101"))}
    application_of(talk).set_faults(BatteryFault(0), talk.now)
    talk.run(5.0)
    assert talk.take() == []


def test_faults_of_the_profile_are_set_from_the_start_and_again_after_a_power_cut() -> None:
    talk = battery(faults=0x8000_0001)
    talk.run(0.5)
    heard = talk.take()
    assert [one.data.hex() for one in heard] == ["01000080"] * 3
    device_of(talk).power_cut(talk.now)
    talk.run(5.0)
    assert talk.take() == []
    device_of(talk).power_on(talk.now)
    talk.run(1.0)
    assert FAULTS in [(one.can_id, one.command) for one in talk.take()]


def test_other_faults_do_not_change_the_cadence() -> None:
    talk = battery(faults=1)
    talk.run(0.3)
    application_of(talk).set_faults(BatteryFault(2), talk.now)
    talk.run(0.6)
    heard = talk.take()
    assert [one.at_s - START_S for one in heard] == pytest.approx(FIVE)
    assert [one.data[0] for one in heard] == [1, 1, 2, 2, 2]


def test_the_bootloader_reports_no_faults() -> None:
    talk = battery(faults=1)
    talk.put(0x752, WRITE, 0x4205, b"RESET")
    talk.run(0.3)
    assert not talk.times_of(*FAULTS)
    talk.run(1.0)
    assert talk.times_of(*FAULTS)


def test_a_bus_that_takes_nothing_does_not_pile_faults_up() -> None:
    talk = battery(faults=1)
    talk.accepts_frames = False
    talk.run(10.0)
    talk.accepts_frames = True
    assert len(talk.take()) == 1


def test_more_faults_than_there_are_bits_are_refused() -> None:
    with pytest.raises(UsageError, match="32 bits"):
        DeviceProfile(faults=1 << 32)


# -- shutdown -------------------------------------------------------------------------------------


def test_shutdown_is_repeated_every_200_ms_until_1_s_when_no_device_answers_then_it_is_off() -> (
    None
):
    talk = battery()
    device_of(talk).hold_key(talk.now)
    talk.run(0.99)
    assert device_of(talk).state is BootloaderState.APPLICATION
    heard = talk.take()
    assert [one.at_s - START_S for one in heard] == pytest.approx(FIVE)
    assert {one[1:] for one in heard} == {(0x720, REPORT, 0x1308, b"SHUTDOWN")}
    talk.run(0.02)
    assert device_of(talk).state is BootloaderState.OFF
    talk.run(60.0)
    assert talk.take() == []
    assert [event for event in talk.events if isinstance(event, ShutdownAnnounced)] == [
        ShutdownAnnounced("key held")
    ]
    assert [event for event in talk.events if isinstance(event, ShutdownEnded)] == [
        ShutdownEnded((), ("WMC", "OBC"))
    ]


@each(
    "dialect, answers",
    [
        ("welling", [WMC_READY, OBC_READY]),
        ("motinova", [WMC_READY, OBC_READY, HMI_READY]),
    ],
)
def test_shutdown_is_sent_once_when_all_others_are_ready_at_once_and_off_still_comes_after_1_s(
    dialect: str, answers: list[tuple[int, int, int, bytes]]
) -> None:
    talk = battery(dialect=dialect)
    device_of(talk).hold_key(talk.now)
    for answer in answers:
        talk.put(*answer)
    talk.run(0.99)
    assert talk.times_of(*SHUTDOWN) == [0.0]
    assert device_of(talk).state is BootloaderState.APPLICATION
    talk.run(0.02)
    assert device_of(talk).state is BootloaderState.OFF
    (ended,) = [event for event in talk.events if isinstance(event, ShutdownEnded)]
    assert len(ended.ready) == len(answers)
    assert ended.silent == ()


@each("missing", [0, 1, 2])
def test_one_node_that_does_not_answer_keeps_it_repeating(missing: int) -> None:
    answers = [WMC_READY, OBC_READY, HMI_READY]
    names = ("WMC", "OBC", "HMI")
    del answers[missing]
    talk = battery(dialect="motinova")
    device_of(talk).hold_key(talk.now)
    for answer in answers:
        talk.put(*answer)
    talk.run(1.5)
    assert talk.times_of(*SHUTDOWN) == pytest.approx(FIVE)
    assert device_of(talk).state is BootloaderState.OFF
    (ended,) = [event for event in talk.events if isinstance(event, ShutdownEnded)]
    assert ended.silent == (names[missing],)


def test_answers_that_come_in_between_end_the_repetitions() -> None:
    talk = battery()
    device_of(talk).hold_key(talk.now)
    talk.put(*WMC_READY)
    talk.run(0.45)
    talk.put(*OBC_READY)
    talk.run(1.0)
    assert talk.times_of(*SHUTDOWN) == pytest.approx([0.0, 0.2, 0.4])


@each(
    "answer",
    [
        (0x710, REPORT, 0x1305, b"REDAY"),
        (0x710, WRITE, 0x1305, b"READY"),
        (0x710, REPORT, 0x1405, b"READY"),
        (0x730, REPORT, 0x1305, b"READY"),
        (0x740, REPORT, 0x1305, b"READY"),
        (0x710, REPORT, 0x1808, b"SHUTDOWN"),
    ],
)
def test_what_is_not_the_wmcs_ready_does_not_count_as_it(
    answer: tuple[int, int, int, bytes],
) -> None:
    talk = battery()
    device_of(talk).hold_key(talk.now)
    talk.put(*OBC_READY)
    talk.put(*answer)
    talk.run(1.5)
    assert len(talk.times_of(*SHUTDOWN)) == 5


def test_ready_without_an_announcement_means_nothing() -> None:
    talk = battery()
    talk.put(*WMC_READY)
    talk.put(*OBC_READY)
    talk.run(5.0)
    assert talk.take() == []
    assert device_of(talk).state is BootloaderState.APPLICATION
    device_of(talk).hold_key(talk.now)
    talk.run(1.5)
    assert len(talk.times_of(*SHUTDOWN)) == 5


def test_holding_the_key_again_does_not_begin_anew() -> None:
    talk = battery()
    device_of(talk).hold_key(talk.now)
    talk.run(0.5)
    device_of(talk).hold_key(talk.now)
    talk.run(0.6)
    assert device_of(talk).state is BootloaderState.OFF
    assert len(talk.times_of(*SHUTDOWN)) == 5


def test_queries_are_answered_until_it_is_off_and_again_once_it_is_on() -> None:
    talk = battery()
    device_of(talk).hold_key(talk.now)
    talk.run(0.5)
    assert len(talk.ask(0x752, READ, 0x3300)) == 1
    talk.run(1.0)
    assert talk.ask(0x752, READ, 0x3300) == []
    device_of(talk).power_on(talk.now)
    talk.run(1.0)
    assert len(talk.ask(0x752, READ, 0x3300)) == 1
    talk.run(5.0)
    assert device_of(talk).state is BootloaderState.APPLICATION


def test_the_key_means_nothing_to_a_bootloader_and_to_others_than_the_bms() -> None:
    talk = battery()
    talk.put(0x752, WRITE, 0x4205, b"RESET")
    device_of(talk).hold_key(talk.now)
    talk.run(1.5)
    assert not talk.times_of(*SHUTDOWN)
    other = Talk(MockDevice(WMC, bitrate_bps=250_000))
    device_of(other).hold_key(other.now)
    other.run(2.0)
    assert other.take() == []
    assert device_of(other).state is BootloaderState.APPLICATION


# -- idle -----------------------------------------------------------------------------------------


@each("dialect", ["welling", "motinova"])
def test_a_resting_battery_on_an_idle_bus_shuts_down_after_half_an_hour(dialect: str) -> None:
    talk = battery(idle_shutdown="on", dialect=dialect)
    talk.run(10.0)
    talk.put(0x752, READ, 0x3300)
    talk.run(1799.0)
    assert not talk.times_of(*SHUTDOWN)
    talk.run(3.0)
    assert talk.times_of(*SHUTDOWN) == pytest.approx([1810.0 + at_s for at_s in FIVE])
    assert device_of(talk).state is BootloaderState.OFF
    assert ShutdownAnnounced("bus idle") in talk.events


def test_any_frame_keeps_it_on() -> None:
    talk = battery(idle_shutdown="on")
    for _ in range(10):
        talk.engine.receive(Frame(0x123, b"\x00"), talk.now)
        talk.run(1000.0)
    assert device_of(talk).state is BootloaderState.APPLICATION


def test_a_battery_that_is_ridden_or_charged_stays_on() -> None:
    talk = battery(idle_shutdown="on", battery_use="riding")
    talk.run(6 * 3600.0)
    assert device_of(talk).state is BootloaderState.APPLICATION


def test_the_current_has_to_be_small_for_the_whole_half_hour() -> None:
    """5.1: it is large for a moment in the middle, and small when the half hour is over."""
    talk = battery(idle_shutdown="on")
    rests, rides = application_of(talk).battery, Battery("riding")
    talk.run(900.0)
    application_of(talk).battery = rides
    talk.run(2.0)
    application_of(talk).battery = rests
    large_until_s = talk.now
    talk.run(1795.0)
    assert not talk.times_of(*SHUTDOWN)
    talk.run(10.0)
    first_s = START_S + talk.times_of(*SHUTDOWN)[0]
    assert first_s - large_until_s == pytest.approx(1800.0, abs=1.5)


def test_a_battery_that_reports_its_faults_keeps_the_bus_busy() -> None:
    talk = battery(idle_shutdown="on", faults=1)
    talk.run(2000.0)
    assert not talk.times_of(*SHUTDOWN)


def test_by_default_an_idle_bus_changes_nothing() -> None:
    talk = battery()
    talk.run(86_400.0)
    assert device_of(talk).state is BootloaderState.APPLICATION
