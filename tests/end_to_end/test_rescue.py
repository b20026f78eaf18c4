"""Nothing that happens in the middle leaves a device that cannot be brought back: the power, the
adapter and the final answer are lost at every packet, and then the device is rescued.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from flasher import api, events
from flasher.bus.simulated import SimulatedLink
from flasher.errors import BusError, ErrorCode, ExitCode
from flasher.events import Phase
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BOOT_VERSION_BURST
from flasher.wording import wording
from tests.end_to_end.stage import IMAGE, NEW, SMALL, Stage, image_of
from tests.loops import each, sample

PACKETS = 40
SAMPLE = sample((1, 2, 3, 20, 21, PACKETS - 1, PACKETS), range(1, PACKETS + 1))
LONG = image_of(PACKETS)
ONCE = UpgradeOptions(attempts=1)
LISTENS = replace(SMALL, without_application="listens")
COMPLETE = bytes.fromhex("55AA0C04C5020000")


# -- the device's power ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.no_cover
@each("number", SAMPLE)
def test_a_device_that_lost_power_at_any_packet_is_rescued(number: int) -> None:
    lose_power_at(number)


def lose_power_at(number: int) -> None:
    """Every other one announces itself at power-up only."""
    stage = Stage(profile=SMALL if number % 2 else LISTENS)
    stage.at_packet[number] = stage.cut_power
    failed = stage.flash(LONG, ONCE)
    assert failed.exit_code == ExitCode.TRANSFER
    assert failed.outcome.packet == number
    assert failed.outcome.device_left is DeviceLeft.NO_APPLICATION
    assert stage.has is None
    rescued = stage.rescue(LONG)
    assert rescued.exit_code == ExitCode.OK
    assert rescued.running_version == NEW
    assert stage.has == LONG.data


@each("number", [1, 20, PACKETS])
def test_power_that_comes_back_within_the_session_is_no_failure(number: int) -> None:
    stage = Stage()
    stage.at_packet[number] = stage.cycle_power
    result = stage.flash(LONG)
    assert result.exit_code == ExitCode.OK
    assert stage.has == LONG.data
    assert [started.attempt for started in stage.seen(events.AttemptStarted)] == [2]


def test_a_power_cut_in_the_middle_of_a_rescue_is_rescued_in_the_same_run() -> None:
    stage = Stage(has_application=False, profile=LISTENS)
    stage.at_packet[3] = stage.cut_power
    result = stage.rescue()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert len(stage.seen(events.PowerCycleAwaited)) == 2


# -- which device can be rescued ------------------------------------------------------------------


@each("target", ["wmc", "bms", "obc"])
@each("profile", [SMALL, LISTENS])
def test_a_device_without_application_is_rescued_whichever_way_it_announces(
    target: str, profile: DeviceProfile
) -> None:
    stage = Stage(target, profile=profile, has_application=False)
    stage.wait(3.0)
    result = stage.rescue()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_a_device_that_announces_on_is_rescued_without_a_power_cycle() -> None:
    stage = Stage(has_application=False)
    stage.wait(3.0)
    result = stage.flash(IMAGE, UpgradeOptions(at_power_up=True))
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_the_announcement_at_power_up_is_answered_within_its_window() -> None:
    """A device with a whole application listens for the burst and a moment more, then starts it."""
    stage = Stage(profile=replace(SMALL, window_s=0.0))
    result = stage.rescue()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert len(stage.seen(events.BootVersionSeen)) == 1


def test_nothing_is_sent_before_the_announcement_and_nothing_at_all_without_one() -> None:
    stage = Stage()
    result = stage.flash(IMAGE, UpgradeOptions(at_power_up=True, power_up_timeout_s=20.0))
    assert stage.heard == []
    assert result.outcome.ending is Ending.NO_ANNOUNCEMENT
    assert result.exit_code == ExitCode.NO_ANSWER
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    assert stage.clock.now() == pytest.approx(20.0, abs=0.3)


def test_an_adapter_that_comes_back_while_power_is_awaited_sends_no_reset() -> None:
    """The application may be running: only an announcement is answered."""
    stage = Stage()
    unplugged = False

    def on_prompt() -> None:
        nonlocal unplugged
        if not unplugged:
            unplugged = True
            stage.bus.unplug(back_after_s=0.3)

    stage.at_event[events.PowerCycleAwaited] = on_prompt
    result = stage.flash(IMAGE, UpgradeOptions(at_power_up=True))
    assert stage.seen(events.AdapterBack)
    assert stage.heard == []
    assert result.outcome.ending is Ending.NO_ANNOUNCEMENT


def test_the_wait_for_power_is_over_with_the_overall_deadline() -> None:
    stage = Stage()
    result = stage.flash(IMAGE, UpgradeOptions(at_power_up=True, timeout_s=4.0))
    assert result.outcome.ending is Ending.OUT_OF_TIME
    assert stage.clock.now() == pytest.approx(4.0, abs=0.3)


# -- the final answer -----------------------------------------------------------------------------


def lose_complete(frame: Frame, _now: float) -> list[Frame]:
    return [] if frame.data == COMPLETE else [frame]


@each("target", ["wmc", "obc"])
def test_a_lost_final_answer_is_unconfirmed_and_the_device_can_be_rescued(target: str) -> None:
    stage = Stage(target)
    stage.disturb = lose_complete
    result = stage.flash()
    assert result.exit_code == ExitCode.UNCONFIRMED
    error = result.error()
    assert error is not None
    assert "Unconfirmed" in str(error)
    assert error.needs_rescue
    stage.disturb = None
    assert stage.rescue(image_of(6)).exit_code == ExitCode.OK
    assert stage.has == image_of(6).data


def test_a_refusal_at_the_end_leaves_a_device_that_can_be_rescued() -> None:
    stage = Stage(profile=replace(SMALL, image_checksum="crc32"))
    result = stage.flash()
    assert result.exit_code == ExitCode.REFUSED
    assert result.outcome.device_left is DeviceLeft.NO_APPLICATION
    stage.device.profile = SMALL  # a device that takes this image
    assert stage.rescue().exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


# -- the adapter ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.no_cover
@each("number", SAMPLE)
def test_an_adapter_that_fails_at_any_packet_is_exit_4_or_overcome(number: int) -> None:
    lose_the_adapter_at(number)


def lose_the_adapter_at(number: int) -> None:
    """In turn: pulled out for good, pulled out and back, bus-off that restarts by itself."""
    stage = Stage()
    match number % 3:
        case 0:
            pulled_out_for_good(stage, number)
        case 1:
            stage.at_packet[number] = lambda: stage.bus.unplug(0.4)
            assert stage.flash(LONG).exit_code == ExitCode.OK
            assert len(stage.seen(events.AdapterLost)) == len(stage.seen(events.AdapterBack)) == 1
            assert not stage.seen(events.AttemptStarted)
        case 2:
            stage.at_packet[number] = lambda: stage.bus.bus_off(0.4)
            assert stage.flash(LONG).exit_code == ExitCode.OK
    assert stage.has == LONG.data


def pulled_out_for_good(stage: Stage, number: int) -> None:
    """The same command repairs, once the adapter is back."""
    stage.at_packet[number] = stage.bus.unplug
    with pytest.raises(BusError) as caught:
        stage.flash(LONG)
    assert f"packet {number} of {PACKETS}" in caught.value.where
    assert caught.value.needs_rescue
    assert stage.has is None
    stage.bus.plug()
    assert stage.flash(LONG).exit_code == ExitCode.OK


def test_an_adapter_that_goes_again_and_again_ends_after_the_last_attempt() -> None:
    stage = Stage()

    def loose_contact() -> None:
        stage.at_packet[2] = loose_contact
        stage.bus.unplug(0.2)

    stage.at_packet[2] = loose_contact
    with pytest.raises(BusError):
        stage.flash(LONG, UpgradeOptions(attempts=3))
    assert len(stage.seen(events.AdapterBack)) == 2
    assert stage.has is None


def test_with_one_attempt_a_lost_adapter_is_the_end() -> None:
    stage = Stage()
    stage.at_packet[2] = lambda: stage.bus.unplug(0.1)
    with pytest.raises(BusError):
        stage.flash(LONG, ONCE)
    assert not stage.seen(events.AdapterLost)


def test_the_wait_for_a_lost_adapter_is_five_seconds_and_counted_down() -> None:
    stage = Stage()
    lost_at: list[float] = []

    def pull_out() -> None:
        lost_at.append(stage.clock.now())
        stage.bus.unplug()

    stage.at_packet[2] = pull_out
    with pytest.raises(BusError):
        stage.flash(LONG)
    assert stage.clock.now() - lost_at[0] == pytest.approx(5.0, abs=0.3)
    assert [each.left_s for each in stage.seen(events.AdapterAwaited)] == [5, 4, 3, 2, 1]


def test_an_adapter_that_comes_back_after_four_seconds_is_no_failure() -> None:
    stage = Stage()
    stage.at_packet[2] = lambda: stage.bus.unplug(4.0)
    assert stage.flash(LONG).exit_code == ExitCode.OK
    assert stage.has == LONG.data
    assert stage.seen(events.AdapterBack)


@each("at_power_up", [False, True])
def test_an_adapter_that_is_lost_before_anything_was_sent_ends_it_within_a_second(
    at_power_up: bool,
) -> None:
    """BU-05, whatever the time that it is given."""
    stage = Stage()
    when(stage, Phase.BOOT if at_power_up else Phase.LISTEN, stage.bus.unplug)
    with pytest.raises(BusError) as caught:
        stage.flash(options=UpgradeOptions(adapter_return_s=60.0, at_power_up=at_power_up))
    assert stage.clock.now() < 1.0
    assert stage.heard == []
    assert "this run erased nothing" in caught.value.remedy


def test_the_error_at_the_end_is_that_of_the_last_try_to_open_it() -> None:
    """An interface that comes back at another bit rate is not "no such device"."""
    stage = Stage()
    reopen = SimulatedLink.reopen

    class Changed(SimulatedLink):
        def reopen(self) -> None:
            reopen(self)
            raise BusError(
                "The bus runs at 500 kbit/s.",
                where="interface socketcan, channel can0",
                cause="somebody has set it so",
                remedy="Set it to 250 kbit/s.",
                code=ErrorCode.OTHER_BIT_RATE,
            )

    stage.wrap = lambda link: Changed(link._bus, link._queue_frames)
    stage.at_packet[2] = lambda: stage.bus.unplug(1.0)
    with pytest.raises(BusError) as caught:
        stage.flash(LONG)
    error = caught.value
    assert error.what == "The bus runs at 500 kbit/s."
    assert error.code is ErrorCode.OTHER_BIT_RATE
    assert "packet 2 of 40" in error.where
    assert "it was lost with: The adapter failed while" in error.cause
    assert error.remedy.startswith("Set it to 250 kbit/s. Run the same command again.")
    assert error.needs_rescue


def test_an_adapter_that_does_not_come_back_is_a_lost_one() -> None:
    stage = Stage()
    stage.at_packet[2] = stage.bus.unplug
    with pytest.raises(BusError) as caught:
        stage.flash(LONG)
    assert caught.value.code is ErrorCode.ADAPTER_LOST
    assert "is not there" in caught.value.what


PHASES = list(Phase)[:-1]


def when(stage: Stage, phase: Phase, happens: object) -> None:
    """Let something happen once, when a phase is entered."""
    left = [happens]

    def on_phase() -> None:
        entered = stage.seen(events.PhaseEntered)[-1]
        if entered.phase is phase and left:
            left.pop()()  # type: ignore[operator]

    stage.at_event[events.PhaseEntered] = on_phase


@each("phase", PHASES)
def test_an_adapter_that_is_lost_for_good_in_any_phase_is_exit_4(phase: Phase) -> None:
    stage = Stage()
    when(stage, phase, stage.bus.unplug)
    with pytest.raises(BusError) as caught:
        stage.flash()
    assert wording(phase) in caught.value.where
    assert "State of the device: " in caught.value.remedy
    assert caught.value.needs_rescue is (phase in PHASES[4:])
    assert stage.has in (None, IMAGE.data) or phase in PHASES[:5]


@each("phase", PHASES)
def test_an_adapter_that_comes_back_in_any_phase_is_no_failure(phase: Phase) -> None:
    stage = Stage()
    when(stage, phase, lambda: stage.bus.unplug(0.5))
    assert stage.flash().exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert stage.seen(events.AdapterBack)


@each("phase", PHASES)
def test_an_adapter_that_restarts_after_a_bus_off_in_any_phase_is_overcome(phase: Phase) -> None:
    stage = Stage()
    when(stage, phase, lambda: stage.bus.bus_off(0.5))
    assert stage.flash().exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_a_bus_off_that_is_over_keeps_no_later_upgrade_from_starting() -> None:
    stage = Stage()
    link = stage.bus.link()
    stage.bus.bus_off(0.5)
    while (seen := link.receive(stage.clock.now() + 1.0)) is not None:
        assert seen.is_error
    connection = api.Connection(link, stage.clock, "the simulated bus")
    result = connection.device().upgrade(IMAGE)
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_an_adapter_that_is_lost_while_the_version_is_asked_for_comes_back_to_the_question() -> (
    None
):
    stage = Stage()
    stage.at_event[events.VerificationStarted] = lambda: stage.bus.unplug(0.5)
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    assert result.running_version == NEW
    assert not stage.seen(events.AttemptStarted)


def test_without_an_adapter_at_the_version_query_the_result_states_that_the_image_is_there() -> (
    None
):
    stage = Stage()
    stage.at_event[events.VerificationStarted] = stage.bus.unplug
    with pytest.raises(BusError) as caught:
        stage.flash()
    assert "verifying by version" in caught.value.where
    assert wording(DeviceLeft.NEW) in caught.value.remedy
    assert not caught.value.needs_rescue


def test_the_wait_for_the_adapter_is_over_with_the_overall_deadline() -> None:
    stage = Stage()
    stage.at_packet[2] = stage.bus.unplug
    with pytest.raises(BusError):
        stage.flash(LONG, UpgradeOptions(adapter_return_s=600.0, timeout_s=5.0))
    assert stage.clock.now() == pytest.approx(5.0, abs=0.3)


@pytest.mark.slow
def test_a_long_wait_for_the_adapter_is_allowed_for_by_the_default_deadline() -> None:
    stage = Stage()
    stage.at_packet[2] = lambda: stage.bus.unplug(550.0)
    assert stage.flash(options=UpgradeOptions(adapter_return_s=600.0)).exit_code == ExitCode.OK
    assert stage.has == IMAGE.data


# -- after a good end -----------------------------------------------------------------------------


def test_a_device_that_has_completed_is_not_upgraded_again() -> None:
    """It passes through its bootloader on the way to the new application, and is power-cycled."""
    stage = Stage(profile=replace(SMALL, after_complete="restarts"))
    stage.at_event[events.VerificationStarted] = stage.cycle_power
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    update = bytes.fromhex("55AA160DA10B")
    assert sum(frame.data.startswith(update) for frame in stage.heard) <= BOOT_VERSION_BURST
    before = stage.device.erase_count
    stage.cycle_power()
    stage.wait(3.0)
    assert stage.device.erase_count == before
    assert stage.has == IMAGE.data


# -- everything at once ---------------------------------------------------------------------------


def some_trouble(stage: Stage, draw: random.Random) -> Callable[[], None]:
    """Power, adapter or line, for a while or for good."""
    return draw.choice(
        [
            stage.cut_power,
            stage.cycle_power,
            stage.bus.unplug,
            lambda: stage.bus.unplug(draw.choice([0.1, 0.5, 2.0])),
            lambda: stage.bus.bus_off(draw.choice([0.1, 0.5])),
        ]
    )


@each("seed", range(12))
def test_whatever_happens_success_is_never_claimed_wrongly_and_the_device_is_rescued(
    seed: int,
) -> None:
    """Two troubles at random packets, on a line that loses frames, with random choices of the
    device.
    """
    draw = random.Random(seed)
    profile = replace(
        SMALL,
        without_application=draw.choice(["announces", "listens"]),
        reset_in_transfer=draw.choice(["ignored", "restarts"]),
        repeated_packet=draw.choice(["ack", "nak_next"]),
        after_complete=draw.choice(["starts", "restarts"]),
    )
    stage = Stage(draw.choice(["wmc", "bms", "obc"]), profile=profile)
    stage.disturb = lambda frame, _now: [] if draw.random() < 0.003 else [frame]
    for _ in range(2):
        stage.at_packet[draw.randrange(1, 5)] = some_trouble(stage, draw)
    with contextlib.suppress(BusError):
        result = stage.flash(options=UpgradeOptions(attempts=draw.choice([1, 3])))
        assert result.exit_code != ExitCode.OK or stage.has == IMAGE.data
        erased = stage.device.erase_count
        assert not erased or result.outcome.device_left is not DeviceLeft.UNTOUCHED
    stage.disturb = None
    stage.at_packet.clear()
    stage.bus.plug()
    stage.cycle_power()
    assert stage.rescue().exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
