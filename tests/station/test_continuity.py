"""What speaks for another unit, from the messages of a run and their times alone."""

from __future__ import annotations

from pathlib import Path

from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.spec import BMS
from flasher.protocol.wire import encode, split
from flasher.station.continuity import Continuity
from flasher.station.presence import TargetWatcher
from tests.loops import each
from tests.station.test_presence import version_answer
from tests.station.unit_bench import UnitBench

BLIND_S = 0.15
ANNOUNCEMENT = BootVersion("BMS", "V1.0.0")


class Watched:
    """A battery of a run that begins at 1.0 s."""

    def __init__(self, folder: Path, **known: bool) -> None:
        loaded = UnitBench(folder).recipe.targets[0]
        self.watcher = TargetWatcher(loaded.profile)
        self.continuity = Continuity(loaded, self.watcher, blind_s=BLIND_S, **known)
        self.now = 1.0

    def identify(self) -> None:
        for frame in version_answer("NONE"):
            self.continuity(frame, sent=False, now=self.now)
        self.continuity.begin(self.watcher.answer)

    def go_to(self, now: float) -> None:
        while self.now < now:
            self.now = min(self.now + 0.05, now)
            self.continuity.listened(self.now)

    def hear(
        self, now: float, message: object, *, sent: bool = False, frames: int | None = None
    ) -> None:
        """`frames`: only so many of its first ones."""
        self.go_to(now)
        can_id = BMS.request_id if sent else BMS.answer_id
        data = encode(message.to_message(can_id))  # type: ignore[attr-defined]
        for frame in split(can_id, data)[:frames]:
            self.continuity(frame, sent=sent, now=self.now)

    def send(self, now: float, message: object) -> None:
        self.hear(now, message, sent=True)

    def announce(self, now: float, times: int = 4) -> None:
        for number in range(times):
            self.hear(now + 0.05 * number, ANNOUNCEMENT)


def in_transfer(folder: Path) -> Watched:
    """A battery that requests its transfer at 1.22 s."""
    run = Watched(folder)
    run.identify()
    run.send(1.1, ResetCommand())
    run.hear(1.11, GeneralFeedbackMessage())
    run.announce(1.2, 1)
    run.send(1.21, UpdateCommand(BMS.update_text, 256))
    run.hear(1.22, RequestTransfer())
    return run


def flashed(folder: Path) -> Watched:
    """A battery whose image is complete at 1.24 s."""
    run = in_transfer(folder)
    run.send(1.23, EndOfTransfer())
    run.hear(1.24, Complete())
    return run


@each("silence_s", [0.35, 1.0])
def test_a_second_burst_after_the_complete_image_is_of_another_unit(
    tmp_path: Path, silence_s: float
) -> None:
    """A small image is stored before the burst that preceded it could be over."""
    run = flashed(tmp_path)
    run.announce(1.45)
    assert not run.continuity.lost, "it may start by its bootloader"
    run.announce(1.6 + silence_s)
    assert "announced its bootloader" in run.continuity.lost


@each("missed_s", [0.2, 0.5])
@each("is_away", [False, True])
def test_a_burst_after_an_unobserved_time_may_be_of_another_unit(
    tmp_path: Path, missed_s: float, is_away: bool
) -> None:
    run = flashed(tmp_path)
    if is_away:
        run.go_to(run.now + missed_s)
        run.continuity.was_away(missed_s)
    else:
        run.now += missed_s
        run.continuity.listened(run.now)
    run.announce(run.now + 0.1)
    assert not run.continuity.lost
    assert bool(run.continuity.unobserved) == (missed_s > 0.25)


@each("confirms", [False, True])
def test_a_unit_that_is_pulled_in_an_unobserved_time_before_it_is_reset(
    tmp_path: Path, confirms: bool
) -> None:
    run = Watched(tmp_path)
    run.identify()
    run.continuity.settle()
    run.now += 1.0
    run.send(2.0, ResetCommand())
    if confirms:
        run.hear(2.01, GeneralFeedbackMessage())
    run.announce(2.15, 1)
    assert not run.continuity.lost
    assert bool(run.continuity.unobserved) == (not confirms)


@each("confirms", [False, True])
def test_a_unit_that_is_pulled_in_an_unobserved_time_before_the_end_of_its_transfer(
    tmp_path: Path, confirms: bool
) -> None:
    run = in_transfer(tmp_path)
    run.now += 1.0
    run.hear(2.22, Ack(2))  # it had waited to be read
    run.send(2.22, EndOfTransfer())
    if confirms:
        run.hear(2.23, Complete())
    run.announce(2.37, 1)
    assert not run.continuity.lost
    assert bool(run.continuity.unobserved) == (not confirms)


def test_an_adapter_that_was_away_in_the_transfer_accuses_no_device(tmp_path: Path) -> None:
    run = in_transfer(tmp_path)
    run.go_to(3.22)
    run.continuity.was_away(2.0)
    run.send(3.23, EndOfTransfer())
    run.hear(3.24, Complete())
    run.announce(3.3)
    assert (run.continuity.lost, run.continuity.unobserved) == ("", "")


@each("confirms_late", [False, True])
def test_a_reset_that_is_confirmed_at_once_causes_one_burst(
    tmp_path: Path, confirms_late: bool
) -> None:
    """The unit was switched on just before, and its application has answered nothing."""
    run = Watched(tmp_path)
    run.announce(1.0)
    run.continuity.begin(None)
    run.send(1.2, ResetCommand())
    if not confirms_late:
        run.hear(1.21, GeneralFeedbackMessage())
    run.announce(1.3, 1)
    if confirms_late:
        run.hear(1.31, GeneralFeedbackMessage())
    run.announce(1.35, 1 + confirms_late)
    run.send(1.41, UpdateCommand(BMS.update_text, 256))
    assert not run.continuity.lost
    run.announce(1.9)
    assert "announced its bootloader" in run.continuity.lost


def test_an_update_command_after_a_confirmed_reset_and_one_announcement_allows_no_other_burst(
    tmp_path: Path,
) -> None:
    run = Watched(tmp_path)
    run.announce(1.0)
    run.continuity.begin(None)
    run.send(1.2, ResetCommand())
    run.hear(1.21, GeneralFeedbackMessage())
    run.announce(1.3, 1)
    run.send(1.31, UpdateCommand(BMS.update_text, 256))
    assert not run.continuity.lost
    run.announce(1.8)
    assert "announced its bootloader" in run.continuity.lost


@each("pause_s", [0.05, 0.4])
@each("frames", [1, 2])
def test_a_unit_that_is_pulled_in_its_first_announcement_has_announced_itself(
    tmp_path: Path, frames: int, pause_s: float
) -> None:
    run = Watched(tmp_path)
    run.identify()
    run.send(1.1, ResetCommand())
    run.hear(1.11, GeneralFeedbackMessage())
    run.hear(1.2, ANNOUNCEMENT, frames=frames)
    run.announce(1.2 + pause_s)
    assert bool(run.continuity.lost) == (pause_s > 0.3), "else a frame was lost"


@each("frames", [0, 1, 3])
def test_a_unit_that_is_pulled_in_its_first_answer_has_started(tmp_path: Path, frames: int) -> None:
    run = flashed(tmp_path)
    for frame in version_answer("NONE")[:frames]:
        run.continuity(frame, sent=False, now=run.now)
    run.announce(2.0)
    assert bool(run.continuity.lost) == (frames > 0)


def test_what_announces_itself_in_a_silent_socket_came_after_the_run_began(tmp_path: Path) -> None:
    run = Watched(tmp_path, was_silent=True)
    run.announce(1.5, 1)
    assert "was silent when the run began" in run.continuity.lost


def test_a_silent_unit_may_answer_and_restart_when_it_is_commanded_to(tmp_path: Path) -> None:
    run = Watched(tmp_path, was_silent=True)
    run.identify()
    run.send(1.1, ResetCommand())
    run.hear(1.11, GeneralFeedbackMessage())
    run.announce(1.2)
    assert not run.continuity.lost


def test_a_silent_unit_may_be_reset_without_an_answer(tmp_path: Path) -> None:
    run = Watched(tmp_path, was_silent=True)
    run.send(1.1, ResetCommand())
    run.announce(1.2)
    assert not run.continuity.lost


def test_a_held_unit_may_be_switched_on_after_its_run_began(tmp_path: Path) -> None:
    run = Watched(tmp_path, was_silent=True, may_restart=True)
    run.announce(1.5)
    assert not run.continuity.lost


@each("may_restart", [False, True])
def test_a_unit_that_restarts_before_it_is_identified_may_be_another_one(
    tmp_path: Path, may_restart: bool
) -> None:
    """Another one was put in just before the label was scanned, even into a fixture that holds it
    then.
    """
    run = Watched(tmp_path, may_restart=may_restart)
    for now in (1.0, 1.05):
        run.announce(now, 1)
    assert not run.continuity.lost
    run.announce(1.7)
    assert "had not restarted it" in run.continuity.lost


def test_a_fixture_may_restart_the_unit_that_it_holds(tmp_path: Path) -> None:
    run = Watched(tmp_path, may_restart=True)
    run.identify()
    run.announce(1.7)
    assert not run.continuity.lost


@each("silence_s", [0.2, 0.3, 1.0])
@each("is_confirmed", [False, True])
def test_a_unit_that_answers_nothing_confirms_its_reset_or_is_another_one(
    tmp_path: Path, is_confirmed: bool, silence_s: float
) -> None:
    """It announced itself when its power came, and its application has answered no question."""
    run = Watched(tmp_path)
    run.announce(1.0)
    run.continuity.begin(None)
    run.send(8.0, ResetCommand())
    if is_confirmed:
        run.hear(8.01, GeneralFeedbackMessage())
    run.send(8.0 + silence_s / 2, ResetCommand())
    run.announce(8.0 + silence_s)
    assert bool(run.continuity.lost) == (not is_confirmed), "its last word was 6.8 s ago"
