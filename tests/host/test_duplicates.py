"""A second device of the same kind on the bus (R27), and a single one, never called two."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import pytest

from flasher.errors import ErrorCode, ExitCode
from flasher.host.outcome import DeviceLeft
from flasher.host.session import Result
from flasher.host.table import Ending
from flasher.host.verify import Verdict
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Nak,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.spec import OBC, WELLING, WMC
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, encode, split
from tests.end_to_end.stage import SMALL, Speaker, Stage, image_of
from tests.host.bench import BOOT, Bench
from tests.host.duplicates import Slow, World, play, world
from tests.loops import each

LATER_S = 0.006
"""How much later than the first device the second one answers: longer than the longest answer."""


def with_twin(
    stage: Stage,
    *,
    latency_s: float = LATER_S,
    has_application: bool = True,
    kind: type[MockDevice] = MockDevice,
    **differs: object,
) -> MockDevice:
    """Another device of the kind on the same bus."""
    other = kind(
        stage.target,
        bitrate_bps=WELLING.bitrate_bps,
        profile=dataclasses.replace(SMALL, **differs),  # type: ignore[arg-type]
        has_application=has_application,
    )
    stage.bus.attach(Slow(other, latency_s))
    return other


def check_untouched(result: Result, *devices: MockDevice) -> None:
    assert result.outcome.ending is Ending.TWO_DEVICES
    assert result.exit_code == ExitCode.WRONG_DEVICE
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    assert all(device.erase_count == 0 for device in devices)


# -- before anything is erased ---------------------------------------------------------------------


@each("target", ["wmc", "bms", "obc"])
@each("latency_s", [0.0011, 0.006, 0.02])
def test_two_that_are_bit_for_bit_alike_are_refused_before_anything_is_erased(
    target: str, latency_s: float
) -> None:
    stage = Stage(target)
    other = with_twin(stage, latency_s=latency_s)
    check_untouched(stage.flash(), stage.device, other)


def test_the_message_names_the_fields_that_differ_and_their_values() -> None:
    stage = Stage()
    other = with_twin(stage, serial_number="W2605099", battery_use="riding")
    result = stage.flash()
    check_untouched(result, stage.device, other)
    error = result.error()
    assert error is not None
    assert error.code is ErrorCode.TWO_DEVICES
    assert "serial number W2605001 / W2605099" in error.what
    assert "mean current" in error.what
    assert "firmware version" not in error.what
    assert not error.needs_rescue


def test_two_of_which_one_answers_no_question_both_confirm_the_reset() -> None:
    stage = Stage()
    other = with_twin(stage, silent_queries="3300,3400")
    result = stage.flash()
    check_untouched(result, stage.device, other)
    assert "confirmed twice" in result.outcome.detail


@each("target", ["wmc", "bms", "obc"])
@each("reset_delay_s", [0.001, 0.03, 0.4, 1.5])
def test_a_bootloader_that_announces_itself_beside_an_application_is_refused(
    target: str, reset_delay_s: float
) -> None:
    """One whose last upgrade failed, and one that works."""
    stage = Stage(target, profile=dataclasses.replace(SMALL, reset_delay_s=reset_delay_s))
    other = with_twin(stage, has_application=False)
    stage.wait(0.313)
    check_untouched(stage.flash(), stage.device)
    assert other.erase_count == 0


def test_an_application_that_sends_beside_a_bootloader_is_refused() -> None:
    stage = Stage("wmc", has_application=False)
    poll = split(0x712, encode(Message(0x712, 0x11, 0x3200, b"")))
    stage.bus.attach(Speaker(*poll, every_s=0.013))
    stage.wait(0.2)
    check_untouched(stage.flash())


def test_two_bursts_that_overlap_are_two_devices_although_one_feedback_was_lost() -> None:
    stage = Stage("obc")
    other = with_twin(stage, reset_delay_s=0.062)
    feedback: list[Frame] = []

    def lose_second(frame: Frame, _now: float) -> list[Frame]:
        if frame.data.startswith(b"\x55\xaa\x0c\x05\x55\x03"):
            feedback.append(frame)
        return [] if len(feedback) == 2 and frame.can_id == OBC.answer_id else [frame]

    def until_boot(frame: Frame, now: float) -> list[Frame]:
        if frame.data.startswith(b"\x55\xaa\x0c\x0b"):
            stage.disturb = None
            return [frame]
        return lose_second(frame, now)

    stage.disturb = until_boot
    result = stage.flash()
    check_untouched(result, stage.device, other)
    assert "alternately" in result.outcome.detail


# -- in the transfer -------------------------------------------------------------------------------


def in_transfer(packet: int) -> Bench:
    bench = Bench(700, target=WMC)
    bench.to_boot()
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_packet(packet, first=1)
    return bench


def check_two(bench: Bench, left: DeviceLeft = DeviceLeft.NO_APPLICATION) -> str:
    outcome = bench.outcome
    assert outcome.ending is Ending.TWO_DEVICES
    assert outcome.device_left is left
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.WRONG_DEVICE
    assert error.needs_rescue
    assert "connect one alone" in error.remedy
    return outcome.detail


def test_a_packet_that_was_sent_once_and_acknowledged_twice_is_two_devices() -> None:
    bench = in_transfer(2)
    bench.say(Ack(2))
    bench.wait(0.003)
    bench.say(Ack(2))
    assert check_two(bench) == "packet 2 was acknowledged more often than it was sent"


def test_a_transfer_that_is_complete_after_a_late_request_is_two_devices() -> None:
    """The second device took until then to erase."""
    bench = in_transfer(1)
    for number in range(1, 6):
        bench.say(Ack(number))
        bench.expect(Packet)
    bench.say(Ack(6))
    bench.expect(EndOfTransfer)
    bench.say(RequestTransfer())
    bench.say(Complete())
    assert "yet the transfer was completed" in check_two(bench, DeviceLeft.UNKNOWN)


def test_an_answer_that_the_link_has_doubled_is_one() -> None:
    bench = in_transfer(1)
    for number in range(1, 6):
        bench.say(Ack(number), Ack(number))
        assert bench.expect(Packet).number == number + 1
    bench.say(Ack(6))
    bench.expect(EndOfTransfer)
    assert bench.complete().ok


def test_a_nak_beside_each_ack_is_two_devices() -> None:
    bench = in_transfer(1)
    for number in range(1, 5):
        bench.say(Ack(number), Nak(1))
        if bench.engine.done:
            break
        bench.expect(Packet)
    assert "answered more often" in check_two(bench)


def test_one_nak_beside_an_ack_is_a_packet_whose_first_frame_was_doubled() -> None:
    bench = in_transfer(2)
    bench.say(Ack(2), Nak(2))
    bench.on_to_packet(6, first=3)
    bench.say(Ack(6))
    bench.expect(EndOfTransfer)
    assert bench.complete().ok


@each("row", [BootVersion("WMC", "V1.2.3"), RequestTransfer()])
def test_an_ack_of_a_device_that_seems_to_have_restarted_is_another_devices(
    row: messages.UpgradeMessage,
) -> None:
    bench = in_transfer(5)
    bench.wait(0.07)
    bench.say(Ack(5))
    bench.expect(Packet)
    bench.say(row)
    bench.wait(0.01)
    assert bench.unread == [], "the update command waits"
    bench.say(Ack(6))
    assert "yet packet 6 was acknowledged" in check_two(bench)


@each("answer_s", [0.03, 0.062, 0.12])
def test_a_second_device_has_no_update_command_while_the_answer_of_a_slow_first_one_is_due(
    answer_s: float,
) -> None:
    bench = in_transfer(5)
    bench.wait(answer_s)
    bench.say(Ack(5))
    bench.expect(Packet)
    bench.say(BootVersion("WMC", "V1.2.3"))
    for passed_s in (0.05, 0.1):
        if passed_s < answer_s:
            bench.wait(0.05)
            bench.say(BootVersion("WMC", "V1.2.3"))
    bench.wait(answer_s % 0.05)
    assert bench.unread == [], "the update command waits"
    bench.say(Ack(6))
    assert "yet packet 6 was acknowledged" in check_two(bench)


def test_a_slow_device_that_has_restarted_has_update_command_before_its_burst_ends() -> None:
    """Its fourth boot version may be the last that it listens after."""
    bench = in_transfer(5)
    bench.wait(0.4)
    bench.say(Ack(5))
    bench.expect(Packet)
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.expect(UpdateCommand, within_s=0.13)


@each("lost", [1, 2, 3])
def test_a_slow_device_whose_first_boot_versions_were_lost_has_update_command_in_its_burst(
    lost: int,
) -> None:
    bench = in_transfer(5)
    bench.wait(0.06)
    bench.say(Ack(5))
    bench.expect(Packet)
    bench.wait(lost * 0.05)
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.expect(UpdateCommand, within_s=0.195 - lost * 0.05)


def test_a_device_that_has_restarted_has_update_command_after_a_moment() -> None:
    bench = in_transfer(5)
    bench.say(Ack(5))
    bench.expect(Packet)
    bench.wait(0.07)
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.expect(UpdateCommand, within_s=0.03)


def test_feedbacks_that_begin_in_the_middle_are_another_devices() -> None:
    bench = Bench(20 * 128, target=WMC)
    bench.to_boot()
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_packet(8, first=1)
    for number in range(8, 20):
        bench.say(GeneralFeedbackMessage(), Ack(number))
        if bench.engine.done:
            break
        bench.expect(Packet)
    assert "general feedback" in check_two(bench)


@each("row", [Nak(3), RequestTransfer(), Ack(6)])
def test_who_goes_on_after_complete_is_another_device(row: messages.UpgradeMessage) -> None:
    """Nothing more is asked of a WMC: it is listened for a moment."""
    stage = Stage("wmc")
    reported = split(WMC.answer_id, encode(row.to_message(WMC.answer_id)))
    speaker = Speaker(*reported, every_s=0.0005, begins_at=1e9, limit=2)
    stage.bus.attach(speaker)
    complete = split(WMC.answer_id, encode(Complete().to_message(WMC.answer_id)))[0]

    def then_speak(frame: Frame, now: float) -> Iterable[Frame]:
        if frame == complete:
            speaker._next = now + 0.05
        return [frame]

    stage.disturb = then_speak
    result = stage.flash()
    assert result.outcome.ending is Ending.COMPLETED
    assert not result.ok
    assert result.verification.verdict is Verdict.TWO_DEVICES
    assert result.exit_code == ExitCode.WRONG_DEVICE
    error = result.error()
    assert error is not None
    assert error.needs_rescue


def test_a_battery_that_answers_beside_the_new_application_is_no_success() -> None:
    stage = Stage()
    attached: list[MockDevice] = []
    complete = split(stage.target.answer_id, encode(Complete().to_message(stage.target.answer_id)))

    def plug_in(frame: Frame, _now: float) -> Iterable[Frame]:
        if frame == complete[0] and not attached:
            attached.append(with_twin(stage, serial_number="W2605077"))
        return [frame]

    stage.disturb = plug_in
    result = stage.flash()
    assert result.outcome.ok
    assert result.verification.verdict is Verdict.TWO_DEVICES
    assert "W2605077" in result.verification.detail
    assert result.exit_code == ExitCode.WRONG_DEVICE


# -- a single device is never two ------------------------------------------------------------------


class Confirming(MockDevice):
    """Its bootloader sends general feedback to whatever it receives, the reset too (R15)."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if self.state not in (
            BootloaderState.APPLICATION,
            BootloaderState.OFF,
            BootloaderState.RESTARTING,
        ):
            self._send(messages.GeneralFeedbackMessage())
        super()._take_row(row, now)


@each("has_application", [True, False])
@each("target", ["wmc", "bms"])
def test_a_bootloader_that_confirms_everything_is_one(
    target: str, *, has_application: bool
) -> None:
    stage = Stage(target)
    stage.bus.detach(stage.device)
    stage.device = Confirming(
        stage.target,
        bitrate_bps=WELLING.bitrate_bps,
        profile=SMALL,
        has_application=has_application,
    )
    stage.bus.attach(stage.device)
    stage.wait(0.3)
    result = stage.flash(image_of(30))
    assert result.ok
    assert stage.has == image_of(30).data


@each("passed_s", [0.02, 0.1, 0.16, 0.21, 0.3, 0.39])
@each("profile", [SMALL, dataclasses.replace(SMALL, window_s=0.06)])
def test_one_that_has_just_been_switched_on_is_one(passed_s: float, profile: DeviceProfile) -> None:
    """It passes through its bootloader while the host listens, or while it is reset."""
    stage = Stage("wmc", profile=profile)
    stage.cycle_power()
    stage.wait(passed_s)
    assert stage.flash().ok


@each("spacing_s", [0.025, 0.038, 0.05, 0.062])
def test_one_that_announces_itself_at_another_pace_is_one(spacing_s: float) -> None:
    stage = Stage("obc")
    stage.bus.detach(stage.device)
    stage.device = MockDevice(
        stage.target,
        bitrate_bps=WELLING.bitrate_bps,
        profile=SMALL,
        timings=dataclasses.replace(DEFAULT_TIMINGS, boot_version_spacing_s=spacing_s),
        has_application=False,
    )
    stage.bus.attach(stage.device)
    stage.wait(0.4)
    assert stage.flash().ok


def test_a_battery_that_others_ask_as_well_is_one() -> None:
    """The display asks for the same on the same ids, and is answered on the same id."""
    stage = Stage()
    asks = [
        frame
        for command in (0x5100, 0x5000)
        for frame in split(0x732, encode(Message(0x732, 0x11, command, b"")))
    ]
    stage.bus.attach(Speaker(*asks, every_s=0.011))
    assert stage.flash().ok


def test_a_question_that_was_not_received_here_makes_no_second_device() -> None:
    """An adapter that has lost the display's question: the answer that came too much once does not
    come again."""
    stage = Stage()
    ask = split(0x732, encode(Message(0x732, 0x11, 0x5100, b"")))
    stage.bus.attach(Speaker(*ask, every_s=0.0006, begins_at=0.1012, limit=2))
    stage.disturb = lambda frame, _now: [frame]
    hears = stage.bus.link

    class Losing:
        """An adapter that never receives the display's questions."""

        def __init__(self) -> None:
            self._link = hears()

        def __getattr__(self, name: str) -> object:
            return getattr(self._link, name)

        def receive(self, deadline: float) -> Frame | None:
            while (frame := self._link.receive(deadline)) is not None:
                if frame.can_id != 0x732:
                    return frame
            return None

    stage.wrap = lambda _link: Losing()  # type: ignore[assignment,return-value]
    assert stage.flash().ok
    versions = [
        frame for frame in stage.heard if frame.data.startswith(b"\x55\xaa\x11\x02\x33\x00")
    ]
    assert len(versions) >= 2, "it was asked again"


def test_a_general_feedback_to_somebody_else_before_the_reset_is_none_to_it() -> None:
    stage = Stage("wmc")
    feedback = split(WMC.answer_id, encode(GeneralFeedbackMessage().to_message(WMC.answer_id)))
    stage.bus.attach(Speaker(*feedback, every_s=0.001, begins_at=0.05, limit=4))
    assert stage.flash().ok


def test_a_link_that_doubles_every_frame_is_no_second_device() -> None:
    bench = Bench(300)
    bench.expect(ResetCommand)
    for frame in split(0x725, encode(GeneralFeedbackMessage().to_message(0x725))) * 2:
        bench.engine.receive(frame, bench.now)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_packet(3, first=1)


# -- any world -------------------------------------------------------------------------------------

SOME = range(1, 61)


def any_world(seed: int, *, units: int) -> World:
    """Where few frames are lost an image has 30 packets at most; campaigns have some of 120."""
    made = world(seed, units=units)
    most = made.packets if made.faults > 0.001 else 30
    return dataclasses.replace(made, packets=min(made.packets, most))


@pytest.mark.slow
@pytest.mark.no_cover
@each("seed", SOME)
def test_two_units_that_both_show_themselves_are_never_a_success(seed: int) -> None:
    """What may hide them is in docs/explanation/safety.md."""
    given = any_world(seed, units=2)
    assert not play(given).is_missed, given


@pytest.mark.slow
@pytest.mark.no_cover
def test_nearly_all_worlds_with_two_units_end_as_two_devices() -> None:
    ended = [play(any_world(seed, units=2)).is_two for seed in range(1001, 1041)]
    assert sum(ended) > 0.85 * len(ended)


@pytest.mark.slow
@pytest.mark.no_cover
@each("seed", SOME)
def test_one_unit_is_never_two(seed: int) -> None:
    """Whatever a bad line, a virtual network and a pause of this computer make of it."""
    given = any_world(seed, units=1)
    judged = play(given)
    assert not judged.is_two, given
    assert not judged.is_false
