"""What keeps an erased device from its image for a while, and is waited for."""

from __future__ import annotations

import pytest

from flasher import events
from flasher.errors import BusError, ExitCode, TransmitBlockedError
from flasher.host.options import UpgradeOptions, default_timeout_s
from flasher.host.table import Ending
from tests.end_to_end.stage import IMAGE, Stage
from tests.loops import each

AWAY_S = 0.3


def without_power(stage: Stage, seconds: float) -> None:
    """The device is off for so long, and no other node acknowledges."""
    stage.cut_power()
    stage.bus.is_unacknowledged = True
    back_at = stage.clock.now() + seconds

    def look(now: float) -> None:
        if now >= back_at and not stage.device.has_power:
            stage.bus.is_unacknowledged = False
            stage.give_power()

    stage.clock.on_wait = look


@each("seconds", [3.0, 30.0])
def test_a_device_alone_on_the_bus_that_loses_its_power_is_finished_when_it_is_back(
    seconds: float,
) -> None:
    stage = Stage()
    stage.at_packet[3] = lambda: without_power(stage, seconds)
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    printed = stage.seen(events.BusBlocked)
    assert ["took no frame" in each.reason and each.limit_s > 60.0 for each in printed] == [True]


def test_a_bus_that_stays_blocked_ends_it_at_the_overall_deadline() -> None:
    stage = Stage()
    stage.at_packet[3] = lambda: without_power(stage, 1e6)
    options = UpgradeOptions()
    with pytest.raises(TransmitBlockedError) as raised:
        stage.flash(options=options)
    assert raised.value.exit_code == ExitCode.BUS
    assert raised.value.needs_rescue
    limit_s = default_timeout_s(stage.plan(), options)
    assert limit_s - 5.0 < stage.clock.now() <= limit_s
    assert len(stage.seen(events.BusBlocked)) == 1


def test_the_user_ends_the_wait_for_a_blocked_bus() -> None:
    stage = Stage()
    stage.at_packet[3] = lambda: without_power(stage, 1e6)
    stage.cancelled = lambda: stage.clock.now() > 20.0
    result = stage.flash()
    assert result.outcome.ending is Ending.CANCELLED
    assert stage.clock.now() < 24.0


def test_a_bus_that_takes_no_frame_ends_it_where_something_can_be_lost() -> None:
    stage = Stage()
    stage.bus.is_unacknowledged = True
    stage.queue_frames = 1
    with pytest.raises(TransmitBlockedError):
        stage.flash()
    assert stage.clock.now() < 5.0
    assert stage.seen(events.BusBlocked) == []


def test_a_bus_that_takes_no_frame_ends_it_where_somebody_has_limited_the_attempts() -> None:
    stage = Stage()
    stage.at_packet[3] = lambda: without_power(stage, 30.0)
    with pytest.raises(TransmitBlockedError):
        stage.flash(options=UpgradeOptions(attempts=3))
    assert stage.clock.now() < 5.0


def with_a_loose_plug() -> Stage:
    stage = Stage()
    for packet in (1, 2, 3, 4):
        stage.at_packet[packet] = lambda: stage.bus.unplug(AWAY_S)
    return stage


def test_an_adapter_may_be_lost_more_often_than_there_are_attempts() -> None:
    stage = with_a_loose_plug()
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_an_adapter_that_is_lost_too_often_for_the_attempts_that_were_given_ends_it() -> None:
    stage = with_a_loose_plug()
    with pytest.raises(BusError) as raised:
        stage.flash(options=UpgradeOptions(attempts=3))
    assert raised.value.needs_rescue
