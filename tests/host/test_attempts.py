"""Whole attempts: what begins another one, what it begins with, and when there is no more."""

from __future__ import annotations

import pytest

from flasher import events
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, State
from flasher.protocol.messages import (
    Ack,
    Complete,
    EndOfTransfer,
    GeneralFeedback,
    Nak,
    Packet,
    RequestTransfer,
    Reset,
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
        if bench.engine.state is State.RESETTING:
            break
        bench.expect(Packet)
    bench.expect(Reset)


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


def states() -> list[tuple[str, bool]]:
    """How far it came, and whether a new attempt (with a reset) follows."""
    return [("to_boot", True), ("to_request", True), ("to_transfer", True), ("to_end", False)]


@pytest.mark.parametrize(("come_to", "begins_again"), states())
def test_an_adapter_that_is_back_begins_again_unless_only_the_end_is_missing(
    come_to: str, *, begins_again: bool
) -> None:
    bench = Bench(options=options(3))
    getattr(bench, come_to)()
    bench.engine.link_back(bench.now)
    if begins_again:
        bench.expect(Reset)
        bench.say(GeneralFeedback(), BOOT)
        bench.expect(UpdateCommand)
    else:
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
    bench.expect(Reset)
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


def test_an_attempt_more_never_follows_a_device_that_may_be_erasing() -> None:
    """R2: into silence after an update command nothing is sent."""
    bench = Bench(options=options(9))
    bench.to_request()
    sent = len(bench.sent)
    bench.wait(60.0)
    assert bench.outcome.ending is Ending.NO_REQUEST
    assert len(bench.sent) == sent


def test_the_deadline_counts_all_attempts_together() -> None:
    bench = Bench(options=UpgradeOptions(timings=TWO_TRIES, attempts=9, timeout_s=8.0))
    began = bench.now
    exhaust_packet_2(bench)
    bench.wait(60.0)
    assert bench.outcome.ending is Ending.OUT_OF_TIME
    assert bench.outcome.statistics.duration_s <= 8.0 + 0.01
    assert began < bench.now
