"""A device whose host was killed sits in its session: the next run finds it (R26), and touches no
device that runs its application.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from flasher import events
from flasher.errors import ExitCode
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending
from flasher.image.release import Release
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, TARGETS, Mode, Node, can_id
from flasher.protocol.wire import Message, encode, split
from flasher.settings.manifest import release_of
from flasher.settings.profile import VersionQuery
from tests.end_to_end.stage import IMAGE, SMALL, Speaker, Stage
from tests.loops import each

UPDATE = bytes.fromhex("55AA160DA10B")
OPEN = UpgradeOptions(in_session=True)
RESCUE = UpgradeOptions(in_session=True, at_power_up=True)
STUBBORN = replace(
    SMALL,
    pause_in_transfer="waits",
    reset_in_bootloader="ignored",
    reset_in_transfer="ignored",
    update_in_transfer="starts_over",
)


class Killed(BaseException):
    """The host is gone in the middle of what it did."""


def left_in_session(
    packet: int = 3, target: str = "bms", profile: DeviceProfile = STUBBORN
) -> Stage:
    """A device whose host was killed while it sent a packet."""
    stage = Stage(target, profile=profile)

    def kill() -> None:
        raise Killed

    stage.at_packet[packet] = kill
    with pytest.raises(Killed):
        stage.flash()
    stage.wait(1.0)
    assert stage.has is None
    stage.heard.clear()
    return stage


def updates(stage: Stage) -> int:
    return sum(frame.data.startswith(UPDATE) for frame in stage.heard)


def with_hardware(hardware: str) -> Release:
    return release_of(IMAGE, BMS, hardware_versions=[hardware])


def test_without_knowing_of_the_session_it_stays_unreachable() -> None:
    stage = left_in_session()
    result = stage.flash()
    assert result.exit_code == ExitCode.NO_ANSWER
    assert updates(stage) == 0
    error = result.error()
    assert error is not None
    assert "--in-session" in error.remedy


@pytest.mark.slow
@each("target", TARGETS)
@each("packet", [1, 3, 4])
@each("options", [OPEN, RESCUE, replace(OPEN, attempts=1)])
def test_an_open_session_is_found_without_a_power_cycle(
    target: str, packet: int, options: UpgradeOptions
) -> None:
    stage = left_in_session(packet, target)
    result = stage.flash(options=options)
    assert result.exit_code == ExitCode.OK
    assert result.outcome.sent_into_silence
    assert stage.has == IMAGE.data
    assert updates(stage) == 1
    assert not stage.seen(events.PowerCycleAwaited)


@each("name", ["flash", "rescue"])
def test_a_program_waives_it_by_a_keyword(name: str) -> None:
    for is_async in (False, True):
        stage = left_in_session()
        connection = stage.connection()
        if is_async:
            call = getattr(connection.async_device(stage.target), name)
            result = asyncio.run(call(IMAGE, in_session=True))
        else:
            result = getattr(connection.device(stage.target), name)(IMAGE, in_session=True)
        assert result.outcome.sent_into_silence
        assert stage.has == IMAGE.data


@each("target", TARGETS)
def test_a_healthy_device_is_upgraded_the_normal_way(target: str) -> None:
    stage = Stage(target)
    result = stage.flash(options=OPEN)
    assert result.exit_code == ExitCode.OK
    assert not result.outcome.sent_into_silence
    assert stage.has == IMAGE.data


def test_a_battery_that_answers_is_waited_for_by_a_rescue_and_gets_nothing() -> None:
    stage = Stage()
    result = stage.flash(options=replace(RESCUE, power_up_timeout_s=20.0))
    assert result.outcome.ending is Ending.NO_ANNOUNCEMENT
    assert len(stage.seen(events.PowerCycleAwaited)) == 1
    assert updates(stage) == 0
    assert not any(b"RESET" in frame.data for frame in stage.heard)


def test_an_application_that_speaks_to_others_gets_no_update_command() -> None:
    """It answers neither the question nor the reset, but it asks the battery."""
    stage = Stage("wmc", profile=replace(STUBBORN, upgrade_in_application="silence"))
    stage.cut_power()
    handshake = Frame(can_id(Node.WMC, Node.BMS), bytes.fromhex("55AA110230090000"))
    stage.bus.attach(Speaker(handshake, every_s=0.5))
    result = stage.flash(options=OPEN)
    assert result.exit_code == ExitCode.NO_ANSWER
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    assert updates(stage) == 0


def test_an_application_that_answers_a_product_s_own_question_gets_no_update_command() -> None:
    """Its answer has the id that the bootloader answers on."""
    query = VersionQuery(0x3900, BMS.answer_id, 0x5210, 0, 16)
    stage = Stage()
    stage.cut_power()
    answer = Message(BMS.answer_id, Mode.REPORT, 0x5210, b"V1r0r0_20220512.")
    frames = split(BMS.answer_id, encode(answer))
    stage.bus.attach(Speaker(*frames, every_s=0.01, begins_at=0.2, limit=len(frames)))
    result = stage.flash(
        options=replace(OPEN, version_request=query.request(BMS)), identity=Identity()
    )
    assert result.previous_version == "V1r0r0_20220512"
    assert result.exit_code == ExitCode.NO_ANSWER
    assert updates(stage) == 0


def test_a_device_that_is_not_there_ends_it_within_the_limits_of_both_waits() -> None:
    stage = Stage()
    stage.cut_power()
    result = stage.flash(options=OPEN)
    assert result.exit_code == ExitCode.NO_ANSWER
    assert updates(stage) == 1
    assert stage.clock.now() < 25.0


# -- what a manifest asks for ----------------------------------------------------------------------


@each("options", [OPEN, RESCUE])
def test_a_rule_that_no_one_can_check_does_not_keep_it_from_being_found(
    options: UpgradeOptions,
) -> None:
    stage = left_in_session()
    identity = Identity(with_hardware("V1r2r0_*"), reports_unchecked=options.at_power_up)
    result = stage.flash(options=options, identity=identity)
    assert result.exit_code == ExitCode.OK
    (check,) = (each for each in stage.seen(events.CheckMade) if each.check == "hardware")
    assert check.verdict == ("unknown" if options.at_power_up else "warned")
    assert stage.has == IMAGE.data


def test_an_application_that_reports_no_hardware_is_refused_as_without_the_option() -> None:
    """A motor controller has no question for it, and answers the reset: no open session."""
    stage = Stage("wmc")
    identity = Identity(with_hardware("V1r2r0_*"), waived=frozenset({IdentityCheck.TARGET}))
    result = stage.flash(options=OPEN, identity=identity)
    assert result.outcome.ending is Ending.UNCHECKED
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    assert result.outcome.waiver == IdentityCheck.HARDWARE.value
    assert updates(stage) == 0
    assert stage.device.erase_count == 0


def test_hardware_that_does_not_fit_refuses_a_battery_that_answers() -> None:
    stage = Stage(profile=SMALL)
    identity = Identity(with_hardware("V9r9r9_*"), reports_unchecked=True)
    result = stage.flash(options=RESCUE, identity=identity)
    assert result.outcome.ending is Ending.NOT_FOR_DEVICE
    assert updates(stage) == 0
