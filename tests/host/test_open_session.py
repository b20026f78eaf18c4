"""A device that an earlier upgrade may have left in its session: R26 over processes and runs."""

from __future__ import annotations

from dataclasses import replace

from flasher import events
from flasher.host.identity import CheckResult, CheckVerdict, IdentityCheck
from flasher.host.options import UpgradeOptions, default_timeout_s
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, Reason
from flasher.image.plan import plan
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Nak,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.spec import BMS, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.host.bench import BOOT, Bench, image_of
from tests.loops import each

OPEN = UpgradeOptions(in_session=True)
ONCE = replace(OPEN, attempts=1)
RESCUE = replace(OPEN, at_power_up=True, power_up_timeout_s=30.0)
ERASE_S = DEFAULT_TIMINGS.request_transfer_timeout_s


def resets(bench: Bench) -> int:
    """Take all resets that were sent."""
    count = 0
    while bench.unread and isinstance(bench.unread[0], ResetCommand):
        bench.expect(ResetCommand)
        count += 1
    return count


def to_silence(bench: Bench) -> float:
    """Up to the update command into the silence; when it had left."""
    bench.wait(ERASE_S - 0.01)
    assert resets(bench)
    assert bench.unread == []
    bench.expect(UpdateCommand, within_s=0.1)
    return bench.now


def finish(bench: Bench) -> None:
    bench.say(RequestTransfer())
    bench.on_to_packet(3, first=1)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    bench.complete()


@each("options", [OPEN, ONCE, RESCUE, replace(RESCUE, attempts=1)])
def test_a_silent_device_gets_one_update_command_when_the_erase_limit_has_passed(
    options: UpgradeOptions,
) -> None:
    bench = Bench(options=options)
    began_at = bench.now
    to_silence(bench)
    assert bench.now - began_at >= ERASE_S
    assert bench.seen(events.AttemptStarted) == [events.AttemptStarted(2, Reason.BOOT_SILENT.value)]
    assert bench.seen(events.PowerCycleAwaited) == []
    finish(bench)
    assert bench.outcome.ending is Ending.COMPLETED
    assert bench.outcome.sent_into_silence
    assert bench.outcome.boot_version is None


def test_without_the_option_nothing_but_the_reset_goes_into_silence() -> None:
    bench = Bench(options=UpgradeOptions())
    bench.wait(60.0)
    assert bench.outcome.ending is Ending.NO_BOOT_VERSION
    assert not bench.outcome.sent_into_silence
    resets(bench)
    assert bench.unread == []


@each("options", [OPEN, ONCE])
def test_an_update_command_that_is_not_answered_ends_it_and_is_not_repeated(
    options: UpgradeOptions,
) -> None:
    bench = Bench(options=options)
    to_silence(bench)
    bench.wait(ERASE_S + 0.01)
    assert bench.outcome.ending is Ending.NO_BOOT_VERSION
    assert bench.outcome.device_left is DeviceLeft.PERHAPS_ERASED
    assert bench.unread == []


def test_a_session_that_is_lost_again_is_another_attempt_of_those_that_were_allowed() -> None:
    bench = Bench(options=replace(OPEN, attempts=2))
    to_silence(bench)
    bench.say(RequestTransfer())
    bench.on_to_packet(2, first=1)
    bench.now += 0.1
    for _ in range(2):
        bench.say(BOOT)
        if bench.engine.done:
            break
        bench.expect(UpdateCommand)
        bench.say(RequestTransfer())
        bench.expect(Packet)
        bench.now += 0.1
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.RESTARTED
    assert bench.outcome.statistics.attempts == 3


# -- the application runs, or the bootloader announces itself: the normal way ----------------------


@each("options", [OPEN, RESCUE])
def test_an_application_that_answers_the_reset_is_never_commanded_to_update_unasked(
    options: UpgradeOptions,
) -> None:
    bench = Bench(options=options)
    bench.expect(ResetCommand)
    bench.say(GeneralFeedbackMessage())
    bench.wait(120.0)
    assert bench.unread == []
    wanted = Ending.NO_ANNOUNCEMENT if options.at_power_up else Ending.NO_BOOT_VERSION
    assert bench.outcome.ending is wanted
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED
    assert len(bench.seen(events.PowerCycleAwaited)) == options.at_power_up


@each("options", [OPEN, RESCUE])
def test_feedback_that_comes_late_counts_as_well(options: UpgradeOptions) -> None:
    bench = Bench(options=options)
    bench.wait(4.0)
    assert resets(bench)
    bench.say(GeneralFeedbackMessage())
    bench.wait(120.0)
    assert bench.unread == []
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED
    assert len(bench.seen(events.PowerCycleAwaited)) == options.at_power_up


@each("options", [OPEN, RESCUE])
@each("after_s", [0.1, 4.0, ERASE_S - 0.1])
def test_a_boot_version_is_answered_as_ever(options: UpgradeOptions, after_s: float) -> None:
    bench = Bench(options=options)
    bench.wait(after_s)
    resets(bench)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    finish(bench)
    assert bench.outcome.ok
    assert not bench.outcome.sent_into_silence
    assert bench.outcome.statistics.attempts == 1


@each("after_s", [1.0, ERASE_S + 1.0])
def test_another_name_is_refused_before_and_after_the_update_command(after_s: float) -> None:
    """R26 changes nothing about whom the image is for."""
    bench = Bench(options=OPEN)
    bench.wait(after_s)
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.WRONG_DEVICE


def test_the_silence_is_counted_from_the_last_message_of_the_device() -> None:
    bench = Bench(options=OPEN)
    bench.wait(4.0)
    bench.say(Nak(7))
    bench.wait(ERASE_S - 0.01)
    resets(bench)
    assert bench.unread == []
    bench.expect(UpdateCommand, within_s=0.1)


@each("options", [OPEN, RESCUE])
def test_an_adapter_that_was_away_has_received_nothing_meanwhile(options: UpgradeOptions) -> None:
    """Nor an answer to the reset, which is sent again."""
    bench = Bench(options=options)
    bench.wait(6.0)
    assert resets(bench)
    bench.engine.link_back(bench.now)
    bench.wait(ERASE_S - 0.01)
    assert isinstance(bench.unread[0], ResetCommand)
    resets(bench)
    assert bench.unread == []
    bench.expect(UpdateCommand, within_s=0.1)


# -- rescue ----------------------------------------------------------------------------------------


def test_a_rescue_asks_for_the_power_only_when_the_update_command_was_not_answered() -> None:
    bench = Bench(options=RESCUE)
    to_silence(bench)
    bench.wait(ERASE_S - 0.1)
    assert bench.seen(events.PowerCycleAwaited) == []
    bench.wait(0.2)
    assert bench.seen(events.PowerCycleAwaited) == [events.PowerCycleAwaited(30.0)]
    bench.wait(20.0)
    assert bench.unread == []
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    finish(bench)
    assert bench.outcome.ok


def test_an_adapter_that_is_back_while_the_power_is_waited_for_sends_nothing() -> None:
    bench = Bench(options=RESCUE)
    to_silence(bench)
    bench.wait(ERASE_S + 1.0)
    bench.engine.link_back(bench.now)
    bench.wait(20.0)
    assert bench.unread == []
    bench.say(BOOT)
    bench.expect(UpdateCommand)


def test_a_rescue_that_no_device_answers_ends_after_one_wait_for_the_power() -> None:
    bench = Bench(options=RESCUE)
    to_silence(bench)
    bench.wait(ERASE_S + 30.1)
    assert bench.outcome.ending is Ending.NO_ANNOUNCEMENT
    assert bench.unread == []


def test_a_rescue_has_all_its_attempts_after_the_wait_for_the_power() -> None:
    bench = Bench(options=replace(RESCUE, attempts=2))
    to_silence(bench)
    bench.wait(ERASE_S + 1.0)
    for _ in range(2):
        bench.say(BOOT)
        bench.expect(UpdateCommand)
        bench.say(RequestTransfer())
        bench.expect(Packet)
        bench.now += 0.1
    bench.say(BOOT)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.RESTARTED


def test_the_default_deadline_leaves_room_for_the_silence() -> None:
    """The wait and the update command come before all that was allowed without them."""
    made = plan(image_of(300), BMS, WELLING.bitrate_bps)
    more_s = default_timeout_s(made, OPEN) - default_timeout_s(made, UpgradeOptions())
    assert more_s >= 2 * ERASE_S


# -- what could not be checked ---------------------------------------------------------------------

UNCHECKED = CheckResult(
    IdentityCheck.HARDWARE, CheckVerdict.REFUSED, "its hardware is unknown", is_unchecked=True
)


def unchecked_bench(options: UpgradeOptions = OPEN) -> Bench:
    bench = Bench(options=options)
    bench.engine._upgrade.unchecked = UNCHECKED
    return bench


def test_a_rule_that_could_not_be_checked_does_not_keep_a_session_open() -> None:
    """It has no application: a rescue goes on unchecked as well."""
    bench = unchecked_bench()
    to_silence(bench)
    finish(bench)
    assert bench.outcome.ending is Ending.COMPLETED
    assert bench.outcome.waiver == ""


@each("after_s", [0.5, 4.0, ERASE_S + 1.0])
def test_a_device_that_announces_itself_after_all_is_refused_by_that_rule(after_s: float) -> None:
    bench = unchecked_bench()
    bench.wait(after_s)
    bench._read = len(bench.sent)
    bench.say(BOOT)
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.UNCHECKED
    assert bench.outcome.waiver == IdentityCheck.HARDWARE.value
    assert "its hardware is unknown" in bench.outcome.detail
    assert bench.unread == []


def test_a_silent_device_is_not_refused_by_that_rule() -> None:
    """The error offers no waiver of a check that did not fail."""
    bench = unchecked_bench()
    to_silence(bench)
    bench.wait(ERASE_S + 0.1)
    assert bench.outcome.ending is Ending.NO_BOOT_VERSION
    assert bench.outcome.waiver == ""


def test_after_the_session_was_found_the_rule_is_no_matter_any_more() -> None:
    bench = unchecked_bench()
    to_silence(bench)
    bench.say(RequestTransfer())
    bench.expect(Packet)
    bench.now += 0.1
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    finish(bench)
    assert bench.outcome.ok


def test_a_bootloader_version_that_no_device_reported_is_reported_as_unknown() -> None:
    bench = Bench(options=replace(OPEN, minimum_boot_version="V9.0.0"))
    to_silence(bench)
    finish(bench)
    assert bench.outcome.ok
    (check,) = bench.seen(events.CheckMade)
    assert check.verdict == "unknown"  # type: ignore[attr-defined]
    assert "V9.0.0" in check.text  # type: ignore[attr-defined]
