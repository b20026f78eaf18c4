"""Packets and their answers, restarts in the middle: R10, R11, R16 and the TX rows of the cases."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher import events
from flasher.errors import ExitCode
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, UpgradeState
from flasher.image.plan import plan
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Nak,
    Packet,
    RequestTransfer,
    UpdateCommand,
    UpgradeMessage,
)
from flasher.protocol.spec import BMS
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.host.bench import BOOT, Bench, answer_frames
from tests.loops import each

ONE_ATTEMPT = UpgradeOptions(attempts=1)

# -- NAK and silence (R12, TX-09) ----------------------------------------------------------------


def test_a_refused_packet_is_sent_again_at_once() -> None:
    bench = Bench()
    first = bench.to_packet(2)
    bench.say(Nak(2))
    again = bench.expect(Packet)
    assert again == first
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 3
    assert events.MessageRepeated("packet 2", "packet_refused", 2) in bench.events


@each("naks", [1, 2, 3, 4])
def test_a_packet_may_be_refused_as_often_as_there_are_tries_but_one(naks: int) -> None:
    bench = Bench(100)
    bench.to_packet(1)
    for _ in range(naks):
        bench.say(Nak(1))
        bench.expect(Packet)
    bench.say(Ack(1))
    bench.expect(EndOfTransfer)
    assert bench.complete().statistics.naks == naks


def test_the_last_try_refused_ends_the_upgrade_naming_the_packet() -> None:
    bench = Bench(300, options=ONE_ATTEMPT)
    bench.to_packet(2)
    for _ in range(4):
        bench.say(Nak(2))
        bench.expect(Packet)
    bench.say(Nak(2))
    outcome = bench.outcome
    assert outcome.ending is Ending.PACKET_FAILED
    assert outcome.device_left is DeviceLeft.NO_APPLICATION
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER
    assert "packet 2 of 3" in str(error)
    assert bench.unread == []


@each("late_s, in_time", [(-0.001, True), (0.001, False)])
def test_the_answer_may_come_up_to_500_ms_after_the_packet_has_left(
    *, late_s: float, in_time: bool
) -> None:
    """TM-01."""
    bench = Bench()
    bench.to_packet(1)
    bench.wait(bench.sent[-1][0] + 0.5 + late_s - bench.now)
    bench.say(Ack(1))
    assert bench.expect(Packet).number == (2 if in_time else 1)


def test_a_silent_device_gets_every_try_and_then_the_upgrade_ends() -> None:
    bench = Bench(options=ONE_ATTEMPT)
    bench.to_packet(2)
    bench.wait(10.0)
    copies = [row for _, row in bench.sent if isinstance(row, Packet) and row.number == 2]
    assert len(copies) == 5
    outcome = bench.outcome
    assert outcome.ending is Ending.PACKET_FAILED
    assert outcome.statistics.timeouts == 5


def test_the_number_of_tries_is_the_users() -> None:
    timings = replace(DEFAULT_TIMINGS, packet_tries=2, ack_timeout_s=0.1)
    bench = Bench(options=UpgradeOptions(timings=timings))
    bench.to_packet(1)
    bench.wait(1.0)
    assert sum(isinstance(row, Packet) for _, row in bench.sent) == 2


# -- stale, doubled, future answers (R10, TX-10) ------------------------------------------------


@each("stale", [Nak(1), Ack(0), Nak(0)])
def test_an_answer_for_an_older_packet_is_ignored(stale: UpgradeMessage) -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.say(stale)
    bench.wait(0.3)
    assert bench.unread == []
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 3


@each("future", [Ack(3), Nak(3), Ack(65535), Nak(65535)])
def test_an_answer_for_a_later_packet_is_reported_and_ignored(future: UpgradeMessage) -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.say(future)
    bench.wait(0.3)
    assert bench.unread == []
    assert bench.seen(events.Reported)
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 3


def test_a_doubled_ack_advances_once() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.say(Ack(1), Ack(1))
    assert bench.expect(Packet).number == 2
    bench.wait(0.4)
    assert bench.unread == []


def test_nak_after_ack_for_the_same_packet_is_stale() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.say(Ack(1), Nak(1))
    assert bench.expect(Packet).number == 2
    bench.wait(0.4)
    assert bench.unread == []


def test_ack_after_nak_for_the_same_packet_waits_for_the_copy_that_is_out() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.say(Nak(1))
    bench.expect(Packet)
    bench.say(Ack(1), Ack(1))
    assert bench.expect(Packet).number == 2


# -- after a repetition (R10, TX-02) ------------------------------------------------------------


def test_after_a_repetition_the_next_packet_waits_until_each_copy_is_answered() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.5)
    bench.expect(Packet)
    bench.say(Ack(1))
    bench.wait(0.02)
    assert bench.unread == []
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2


def test_after_a_repetition_50_ms_of_quiet_are_enough() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.5)
    bench.expect(Packet)
    bench.say(Ack(1))
    answered_at = bench.now
    assert bench.expect(Packet).number == 2
    waited_s = bench.sent[-1][0] - answered_at
    assert 0.05 < waited_s < 0.065


def test_quiet_after_a_copy_that_was_answered_while_it_left_begins_at_its_end() -> None:
    bench = Bench()
    bench.to_packet(1)
    at_frame: list[int] = []

    def ack_in_the_middle(frames: int) -> None:
        at_frame.append(frames)
        if len(at_frame) == 9:
            for frame in answer_frames(Ack(1)):
                bench.engine.receive(frame, bench.now)

    bench.on_frame = ack_in_the_middle
    assert bench.expect(Packet).number == 1
    left_at = bench.sent[-1][0]
    assert bench.expect(Packet, within_s=1.0).number == 2
    assert 0.05 < bench.sent[-1][0] - left_at < 0.065


def test_an_answer_is_waited_for_from_the_moment_in_which_the_packet_has_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And not from the one in which an adapter has taken its last frame."""
    bench = Bench()
    bench.to_request()
    noted = bench.engine.frame_sent

    def take_at_once(at: float) -> None:
        noted(at)
        bench.now = at

    monkeypatch.setattr(bench.engine, "frame_sent", take_at_once)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1
    taken_at = bench.sent[-1][0]
    assert bench.expect(Packet).number == 1
    wire_s = plan(bench.image, BMS, 250_000).packet_wire_s(1)
    assert 0.5 + 0.9 * wire_s < bench.sent[-1][0] - taken_at < 0.5 + 1.1 * wire_s


def test_a_late_answer_does_not_double_the_packets_that_follow() -> None:
    """The old copy's ACK comes while the new copy is being sent."""
    bench = Bench(128 * 6)
    bench.to_packet(2)
    start = len(bench.sent)
    at_frame: list[int] = []

    def ack_in_the_middle(frames: int) -> None:
        at_frame.append(frames)
        if len(at_frame) == 9:
            for frame in answer_frames(Ack(2)):
                bench.engine.receive(frame, bench.now)

    bench.on_frame = ack_in_the_middle
    bench.wait(0.501)
    bench.say(Ack(2))
    for number in range(3, 7):
        bench.wait(0.1)
        bench.say(Ack(number))
    packets = [row.number for _, row in bench.sent[start:] if isinstance(row, Packet)]
    assert packets == [2, 3, 4, 5, 6]


def test_nak_of_one_copy_and_ack_of_the_other_is_an_ack() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.5)
    bench.expect(Packet)
    bench.say(Nak(1), Ack(1))
    assert bench.expect(Packet).number == 2


def test_both_copies_refused_is_one_more_try() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.5)
    bench.expect(Packet)
    bench.say(Nak(1), Nak(1))
    assert bench.expect(Packet).number == 1
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2


def test_nak_n_plus_1_for_a_repeated_packet_counts_only_where_the_profile_allows_it() -> None:
    for allowed, expected in ((True, 2), (False, 1)):
        bench = Bench(options=UpgradeOptions(nak_next_is_ack=allowed))
        bench.to_packet(1)
        bench.wait(0.5)
        bench.expect(Packet)
        bench.say(Nak(2))
        assert bench.expect(Packet).number == expected


def test_nak_n_plus_1_for_a_packet_sent_once_is_never_an_ack() -> None:
    bench = Bench(options=UpgradeOptions(nak_next_is_ack=True))
    bench.to_packet(1)
    bench.say(Nak(2))
    assert bench.expect(Packet).number == 1


def test_the_failure_names_the_option_when_the_device_answers_nak_n_plus_1() -> None:
    bench = Bench(100, options=ONE_ATTEMPT)
    bench.to_packet(1)
    while not bench.engine.done:
        bench.wait(0.5)
        bench.say(Nak(2))
    error = bench.outcome.error()
    assert error is not None
    assert "--nak-next-is-ack" in str(error)


# -- restart in the middle (R11, R16, TX-11) ----------------------------------------------------


def test_a_boot_version_within_60_ms_of_request_transfer_is_a_leftover() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.04)
    bench.say(BOOT)
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2
    assert bench.seen(events.Reported)
    assert bench.seen(events.AttemptStarted) == []


def test_a_later_boot_version_starts_the_transfer_over_as_a_new_attempt() -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.wait(0.1)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_packet(3, first=1)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    outcome = bench.complete()
    assert outcome.ok
    assert outcome.statistics.attempts == 2


@pytest.mark.parametrize("attempts", [None, 3])
def test_a_single_session_ends_with_the_first_restart(attempts: int | None) -> None:
    bench = Bench(options=UpgradeOptions(single_session=True, attempts=attempts))
    bench.to_packet(2)
    bench.wait(0.1)
    bench.say(BOOT)
    assert bench.outcome.ending is Ending.RESTARTED
    assert bench.seen(events.AttemptStarted) == []


def test_a_single_session_ends_with_a_packet_that_is_not_answered() -> None:
    bench = Bench(options=UpgradeOptions(single_session=True, attempts=3))
    bench.to_packet(2)
    bench.wait(DEFAULT_TIMINGS.ack_timeout_s * DEFAULT_TIMINGS.packet_tries + 0.1)
    assert bench.outcome.ending is Ending.PACKET_FAILED
    assert bench.seen(events.AttemptStarted) == []


def test_a_device_that_restarts_again_and_again_ends_the_upgrade() -> None:
    bench = Bench(options=UpgradeOptions(attempts=3))
    bench.to_packet(1)
    for _ in range(2):
        bench.wait(0.1)
        bench.say(BOOT)
        bench.expect(UpdateCommand)
        bench.say(RequestTransfer())
        bench.expect(Packet)
    bench.wait(0.1)
    bench.say(BOOT)
    outcome = bench.outcome
    assert outcome.ending is Ending.RESTARTED
    assert outcome.statistics.attempts == 3
    assert bench.unread == []


def test_another_device_after_a_restart_is_refused() -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.wait(0.1)
    bench.say(BootVersion("WMC", "V1.2.3"))
    assert bench.outcome.ending is Ending.TWO_DEVICES


def test_request_transfer_again_before_ack_1_gets_packet_1_again_and_no_update_command() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.05)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1
    bench.say(Ack(1), Ack(1))
    assert bench.expect(Packet).number == 2
    assert sum(isinstance(row, UpdateCommand) for _, row in bench.sent) == 1


def test_request_transfer_doubled_at_once_does_no_harm() -> None:
    bench = Bench()
    bench.to_request()
    bench.say(RequestTransfer(), RequestTransfer())
    assert bench.expect(Packet).number == 1
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2


def test_request_transfer_again_and_again_is_bounded() -> None:
    bench = Bench(options=ONE_ATTEMPT)
    bench.to_packet(1)
    for _ in range(20):
        bench.wait(0.06)
        bench.say(RequestTransfer())
        if bench.engine.done:
            break
    assert bench.outcome.ending is Ending.PACKET_FAILED


def test_request_transfer_in_the_middle_starts_over_and_is_reported() -> None:
    bench = Bench()
    bench.to_packet(3)
    bench.say(RequestTransfer())
    bench.expect(UpdateCommand)
    assert bench.seen(events.AttemptStarted)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_a_doubled_late_request_is_not_taken_for_the_answer_to_the_update_command() -> None:
    """The device may be erasing for long after the update command."""
    bench = Bench()
    bench.to_packet(3)
    late = [*answer_frames(RequestTransfer()), *answer_frames(RequestTransfer())]
    for frame in late:
        bench.engine.receive(frame, bench.now)
    bench.say()
    bench.expect(UpdateCommand)
    bench.wait(5.0)
    assert bench.unread == []
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_request_transfer_while_packet_1_settles_waits_for_quiet() -> None:
    bench = Bench()
    bench.to_packet(1)
    bench.wait(0.5)
    bench.expect(Packet)
    bench.say(Nak(1), RequestTransfer())
    assert bench.expect(Packet).number == 1


# -- what breaks the protocol -------------------------------------------------------------------


@each("number", [1, 2])
def test_complete_before_end_of_transfer_is_a_protocol_error(number: int) -> None:
    """EN-05."""
    bench = Bench()
    bench.to_packet(number)
    bench.say(Complete())
    outcome = bench.outcome
    assert outcome.ending is Ending.BROKEN_PROTOCOL
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER


def test_general_feedback_in_the_transfer_is_ignored() -> None:
    """R15."""
    bench = Bench()
    bench.to_packet(1)
    bench.say(GeneralFeedbackMessage())
    bench.wait(0.3)
    assert bench.unread == []
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2


def test_answers_that_come_before_they_can_be_answers_are_reported() -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(Ack(1), Nak(1), RequestTransfer(), Complete())
    assert len(bench.seen(events.Reported)) == 4
    assert bench.unread == []


def test_no_message_is_ever_interleaved_with_another() -> None:
    """The bench reassembles what is sent strictly; a restart in the middle of a packet."""
    bench = Bench()
    bench.to_packet(1)

    def restart(frames: int) -> None:
        if bench.engine.state is UpgradeState.TRANSFERRING and frames % 18 == 9:
            for frame in answer_frames(BOOT):
                bench.engine.receive(frame, bench.now)

    bench.wait(0.3)
    bench.on_frame = restart
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2
    bench.on_frame = None
    bench.expect(UpdateCommand)


@each(
    "answer, what",
    [
        (Ack(0x0200), "the device answered ACK 512"),
        (Nak(7), "the device answered NAK 7"),
        (GeneralFeedbackMessage(), "the device answered general feedback"),
    ],
)
@each("timeout_s", [None, 2.0])
def test_a_device_that_answers_a_packet_otherwise_has_power_and_contact(
    answer: UpgradeMessage, what: str, timeout_s: float | None
) -> None:
    bench = Bench(options=UpgradeOptions(attempts=1, timeout_s=timeout_s))
    bench.to_packet(2)
    while not bench.engine.done:
        bench.say(answer)
        bench.wait(0.5)
    error = bench.outcome.error()
    assert error is not None
    assert what in error.what
    assert "power" not in error.cause
    assert "numbers packets in another way" in error.cause
    assert error.exit_code == ExitCode.TRANSFER


@each("answer", [Ack(0x0200), GeneralFeedbackMessage()])
def test_one_odd_answer_before_the_device_falls_silent_explains_nothing(
    answer: UpgradeMessage,
) -> None:
    bench = Bench(options=UpgradeOptions(attempts=1))
    bench.to_packet(2)
    bench.say(answer)
    bench.wait(60.0)
    error = bench.outcome.error()
    assert error is not None
    assert "lost power" in error.cause
