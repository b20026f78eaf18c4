"""Whole attempts: what begins another one, what it begins with, and when there is no more."""

from __future__ import annotations

import pytest

from flasher import events
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, UpgradeState
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
)
from flasher.protocol.timing import Timings
from tests.host.bench import BOOT, Bench

TWO_TRIES = Timings(ack_timeout_s=0.05, packet_tries=2)


def options(attempts: int) -> UpgradeOptions:
    return UpgradeOptions(timings=TWO_TRIES, attempts=attempts)


def exhaust_packet_2(bench: Bench) -> None:
    bench.to_packet(2)
    bench.expect(Packet)


def test_a_packet_that_is_never_answered_begins_another_attempt_with_a_reset() -> None:
    bench = Bench(options=options(2))
    exhaust_packet_2(bench)
    bench.to_boot()
    assert bench.seen(events.AttemptStarted)[0].attempt == 2  # type: ignore[attr-defined]
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.on_to_packet(3, first=1).number == 3
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    assert bench.complete().ending is Ending.COMPLETED
    assert bench.outcome.statistics.attempts == 2


def test_a_packet_that_is_refused_to_the_last_try_begins_another_attempt() -> None:
    bench = Bench(options=options(2))
    bench.to_packet(2)
    for _ in range(2):
        bench.say(Nak(2))
        if bench.engine.state is UpgradeState.RESETTING:
            break
        bench.expect(Packet)
    bench.expect(ResetCommand)


def test_the_last_attempt_ends_with_the_packet() -> None:
    bench = Bench(options=options(1))
    exhaust_packet_2(bench)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.PACKET_FAILED
    assert bench.outcome.packet == 2
    assert bench.outcome.device_left is DeviceLeft.NO_APPLICATION
    assert bench.unread == []


def test_a_device_that_does_not_come_back_for_the_next_attempt_still_names_the_packet() -> None:
    bench = Bench(options=options(2))
    exhaust_packet_2(bench)
    bench.wait(60.0)
    assert bench.outcome.ending is Ending.PACKET_FAILED
    assert bench.outcome.packet == 2
    assert "no boot version came after it" in bench.outcome.detail
    error = bench.outcome.error()
    assert error is not None
    assert "rescue" in error.remedy
    assert error.needs_rescue


def test_a_device_that_does_not_come_back_is_given_each_attempt_before_it_is_given_up() -> None:
    bench = Bench(options=options(4))
    exhaust_packet_2(bench)
    bench.wait(120.0)
    assert len(bench.seen(events.AttemptStarted)) == 3
    assert bench.outcome.statistics.attempts == 4


def test_an_adapter_that_is_back_before_the_update_command_begins_again() -> None:
    bench = Bench(options=options(3))
    bench.to_boot()
    bench.engine.link_back(bench.now)
    bench.expect(ResetCommand)
    bench.say(GeneralFeedbackMessage(), BOOT)
    bench.expect(UpdateCommand)
    assert bench.seen(events.AttemptStarted)


def test_an_adapter_that_is_back_in_the_erase_waits_on_for_request_transfer() -> None:
    bench = Bench(options=options(1))
    bench.to_request()
    bench.wait(9.0)
    bench.engine.link_back(bench.now)
    bench.wait(0.9)
    assert bench.unread == []
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_an_adapter_that_is_back_in_the_transfer_sends_the_packet_in_flight_again() -> None:
    """R10: a device that has stored it answers it all the same. No attempt is used."""
    bench = Bench(options=options(1))
    bench.to_packet(2)
    bench.engine.link_back(bench.now)
    assert bench.expect(Packet).number == 2
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 3
    assert not bench.seen(events.AttemptStarted)


def test_a_transfer_reports_for_how_long_the_adapter_was_away_since_its_update_command() -> None:
    bench = Bench(options=options(2))
    bench.to_packet(2)
    for away_s in (1.5, 0.25):
        bench.now += away_s
        bench.engine.link_back(bench.now)
        bench.expect(Packet)
    bench.say(Ack(2))
    bench.on_to_end(first=3)
    bench.say(Complete())
    assert bench.outcome.ok
    assert bench.outcome.unobserved_s == pytest.approx(1.75, abs=0.01)


def test_a_transfer_that_began_after_the_adapter_was_away_is_observed() -> None:
    bench = Bench(options=options(3))
    bench.to_packet(2)
    bench.now += 2.0
    bench.engine.link_back(bench.now)
    bench.expect(Packet)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_end(first=1)
    bench.say(Complete())
    assert bench.outcome.ok
    assert not bench.outcome.unobserved_s


def test_a_packet_in_flight_that_is_not_answered_after_all_begins_again() -> None:
    bench = Bench(options=options(2))
    bench.to_packet(2)
    bench.engine.link_back(bench.now)
    bench.expect(Packet)
    bench.expect(ResetCommand)
    assert bench.seen(events.AttemptStarted)


def test_an_adapter_that_is_back_while_copies_are_waited_for_waits_for_quiet_again() -> None:
    bench = Bench(options=UpgradeOptions(attempts=1))
    bench.to_packet(2)
    bench.wait(0.51)
    bench.expect(Packet)
    bench.say(Ack(2))
    assert bench.engine.state is UpgradeState.SETTLING
    bench.engine.link_back(bench.now)
    assert bench.expect(Packet).number == 3


def test_an_adapter_that_is_back_at_the_end_sends_the_end_again() -> None:
    bench = Bench(options=options(1))
    bench.to_end()
    bench.engine.link_back(bench.now)
    bench.expect(EndOfTransfer)
    bench.say(Complete())
    assert bench.outcome.ending is Ending.COMPLETED
    assert bench.outcome.statistics.attempts == 1


def test_a_message_that_was_cut_short_is_followed_by_more_silence_than_its_receiver_waits() -> None:
    """R12: else its rest and the next message would be one damaged message."""
    bench = Bench()
    bench.to_request()
    bench.on_frame = lambda count: cut(bench, count)
    began: list[float] = []

    def cut(_bench: Bench, _count: int) -> None:
        bench.on_frame = None
        began.append(bench.now)

    bench.say(RequestTransfer())
    bench.engine.link_back(bench.now)
    bench.expect(Packet)  # the bench lets a message out that it had begun
    at = bench.now
    bench.expect(Packet)
    assert bench.now - at > Timings().inter_frame_timeout_s
    assert began


def test_a_restart_counts_as_an_attempt_too() -> None:
    bench = Bench(options=options(2))
    bench.to_packet(2)
    bench.wait(0.01)
    bench.say(Ack(2))
    bench.expect(Packet)
    for attempt in (2, 3):
        bench.now += 0.07
        bench.say(BOOT)
        if attempt == 2:
            bench.expect(UpdateCommand)
            bench.say(RequestTransfer())
            bench.expect(Packet)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.RESTARTED


def test_nothing_is_sent_to_a_device_that_may_be_erasing() -> None:
    """R2: not before the erase limit has passed."""
    bench = Bench(options=options(9))
    bench.to_request()
    bench.wait(9.99)
    assert bench.unread == []


def test_no_request_transfer_begins_again_while_an_attempt_is_left() -> None:
    bench = Bench(options=options(2))
    bench.to_request()
    bench.wait(10.01)
    bench.to_boot()
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def lose_request(bench: Bench) -> None:
    """Up to the silence after an attempt that got no request transfer."""
    bench.to_request()
    bench.wait(10.01)
    while bench.engine.state is UpgradeState.RESETTING:
        bench.expect(ResetCommand)
        bench.wait(0.2)


def test_a_silent_device_gets_one_update_command_when_the_erase_limit_has_passed() -> None:
    """R26: it may sit in a session that knows no reset. Not two, however many attempts are left."""
    bench = Bench(options=options(9))
    lose_request(bench)
    bench.expect(UpdateCommand, within_s=5.1)
    assert bench.engine.state is UpgradeState.AWAITING_REQUEST
    assert [each.attempt for each in bench.seen(events.AttemptStarted)] == [2, 3]  # type: ignore[attr-defined]
    bench.wait(120.0)
    assert bench.outcome.ending is Ending.NO_BOOT_VERSION
    assert not any(isinstance(row, UpdateCommand) for row in bench.unread)


def test_a_session_that_was_left_over_is_found_by_the_update_command_into_the_silence() -> None:
    bench = Bench(options=options(3))
    lose_request(bench)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.on_to_packet(3, first=1)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    outcome = bench.complete()
    assert outcome.ok
    assert outcome.boot_version == "BMS V1.2.3"
    assert outcome.statistics.attempts == 3


def test_the_silence_is_counted_from_the_last_word_of_the_device() -> None:
    """R26: the erase limit has to pass in silence."""
    bench = Bench(options=options(3))
    lose_request(bench)
    bench.wait(4.0)
    bench.say(RequestTransfer())  # too late: it got a reset
    bench.wait(9.9)
    assert bench.unread == []
    bench.expect(UpdateCommand, within_s=0.2)


def test_a_device_that_answers_the_reset_is_reset_again_and_not_commanded_to_update() -> None:
    """Its application runs: R26 is for devices that do not even answer the reset."""
    bench = Bench(options=options(3))
    bench.to_request()
    bench.wait(10.01)
    bench.to_boot()
    bench.expect(ResetCommand)


def test_the_deadline_counts_all_attempts_together() -> None:
    bench = Bench(options=UpgradeOptions(timings=TWO_TRIES, attempts=9, timeout_s=8.0))
    began = bench.now
    exhaust_packet_2(bench)
    bench.wait(60.0)
    assert bench.outcome.ending is Ending.OUT_OF_TIME
    assert bench.outcome.statistics.duration_s <= 8.0 + 0.01
    assert began < bench.now
