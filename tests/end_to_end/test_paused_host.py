"""The host's computer pauses in the middle of an upgrade: no fault of the device's or the bus's."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher import events
from flasher.bus.simulated import SimulatedLink
from flasher.host.options import UpgradeOptions
from flasher.host.session import Result
from flasher.host.table import Ending
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.end_to_end.stage import IMAGE, SMALL, Stage

pytestmark = pytest.mark.slow

ONE_TRY = UpgradeOptions(attempts=1, timings=replace(DEFAULT_TIMINGS, packet_tries=1))
"""No pause may use up a try, nor an attempt."""


class Pausing(SimulatedLink):
    """An adapter whose computer pauses once, or every `again_after` frames, while it hands over a
    frame or while it waits for the next one to come: the bus goes on.
    """

    def __init__(
        self,
        link: SimulatedLink,
        stage: Stage,
        after_frame: int,
        pause_s: float,
        *,
        sending: bool,
        again_after: int = 0,
    ) -> None:
        self.__dict__ = link.__dict__
        self.stage, self.pause_s, self.sending = stage, pause_s, sending
        self.frames_left = after_frame
        self.again_after = again_after

    def send(self, frame: Frame) -> None:
        super().send(frame)
        self.frames_left -= 1
        self._pause(self.sending)

    def receive(self, deadline: float) -> Frame | None:
        self._pause(deadline > 0 and not self.sending)
        return super().receive(deadline)

    def _pause(self, here: bool) -> None:
        if here and self.frames_left <= 0 and self.pause_s:
            pause_s, self.pause_s = self.pause_s, self.pause_s if self.again_after else 0.0
            self.frames_left = self.again_after
            self.stage.wait(pause_s)


def flash(
    after_frame: int,
    pause_s: float,
    *,
    sending: bool,
    options: UpgradeOptions | None = ONE_TRY,
    profile: DeviceProfile = SMALL,
) -> tuple[Stage, Result]:
    stage = Stage(profile=profile)
    stage.wrap = lambda link: Pausing(link, stage, after_frame, pause_s, sending=sending)
    return stage, stage.flash(options=options)


def frames_of_an_upgrade() -> int:
    whole = Stage()
    assert whole.flash(options=ONE_TRY).ok
    return len(whole.heard)


@pytest.mark.parametrize("sending", [True, False])
@pytest.mark.parametrize("pause_s", [0.3, 2.0, 4.0])
def test_a_pause_after_any_frame_of_a_transfer_costs_no_try_and_no_attempt(
    pause_s: float, *, sending: bool
) -> None:
    frames = frames_of_an_upgrade()
    for after_frame in range(frames - 54, frames):
        stage, result = flash(after_frame, pause_s, sending=sending)
        assert result.ok, after_frame
        assert stage.has == IMAGE.data
        assert result.outcome.statistics.repetitions == 0, after_frame


@pytest.mark.parametrize("pause_s", [0.3, 2.0, 12.0])
def test_a_pause_anywhere_else_ends_well_with_the_attempts_that_are_there(pause_s: float) -> None:
    """The window of the bootloader passes meanwhile, and its application starts again."""
    for after_frame in range(1, frames_of_an_upgrade() - 54):
        stage, result = flash(after_frame, pause_s, sending=False, options=None)
        assert result.ok, after_frame
        assert stage.has == IMAGE.data


def test_pauses_in_packet_after_packet_are_not_blamed_on_a_second_device() -> None:
    stage = Stage(profile=SMALL)
    first = frames_of_an_upgrade() - 54
    stage.wrap = lambda link: Pausing(link, stage, first, 0.12, sending=True, again_after=23)
    result = stage.flash(options=replace(ONE_TRY, attempts=3))
    assert result.outcome.ending is Ending.COMPLETED, result.outcome.detail
    assert result.outcome.statistics.naks > 1, "the device refused the parts"
    assert stage.has == IMAGE.data


def test_a_pause_is_reported_and_named_as_the_likely_cause() -> None:
    gives_up = replace(SMALL, transfer_timeout_s=5.0)
    stage, result = flash(50, 12.0, sending=False, profile=gives_up)
    (stall,) = stage.seen(events.HostStalled)
    assert 11.5 < stall.stalled_s <= 12.0
    error = result.error()
    assert error is not None
    assert error.cause.startswith("this computer paused for 11.9 s meanwhile; else ")
