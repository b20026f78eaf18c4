"""End of transfer, lost final answers, and the ways to stop: R6, R11, EN rows of the cases."""

from __future__ import annotations

import dataclasses

import pytest

from flasher import events
from flasher.errors import ExitCode
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, UpgradeState
from flasher.image.plan import plan
from flasher.protocol.messages import (
    Ack,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Nak,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
    UpgradeMessage,
)
from flasher.protocol.spec import BMS, OBC, WMC, Target
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message
from tests.host.bench import BOOT, Bench, answer_frames, image_of
from tests.host.upgrade import Upgrade
from tests.loops import each

NEW = "V2r0r1_20260102"
READ_VERSION = (0x11, 0x3300, b"")
"""Mode, command and data of the version query."""


def versioned(**changes: object) -> Bench:
    """A bench with a BMS whose image holds the version `NEW`."""
    image = dataclasses.replace(image_of(200), version=NEW)
    return Bench(image=image, **changes)  # type: ignore[arg-type]


def runs(version: str) -> Message:
    """The application's answer to the version query."""
    data = encode_text("BM36", 16) * 3 + encode_text(version, 16)
    return Message(BMS.broadcast_id, 0x0C, 0x1540, data)


def announce_on(bench: Bench) -> None:
    """Far beyond a burst: the device did not accept."""
    for _ in range(25):
        bench.say(BOOT)
        bench.wait(0.05)
        if bench.engine.done or isinstance(bench.sent[-1][1], UpdateCommand):
            return


def answer_version(bench: Bench, version: str) -> None:
    bench.say(runs(version))


# -- NAK at the end (R6, EN-06) -----------------------------------------------------------------


@each("number", [0, 2, 3, 65535])
def test_one_nak_gets_end_of_transfer_once_more(number: int) -> None:
    bench = Bench(200)
    bench.to_end()
    bench.say(Nak(number))
    bench.expect(EndOfTransfer)
    assert bench.complete().ending is Ending.COMPLETED


@each("number", [0, 2, 3, 65535])
def test_a_second_nak_whatever_its_number_means_refused(number: int) -> None:
    bench = Bench(200)
    bench.to_end()
    bench.say(Nak(2))
    bench.expect(EndOfTransfer)
    bench.say(Nak(number))
    outcome = bench.outcome
    assert outcome.ending is Ending.REFUSED
    assert outcome.device_left is DeviceLeft.NO_APPLICATION
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.REFUSED


def test_a_doubled_nak_counts_once() -> None:
    bench = Bench(200)
    bench.to_end()
    bench.say(Nak(2), Nak(2))
    bench.expect(EndOfTransfer)
    assert bench.complete().ok


def test_general_feedback_after_the_end_is_ignored() -> None:
    bench = Bench(200)
    bench.to_end()
    bench.say(GeneralFeedbackMessage())
    bench.wait(1.0)
    assert bench.unread == []
    assert bench.complete().ok


def test_complete_before_the_end_has_left_is_a_protocol_error() -> None:
    bench = Bench(200, options=UpgradeOptions(packet_gap_s=0.1))
    bench.to_packet(2)
    bench.say(Ack(2))
    bench.say(Complete())
    assert bench.outcome.ending is Ending.BROKEN_PROTOCOL


# -- the final answer is lost (R11, EN-03) ------------------------------------------------------


def test_end_of_transfer_is_asked_again_after_ten_seconds() -> None:
    bench = Bench(200)
    bench.to_end()
    bench.wait(9.9)
    assert bench.unread == []
    bench.wait(0.2)
    bench.expect(EndOfTransfer)
    assert bench.complete().ok


@each("target", [WMC, OBC])
def test_three_unanswered_ends_are_unconfirmed_where_no_version_can_be_asked(
    target: Target,
) -> None:
    bench = Bench(200, target=target, options=UpgradeOptions(allow_boot_name=True))
    bench.to_end()
    bench.wait(60.0)
    assert [type(row) for row in bench.unread] == [EndOfTransfer, EndOfTransfer]
    outcome = bench.outcome
    assert outcome.ending is Ending.UNCONFIRMED
    assert outcome.device_left is DeviceLeft.UNKNOWN
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.UNCONFIRMED
    assert "nconfirmed" in str(error)


def test_a_lost_final_answer_is_replaced_by_the_version_answer() -> None:
    bench = versioned()
    bench.to_end()
    bench.expect(EndOfTransfer)
    bench.expect(EndOfTransfer)
    assert bench.expect(Message)[1:] == READ_VERSION
    answer_version(bench, NEW)
    outcome = bench.outcome
    assert outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert outcome.ok
    assert outcome.running_version == NEW


def test_another_version_after_a_lost_final_answer_fails() -> None:
    bench = versioned()
    bench.to_end()
    bench.wait(31.0)
    answer_version(bench, "V1r0r0_20200101")
    outcome = bench.outcome
    assert outcome.ending is Ending.OTHER_VERSION
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.VERIFICATION
    assert "V1r0r0_20200101" in str(error)
    assert NEW in str(error)


def test_a_version_that_cannot_be_compared_leaves_it_unconfirmed_and_is_reported() -> None:
    bench = Bench(200)
    bench.to_end()
    bench.wait(31.0)
    answer_version(bench, NEW)
    outcome = bench.outcome
    assert outcome.ending is Ending.UNCONFIRMED
    assert outcome.running_version == NEW


def test_the_version_is_asked_every_200_ms_and_given_up_after_five_seconds() -> None:
    bench = versioned()
    bench.to_end()
    bench.wait(60.0)
    asked = [at for at, row in bench.sent if isinstance(row, Message) and row[1:] == READ_VERSION]
    assert 24 <= len(asked) <= 26
    assert bench.outcome.ending is Ending.UNCONFIRMED


def test_complete_while_the_version_is_asked_completes() -> None:
    bench = versioned()
    bench.to_end()
    bench.wait(31.0)
    assert bench.complete().ending is Ending.COMPLETED


def test_a_refusal_while_the_version_is_asked_is_a_refusal() -> None:
    bench = versioned()
    bench.to_end()
    bench.wait(31.0)
    bench.say(Nak(2))
    bench.wait(0.02)
    bench.say(Nak(2))
    assert bench.outcome.ending is Ending.REFUSED


def test_a_nak_after_announcements_has_the_end_repeated_and_waited_for() -> None:
    bench = versioned()
    bench.to_end()
    bench.say(BOOT)
    bench.wait(0.5)
    assert bench.engine.state is UpgradeState.CONFIRMING
    bench.say(Nak(2))
    assert isinstance(bench.sent[-1][1], EndOfTransfer)
    bench.wait(40.0)
    assert bench.outcome.ending is Ending.UNCONFIRMED


def test_a_version_on_the_bus_before_the_end_decides_nothing() -> None:
    bench = versioned()
    bench.to_end()
    answer_version(bench, NEW)
    assert not bench.engine.done


# -- boot versions after the end (R11) ----------------------------------------------------------


def test_no_boot_version_is_answered_after_the_end_and_the_version_answer_decides() -> None:
    """The device announces itself on the way into its new application: no second erase."""
    bench = versioned()
    bench.to_end()
    for _ in range(4):
        bench.say(BOOT)
        bench.wait(0.05)
    assert bench.expect(Message)[1:] == READ_VERSION
    answer_version(bench, NEW)
    assert bench.outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_a_new_application_is_asked_up_to_its_time_limit() -> None:
    bench = versioned()
    bench.to_end()
    bench.say(BOOT)
    bench.expect(Message)
    asked_at = bench.sent[-1][0]
    while bench.now < asked_at + 4.95:
        bench.expect(Message)
    answer_version(bench, NEW)
    assert bench.outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert asked_at + 4.95 <= bench.sent[-1][0] < asked_at + 5.25


def test_boot_versions_after_the_end_and_nothing_more_are_unconfirmed() -> None:
    bench = versioned()
    bench.to_end()
    for _ in range(4):
        bench.say(BOOT)
        bench.wait(0.05)
    bench.wait(10.0)
    assert bench.outcome.ending is Ending.UNCONFIRMED
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_a_target_without_version_query_that_restarts_is_unconfirmed() -> None:
    bench = Bench(200, target=WMC, options=UpgradeOptions(allow_boot_name=True))
    bench.to_end()
    for _ in range(4):
        bench.say(BOOT)
        bench.wait(0.05)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.UNCONFIRMED
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_a_boot_version_before_the_end_has_left_is_a_restart() -> None:
    bench = Bench(200, options=UpgradeOptions(packet_gap_s=0.2))
    bench.to_packet(2)
    bench.say(Ack(2))
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    assert bench.seen(events.AttemptStarted)


def test_a_boot_version_while_the_end_is_leaving_is_not_answered() -> None:
    bench = Bench(200)
    bench.to_packet(2)

    def announce(frames: int) -> None:
        if frames == before + 2:
            for frame in answer_frames(BOOT):
                bench.engine.receive(frame, bench.now)

    before = bench._frames
    bench.on_frame = announce
    bench.say(Ack(2))
    bench.expect(EndOfTransfer)
    bench.wait(1.0)
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_announcements_beyond_a_burst_are_a_device_that_did_not_accept() -> None:
    bench = versioned()
    bench.to_end()
    announce_on(bench)
    bench.expect(UpdateCommand)
    assert bench.seen(events.AttemptStarted)
    bench.say(RequestTransfer())
    bench.on_to_packet(2, first=1)
    bench.say(Ack(2))
    bench.expect(EndOfTransfer)
    assert bench.complete().statistics.attempts == 2


def test_announcements_beyond_a_burst_while_the_version_is_asked_start_over() -> None:
    bench = versioned()
    bench.to_end()
    bench.wait(31.0)
    announce_on(bench)
    assert isinstance(bench.unread[-1], UpdateCommand)


@each("times", [(0.0, 0.05, 0.05, 0.1, 0.15), (0.0, 0.05, 0.1, 0.15, 0.2, 0.25)])
def test_a_doubled_or_a_fifth_announcement_does_not_erase_a_good_image(
    times: tuple[float, ...],
) -> None:
    bench = versioned()
    bench.to_end()
    began = bench.now
    for at in times:
        bench.wait(began + at - bench.now)
        bench.say(BOOT)
    bench.wait(0.5)
    answer_version(bench, NEW)
    assert bench.outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_two_passes_through_the_bootloader_do_not_erase_a_good_image() -> None:
    bench = versioned()
    bench.to_end()
    for _ in range(2):
        for _ in range(4):
            bench.say(BOOT)
            bench.wait(0.05)
        bench.wait(0.1)
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_bursts_that_stop_in_between_are_not_counted_together() -> None:
    bench = versioned()
    bench.to_end()
    for _ in range(3):
        for _ in range(4):
            bench.say(BOOT)
            bench.wait(0.05)
        bench.wait(0.5)
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_a_device_that_never_accepts_ends_when_the_attempts_are_used_up() -> None:
    bench = versioned(options=UpgradeOptions(attempts=1))
    bench.to_end()
    announce_on(bench)
    outcome = bench.outcome
    assert outcome.ending is Ending.RESTARTED
    assert outcome.device_left is DeviceLeft.NO_APPLICATION
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER


def test_complete_after_the_first_boot_version_still_completes() -> None:
    bench = versioned()
    bench.to_end()
    bench.say(BOOT)
    assert bench.complete().ending is Ending.COMPLETED


# -- cancelled by the user ----------------------------------------------------------------------


@each(
    "reach, left",
    [
        ("to_boot", DeviceLeft.UNTOUCHED),
        ("to_request", DeviceLeft.PERHAPS_ERASED),
        ("to_transfer", DeviceLeft.NO_APPLICATION),
        ("to_end", DeviceLeft.UNKNOWN),
    ],
)
def test_cancelling_reports_what_state_the_device_is_left_in(reach: str, left: DeviceLeft) -> None:
    bench = Bench(200)
    getattr(bench, reach)()
    sent = len(bench.sent)
    bench.engine.cancel(bench.now)
    outcome = bench.outcome
    assert outcome.ending is Ending.CANCELLED
    assert outcome.device_left is left
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.INTERRUPTED
    bench.wait(10.0)
    assert len(bench.sent) == sent


def test_cancelling_lets_the_rest_of_a_message_out_without_gaps() -> None:
    bench = Bench(options=UpgradeOptions(frame_gap_s=0.08))
    bench.to_packet(1)
    bench.say(Ack(1))
    bench.wait(0.2)
    cancelled_at = bench.now
    bench.engine.cancel(bench.now)
    bench.wait(10.0)
    assert bench.outcome.ending is Ending.CANCELLED
    sent_at, packet = bench.sent[-1]
    assert isinstance(packet, Packet)
    assert packet.number == 2
    assert sent_at - cancelled_at < 0.02


def test_cancelling_in_the_middle_of_a_message_finishes_the_message() -> None:
    bench = Bench(300)
    bench.to_request()

    def cancel(frames: int) -> None:
        if frames == before + 7:
            bench.engine.cancel(bench.now)

    before = bench._frames
    bench.on_frame = cancel
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1
    outcome = bench.outcome
    assert outcome.ending is Ending.CANCELLED
    assert bench._frames == before + 18


@each(
    "stage, kind, left",
    [
        ("boot", UpdateCommand, DeviceLeft.PERHAPS_ERASED),
        ("last", EndOfTransfer, DeviceLeft.UNKNOWN),
    ],
)
def test_a_message_finished_after_the_users_word_counts_for_the_state_of_the_device(
    stage: str, kind: type[UpgradeMessage], left: DeviceLeft
) -> None:
    bench = Bench(100)
    if stage == "boot":
        bench.to_boot()
    else:
        bench.to_packet(1)
    before = bench._frames

    def cancel(frames: int) -> None:
        if frames == before + 2:
            bench.engine.cancel(bench.now)

    bench.on_frame = cancel
    bench.say(BOOT if stage == "boot" else Ack(1))
    bench.expect(kind)
    assert bench.outcome.device_left is left


def test_cancelling_before_the_beginning_sends_nothing() -> None:
    engine = Upgrade(plan(image_of(100), BMS, 250_000))
    engine.cancel(5.0)
    assert engine.done
    assert engine.next_frame(5.0) is None
    assert engine.deadline() is None
    assert engine.outcome.device_left is DeviceLeft.UNTOUCHED


def test_a_second_cancellation_changes_nothing() -> None:
    bench = Bench(200)
    bench.to_request()
    bench.engine.cancel(bench.now)
    first = bench.outcome
    bench.engine.cancel(bench.now + 1.0)
    assert bench.outcome is first


def test_what_arrives_after_the_end_is_not_looked_at() -> None:
    bench = Bench(200)
    bench.to_end()
    outcome = bench.complete()
    bench.say(BOOT, Nak(1), Complete())
    bench.wait(5.0)
    assert bench.outcome is outcome
    assert bench.unread == []


def test_the_outcome_cannot_be_read_before_there_is_one() -> None:
    bench = Bench(200)
    bench.expect(ResetCommand)
    with pytest.raises(RuntimeError, match="not ended"):
        _ = bench.engine.outcome
