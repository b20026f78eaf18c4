"""A session message by message: what it asks, what ends it before the reset, what a lost adapter,
an application and another tool change."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher import events
from flasher.errors import ErrorCode, ExitCode
from flasher.events import Phase
from flasher.host.duplicates import SECOND_DEVICE_WAIT_S
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome, ended_before_start
from flasher.host.session import Result, UpgradeSession
from flasher.host.table import Ending
from flasher.host.verify import Level, Verdict
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol import catalogue
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import (
    BatteryStatus,
    RunningInformation,
    Shutdown,
    VersionInformation,
)
from flasher.protocol.fields import Content, WireText
from flasher.protocol.frame import Frame
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
from flasher.protocol.spec import BMS, OBC, WELLING
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split
from flasher.settings.manifest import release_of
from tests.firmware import VECTORS
from tests.host.bench import BOOT, Bench
from tests.loops import each

NEW, OLD = "V2r0r1_20260102", "V1r0r0_20220512"
IMAGE = replace(Image.from_bytes(VECTORS + bytes(64) + NEW.encode()), version=NEW)
PLAN = plan(IMAGE, BMS, WELLING.bitrate_bps)
VERSION, RUNNING = (0x720, 0x1540), (0x720, 0x1010)
BATTERY = RunningInformation(40_000, -8, 8000, 9800, 22, 85, BatteryStatus(0), 98, bytes(4))
OTHER_TOOL = Frame(0x752, bytes.fromhex("55AA1605420501FF"))
OPEN = UpgradeOptions(in_session=True)
SHUTDOWN = next(item for item in catalogue.ITEMS if item.content is Shutdown)


def version(firmware: str = OLD, serial: str = "W1") -> VersionInformation:
    texts = ("BM36", serial, "V1r2r0_20220512", firmware)
    return VersionInformation(*(WireText(encode_text(text, 16)) for text in texts))


class Dialogue(Bench):
    """A session in the place of the upgrade."""

    def __init__(
        self,
        options: UpgradeOptions | None = None,
        *,
        identity: Identity | None = None,
        level: Level = Level.NONE,
    ) -> None:
        super().__init__(image=IMAGE)
        self.session = UpgradeSession(PLAN, options, level, identity)
        self.engine = self.session  # type: ignore[assignment]
        self.sent.clear()
        self.events.clear()
        self.now = 100.0
        self._step()

    def answers(self, key: tuple[int, int], content: Content) -> None:
        self.say(catalogue.encode(BY_KEY[key], content))

    def asked(self) -> int:
        return self.expect(Message).command

    def identified(self, firmware: str = OLD) -> None:
        """Both questions are answered."""
        assert self.asked() == 0x3300
        self.answers(VERSION, version(firmware))
        assert self.asked() == 0x3400
        self.answers(RUNNING, BATTERY)

    def may_begin_again(self) -> bool:
        """A call, for it changes from one line to the next."""
        return self.session.may_begin_again

    @property
    def result(self) -> Result:
        assert self.session.done, self.session.progress
        return self.session.result

    @property
    def ended(self) -> Outcome:
        return self.result.outcome


# -- who is there ---------------------------------------------------------------------------------


def test_a_battery_is_asked_before_the_reset_and_what_it_answered_is_kept() -> None:
    dialogue = Dialogue(identity=Identity())
    began_at = dialogue.now
    dialogue.identified()
    assert dialogue.sent[0][0] >= began_at + LISTEN_FIRST_S
    dialogue.to_packet(1)
    dialogue.say(Ack(1))
    dialogue.expect(EndOfTransfer)
    dialogue.say(Complete())
    dialogue.wait(SECOND_DEVICE_WAIT_S)
    assert dialogue.result.ok
    assert dialogue.result.previous_version == OLD
    assert dialogue.result.shutdown_heard is False
    assert dialogue.result.running_version is None
    assert dialogue.ended.statistics.attempts == 1
    noted = dialogue.seen(events.CheckMade)
    assert ("downgrade", "passed") in [(e.check, e.verdict) for e in noted]  # type: ignore[attr-defined]


def test_without_an_identity_nothing_is_asked_and_no_version_is_known() -> None:
    dialogue = Dialogue()
    dialogue.expect(ResetCommand)
    dialogue.say(GeneralFeedbackMessage())
    dialogue.engine.cancel(dialogue.now)
    assert dialogue.result.previous_version is None
    assert dialogue.seen(events.CheckMade) == []


def test_the_first_check_that_refuses_ends_it_and_all_are_reported() -> None:
    rules = release_of(IMAGE, BMS, hardware_versions=["V9*"])
    dialogue = Dialogue(identity=Identity(rules))
    dialogue.identified("V3r0r0_20260301")
    dialogue.wait(SECOND_DEVICE_WAIT_S)
    outcome = dialogue.ended
    assert outcome.ending is Ending.NOT_FOR_DEVICE
    assert outcome.waiver == "hardware"
    assert "V1r2r0_20220512 is not in the manifest" in outcome.detail
    assert "--allow-hardware waives this" in outcome.detail
    assert outcome.phase is Phase.IDENTIFY
    assert outcome.device_left is DeviceLeft.UNTOUCHED
    assert outcome.statistics.duration_s == pytest.approx(dialogue.now - 100.0, abs=1e-6)
    noted = [(e.check, e.verdict) for e in dialogue.seen(events.CheckMade)]  # type: ignore[attr-defined]
    assert ("hardware", "refused") in noted
    assert ("downgrade", "refused") in noted
    assert not dialogue.unread


def test_an_image_that_is_refused_by_itself_ends_it_before_anybody_is_asked() -> None:
    dialogue = Dialogue(identity=Identity(replace(release_of(IMAGE, BMS), target=OBC)))
    assert dialogue.ended.ending is Ending.NOT_FOR_DEVICE
    assert dialogue.ended.waiver == IdentityCheck.TARGET.value
    assert dialogue.sent == []


@each("goes_on", [False, True])
def test_a_device_that_is_waited_for_cannot_be_asked_for_a_rule(*, goes_on: bool) -> None:
    rules = release_of(IMAGE, BMS, hardware_versions=["V1*"])
    dialogue = Dialogue(
        UpgradeOptions(at_power_up=True), identity=Identity(rules, reports_unchecked=goes_on)
    )
    dialogue.wait(1.0)
    assert dialogue.sent == []
    if goes_on:
        dialogue.say(BOOT)
        dialogue.expect(UpdateCommand)
    else:
        assert dialogue.ended.ending is Ending.UNCHECKED
        assert dialogue.seen(events.PowerCycleAwaited) == []


def test_one_that_may_sit_in_its_session_is_asked_at_power_up_too() -> None:
    dialogue = Dialogue(replace(OPEN, at_power_up=True), identity=Identity())
    assert dialogue.asked() == 0x3300


def test_two_different_answers_end_it_before_the_reset() -> None:
    dialogue = Dialogue(identity=Identity())
    assert dialogue.asked() == 0x3300
    dialogue.answers(VERSION, version())
    dialogue.answers(VERSION, version(serial="W2"))
    assert dialogue.asked() == 0x3400
    dialogue.answers(RUNNING, BATTERY)
    dialogue.wait(3.0)
    assert dialogue.ended.ending is Ending.TWO_DEVICES
    assert "serial number W1 / W2" in dialogue.ended.detail
    assert dialogue.result.exit_code == ExitCode.WRONG_DEVICE


def test_a_device_that_announces_itself_while_it_is_asked_gets_the_reset_once_more() -> None:
    dialogue = Dialogue(identity=Identity())
    assert dialogue.asked() == 0x3300
    dialogue.say(BOOT)
    dialogue.expect(ResetCommand)
    dialogue.expect(UpdateCommand, within_s=0.1)
    assert dialogue.seen(events.BootVersionSeen) == [events.BootVersionSeen("BMS", "V1.2.3")]


@each("timeout_s, at_s", [(0.05, 0.05), (0.5, 0.5)])
def test_the_deadline_while_it_listens_or_asks_is_the_deadline(
    timeout_s: float, at_s: float
) -> None:
    dialogue = Dialogue(UpgradeOptions(timeout_s=timeout_s), identity=Identity())
    dialogue.wait(2.0)
    assert dialogue.ended.ending is Ending.OUT_OF_TIME
    assert dialogue.ended.statistics.duration_s == pytest.approx(at_s, abs=0.01)
    assert dialogue.ended.phase is (Phase.LISTEN if at_s < LISTEN_FIRST_S else Phase.IDENTIFY)


def test_the_user_ends_it_while_it_listens_or_asks() -> None:
    for wait_s, phase in ((0.05, Phase.LISTEN), (0.5, Phase.IDENTIFY)):
        dialogue = Dialogue(identity=Identity())
        dialogue.wait(wait_s)
        dialogue.engine.cancel(dialogue.now)
        assert dialogue.ended.ending is Ending.CANCELLED
        assert dialogue.ended.phase is phase
        assert dialogue.ended.statistics.duration_s == pytest.approx(wait_s)


def test_another_tool_ends_it_while_it_listens() -> None:
    dialogue = Dialogue(identity=Identity())
    dialogue.wait(0.05)
    dialogue.engine.receive(OTHER_TOOL, dialogue.now)
    assert dialogue.ended.ending is Ending.SECOND_TOOL
    assert dialogue.ended.detail.startswith("frame 55 aa 16 05 42 05 01 ff with id 0x752")
    assert dialogue.ended.phase is Phase.LISTEN
    assert dialogue.result.exit_code == ExitCode.BUS


# -- a device that may sit in an open session -----------------------------------------------------


@each(
    "can_id, is_application",
    [(0x720, True), (0x723, True), (0x721, True), (0x710, False), (0x725, False)],
)
def test_an_application_that_sends_is_in_no_session(can_id: int, *, is_application: bool) -> None:
    dialogue = Dialogue(OPEN)
    dialogue.expect(ResetCommand)
    dialogue.engine.receive(Frame(can_id, b"\x05"), dialogue.now)
    dialogue.wait(60.0)
    updates = [row for row in dialogue.unread if isinstance(row, UpdateCommand)]
    assert len(updates) == (not is_application)


def test_a_frame_that_is_no_payload_is_no_application() -> None:
    dialogue = Dialogue(OPEN)
    dialogue.expect(ResetCommand)
    dialogue.engine.receive(Frame(0x720, b"", is_remote=True), dialogue.now)
    dialogue.wait(60.0)
    assert [row for row in dialogue.unread if isinstance(row, UpdateCommand)]


@each("answers", [True, False])
def test_one_that_answers_a_question_is_in_no_session(*, answers: bool) -> None:
    dialogue = Dialogue(OPEN, identity=Identity())
    if answers:
        # On the tool's own id, as a product's own query may be answered: no sign of an application.
        dialogue.session._application_ids = frozenset()
        dialogue.identified()
    dialogue.wait(60.0)
    updates = [row for row in dialogue.unread if isinstance(row, UpdateCommand)]
    assert len(updates) == (not answers)


# -- the adapter ----------------------------------------------------------------------------------


@each("attempts, losses", [(1, 0), (2, 1), (3, 2), (None, 2)])
def test_an_adapter_may_be_lost_once_for_each_attempt_but_the_last(
    attempts: int | None, losses: int
) -> None:
    dialogue = Dialogue(UpgradeOptions(attempts=attempts))
    dialogue.expect(ResetCommand)
    for _ in range(losses):
        assert dialogue.may_begin_again()
        dialogue.session.link_back(dialogue.now)
        dialogue.expect(ResetCommand)
    assert not dialogue.may_begin_again()


def test_an_adapter_may_be_lost_as_often_as_it_likes_where_nothing_can_be_lost() -> None:
    dialogue = Dialogue()
    assert Dialogue().session.goes_on is False
    dialogue.to_packet(1)
    assert dialogue.session.goes_on is True
    for _ in range(9):
        assert dialogue.may_begin_again()
        dialogue.session.link_back(dialogue.now)
        dialogue.expect(Packet)
    dialogue.engine.cancel(dialogue.now)
    dialogue.wait(1.0)
    assert not dialogue.may_begin_again(), "it is over"


def test_questions_are_asked_anew_when_the_adapter_is_back() -> None:
    dialogue = Dialogue(identity=Identity())
    assert dialogue.asked() == 0x3300
    assert dialogue.may_begin_again()
    dialogue.session.link_back(dialogue.now + 3.0)
    assert dialogue.session.now == dialogue.now + 3.0
    dialogue.now += 3.0
    dialogue._flush()
    assert dialogue.session.progress == "listening for another tool"
    dialogue.identified()
    dialogue.expect(ResetCommand)


def test_a_lost_adapter_does_not_disturb_a_verification() -> None:
    dialogue = to_verification()
    dialogue.session.link_back(dialogue.now)
    dialogue.wait(0.3)
    dialogue.answers(VERSION, version(NEW))
    dialogue.wait(1.0)
    dialogue.answers(VERSION, version(NEW))
    dialogue.wait(1.0)
    assert dialogue.result.verification.verdict is Verdict.VERSION_RIGHT


def to_verification(options: UpgradeOptions | None = None) -> Dialogue:
    dialogue = Dialogue(options, level=Level.VERSION)
    dialogue.to_packet(1)
    dialogue.say(Ack(1))
    dialogue.expect(EndOfTransfer)
    assert dialogue.session.has_begun_to_erase
    dialogue.say(Complete())
    assert dialogue.session.progress == "listening for a second device"
    dialogue.wait(SECOND_DEVICE_WAIT_S)
    assert dialogue.session.progress == "verifying by version"
    assert dialogue.session.device_left is DeviceLeft.NEW
    assert dialogue.asked() == 0x3300
    return dialogue


def test_the_deadline_in_the_verification_leaves_it_without_an_answer() -> None:
    dialogue = to_verification(UpgradeOptions(timeout_s=2.0))
    dialogue.wait(3.0)
    found = dialogue.result.verification
    assert found.verdict is Verdict.NO_ANSWER
    assert found.detail == "the overall deadline passed"
    assert dialogue.now >= 102.0
    dialogue = to_verification()
    dialogue.engine.cancel(dialogue.now)
    dialogue.wait(1.0)
    assert dialogue.result.verification.verdict is Verdict.INTERRUPTED


# -- another tool ---------------------------------------------------------------------------------


def test_a_query_of_another_tool_in_the_transfer_is_reported_by_its_title_once() -> None:
    dialogue = Dialogue()
    dialogue.to_packet(1)
    for command in (0x3300, 0x3300, 0x7700, 0x3400):
        for frame in split(0x752, encode(Message(0x752, 0x11, command, b""))):
            dialogue.engine.receive(frame, dialogue.now)
    dialogue.events += dialogue.engine.take_events()
    assert dialogue.seen(events.ForeignQuery) == [
        events.ForeignQuery("read version information"),
        events.ForeignQuery("query 7700"),
        events.ForeignQuery("read running information"),
    ]


def test_a_query_of_another_tool_before_the_update_command_ends_it() -> None:
    dialogue = Dialogue()
    dialogue.to_boot()
    for frame in split(0x752, encode(Message(0x752, 0x11, 0x3300, b""))):
        dialogue.engine.receive(frame, dialogue.now)
    assert dialogue.ended.ending is Ending.SECOND_TOOL
    dialogue = Dialogue()
    dialogue.to_request()
    for frame in split(0x752, encode(Message(0x752, 0x11, 0x3300, b""))):
        dialogue.engine.receive(frame, dialogue.now)
    assert not dialogue.session.done
    assert dialogue.session.has_begun_to_erase


@each("end", [Ending.CANCELLED, Ending.COMPLETED])
def test_a_battery_that_switches_off_is_reported_and_kept(end: Ending) -> None:
    dialogue = Dialogue(identity=Identity() if end is Ending.CANCELLED else None)
    shutdown = catalogue.encode(SHUTDOWN, SHUTDOWN.content())
    for _ in range(2):
        dialogue.say(shutdown)
    dialogue.wait(0.05)
    assert dialogue.seen(events.ShutdownHeard) == [events.ShutdownHeard("BMS")]
    if end is Ending.CANCELLED:
        dialogue.engine.cancel(dialogue.now)
    else:
        dialogue.to_packet(1)
        dialogue.say(Ack(1))
        dialogue.expect(EndOfTransfer)
        dialogue.say(Complete())
        dialogue.wait(SECOND_DEVICE_WAIT_S)
    assert dialogue.ended.ending is end
    assert dialogue.result.shutdown_heard is True


# -- a rule that the silent device could not be asked for -----------------------------------------


def ruled() -> Identity:
    return Identity(release_of(IMAGE, BMS, hardware_versions=["V1*"]))


def test_a_silent_device_that_may_sit_in_its_session_is_not_refused_by_a_rule_yet() -> None:
    dialogue = Dialogue(OPEN, identity=ruled())
    dialogue.wait(2.0)
    noted = {e.check: e for e in dialogue.events if isinstance(e, events.CheckMade)}
    assert noted["hardware"].verdict == "warned"
    assert noted["hardware"].text.endswith(": only a device in an open session is upgraded")
    assert noted["other-target"].verdict == "passed"
    dialogue.wait(12.0)
    assert isinstance(dialogue.unread[-1], UpdateCommand)
    dialogue._read = len(dialogue.sent)
    dialogue.say(RequestTransfer())
    assert dialogue.expect(Packet).number == 1


def test_it_is_refused_when_it_announces_itself_after_all() -> None:
    dialogue = Dialogue(OPEN, identity=ruled())
    dialogue.wait(2.0)
    dialogue.say(BOOT)
    dialogue.wait(1.0)
    assert dialogue.ended.ending is Ending.UNCHECKED
    assert dialogue.ended.waiver == "hardware"
    assert dialogue.ended.device_left is DeviceLeft.UNTOUCHED


@each("options, announces", [(OPEN, True), (None, False), (None, True)])
def test_one_that_is_in_no_session_is_refused_at_once(
    options: UpgradeOptions | None, *, announces: bool
) -> None:
    dialogue = Dialogue(options, identity=ruled())
    assert dialogue.asked() == 0x3300
    if announces:
        dialogue.say(BOOT)
    dialogue.wait(2.0)
    assert dialogue.ended.ending is Ending.UNCHECKED
    assert not [row for row in dialogue.unread if isinstance(row, ResetCommand)]


def test_other_findings_refuse_a_silent_device_as_ever() -> None:
    odd = replace(IMAGE, data=b"PK\3\4" + IMAGE.data[4:])
    dialogue = Dialogue(OPEN, identity=Identity(replace(release_of(odd, BMS), target=OBC)))
    assert dialogue.ended.ending is Ending.NOT_FOR_DEVICE


# -- after the end --------------------------------------------------------------------------------


def test_time_without_the_adapter_after_the_end_is_unobserved() -> None:
    dialogue = Dialogue()
    dialogue.to_packet(1)
    dialogue.say(Ack(1))
    dialogue.expect(EndOfTransfer)
    dialogue.say(Complete())
    dialogue.session.link_back(dialogue.now + 1.4)
    dialogue.wait(1.6)
    assert dialogue.result.ok
    assert dialogue.result.outcome.unobserved_s == pytest.approx(1.4)


def test_a_second_device_that_goes_on_after_the_end_is_no_success() -> None:
    dialogue = Dialogue(level=Level.VERSION)
    dialogue.to_packet(1)
    dialogue.say(Ack(1))
    dialogue.expect(EndOfTransfer)
    dialogue.say(Complete())
    dialogue.wait(0.05)
    assert dialogue.session.goes_on is False, "nothing is left to be tried"
    dialogue.say(Nak(1))
    dialogue.wait(0.1)
    found = dialogue.result.verification
    assert (found.level, found.verdict) == (Level.VERSION, Verdict.TWO_DEVICES)
    assert found.detail == "one device continued a transfer that another one had completed"
    assert found.running_version is None


def test_a_device_that_was_not_asked_has_no_version_before_the_upgrade() -> None:
    dialogue = Dialogue(UpgradeOptions(at_power_up=True))
    dialogue.say(BOOT)
    dialogue.expect(UpdateCommand)
    dialogue.say(RequestTransfer())
    dialogue.expect(Packet)
    dialogue.say(Ack(1))
    dialogue.expect(EndOfTransfer)
    dialogue.say(Complete())
    dialogue.wait(SECOND_DEVICE_WAIT_S)
    assert dialogue.result.ok
    assert dialogue.result.previous_version is None


def test_attempts_that_were_limited_limit_lost_adapters_in_the_transfer_too() -> None:
    dialogue = Dialogue(UpgradeOptions(attempts=3))
    dialogue.to_packet(1)
    for _ in range(2):
        assert dialogue.may_begin_again()
        dialogue.session.link_back(dialogue.now)
        assert dialogue.expect(Packet).number == 1
    assert not dialogue.may_begin_again()


def test_a_question_that_was_cut_short_is_not_gone_on_with() -> None:
    session = UpgradeSession(PLAN, identity=Identity())
    session.tick(0.0)
    session.tick(LISTEN_FIRST_S)
    first = session.next_frame(LISTEN_FIRST_S)
    assert first is not None
    session.frame_sent(LISTEN_FIRST_S)
    session.link_back(LISTEN_FIRST_S)
    assert session.next_frame(LISTEN_FIRST_S) is None
    session.tick(2 * LISTEN_FIRST_S)
    assert session.next_frame(2 * LISTEN_FIRST_S) == first


# -- why no device answered -----------------------------------------------------------------------


@each(
    "ending, stalled_s, shutdown, begins",
    [
        (Ending.NO_BOOT_VERSION, 0.0, False, "the device has no power"),
        (Ending.NO_BOOT_VERSION, 2.04, False,
         "this computer paused for 2.0 s meanwhile; else the device has no power"),
        (Ending.NO_BOOT_VERSION, 0.0, True,
         "the battery sent SHUTDOWN and switched off; else the device has no power"),
        (Ending.NO_BOOT_VERSION, 2.04, True,
         "the battery sent SHUTDOWN and switched off; else this computer paused for 2.0 s"),
        (Ending.NOT_FOR_DEVICE, 2.04, True, "another file was meant"),
    ],
)  # fmt: skip
def test_a_pause_or_a_shutdown_is_a_cause_only_where_no_device_answered(
    ending: Ending, stalled_s: float, begins: str, *, shutdown: bool
) -> None:
    outcome = ended_before_start(PLAN, ending, "", duration_s=1.0)
    error = Result(outcome, shutdown_heard=shutdown, stalled_s=stalled_s).error()
    assert error is not None
    assert error.cause.startswith(begins)


def test_the_error_of_another_tool_has_its_code() -> None:
    error = Result(ended_before_start(PLAN, Ending.SECOND_TOOL, "", duration_s=1.0)).error()
    assert error is not None
    assert error.code is ErrorCode.SECOND_TOOL


def test_a_request_that_comes_in_time_goes_on_after_a_lost_adapter() -> None:
    dialogue = Dialogue(UpgradeOptions(attempts=1))
    dialogue.to_request()
    assert not dialogue.may_begin_again()
    dialogue.session.link_back(dialogue.now)
    dialogue.say(RequestTransfer())
    assert dialogue.expect(Packet).number == 1
