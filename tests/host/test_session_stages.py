"""A whole session, and what may befall it in each of its stages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import pytest

from flasher import events
from flasher.bus.echoes import Echoes
from flasher.bus.health import LinkHealth
from flasher.bus.simulated import SimulatedLink
from flasher.errors import BusError, ExitCode
from flasher.events import Phase
from flasher.host.options import UpgradeOptions, default_timeout_s
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending
from flasher.host.verify import Level, Verdict
from flasher.mock.model import MockDevice
from flasher.protocol import catalogue
from flasher.protocol.contents import VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.frame import Frame
from flasher.protocol.spec import WELLING
from flasher.protocol.text import encode_text
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message, encode, split
from flasher.wording import wording
from tests.end_to_end.stage import IMAGE, NEW, SMALL, Speaker, Stage, image_of
from tests.host.duplicates import Slow
from tests.loops import each

OTHER_TOOL = Frame(0x752, bytes.fromhex("55AA16123A105A5A"))
"""Begins to write user string 1."""
QUERY = split(0x752, encode(Message(0x752, 0x11, 0x3900, b"")))
"""Asks for user string 1."""
UPDATE = bytes.fromhex("55AA160DA10B")
COMPLETE = bytes.fromhex("55AA0C04C5020000")
READ_VERSION = bytes.fromhex("55AA11023300")
TWIN = replace(SMALL, serial_number="W2605077")
NEVER = 1e9
LONG = image_of(40)
VERIFICATION = "verification"
BEFORE_ERASE = (Phase.LISTEN, Phase.IDENTIFY, Phase.RESET, Phase.BOOT)


def once(stage: Stage, phase: Phase | str, happens: Callable[[], None]) -> None:
    """Let something happen when a phase, or the verification, is entered for the first time."""
    left = [happens]

    def on_phase() -> None:
        if stage.seen(events.PhaseEntered)[-1].phase is phase and left:
            left.pop()()

    if phase == VERIFICATION:
        stage.at_event[events.VerificationStarted] = left.pop()
    else:
        stage.at_event[events.PhaseEntered] = on_phase


def lose_complete_and_what_the_new_application_says(frame: Frame, now: float) -> list[Frame]:
    return [] if frame.data == COMPLETE or (now > 5.0 and frame.can_id == 0x720) else [frame]


# -- a second tool --------------------------------------------------------------------------------


class Witness:
    """A tap: what the host handed to its adapter after it had received the other tool."""

    def __init__(self) -> None:
        self.has_heard = False
        self.sent_after: list[Frame] = []

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent and self.has_heard:
            self.sent_after.append(frame)
        self.has_heard = self.has_heard or (not sent and frame in (OTHER_TOOL, QUERY[0]))


@each(
    "phase, frame",
    [(phase, OTHER_TOOL) for phase in (*Phase, VERIFICATION)]
    + [(phase, QUERY[0]) for phase in BEFORE_ERASE],
)
def test_a_second_tool_ends_the_session_in_every_stage_and_not_one_frame_more_is_sent(
    phase: Phase | str, frame: Frame
) -> None:
    """Where an attempt is left, a device that is erased gets it: not here (see below)."""
    stage, witness = Stage(), Witness()
    if phase is Phase.CONFIRM:
        stage.disturb = lose_complete_and_what_the_new_application_says

    def speak() -> None:
        now = stage.clock.now()
        stage.bus.attach(Speaker(frame, every_s=60.0, begins_at=now + 0.0011))

    once(stage, phase, speak)
    result = stage.flash(options=UpgradeOptions(attempts=1), taps=[witness])
    assert witness.has_heard
    assert witness.sent_after == []
    assert result.exit_code == ExitCode.BUS
    error = result.error()
    assert error is not None
    assert frame.data.hex(" ") in str(error)
    assert "End the other tool" in error.remedy
    if phase in BEFORE_ERASE:
        assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    if phase == VERIFICATION:
        assert "completed, but a second tool sends" in error.what
        assert wording(DeviceLeft.UNKNOWN) in error.remedy


def test_a_second_tool_cuts_a_message_short_that_was_finished_for_a_clean_end() -> None:
    """Ctrl-C lets the message go to its end; somebody else's voice does not."""
    stage, witness = Stage(), Witness()
    asked: list[bool] = []

    def stop() -> None:
        asked.append(True)
        stage.bus.attach(Speaker(OTHER_TOOL, every_s=60.0, begins_at=stage.clock.now()))

    stage.at_packet[2] = stop
    stage.cancelled = lambda: bool(asked)
    result = stage.flash(options=UpgradeOptions(frame_gap_s=0.002), taps=[witness])
    assert result.exit_code in (ExitCode.INTERRUPTED, ExitCode.BUS)
    assert witness.sent_after == []


@each("target", ["bms", "obc"])
def test_a_tool_that_flashes_is_detected_before_anything_is_sent(target: str) -> None:
    """The OBC cannot be asked: before its reset nothing else would have shown it."""
    stage = Stage(target)
    packet = Frame(stage.target.request_id, bytes.fromhex("0102030405060708"))
    stage.bus.attach(Speaker(packet, every_s=0.09, begins_at=0.08))
    result = stage.flash()
    assert stage.heard == [packet], "the other tool's frame, and none of ours"
    error = result.error()
    assert error is not None
    assert error.exit_code == ExitCode.BUS
    assert error.where == "listening for another tool"
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED


@each("phase", [Phase.UPDATE, Phase.TRANSFER, Phase.END, VERIFICATION])
def test_a_query_of_a_second_tool_is_reported_once_and_the_upgrade_goes_on(
    phase: Phase | str,
) -> None:
    stage = Stage(profile=replace(SMALL, erase_time_s=0.1))
    asked = Speaker(*QUERY, every_s=0.0373, begins_at=NEVER)
    stage.bus.attach(asked)
    once(stage, phase, lambda: setattr(asked, "_next", stage.clock.now() + 0.0011))
    result = stage.flash(LONG, verify=Level.VERSION)
    assert result.exit_code == ExitCode.OK, result.error()
    assert stage.has == LONG.data
    assert stage.seen(events.ForeignQuery) == [events.ForeignQuery("read user string 1")]
    if phase is Phase.TRANSFER:
        assert result.outcome.statistics.repetitions, "a query in a packet destroys the packet"
        assert result.outcome.statistics.attempts == 1


# -- echoes ---------------------------------------------------------------------------------------


class Echoing:
    """An adapter that receives its own messages: `copies` of the frame with a number, late."""

    def __init__(
        self, link: SimulatedLink, stage: Stage, copies: Callable[[int], int], delay_s: float
    ) -> None:
        self._link, self._clock = link, stage.clock
        self._copies, self._delay_s = copies, delay_s
        self._echoes: deque[tuple[float, Frame]] = deque()
        self._marks = Echoes()
        self._count = 0

    def send(self, frame: Frame) -> None:
        self._link.send(frame)
        self._marks.sent(frame)
        self._count += 1
        at = self._clock.now() + self._delay_s
        self._echoes.extend([(at, frame)] * self._copies(self._count))

    def receive(self, deadline: float) -> Frame | None:
        until = min(deadline, self._echoes[0][0]) if self._echoes else deadline
        frame = self._link.receive(until)
        if frame is None and self._echoes and self._echoes[0][0] <= self._clock.now():
            at, echo = self._echoes.popleft()
            return self._marks.mark(echo, at, is_rx=True)
        return frame

    def drain(self) -> int:
        return self._link.drain()

    def close(self) -> None:
        self._link.close()

    def reopen(self) -> None:
        self._link.reopen()

    @property
    def is_off(self) -> bool:
        return self._link.is_off

    @property
    def is_physical(self) -> bool:
        return self._link.is_physical

    def health(self) -> LinkHealth:
        return self._link.health()


@each("delay_s", [0.0, 0.002, 0.3, 0.7])
@each(
    "copies",
    [lambda _n: 1, lambda n: int(n % 3 > 0), lambda _n: 2, lambda n: n % 3],
)
def test_echoes_of_own_frames_are_no_second_tool(
    copies: Callable[[int], int], delay_s: float
) -> None:
    stage = Stage()
    stage.wrap = lambda link: Echoing(link, stage, copies, delay_s)
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert not stage.seen(events.MessageRepeated)


def test_a_second_tool_is_detected_among_echoes() -> None:
    stage, witness = Stage(), Witness()
    stage.wrap = lambda link: Echoing(link, stage, lambda _number: 1, 0.001)
    stage.at_packet[2] = lambda: stage.bus.attach(
        Speaker(OTHER_TOOL, every_s=60.0, begins_at=stage.clock.now())
    )
    result = stage.flash(options=UpgradeOptions(attempts=1), taps=[witness])
    assert result.exit_code == ExitCode.BUS
    assert witness.sent_after == []


# -- another tool that writes while the device is erased ------------------------------------------


class Timed(Witness):
    """A witness that knows when."""

    def __init__(self) -> None:
        super().__init__()
        self.heard_at = 0.0
        self.sent_again_at: float | None = None

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        super().__call__(frame, sent=sent, now=now)
        if self.has_heard and not sent and frame.can_id == OTHER_TOOL.can_id:
            self.heard_at = now
        if self.sent_after and self.sent_again_at is None:
            self.sent_again_at = now


def interrupted_by(*frames: Frame, every_s: float, limit: int) -> tuple[Stage, Timed]:
    """Another tool sends these in turn from packet 2 on."""
    stage, witness = Stage(), Timed()
    stage.at_packet[2] = lambda: stage.bus.attach(
        Speaker(*frames, every_s=every_s, begins_at=stage.clock.now() + 0.0011, limit=limit)
    )
    return stage, witness


@each("frames, every_s", [((OTHER_TOOL,), 1.9), ((OTHER_TOOL, *QUERY), 1.9)])
def test_an_erased_device_is_upgraded_again_when_the_other_tool_was_silent_for_two_seconds(
    frames: tuple[Frame, ...], every_s: float
) -> None:
    """CO-03. Whatever the other tool says meanwhile, a query too, is no silence."""
    stage, witness = interrupted_by(*frames, every_s=every_s, limit=6)
    result = stage.flash(taps=[witness])
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert witness.sent_again_at is not None
    assert 2.0 <= witness.sent_again_at - witness.heard_at < 2.01
    (noted,) = stage.seen(events.SecondToolAwaited)
    assert OTHER_TOOL.data.hex(" ") in noted.seen
    assert noted.quiet_s == 2.0
    (started,) = stage.seen(events.AttemptStarted)
    assert (started.attempt, started.reason) == (2, "second_tool")


def test_another_tool_that_does_not_fall_silent_ends_it_at_the_overall_deadline() -> None:
    stage, witness = interrupted_by(OTHER_TOOL, every_s=1.5, limit=1000)
    result = stage.flash(options=UpgradeOptions(timeout_s=20.0), taps=[witness])
    assert witness.sent_after == []
    assert result.outcome.ending is Ending.SECOND_TOOL
    assert result.exit_code == ExitCode.BUS
    assert stage.clock.now() == pytest.approx(20.0)
    assert OTHER_TOOL.data.hex(" ") in result.outcome.detail
    assert result.outcome.device_left is DeviceLeft.NO_APPLICATION


def test_another_tool_can_be_waited_for_as_often_as_attempts_are_left() -> None:
    stage, witness = interrupted_by(OTHER_TOOL, every_s=2.5, limit=100)
    result = stage.flash(options=UpgradeOptions(attempts=3), taps=[witness])
    assert result.outcome.ending is Ending.SECOND_TOOL
    assert result.outcome.statistics.attempts == 3


def test_the_user_ends_the_wait_for_another_tool() -> None:
    stage, _ = interrupted_by(OTHER_TOOL, every_s=1.0, limit=1000)
    stage.cancelled = lambda: stage.clock.now() > 5.0
    result = stage.flash()
    assert result.outcome.ending is Ending.CANCELLED
    assert stage.clock.now() < 5.2


def test_a_packet_of_another_tool_that_begins_as_an_own_one_is_noticed() -> None:
    """Its first frame is equal to one that was sent, so that it is taken for an echo."""
    stage = Stage()
    other = image_of(4, seed=77)
    foreign = stage.plan(other).packet_frames(2)
    assert foreign[0] == stage.plan().packet_frames(2)[0]
    stage.wrap = lambda link: Echoing(link, stage, lambda _number: 1, 0.001)

    def tamper() -> None:
        begins_at = stage.clock.now() + 0.0005
        stage.bus.attach(Speaker(*foreign, every_s=0.0, begins_at=begins_at, limit=len(foreign)))

    stage.at_packet[3] = tamper
    assert stage.flash().exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert stage.seen(events.SecondToolAwaited)


# -- two devices ----------------------------------------------------------------------------------


def with_another(stage: Stage, **differs: str) -> MockDevice:
    profile = replace(SMALL, **differs)  # type: ignore[arg-type]
    other = MockDevice(stage.target, bitrate_bps=WELLING.bitrate_bps, profile=profile)
    stage.bus.attach(Slow(other, 0.006))
    return other


@each("differs", [{"serial_number": "W2605002"}, {"factory_version": "V1r0r1_20230512"}])
def test_two_devices_that_report_different_versions_are_refused_before_the_reset(
    differs: dict[str, str],
) -> None:
    stage = Stage()
    other = with_another(stage, **differs)
    result = stage.flash()
    assert result.exit_code == ExitCode.WRONG_DEVICE
    assert result.outcome.ending is Ending.TWO_DEVICES
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    assert not any(b"RESET" in frame.data for frame in stage.heard)
    assert stage.device.erase_count == other.erase_count == 0


class LateTwin(Speaker):
    """Another battery, which answers the version query a while after the first one."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        answer = catalogue.BY_KEY[(0x720, 0x1540)]
        texts = (TWIN.model, TWIN.serial_number, TWIN.hardware_version, TWIN.factory_version)
        fields = (WireText(encode_text(text, 16)) for text in texts)
        frames = split(0x720, encode(catalogue.encode(answer, VersionInformation(*fields))))
        super().__init__(*frames, every_s=0.0006, begins_at=NEVER)

    def receive(self, frame: Frame, now: float) -> None:
        if frame.data.startswith(READ_VERSION):
            self._next = now + self._delay_s

    def frame_sent(self, now: float) -> None:
        super().frame_sent(now)
        if self._sent % len(self._frames) == 0:
            self._next = NEVER


@each("delay_s", [0.015, 0.04, 0.08])
def test_a_second_device_that_answers_later_is_noticed_before_the_reset_too(
    delay_s: float,
) -> None:
    stage = Stage()
    stage.bus.attach(LateTwin(delay_s))
    result = stage.flash()
    assert result.outcome.ending is Ending.TWO_DEVICES
    assert not any(b"RESET" in frame.data for frame in stage.heard)
    assert stage.device.erase_count == 0


def test_two_bootloaders_that_announce_different_versions_are_refused() -> None:
    stage = Stage("wmc")
    with_another(stage, boot_version="V9.9.9")
    result = stage.flash()
    assert result.exit_code == ExitCode.WRONG_DEVICE
    assert result.outcome.ending is Ending.TWO_DEVICES
    assert result.outcome.device_left is DeviceLeft.UNTOUCHED
    stage.wait(10.0)
    assert not any(frame.data.startswith(UPDATE) for frame in stage.heard)


# -- a device that announces itself ---------------------------------------------------------------


@each("after_s", [0.0, 0.013, 0.1, 0.35, 0.9])
def test_an_announcement_while_the_device_is_asked_is_answered_inside_of_its_window(
    after_s: float,
) -> None:
    """It is switched on meanwhile, and listens for as long as its burst lasts only."""
    stage = Stage(profile=replace(SMALL, window_s=0.0, without_application="listens"))
    stage.cut_power()

    def later() -> None:
        at = stage.clock.now() + after_s
        stage.bus.attach(Switch(stage, at))

    once(stage, Phase.IDENTIFY, later)
    result = stage.flash()
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    assert not any(b"RESET" in frame.data for frame in stage.heard) or after_s > 0.8


class Switch(Speaker):
    """Switches the device on at a time; sends nothing."""

    def __init__(self, stage: Stage, at: float) -> None:
        super().__init__(Frame(0x7FF, b""), every_s=1e9, begins_at=at)
        self._stage = stage

    def tick(self, now: float) -> None:
        super().tick(now)
        self._is_due = False
        self._stage.give_power()


# -- attempts and the deadline ---------------------------------------------------------------------

HURRIED = Timings(ack_timeout_s=0.05, packet_tries=2)


def deaf_to(number: int, times: int) -> Callable[[Frame, float], list[Frame]]:
    """The ACK of a packet is lost so often."""
    ack, left = bytes.fromhex("55AA0C04C202") + bytes([number]), [times]

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        if frame.data[:7] == ack and left[0]:
            left[0] -= 1
            return []
        return [frame]

    return disturb


def test_a_packet_whose_tries_are_exhausted_begins_another_attempt_and_each_is_reported() -> None:
    stage = Stage()
    stage.disturb = deaf_to(2, times=4)
    result = stage.flash(options=UpgradeOptions(timings=HURRIED))
    assert result.exit_code == ExitCode.OK
    assert stage.has == IMAGE.data
    started = stage.seen(events.AttemptStarted)
    assert [each.attempt for each in started] == [2, 3]
    assert all(each.reason == "packet_given_up" for each in started)
    phases = [(each.phase, each.attempt) for each in stage.seen(events.PhaseEntered)]
    assert [(Phase.RESET, n) for n in (1, 2, 3)] == [p for p in phases if p[0] is Phase.RESET]
    assert result.outcome.statistics.attempts == 3


@each("attempts", [1, 2, 4])
def test_attempts_are_bounded(attempts: int) -> None:
    stage = Stage()
    stage.disturb = deaf_to(2, times=1000)
    result = stage.flash(options=UpgradeOptions(timings=HURRIED, attempts=attempts))
    assert result.exit_code == ExitCode.TRANSFER
    assert result.outcome.ending is Ending.PACKET_FAILED
    assert result.outcome.packet == 2
    assert len(stage.seen(events.AttemptStarted)) == attempts - 1
    resets = sum(frame.data[6:8] == b"RE" for frame in stage.heard)
    assert resets >= attempts
    assert (attempts == 1) is (resets == 1)


@each("timeout_s", [0.3, 1.2, 3.0])
@each("cut", [None, 1, 3])
def test_the_deadline_bounds_every_stage_together(timeout_s: float, cut: int | None) -> None:
    """Silent from the beginning, or from a packet on."""
    stage = Stage()
    if cut is None:
        stage.cut_power()
    else:
        stage.at_packet[cut] = stage.cut_power
    result = stage.flash(options=UpgradeOptions(timeout_s=timeout_s, attempts=9))
    assert not result.ok
    assert stage.clock.now() <= timeout_s + 0.05


@each("level", [Level.VERSION, Level.NONE])
def test_the_deadline_bounds_the_verification_too(level: Level) -> None:
    stage = Stage()
    stage.at_event[events.VerificationStarted] = stage.cut_power
    result = stage.flash(options=UpgradeOptions(timeout_s=2.0), verify=level)
    assert result.outcome.ok
    assert stage.clock.now() <= 2.0 + 0.05
    if level is Level.VERSION:
        assert result.verification.verdict is Verdict.NO_ANSWER
        assert result.exit_code == ExitCode.VERIFICATION
        assert "overall deadline" in result.verification.detail


def test_a_device_that_is_always_just_in_time_is_upgraded_or_ends_with_the_deadline() -> None:
    """TM-03: each packet is acknowledged at its last try, as late as is allowed."""
    stage = Stage(profile=replace(SMALL, program_time_s=0.49))
    acks: dict[bytes, int] = {}

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        if frame.data[:6] != bytes.fromhex("55AA0C04C202"):
            return [frame]
        acks[frame.data] = acks.get(frame.data, 0) + 1
        return [frame] if acks[frame.data] % 5 == 0 else []

    stage.disturb = disturb
    options = UpgradeOptions()
    result = stage.flash(options=options)
    assert result.ok or result.outcome.ending is Ending.OUT_OF_TIME
    assert result.ok == (stage.has == IMAGE.data)
    assert stage.clock.now() <= default_timeout_s(stage.plan(), options) + 0.5


def test_a_bus_without_acknowledgement_is_distinguished_from_a_device_that_is_silent() -> None:
    alone, silent = Stage(), Stage()
    alone.bus.is_unacknowledged = True
    silent.cut_power()
    silent.bus.attach(Speaker(Frame(0x100, b"\1"), every_s=0.1))
    with pytest.raises(BusError, match="No node on the bus acknowledges"):
        alone.flash()
    assert silent.flash().exit_code == ExitCode.NO_ANSWER


def test_a_session_that_went_well_states_what_runs() -> None:
    stage = Stage()
    result = stage.flash()
    assert (result.exit_code, result.running_version) == (ExitCode.OK, NEW)
    assert [each.phase for each in stage.seen(events.PhaseEntered)] == [*Phase][:-1]
