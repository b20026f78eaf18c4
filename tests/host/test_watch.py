"""The moment between a boot version and the update command, in which a second device may show
itself (R27): how long it is, and what is done with what comes in it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher import events
from flasher.events import Phase
from flasher.host.options import UpgradeOptions
from flasher.host.table import Ending
from flasher.image.plan import plan
from flasher.protocol.messages import (
    BootVersion,
    GeneralFeedbackMessage,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
    UpgradeMessage,
)
from flasher.protocol.spec import BMS, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Message
from tests.host.bench import BOOT, Bench, answer_frames
from tests.host.upgrade import Upgrade
from tests.loops import each

WATCH_S, SPACING_S = DEFAULT_TIMINGS.boot_watch_s, DEFAULT_TIMINGS.boot_version_spacing_s
BURST_S = 4 * SPACING_S
FRAME_S = 0.0006
"""More than the longest frame takes."""
AWAITED = UpgradeOptions(at_power_up=True, power_up_timeout_s=30.0)
SHORT = replace(DEFAULT_TIMINGS, boot_watch_s=0.01)


def begins(bench: Bench, kind: type[UpgradeMessage]) -> float:
    """When the next message began to be sent, which must be of this kind."""
    times: list[float] = []
    bench.on_frame = lambda _number: times.append(bench.now)
    bench.expect(kind)
    bench.on_frame = None
    return times[0]


def heard_before(options: UpgradeOptions | None = None) -> Bench:
    """An upgrade whose device announced itself while it was asked."""
    bench = Bench()
    bench.engine = Upgrade(plan(bench.image, BMS, WELLING.bitrate_bps), options)
    bench.engine._upgrade.announcement = BOOT.to_message(BMS.answer_id)
    bench.sent.clear()
    bench.events.clear()
    bench._step()
    return bench


@each("timings", [DEFAULT_TIMINGS, SHORT])
def test_the_update_command_follows_the_boot_version_after_the_watch(timings: Timings) -> None:
    bench = Bench(options=UpgradeOptions(timings=timings))
    bench.to_boot()
    bench.wait(1.0)
    announced_at = bench.now
    bench.say(BOOT)
    assert begins(bench, UpdateCommand) == pytest.approx(announced_at + timings.boot_watch_s)


def test_it_is_counted_from_where_a_message_that_is_being_sent_has_left() -> None:
    bench = Bench()
    bench.expect(ResetCommand)
    second_at: list[float] = []

    def announce(_number: int) -> None:
        if not second_at:
            second_at.append(bench.now)
        else:
            bench.on_frame = None
            for frame in answer_frames(BOOT):
                bench.engine.receive(frame, bench.now)

    bench.on_frame = announce
    bench.expect(ResetCommand)
    assert begins(bench, UpdateCommand) == pytest.approx(bench.sent[1][0] + WATCH_S, abs=1e-6)


def test_two_announcements_too_near_to_each_other_are_watched_for_two_rounds() -> None:
    bench = Bench()
    bench.to_boot()
    announced_at = bench.now
    bench.say(BOOT)
    bench.wait(0.01)
    bench.say(BOOT)
    assert begins(bench, UpdateCommand) == pytest.approx(announced_at + 2 * SPACING_S)


def test_an_announcement_of_another_kind_of_device_ends_it() -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(BOOT)
    bench.wait(0.01)
    bench.say(BootVersion("OBC", "V1.2.3"))
    assert bench.outcome.ending in (Ending.WRONG_DEVICE, Ending.TWO_DEVICES)
    assert not [row for _, row in bench.sent if isinstance(row, UpdateCommand)]


# -- a bootloader beside an application that confirms the reset -----------------------------------


def beside(options: UpgradeOptions | None = None) -> tuple[Bench, float]:
    """A bootloader announces itself, and the reset is confirmed; when it was."""
    bench = Bench(options=options)
    bench.expect(ResetCommand)
    bench.say(BOOT)
    bench.wait(0.005)
    bench.say(GeneralFeedbackMessage())
    return bench, bench.now


def test_the_application_is_reset_again_when_the_announcements_have_ended() -> None:
    bench, confirmed_at = beside()
    assert begins(bench, ResetCommand) == pytest.approx(confirmed_at + BURST_S)
    bench.say(GeneralFeedbackMessage())
    bench.wait(1.0)
    bench.say(BOOT)
    bench.expect(UpdateCommand, within_s=WATCH_S + 3 * FRAME_S)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_that_reset_is_repeated_as_ever() -> None:
    bench, _ = beside()
    bench.expect(ResetCommand)
    bench.expect(ResetCommand, within_s=0.3)


@each("attempts", [None, 1])
def test_a_bootloader_that_confirmed_that_reset_as_well_gets_another_one(
    attempts: int | None,
) -> None:
    """It started its application since, as no update command came in its window."""
    bench, _ = beside(UpgradeOptions(attempts=attempts))
    bench.expect(ResetCommand)
    bench.say(GeneralFeedbackMessage())
    bench.wait(5.1)
    if attempts == 1:
        assert bench.outcome.ending is Ending.NO_BOOT_VERSION
        return
    bench.to_boot()
    bench.say(BOOT)
    bench.expect(UpdateCommand)


def test_it_is_reset_again_once() -> None:
    bench, _ = beside()
    bench.expect(ResetCommand)
    bench.say(BOOT)
    bench.wait(0.005)
    bench.say(GeneralFeedbackMessage())
    confirmed_at = bench.now
    assert begins(bench, UpdateCommand) == pytest.approx(confirmed_at + BURST_S)


def test_announcements_that_go_on_are_those_of_one_bootloader_that_confirms_everything() -> None:
    bench, _ = beside()
    watched_since = bench.sent[0][0]
    while bench.now < watched_since + 4.9:
        bench.wait(SPACING_S)
        bench.say(BOOT)
    assert bench.unread == []
    begins_at = begins(bench, UpdateCommand)
    assert begins_at == pytest.approx(watched_since + 5.0, abs=0.01)


# -- a device that sent before --------------------------------------------------------------------


def test_a_device_that_announced_itself_gets_a_reset_that_only_another_application_answers() -> (
    None
):
    bench = heard_before()
    assert bench.seen(events.PhaseEntered) == [events.PhaseEntered(Phase.BOOT, 1)]
    assert bench.seen(events.BootVersionSeen) == [events.BootVersionSeen("BMS", "V1.2.3")]
    bench.expect(ResetCommand)
    left_at = bench.sent[0][0]
    assert begins(bench, UpdateCommand) == pytest.approx(left_at + WATCH_S, abs=1e-6)
    assert bench.seen(events.PhaseEntered)[-1] == events.PhaseEntered(Phase.UPDATE, 1)


def test_another_kind_of_device_that_announces_itself_after_that_reset_is_refused() -> None:
    bench = heard_before()
    bench.expect(ResetCommand)
    bench.say(BootVersion("OBC", "V1.2.3"))
    assert bench.outcome.ending is Ending.WRONG_DEVICE


def test_a_reset_that_leaves_late_is_followed_by_a_whole_watch() -> None:
    bench = Bench()
    bench.engine = Upgrade(plan(bench.image, BMS, WELLING.bitrate_bps))
    bench.engine._upgrade.announcement = BOOT.to_message(BMS.answer_id)
    bench.sent.clear()
    bench.engine.tick(bench.now)
    bench.now += 1.0  # the adapter takes nothing
    bench._step()
    bench.expect(ResetCommand)
    left_at = bench.sent[0][0]
    bench.wait(0.01)
    bench.say(BOOT)
    assert begins(bench, UpdateCommand) >= left_at + WATCH_S - 1e-6


def test_an_announcement_right_after_one_that_waited_for_that_reset_to_be_accepted() -> None:
    """This computer paused, and read those of the pause just before the next one came."""
    bench = Bench()
    bench.engine = Upgrade(plan(bench.image, BMS, WELLING.bitrate_bps))
    bench.engine._upgrade.announcement = BOOT.to_message(BMS.answer_id)
    bench.engine.tick(bench.now)
    for frame in answer_frames(BOOT):
        bench.engine.receive(frame, bench.now)
    while bench.engine.next_frame(bench.now) is not None:
        bench.engine.frame_sent(bench.now)
    bench.now += 0.0002
    bench.say(BOOT)
    bench.sent.clear()
    bench.expect(UpdateCommand)


def test_an_application_that_answers_that_reset_is_waited_for() -> None:
    bench = heard_before()
    bench.expect(ResetCommand)
    bench.wait(0.01)
    bench.say(GeneralFeedbackMessage())
    bench.wait(1.0)
    assert bench.unread == []
    bench.say(BOOT)
    bench.expect(UpdateCommand, within_s=WATCH_S + 3 * FRAME_S)


def test_at_power_up_it_gets_no_reset_and_no_power_cycle_is_asked_for() -> None:
    bench = heard_before(AWAITED)
    announced_at = bench.now
    assert begins(bench, UpdateCommand) == pytest.approx(announced_at + WATCH_S)
    assert bench.seen(events.PowerCycleAwaited) == []


@each(
    "options, phase",
    [
        (UpgradeOptions(), Phase.RESET),
        (AWAITED, Phase.BOOT),
        (replace(AWAITED, in_session=True), Phase.RESET),
    ],
)
def test_an_upgrade_begins_with_the_reset_or_with_the_wait(
    options: UpgradeOptions, phase: Phase
) -> None:
    bench = Bench(options=options)
    assert bench.seen(events.PhaseEntered) == [events.PhaseEntered(phase, 1)]
    assert bool(bench.seen(events.PowerCycleAwaited)) is (phase is Phase.BOOT)


def test_before_it_begins_it_states_what_it_will_begin_with() -> None:
    planned = plan(Bench().image, BMS, WELLING.bitrate_bps)
    for options, text in ((UpgradeOptions(), "resetting"), (AWAITED, "waiting for the boot")):
        assert Upgrade(planned, options)._upgrade.progress.startswith(text)


def test_a_version_that_the_bus_brings_is_no_boot_version() -> None:
    bench = Bench()
    bench.to_boot()
    bench.say(Message(BMS.answer_id, 0x0C, 0x7702, b"\0\0"))
    bench.wait(1.0)
    assert bench.unread == []
