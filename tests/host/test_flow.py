"""The upgrade from reset to the final answer: what the host sends, and when (4.2, R2, R3, R12)."""

from __future__ import annotations

from itertools import pairwise

import pytest

from flasher import events
from flasher.errors import ErrorCode, ExitCode
from flasher.events import Phase
from flasher.host.options import UpgradeOptions, default_timeout_s
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, UpgradeState
from flasher.image.plan import plan
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.spec import BMS, OBC, WELLING, WMC, Target
from flasher.protocol.timing import Timings
from tests.host.bench import BOOT, Bench, answer_frames, image_of
from tests.host.upgrade import Upgrade
from tests.loops import each


@each(
    "target, boot_name, text",
    [(WMC, "WMC", "WMC_UPD"), (BMS, "BMS", "BMS_UPD"), (OBC, "PBU", "OBC_UPD")],
)
def test_a_right_device_is_upgraded_with_every_message_once(
    target: Target, boot_name: str, text: str
) -> None:
    bench = Bench(300, target=target)
    bench.expect(ResetCommand)
    bench.say(GeneralFeedbackMessage())
    bench.say(BootVersion(boot_name, "V1.2.3"))
    assert bench.expect(UpdateCommand) == UpdateCommand(text, 300)
    bench.say(RequestTransfer())
    received = b""
    for number in (1, 2, 3):
        packet = bench.expect(Packet)
        assert (packet.number, packet.total) == (number, 3)
        received += packet.payload
        bench.say(Ack(number))
    assert received == bench.image.data + b"\xff" * 84
    bench.expect(EndOfTransfer)
    outcome = bench.complete()
    assert outcome.ending is Ending.COMPLETED
    assert outcome.ok
    assert outcome.error() is None
    assert outcome.device_left is DeviceLeft.NEW
    assert outcome.boot_version == f"{boot_name} V1.2.3"
    assert outcome.statistics.packets_acknowledged == 3
    assert outcome.statistics.repetitions == 0
    assert bench.unread == []


def test_the_phases_and_packets_are_reported_in_order() -> None:
    bench = Bench(200)
    bench.to_end()
    bench.complete()
    phases = [event.phase for event in bench.events if isinstance(event, events.PhaseEntered)]
    assert phases == [Phase.RESET, Phase.BOOT, Phase.UPDATE, Phase.TRANSFER, Phase.END]
    assert bench.seen(events.PacketAcknowledged) == [
        events.PacketAcknowledged(1, 2, 1),
        events.PacketAcknowledged(2, 2, 1),
    ]
    last = bench.events.index(events.PacketAcknowledged(2, 2, 1))
    assert bench.events[last + 1] == events.PhaseEntered(Phase.END, 1)
    assert bench.seen(events.BootVersionSeen) == [events.BootVersionSeen("BMS", "V1.2.3")]


# -- reset (4.3) --------------------------------------------------------------------------------


def test_reset_is_repeated_every_200_ms_and_given_up_after_one_second() -> None:
    bench = Bench()
    bench.wait(3.0)
    resets = [at for at, row in bench.sent if isinstance(row, ResetCommand)]
    assert len(resets) == 5
    gaps = [later - earlier for earlier, later in pairwise(resets)]
    assert gaps == pytest.approx([0.2] * 4, abs=0.003)
    assert bench.engine.state is UpgradeState.AWAITING_BOOT


def test_reset_is_repeated_after_a_pause_of_this_computer_too() -> None:
    """The device drops a reset whose second frame comes so late (R12)."""
    bench = Bench()
    bench.engine = Upgrade(plan(bench.image, BMS, WELLING.bitrate_bps))
    bench.sent.clear()
    bench.engine.tick(bench.now)
    bench.engine.next_frame(bench.now)
    bench.engine.frame_sent(bench.now)
    bench.engine.next_frame(bench.now)
    bench.now += 1.5
    bench.engine.frame_sent(bench.now)
    bench.expect(ResetCommand, within_s=0.25)
    bench.say(GeneralFeedbackMessage(), BOOT)
    bench.expect(UpdateCommand)


def test_reset_stops_at_general_feedback() -> None:
    bench = Bench()
    bench.expect(ResetCommand)
    bench.say(GeneralFeedbackMessage())
    bench.wait(1.5)
    assert bench.unread == []


def test_a_boot_version_without_general_feedback_is_answered() -> None:
    """RS-06, and a device that sits in its bootloader already."""
    bench = Bench()
    bench.expect(ResetCommand)
    bench.say(BOOT)
    assert bench.expect(UpdateCommand).size_bytes == 300


def test_a_second_reset_is_not_queued_while_the_first_is_unsent() -> None:
    """A sleeping device acknowledges nothing: copies must not pile up in the adapter."""
    engine = Upgrade(plan(image_of(100), BMS, WELLING.bitrate_bps))
    for tenth in range(20):
        engine.tick(tenth / 10)
    frames = 0
    while engine.next_frame(2.0) is not None:
        engine.frame_sent(2.0)
        frames += 1
    assert frames == 2


def test_no_boot_version_ends_with_no_answer_and_an_untouched_device() -> None:
    """RS-07: all versions lost."""
    bench = Bench()
    bench.wait(20.0)
    outcome = bench.outcome
    assert outcome.ending is Ending.NO_BOOT_VERSION
    assert outcome.device_left is DeviceLeft.UNTOUCHED
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.NO_ANSWER
    assert "waiting for the boot version" in str(error)
    assert "no power" in error.cause
    assert bench.now - 100.0 < 21.0


def test_an_application_that_confirms_the_reset_and_goes_on_has_power_and_contact() -> None:
    bench = Bench()
    bench.to_boot()
    bench.wait(20.0)
    error = bench.outcome.error()
    assert error is not None
    assert error.code is ErrorCode.NO_BOOT_VERSION
    assert "its application runs" in error.cause
    assert "no power" not in error.cause


@each("late_s, answered", [(-0.001, True), (0.001, False)])
def test_the_boot_version_may_come_up_to_five_seconds_after_the_reset(
    *, late_s: float, answered: bool
) -> None:
    """TM-01."""
    bench = Bench()
    bench.expect(ResetCommand)
    left_at = bench.sent[-1][0]
    bench.say(GeneralFeedbackMessage())
    bench.wait(left_at + 5.0 + late_s - bench.now)
    if answered:
        bench.say(BOOT)
        bench.expect(UpdateCommand)
    else:
        assert bench.outcome.ending is Ending.NO_BOOT_VERSION


# -- update command (R2) ------------------------------------------------------------------------


def test_every_boot_version_of_a_burst_is_answered_until_request_transfer() -> None:
    bench = Bench()
    bench.to_boot()
    for _ in range(4):
        bench.say(BOOT)
        bench.expect(UpdateCommand)
        bench.wait(0.048)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_boot_versions_that_queued_up_are_one_version() -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(BOOT, BOOT, BOOT, BOOT)
    bench.expect(UpdateCommand)
    bench.wait(1.0)
    assert bench.unread == []


@each("after_s, commands", [(0.029, 1), (0.031, 2)])
def test_a_boot_version_within_30_ms_of_the_update_command_is_not_answered(
    after_s: float, commands: int
) -> None:
    bench = Bench()
    bench.to_request()
    left_at = bench.sent[-1][0]
    bench.wait(left_at + after_s - bench.now)
    bench.say(BOOT)
    bench.wait(1.0)
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == commands


@each("gap_s, after_s", [(0.01, 0.029), (0.02, 0.001), (0.02, 0.029)])
def test_the_next_boot_version_is_answered_later_where_the_command_took_long_to_leave(
    gap_s: float, after_s: float
) -> None:
    bench = Bench(options=UpgradeOptions(frame_gap_s=gap_s, attempts=1))
    bench.to_request()
    left_at = bench.sent[-1][0]
    bench.wait(left_at + after_s - bench.now)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    assert left_at + 0.03 <= bench.sent[-1][0] <= left_at + 0.03 + 2 * gap_s + 0.01
    bench.wait(5.0)
    assert not bench.unread


def _announced_while_the_command_leaves() -> Bench:
    bench = Bench(options=UpgradeOptions(frame_gap_s=0.08, attempts=1))
    bench.to_boot()
    bench.say(BOOT)
    bench.wait(0.1)
    assert not bench.unread
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    return bench


def test_a_boot_version_that_comes_while_the_update_command_leaves_is_answered() -> None:
    """It may be the last one of a device that listens after its announcement only (R2)."""
    bench = _announced_while_the_command_leaves()
    left_at = bench.sent[-1][0]
    bench.expect(UpdateCommand)
    assert left_at + 0.03 <= bench.sent[-1][0] <= left_at + 0.03 + 2 * 0.08 + 0.01
    bench.wait(5.0)
    assert not bench.unread


def test_no_further_update_command_follows_a_request_that_came_in_time() -> None:
    bench = _announced_while_the_command_leaves()
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_a_boot_version_from_before_an_outage_is_not_answered_after_it() -> None:
    """The device may be erasing by then (R2)."""
    bench = _announced_while_the_command_leaves()
    bench.now += 3.0
    bench.engine.link_back(bench.now)
    bench.wait(20.0)
    assert not bench.unread
    assert bench.outcome.ending is Ending.NO_REQUEST


def test_a_device_that_announces_into_each_update_command_does_not_receive_it() -> None:
    bench = _announced_while_the_command_leaves()
    first_at = bench.now
    while not bench.engine.done:
        bench.wait(0.11)
        bench.say(BOOT)
    assert bench.outcome.ending is Ending.UNHEARING
    assert bench.now - first_at < 11.0


def test_the_update_command_is_never_repeated_into_silence() -> None:
    """The device may be erasing: UP-07."""
    bench = Bench(options=UpgradeOptions(attempts=1))
    bench.to_request()
    bench.wait(30.0)
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1
    outcome = bench.outcome
    assert outcome.ending is Ending.NO_REQUEST
    assert outcome.device_left is DeviceLeft.PERHAPS_ERASED
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.NO_ANSWER


@each("silence_s", [0.3, 5.0, 9.5])
def test_a_device_that_announces_itself_after_a_silence_may_have_received_the_command(
    silence_s: float,
) -> None:
    """It erased, or restarted, or this computer paused and the command left after that."""
    bench = Bench()
    bench.to_request()
    bench.wait(9.9)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.wait(silence_s)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


@each("late_s, in_time", [(-0.001, True), (0.001, False)])
def test_request_transfer_may_come_up_to_ten_seconds_after_the_update_command(
    *, late_s: float, in_time: bool
) -> None:
    """TM-01, UP-07."""
    bench = Bench(options=UpgradeOptions(attempts=1))
    bench.to_request()
    bench.wait(bench.sent[-1][0] + 10.0 + late_s - bench.now)
    bench.say(RequestTransfer())
    assert bench.engine.done is not in_time
    if in_time:
        assert bench.expect(Packet).number == 1


def test_a_bootloader_that_announces_on_and_on_and_reads_nothing_ends_in_bounded_time() -> None:
    bench = Bench()
    bench.to_boot()
    for _ in range(400):
        bench.say(BOOT)
        bench.wait(0.05)
        if bench.engine.done:
            break
    assert bench.outcome.ending is Ending.UNHEARING
    assert bench.now - 100.0 < 12.0


def test_an_update_command_not_yet_begun_is_dropped_at_request_transfer() -> None:
    bench = Bench()
    bench.to_request()
    bench.wait(0.05)
    for frame_row in (BOOT, RequestTransfer()):
        _receive_without_sending(bench, frame_row)
    bench.say()
    assert bench.expect(Packet).number == 1


def _receive_without_sending(bench: Bench, row: BootVersion | RequestTransfer) -> None:
    for frame in answer_frames(row):
        bench.engine.receive(frame, bench.now)


# -- who answers (RS-08, RS-09) -----------------------------------------------------------------


@each(
    "name, version",
    [("WMC", "V1.2.3"), ("BMS", "V1.2-3"), ("BMS", "\x1b[2J<b"), ("\x00\xff\x1b", "V1.2.3")],
)
def test_another_device_or_no_version_is_refused_before_anything_is_sent_to_it(
    name: str, version: str
) -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(BootVersion(name, version))
    outcome = bench.outcome
    assert outcome.ending is Ending.WRONG_DEVICE
    assert outcome.device_left is DeviceLeft.UNTOUCHED
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.WRONG_DEVICE
    assert str(error).replace("\n", "").isprintable()
    assert bench.unread == []


def test_another_boot_name_is_taken_when_the_user_allows_it() -> None:
    bench = Bench(options=UpgradeOptions(allow_boot_name=True))
    bench.to_boot()
    bench.say(BootVersion("XYZ", "hello!"))
    bench.expect(UpdateCommand)


def test_another_version_within_the_burst_means_two_devices() -> None:
    bench = Bench()
    bench.to_request()
    bench.wait(0.05)
    bench.say(BootVersion("BMS", "V1.2.4"))
    assert bench.outcome.ending is Ending.TWO_DEVICES


# -- what is not for the host -------------------------------------------------------------------


def test_frames_of_others_and_frames_that_are_no_payload_change_nothing() -> None:
    """FR-09, CO-04, BU-04."""
    bench = Bench()
    bench.to_packet(1)
    before = bench.engine.state
    for frame in (
        Frame(0x720, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00"),
        Frame(0x752, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00"),
        Frame(0x725, b""),
        Frame(0x725, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00", is_extended=True),
        Frame(0x725, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00", is_remote=True),
        Frame(0x725, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00", is_error=True),
    ):
        bench.engine.receive(frame, bench.now)
    bench.wait(0.2)
    assert bench.engine.state is before
    assert bench.seen(events.BytesDamaged) == []


def test_damaged_bytes_and_unknown_messages_are_reported_and_passed_over() -> None:
    """FR-10, FR-04."""
    bench = Bench()
    bench.to_packet(1)
    for data in (b"\x55\xaa\x0c\x04\xc2\x02\x01\x00", b"\x32\xbc\x87\xee\x00"):
        bench.engine.receive(Frame(0x725, data), bench.now)
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2
    assert len(bench.seen(events.BytesDamaged)) == 1


# -- gaps and the overall deadline --------------------------------------------------------------


def test_the_packet_gap_is_kept_before_every_packet() -> None:
    bench = Bench(options=UpgradeOptions(packet_gap_s=0.02))
    bench.to_request()
    bench.say(RequestTransfer())
    asked_at = bench.now
    bench.expect(Packet)
    packet_s = bench.sent[-1][0] - asked_at
    assert packet_s > 0.02
    bench.say(Ack(1))
    answered_at = bench.now
    bench.expect(Packet)
    assert bench.sent[-1][0] - answered_at > 0.02


def test_the_frame_gap_is_kept_within_a_packet() -> None:
    bench = Bench(100, options=UpgradeOptions(frame_gap_s=0.005))
    bench.to_request()
    bench.say(RequestTransfer())
    asked_at = bench.now
    bench.expect(Packet)
    assert bench.sent[-1][0] - asked_at > 17 * 0.005


def test_a_device_that_answers_every_packet_at_the_last_moment_is_not_cut_off() -> None:
    """R12 allows 500 ms for each answer."""
    bench = Bench(128 * 200, options=UpgradeOptions(attempts=1))
    bench.to_request()
    bench.wait(9.9)
    bench.say(RequestTransfer())
    for number in range(1, 201):
        assert bench.expect(Packet).number == number
        bench.wait(0.49)
        bench.say(Ack(number))
    bench.expect(EndOfTransfer)
    bench.wait(9.9)
    assert bench.complete().ok


@pytest.mark.slow
def test_a_device_that_answers_only_the_last_try_is_ended_by_the_overall_deadline() -> None:
    """TM-03: always just in time, for ever."""
    bench = Bench(128 * 1000)
    bench.to_request()
    bench.say(RequestTransfer())
    while not bench.engine.done:
        if bench.unread:
            packet = bench.expect(Packet)
            copies = 1
            while copies < 5 and not bench.engine.done:
                bench.wait(0.51)
                copies += len(bench.unread)
                while bench.unread:
                    bench.expect(Packet)
            bench.say(Ack(packet.number))
        bench.wait(0.01)
    outcome = bench.outcome
    assert outcome.ending is Ending.OUT_OF_TIME
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER
    limit_s = default_timeout_s(plan(bench.image, BMS, 250_000), UpgradeOptions())
    assert bench.now - 100.0 <= limit_s + 1.0


@each(
    "reach, code",
    [
        ("to_boot", ExitCode.NO_ANSWER),
        ("to_request", ExitCode.NO_ANSWER),
        ("to_end", ExitCode.UNCONFIRMED),
    ],
)
def test_the_deadline_is_reported_by_what_had_been_reached(reach: str, code: ExitCode) -> None:
    bench = Bench(100, options=UpgradeOptions(timeout_s=2.0))
    getattr(bench, reach)()
    bench.wait(2.0)
    error = bench.outcome.error()
    assert error is not None
    assert error.exit_code == code


def test_a_deadline_before_the_end_has_left_is_a_failed_transfer() -> None:
    bench = Bench(100, options=UpgradeOptions(timeout_s=2.0, packet_gap_s=1.5))
    bench.to_packet(1)
    bench.say(Ack(1))
    bench.wait(2.0)
    outcome = bench.outcome
    assert outcome.device_left is DeviceLeft.NO_APPLICATION
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER


def test_the_default_deadline_grows_with_the_image() -> None:
    small = default_timeout_s(plan(image_of(128), BMS, 250_000), UpgradeOptions())
    large = default_timeout_s(plan(image_of(128 * 1000), BMS, 250_000), UpgradeOptions())
    assert small < 100
    assert large > small + 3 * 990 * 0.5


def test_the_default_deadline_is_every_wait_at_its_limit() -> None:
    timings = Timings(
        command_timeout_s=1.0,
        boot_version_timeout_s=20.0,
        request_transfer_timeout_s=300.0,
        ack_timeout_s=4_000.0,
        complete_timeout_s=50_000.0,
        end_tries=3,
        application_start_timeout_s=600_000.0,
    )
    options = UpgradeOptions(
        timings=timings, attempts=5, adapter_return_s=7e6, frame_gap_s=0.0625, packet_gap_s=8.0
    )
    made = plan(image_of(300), BMS, 250_000)
    # Each of the 3 packets has 18 frames; reset has 2, the update command 3, end of transfer 2.
    frame_gaps_s = 0.0625 * (3 * 17 + 1 + 2 + 1)
    packet_gaps_s = 8.0 * 4
    attempt_s = 1.0 + 20.0 + 300.0 + 3 * 4_000.0 + made.wire_s + frame_gaps_s + packet_gaps_s
    end_s = 3 * 50_000.0 + 600_000.0
    expected_s = 5 * attempt_s + 4 * 7e6 + end_s
    assert default_timeout_s(made, options) == pytest.approx(expected_s, abs=1e-3)


def test_the_packets_acknowledged_are_counted_from_the_first_one() -> None:
    for acknowledged in (0, 1, 2):
        bench = Bench(300, options=UpgradeOptions(timeout_s=2.0))
        bench.to_packet(acknowledged + 1)
        bench.wait(2.0)
        assert bench.outcome.statistics.packets_acknowledged == acknowledged
