"""Reports of an upgrade, while it runs and at its end: progress, counts, unexpected messages."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher import events
from flasher.host.identity import CheckResult, CheckVerdict, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, Reason
from flasher.host.upgrade import UpgradeStage
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
    UpgradeMessage,
)
from flasher.protocol.spec import OBC
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message
from tests.host.bench import BOOT, Bench, answer_frames
from tests.loops import each

ONCE = UpgradeOptions(attempts=1)
HURRIED = Timings(ack_timeout_s=0.05, packet_tries=2)


def stage(bench: Bench) -> UpgradeStage:
    return bench.engine._upgrade


def reported(bench: Bench) -> list[str]:
    return [event.what for event in bench.events if isinstance(event, events.Reported)]


# -- progress --------------------------------------------------------------------------------------


def test_it_states_where_it_is_with_packet_and_attempt() -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED))
    stands = [stage(bench).progress]
    bench.to_boot()
    stands.append(stage(bench).progress)
    bench.say(BOOT)
    stands.append(stage(bench).progress)
    bench.expect(UpdateCommand)
    stands.append(stage(bench).progress)
    bench.say(RequestTransfer())
    bench.on_to_packet(2, first=1)
    stands.append(stage(bench).progress)
    bench.now += 0.1
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    stands.append(stage(bench).progress)
    bench.say(RequestTransfer())
    bench.on_to_packet(3, first=1)
    stands.append(stage(bench).progress)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    stands.append(stage(bench).progress)
    assert stands == [
        "resetting the application",
        "waiting for the boot version",
        "waiting for the boot version",
        "waiting for request transfer",
        "transferring, packet 2 of 3",
        "waiting for request transfer, attempt 2",
        "transferring, packet 3 of 3, attempt 2",
        "waiting for the final answer, attempt 2",
    ]


def test_it_has_begun_to_erase_with_the_first_frame_of_the_update_command() -> None:
    begun: list[bool] = []
    bench = Bench()
    bench.on_frame = lambda _number: begun.append(stage(bench).has_begun_to_erase)
    bench.expect(ResetCommand)
    assert not any(begun)
    bench.say(GeneralFeedbackMessage(), BOOT)
    begun.clear()
    bench.expect(UpdateCommand)
    assert begun == [False, True, True]
    assert stage(bench).has_begun_to_erase
    bench.engine.link_back(bench.now)
    assert stage(bench).has_begun_to_erase


def test_a_reset_that_is_half_sent_erases_nothing() -> None:
    bench = Bench()
    bench.expect(ResetCommand)
    begun: list[bool] = []
    bench.on_frame = lambda _number: begun.append(stage(bench).has_begun_to_erase)
    bench.expect(ResetCommand)
    assert begun == [False, False]


@each("attempts, before", [(1, False), (2, True)])
def test_after_a_lost_adapter_it_goes_on_or_needs_an_attempt(
    attempts: int, *, before: bool
) -> None:
    bench = Bench(options=UpgradeOptions(attempts=attempts))
    assert stage(bench).may_begin_again is before
    bench.to_boot()
    assert stage(bench).may_begin_again is before
    bench.say(BOOT)
    assert stage(bench).may_begin_again is before
    bench.expect(UpdateCommand)
    assert stage(bench).may_begin_again
    bench.say(RequestTransfer())
    assert stage(bench).may_begin_again
    bench.on_to_packet(3, first=1)
    bench.say(Ack(3))
    assert stage(bench).may_begin_again
    bench.expect(EndOfTransfer)
    assert stage(bench).may_begin_again


def test_one_that_ends_may_finish_its_message_on_an_adapter_that_is_back() -> None:
    bench = Bench(options=ONCE)
    bench.expect(ResetCommand)

    def cancel(_number: int) -> None:
        if bench._frames % 2 == 0:
            bench.on_frame = None
            bench.engine.cancel(bench.now)
            endings.append((bench.engine.done, stage(bench).may_begin_again))

    endings: list[tuple[bool, bool]] = []
    bench.on_frame = cancel
    bench.wait(1.0)
    assert endings == [(False, True)]


# -- what is counted ------------------------------------------------------------------------------


def test_repetitions_refusals_and_silences_are_counted() -> None:
    bench = Bench(options=UpgradeOptions(timings=Timings(ack_timeout_s=0.05)))
    bench.to_packet(1)
    requested_at = bench.now
    bench.say(Nak(1))
    bench.expect(Packet)  # once refused
    bench.expect(Packet)  # once not answered
    bench.say(Ack(1))
    bench.wait(0.06)
    bench.on_to_packet(3, first=2)
    bench.say(Ack(3))
    transferred_at = bench.now
    bench.expect(EndOfTransfer)
    bench.say(Nak(3))
    bench.expect(EndOfTransfer)
    outcome = bench.complete()
    figures = outcome.statistics
    assert outcome.ok
    assert outcome.is_transferred
    assert (figures.attempts, figures.packets_acknowledged) == (1, 3)
    assert (figures.repetitions, figures.naks, figures.timeouts) == (3, 2, 1)
    assert figures.duration_s == pytest.approx(bench.now - 100.0)
    assert figures.transfer_s == pytest.approx(transferred_at - requested_at, abs=0.02)
    assert bench.seen(events.MessageRepeated) == [
        events.MessageRepeated("packet 1", Reason.PACKET_REFUSED.value, 2),
        events.MessageRepeated("packet 1", Reason.PACKET_UNANSWERED.value, 3),
        events.MessageRepeated("end of transfer", Reason.END_REFUSED.value, 2),
    ]
    assert bench.seen(events.PacketAcknowledged) == [
        events.PacketAcknowledged(1, 3, 3),
        events.PacketAcknowledged(2, 3, 1),
        events.PacketAcknowledged(3, 3, 1),
    ]


def test_an_end_that_is_not_answered_is_a_silence_and_one_with_announcements_is_none() -> None:
    bench = Bench(100, target=OBC)
    bench.to_boot()
    bench.say(BootVersion("PBU", "V1.2.3"))
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.expect(Packet)
    bench.say(Ack(1))
    for _ in range(3):
        bench.expect(EndOfTransfer)
    bench.say(BootVersion("PBU", "V1.2.3"))
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.UNCONFIRMED
    assert bench.outcome.statistics.timeouts == 2
    assert bench.outcome.statistics.repetitions == 2


def test_an_end_that_is_sent_again_while_the_version_is_asked_is_waited_for_as_ever() -> None:
    bench = Bench()
    bench.to_end()
    for _ in range(2):
        bench.expect(EndOfTransfer)
    assert bench.expect(Message).command == 0x3300
    bench.say(Nak(3))
    bench.expect(EndOfTransfer)
    assert stage(bench).progress == "waiting for the final answer"
    bench.wait(9.9)
    assert bench.unread == []
    assert bench.expect(Message, within_s=0.2).command == 0x3300


def test_an_upgrade_that_came_to_no_transfer_has_no_time_of_it() -> None:
    bench = Bench(options=ONCE)
    bench.wait(20.0)
    assert bench.outcome.statistics.transfer_s is None
    assert not bench.outcome.is_transferred
    assert bench.outcome.packet is None
    assert bench.outcome.statistics.repetitions == 0


# -- what came where it had no place --------------------------------------------------------------

OUT_OF_PLACE = "message that has no place here"


@each(
    "row, what",
    [
        (Ack(7), f"{OUT_OF_PLACE}: ACK 7"),
        (Nak(8), f"{OUT_OF_PLACE}: NAK 8"),
        (RequestTransfer(), OUT_OF_PLACE),
        (Complete(), OUT_OF_PLACE),
        (Message(0x725, 0x0C, 0x7702, b"\0\0"), "unknown message 7702 from 725 ignored"),
        (Message(0x725, 0x16, 0xC202, b"\1\0"),
         "message C202 from 725 ignored: mode is 16, not 0C"),
    ],
)  # fmt: skip
def test_a_message_that_has_no_place_is_reported_by_name(
    row: UpgradeMessage | Message, what: str
) -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(row)
    assert reported(bench) == [what]


def test_answers_and_announcements_that_have_no_place_are_reported_with_their_content() -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.say(Ack(3))
    bench.say(BOOT)
    assert reported(bench) == [
        "ACK or NAK for another packet: ACK 3",
        "leftover boot version: BMS V1.2.3",
    ]
    bench.say(Ack(2))
    bench.expect(Packet)
    bench.say(Ack(3))
    bench.expect(EndOfTransfer)
    bench.say(BOOT)
    assert reported(bench)[2] == "boot version after end of transfer: BMS V1.2.3"


# -- the bootloader's version ---------------------------------------------------------------------


@each(
    "minimum, announced, ending",
    [
        ("V1.2.3", "V1.2.3", None),
        ("V1.2.2", "V1.2.3", None),
        ("V1.2.4", "V1.2.3", Ending.BOOT_TOO_OLD),
        ("V2.0.0", "V1.9.9", Ending.BOOT_TOO_OLD),
        (None, "V0.0.1", None),
    ],
)
def test_a_bootloader_that_is_older_than_the_manifest_asks_is_refused(
    minimum: str | None, announced: str, ending: Ending | None
) -> None:
    bench = Bench(options=UpgradeOptions(minimum_boot_version=minimum))
    bench.to_boot()
    bench.say(BootVersion("BMS", announced))
    if ending is None:
        bench.expect(UpdateCommand)
        text = f"the bootloader {announced} is not older than {minimum}, as the manifest asks"
        check = events.CheckMade("boot-version", "passed", text)
        assert bench.seen(events.CheckMade) == ([] if minimum is None else [check])
        bench.say(RequestTransfer())
        assert len(bench.seen(events.CheckMade)) == (minimum is not None)
    else:
        assert bench.outcome.ending is ending
        assert bench.outcome.detail == f"boot version 'BMS' '{announced}'"
        assert bench.unread == []


def test_a_bootloader_that_names_no_version_is_refused_where_one_is_asked_for() -> None:
    options = UpgradeOptions(minimum_boot_version="V1.0.0", allow_boot_name=True)
    bench = Bench(options=options)
    bench.to_boot()
    bench.say(BootVersion("BMS", "absent"))
    assert bench.outcome.ending is Ending.BOOT_TOO_OLD


def test_each_attempt_reports_the_boot_version_once() -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED))
    bench.to_packet(2)
    bench.now += 0.1
    for _ in range(2):
        bench.say(BOOT)
        bench.now += 0.01
    bench.expect(UpdateCommand)
    assert bench.seen(events.BootVersionSeen) == [events.BootVersionSeen("BMS", "V1.2.3")] * 2
    assert bench.seen(events.AttemptStarted)[0].reason == Reason.RESTARTED.value  # type: ignore[attr-defined]


# -- how it ends ----------------------------------------------------------------------------------


@each("fails_first, ending", [(False, Ending.OUT_OF_TIME), (True, Ending.RESTARTED)])
def test_at_the_deadline_it_ends_as_the_attempt_before_would_have(
    *, fails_first: bool, ending: Ending
) -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED, timeout_s=30.0))
    bench.to_packet(2)
    if fails_first:
        for _ in range(3):
            bench.now += 0.1
            bench.say(BOOT)
            bench.expect(UpdateCommand)
            bench.say(RequestTransfer())
            bench.expect(Packet)
            bench.say(Ack(1))
            bench.expect(Packet)
        bench.now += 0.1
        bench.say(BOOT)
    bench.now = 130.0
    bench.engine.tick(bench.now)
    bench._flush()
    bench.wait(1.0)
    assert bench.outcome.ending is ending


def test_a_session_that_was_not_to_be_checked_names_the_check_that_refused() -> None:
    rule = CheckResult(IdentityCheck.HARDWARE, CheckVerdict.REFUSED, "no hardware reported")
    bench = Bench(options=replace(ONCE, in_session=True))
    stage(bench).unchecked = rule
    bench.expect(ResetCommand)
    bench.say(BOOT)
    outcome = bench.outcome
    assert outcome.ending is Ending.UNCHECKED
    assert outcome.waiver == "hardware"
    assert outcome.detail == rule.detail
    assert outcome.device_left is DeviceLeft.UNTOUCHED
    other = Bench(options=replace(ONCE, in_session=True))
    stage(other).unchecked = rule
    other.engine.cancel(other.now)
    other.wait(1.0)
    assert other.outcome.waiver == ""


def test_the_boot_version_of_the_device_is_in_the_outcome_and_escaped() -> None:
    bench = Bench(options=replace(ONCE, allow_boot_name=True))
    bench.to_boot()
    bench.say(BootVersion("B\x1bS", "V1.2.3"))
    bench.expect(UpdateCommand)
    bench.engine.cancel(bench.now)
    assert bench.outcome.boot_version is not None
    assert bench.outcome.boot_version.endswith("S V1.2.3")
    assert "\x1b" not in bench.outcome.boot_version


def test_at_the_deadline_the_last_failure_counts_and_silence_after_it_does_not() -> None:
    """The device has no application to lose: attempts go on until the deadline."""

    def restarts(bench: Bench) -> None:
        for _ in range(4):
            bench.now += 0.1
            bench.say(BOOT)
            bench.expect(UpdateCommand)
            bench.say(RequestTransfer())
            bench.expect(Packet)
            bench.say(Ack(1))
            bench.expect(Packet)

    options = UpgradeOptions(timings=HURRIED, timeout_s=60.0)
    bench = Bench(options=options)
    bench.to_packet(2)
    restarts(bench)
    bench.now += 0.1
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.wait(70.0)
    assert bench.outcome.ending is Ending.NO_REQUEST, "the last failure that says something"
    assert bench.outcome.statistics.attempts > 5
    bench = Bench(options=options)
    bench.to_packet(2)
    restarts(bench)
    bench.wait(70.0)
    assert bench.outcome.ending is Ending.PACKET_FAILED
    assert bench.outcome.packet == 2


def test_an_adapter_that_is_back_while_an_erased_device_is_reset_takes_no_attempt() -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED))
    bench.to_packet(2)
    bench.expect(Packet)
    bench.expect(ResetCommand)
    before = len(bench.seen(events.AttemptStarted))
    for _ in range(5):
        bench.engine.link_back(bench.now)
        bench.expect(ResetCommand, within_s=0.19)
    assert len(bench.seen(events.AttemptStarted)) == before == 1


# -- an adapter that takes nothing for a while ----------------------------------------------------


def hears(bench: Bench, row: UpgradeMessage) -> None:
    """The device speaks while the adapter takes nothing."""
    for frame in answer_frames(row):
        bench.engine.receive(frame, bench.now)


def passes(bench: Bench, seconds: float) -> None:
    bench.now += seconds
    bench.engine.tick(bench.now)
    bench.events += bench.engine.take_events()


def test_a_timer_begins_when_the_message_has_left_and_not_before() -> None:
    bench = Bench()
    bench.to_end()
    hears(bench, Nak(3))
    passes(bench, 11.0)
    assert bench.seen(events.MessageRepeated) == [
        events.MessageRepeated("end of transfer", Reason.END_REFUSED.value, 2)
    ]
    bench = Bench()
    bench.expect(ResetCommand)
    bench.engine.link_back(bench.now)
    passes(bench, 0.3)
    bench._flush()
    assert bench.unread == [ResetCommand()]
    bench = Bench()
    bench.to_transfer()
    hears(bench, Ack(1))
    passes(bench, 0.6)
    assert bench.seen(events.MessageRepeated) == []


def test_a_reset_that_has_not_left_when_it_is_needed_no_more_is_not_sent() -> None:
    bench = Bench()
    bench.expect(ResetCommand)
    passes(bench, 0.25)
    hears(bench, GeneralFeedbackMessage())
    bench._flush()
    assert bench.unread == []


def update_that_waits() -> Bench:
    """The update command is queued, and the adapter takes nothing."""
    bench = Bench(options=ONCE)
    bench.to_boot()
    hears(bench, BOOT)
    passes(bench, 0.03)
    assert not stage(bench).has_begun_to_erase
    return bench


def test_an_adapter_that_is_back_before_the_update_command_has_left_begins_with_the_reset() -> None:
    bench = update_that_waits()
    bench.engine.link_back(bench.now)
    bench._flush()
    bench.expect(ResetCommand)


def test_a_request_before_the_update_command_has_left_is_reported_and_not_answered() -> None:
    bench = update_that_waits()
    hears(bench, RequestTransfer())
    bench.events += bench.engine.take_events()
    assert reported(bench) == [OUT_OF_PLACE]
    bench._flush()
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_a_request_that_never_comes_is_missed_although_the_adapter_was_lost_meanwhile() -> None:
    bench = Bench(options=ONCE)
    bench.to_request()
    bench.wait(0.05)
    hears(bench, BOOT)  # answered by another update command, which does not leave
    bench.engine.link_back(bench.now)
    bench.wait(10.1)
    assert bench.outcome.ending is Ending.NO_REQUEST


def test_a_boot_version_after_an_update_command_into_the_silence_is_reported() -> None:
    bench = Bench(options=replace(ONCE, in_session=True))
    bench.wait(10.1)
    assert isinstance(bench.unread[-1], UpdateCommand)
    assert bench.seen(events.BootVersionSeen) == []
    bench._read = len(bench.sent)
    bench.wait(1.0)
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    assert bench.seen(events.BootVersionSeen) == [events.BootVersionSeen("BMS", "V1.2.3")]


def test_an_erased_device_that_announces_on_and_on_is_reset_and_commanded_again() -> None:
    bench = Bench()
    bench.to_packet(2)
    bench.now += 0.1
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    reported_at = bench.now
    while bench.now < reported_at + 10.1:
        bench.now += 0.05
        bench.say(BOOT)
    started = [e.reason for e in bench.events if isinstance(e, events.AttemptStarted)]
    assert started[:2] == [Reason.RESTARTED.value, Reason.REQUEST_GIVEN_UP.value]
    assert not bench.engine.done


@each(
    "attempts, comes_back, ending",
    [(2, True, Ending.NO_REQUEST), (3, False, Ending.PACKET_FAILED)],
)
def test_no_request_after_a_failed_packet_is_named_by_whether_the_device_came_back(
    attempts: int, ending: Ending, *, comes_back: bool
) -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED, attempts=attempts))
    bench.to_packet(2)
    bench.expect(Packet)
    bench.expect(ResetCommand)
    if comes_back:
        bench.say(BOOT)
        bench.expect(UpdateCommand)
    bench.wait(60.0)
    assert bench.outcome.ending is ending
    assert bench.outcome.packet == (2 if ending is Ending.PACKET_FAILED else None)


def test_no_power_cycle_is_asked_for_before_an_update_command_went_into_the_silence() -> None:
    bench = Bench(options=UpgradeOptions(timings=HURRIED))
    bench.to_packet(2)
    bench.now += 0.1
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.wait(12.0)
    assert bench.seen(events.PowerCycleAwaited) == []
    assert ResetCommand() in bench.unread


def test_the_wait_for_the_power_begins_anew_when_the_adapter_is_back() -> None:
    bench = Bench(options=UpgradeOptions(at_power_up=True, power_up_timeout_s=30.0))
    bench.wait(20.0)
    bench.engine.link_back(bench.now)
    bench.wait(20.0)
    assert not bench.engine.done
    bench.wait(11.0)
    assert bench.outcome.ending is Ending.NO_ANNOUNCEMENT
