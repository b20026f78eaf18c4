"""A device that has no application to lose is not given up before the overall deadline."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from flasher import events
from flasher.errors import ExitCode
from flasher.host.options import (
    DEFAULT_ATTEMPTS,
    ERASURES_MAX,
    PATIENT_TRIES,
    UpgradeOptions,
    default_timeout_s,
)
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending
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
from flasher.protocol.spec import BMS
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.settings.profile import Profile
from tests.host.bench import BOOT, Bench
from tests.loops import each

HURRIED = Timings(ack_timeout_s=0.05, packet_tries=2)
PATIENT = UpgradeOptions(timings=HURRIED)


def count(bench: Bench, kind: type[UpgradeMessage]) -> int:
    return sum(isinstance(row, kind) for _, row in bench.sent)


def answer_next(bench: Bench, restarts: bool) -> None:
    """The device restarts at its second packet, or takes the whole image."""
    bench.say(RequestTransfer())
    bench.expect(Packet)
    if restarts:
        bench.wait(0.07)
        bench.say(BOOT)
        bench.expect(UpdateCommand)


def test_a_device_that_restarts_more_often_than_there_are_attempts_is_upgraded_in_the_end() -> None:
    bench = Bench(options=UpgradeOptions())
    bench.to_request()
    for _ in range(2 * DEFAULT_ATTEMPTS):
        answer_next(bench, restarts=True)
    answer_next(bench, restarts=False)
    bench.say(Ack(1))
    bench.on_to_packet(3, first=2)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    assert bench.complete().ending is Ending.COMPLETED
    assert bench.outcome.statistics.attempts == 2 * DEFAULT_ATTEMPTS + 1


def test_attempts_that_somebody_has_limited_are_kept_to() -> None:
    bench = Bench(options=UpgradeOptions(attempts=DEFAULT_ATTEMPTS))
    bench.to_request()
    for attempt in range(DEFAULT_ATTEMPTS):
        answer_next(bench, restarts=attempt < DEFAULT_ATTEMPTS - 1)
    bench.wait(0.07)
    bench.say(BOOT)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.RESTARTED


def test_a_device_that_always_restarts_is_not_erased_for_ever() -> None:
    """Flash wears."""
    bench = Bench(options=UpgradeOptions())
    bench.to_request()
    while not bench.engine.done:
        bench.say(RequestTransfer())
        bench.expect(Packet)
        bench.wait(0.07)
        bench.say(BOOT)
        bench.wait(0.04)
        bench._read = len(bench.sent)
    assert bench.outcome.ending is Ending.RESTARTED
    assert count(bench, UpdateCommand) == ERASURES_MAX
    assert bench.outcome.device_left is DeviceLeft.NO_APPLICATION


def test_each_attempt_reports_how_much_time_is_left() -> None:
    bench = Bench(options=UpgradeOptions(timeout_s=100.0))
    bench.to_request()
    bench.wait(1.0)
    answer_next(bench, restarts=True)
    (started,) = bench.seen(events.AttemptStarted)
    assert isinstance(started, events.AttemptStarted)
    assert started.left_s == pytest.approx(100.0 - 1.07, abs=0.1)
    limited = Bench(options=UpgradeOptions(attempts=9))
    limited.to_request()
    answer_next(limited, restarts=True)
    assert limited.seen(events.AttemptStarted) == [events.AttemptStarted(2, "restarted", 0.0)]


@each("timeout_s", [None, 60.0, 300.0])
def test_a_device_that_falls_silent_is_tried_until_the_overall_deadline_and_not_longer(
    timeout_s: float | None,
) -> None:
    options = replace(PATIENT, timeout_s=timeout_s)
    bench = Bench(options=options)
    began_at = bench.now
    bench.to_transfer()
    limit_s = default_timeout_s(bench.engine._upgrade._plan, options)
    bench.wait(10_000.0)
    outcome = bench.outcome
    assert outcome.ending is Ending.PACKET_FAILED
    assert outcome.packet == 1
    assert outcome.statistics.duration_s == pytest.approx(timeout_s or limit_s, abs=0.01)
    assert bench.sent[-1][0] <= began_at + (timeout_s or limit_s) + 0.01
    error = outcome.error()
    assert error is not None
    assert error.exit_code == ExitCode.TRANSFER
    assert error.needs_rescue


def test_an_update_command_goes_into_the_silence_again_after_each_erase_limit() -> None:
    """R26: a device that hangs for longer may sit in its session all the same."""
    bench = Bench(options=PATIENT)
    bench.to_transfer()
    bench.wait(90.0)
    commands = [at for at, row in bench.sent if isinstance(row, UpdateCommand)]
    assert 4 <= len(commands) <= 7
    erase_s = DEFAULT_TIMINGS.request_transfer_timeout_s
    assert all(later - earlier >= erase_s for earlier, later in pairwise(commands))
    bench._read = len(bench.sent)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.on_to_packet(2, first=1)


def test_a_bootloader_that_confirms_the_reset_and_stays_in_its_session_has_update_command() -> None:
    """R15: to the letter it confirms every write, the reset too, that it ignores (R18)."""
    bench = Bench(options=PATIENT)
    bench.to_transfer()
    bench.expect(Packet)
    bench.to_boot()
    bench.expect(UpdateCommand, within_s=DEFAULT_TIMINGS.request_transfer_timeout_s + 0.1)
    bench.say(RequestTransfer())
    assert bench.on_to_packet(2, first=1)


def test_the_user_is_asked_for_a_power_cycle_when_the_update_command_went_into_silence() -> None:
    bench = Bench(options=replace(PATIENT, timeout_s=100.0))
    bench.to_transfer()
    bench.wait(20.0)
    assert bench.seen(events.PowerCycleAwaited) == []
    bench.wait(30.0)
    asked = [
        each
        for each in bench.seen(events.PowerCycleAwaited)
        if isinstance(each, events.PowerCycleAwaited)
    ]
    assert asked
    assert all(30.0 < each.limit_s < 80.0 for each in asked)
    bench._read = len(bench.sent)
    bench.say(BOOT)  # it was switched off and on
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.on_to_packet(2, first=1)


def test_an_application_that_answers_the_reset_is_not_erased_and_attempts_are_counted() -> None:
    """It has taken no update command: too large for it, say."""
    bench = Bench(options=UpgradeOptions())
    for _ in range(DEFAULT_ATTEMPTS):
        bench.to_request()
        bench.wait(10.01)
    assert bench.outcome.ending is Ending.NO_REQUEST
    assert bench.outcome.statistics.attempts == DEFAULT_ATTEMPTS


def test_a_whole_image_that_is_not_accepted_counts_as_an_attempt() -> None:
    """The device announces itself on and on: it has not taken the image, and will not."""
    bench = Bench(200, options=UpgradeOptions())
    bench.to_request()
    while not bench.engine.done:
        bench.say(RequestTransfer())
        bench.on_to_packet(2, first=1)
        bench.say(Ack(2))
        bench.expect(EndOfTransfer)
        for _ in range(30):
            bench.say(BOOT)
            bench.wait(0.05)
        bench._read = len(bench.sent)
    assert bench.outcome.ending is Ending.RESTARTED
    assert count(bench, EndOfTransfer) == DEFAULT_ATTEMPTS


def test_a_refused_image_is_refused_at_once() -> None:
    bench = Bench(200, options=UpgradeOptions())
    bench.to_end()
    bench.say(Nak(2))
    bench.expect(EndOfTransfer)
    bench.say(Nak(2))
    assert bench.outcome.ending is Ending.REFUSED
    assert bench.outcome.statistics.attempts == 1


def test_a_bootloader_that_no_longer_receives_is_commanded_again() -> None:
    bench = Bench(options=PATIENT)
    bench.to_transfer()
    bench.wait(0.07)
    for _ in range(400):
        bench.say(BOOT)
        bench.wait(0.05)
    assert not bench.engine.done
    packets = count(bench, Packet)
    bench.say(BOOT)
    bench.wait(0.1)
    bench.say(RequestTransfer())
    assert count(bench, Packet) == packets + 1


# -- the tries of a packet ------------------------------------------------------------------------


def tried(options: UpgradeOptions) -> int:
    """How often packet 1 is sent before the device is reset."""
    bench = Bench(options=options)
    bench.to_transfer()
    while not isinstance(bench.sent[-1][1], ResetCommand) and not bench.engine.done:
        bench.wait(0.5)
    return count(bench, Packet)


def test_a_packet_is_repeated_for_longer_where_nothing_can_be_lost() -> None:
    assert tried(UpgradeOptions()) == PATIENT_TRIES
    assert tried(UpgradeOptions(attempts=3)) == DEFAULT_TIMINGS.packet_tries


def test_tries_that_somebody_has_chosen_are_kept_to() -> None:
    assert tried(PATIENT) == HURRIED.packet_tries
    profile = Profile(BMS)
    for tries in (2, DEFAULT_TIMINGS.packet_tries, 9):
        assert tried(profile.upgrade_options(packet_tries=tries)) == tries
    assert tried(profile.upgrade_options()) == PATIENT_TRIES
    chosen = replace(profile, sources={"timings.packet_tries": "a file"})
    assert tried(chosen.upgrade_options()) == DEFAULT_TIMINGS.packet_tries


def test_attempts_that_somebody_has_chosen_are_kept_to_be_they_the_default() -> None:
    profile = Profile(BMS)
    assert profile.upgrade_options().attempts is None
    assert profile.upgrade_options(attempts=DEFAULT_ATTEMPTS).attempts == DEFAULT_ATTEMPTS
    assert replace(profile, attempts=7).upgrade_options().attempts == 7
    chosen = replace(profile, sources={"attempts": "a file"})
    assert chosen.upgrade_options().attempts == DEFAULT_ATTEMPTS


def test_a_packet_that_is_answered_after_a_long_time_goes_on_where_it_was() -> None:
    bench = Bench(options=UpgradeOptions())
    bench.to_packet(2)
    bench.wait(25.0)
    bench._read = len(bench.sent)
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 3
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    bench.say(Complete())
    assert bench.outcome.ending is Ending.COMPLETED
    assert bench.outcome.statistics.attempts == 1


# -- another tool ---------------------------------------------------------------------------------

SEEN = "frame 55 aa"


def test_another_tool_before_the_update_command_ends_it() -> None:
    bench = Bench(options=UpgradeOptions())
    bench.to_boot()
    bench.engine.second_tool(SEEN, bench.now)
    assert bench.outcome.ending is Ending.SECOND_TOOL
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED


def test_another_tool_after_the_end_of_transfer_ends_it() -> None:
    """The image may be complete: it is not erased again."""
    bench = Bench(200, options=UpgradeOptions())
    bench.to_end()
    bench.engine.second_tool(SEEN, bench.now)
    assert bench.outcome.ending is Ending.SECOND_TOOL
    assert bench.outcome.device_left is DeviceLeft.UNKNOWN


@each("state", ["erasing", "transfer"])
def test_another_tool_is_waited_for_once_the_device_was_commanded_to_erase(state: str) -> None:
    bench = Bench(options=UpgradeOptions())
    if state == "erasing":
        bench.to_request()
    else:
        bench.to_packet(2)
    bench.wait(0.2)
    bench.engine.second_tool(SEEN, bench.now)
    bench._read = len(bench.sent)
    for answer in (RequestTransfer(), Ack(2), Nak(1), BOOT, Complete(), GeneralFeedbackMessage()):
        bench.say(answer)
    bench.wait(1.5)
    bench.engine.second_tool(SEEN, bench.now)
    bench.engine.link_back(bench.now)
    bench.wait(1.99)
    assert bench.unread == []
    bench.expect(ResetCommand, within_s=0.02)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.on_to_packet(3, first=1).number == 3
