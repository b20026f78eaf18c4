"""Upgrade, wait for the new application, verification: one machine, one result."""

from __future__ import annotations

import random
from dataclasses import replace
from math import inf

import pytest

from flasher import events
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import Disturbance, SimulatedBus
from flasher.driver import drive
from flasher.errors import ErrorCode, ExitCode, UsageError, WrongDeviceError
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.runner import Runner
from flasher.host.session import Result, UpgradeSession
from flasher.host.table import Ending
from flasher.host.verify import (
    Level,
    Verdict,
    Verification,
    as_level,
    check_version,
    memory_check,
    possible_levels,
    version_check,
)
from flasher.image.image import Image
from flasher.image.plan import Plan, plan
from flasher.mock.bms import BmsApplication
from flasher.mock.model import MockDevice
from flasher.protocol import catalogue
from flasher.protocol.contents import Memory, ReadMemory, SerialNumber, VersionInformation
from flasher.protocol.fields import Content, WireText
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BMS, OBC, TARGETS, WELLING, WMC
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, Reassembler, encode, split
from tests.end_to_end.stage import Stage
from tests.loops import each

NEW = "V2r0r1_20260102"
BASE = 0x0800_8000
BYTES = b"\x00\x50\x00\x20BMS\0" + NEW.encode() + b"\0" + random.Random(4).randbytes(300)
IMAGE = Image.from_bytes(BYTES, base=BASE)


def planned(image: Image = IMAGE) -> Plan:
    return plan(image, BMS, WELLING.bitrate_bps)


def run(
    level: Level,
    image: Image = IMAGE,
    target: str = "bms",
    disturbance: Disturbance | None = None,
) -> tuple[Result, list[object]]:
    """A session with the device model."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock, disturbance)
    bus.attach(MockDevice(TARGETS[target], bitrate_bps=WELLING.bitrate_bps))
    session = UpgradeSession(plan(image, TARGETS[target], WELLING.bitrate_bps), level=level)
    seen: list[object] = []
    drive(session, bus.link(), clock, on_event=seen.append)
    return session.result, seen


def test_the_new_version_is_asked_for_and_right() -> None:
    result, seen = run(Level.VERSION)
    assert result.ok
    assert result.verification.verdict is Verdict.VERSION_RIGHT
    assert result.running_version == NEW
    assert result.error() is None
    assert events.VerificationStarted("version") in seen


def test_without_verification_nothing_is_asked_and_nothing_is_claimed() -> None:
    result, seen = run(Level.NONE)
    assert result.ok
    assert result.verification.verdict is Verdict.NOT_ASKED
    assert result.running_version is None
    assert not [event for event in seen if isinstance(event, events.VerificationStarted)]


def test_another_version_than_the_image_names_is_exit_code_10() -> None:
    result, _ = run(Level.VERSION, replace(IMAGE, version="V9r9r9_20990101"))
    assert result.outcome.ok
    assert not result.ok
    error = result.error()
    assert error is not None
    assert error.exit_code == ExitCode.VERIFICATION
    assert f"{NEW} instead of V9r9r9_20990101" in str(error)
    assert "completed, but" in str(error)


def test_an_image_without_a_version_is_not_compared_and_that_is_reported() -> None:
    result, _ = run(Level.VERSION, Image.from_bytes(bytes(200)))
    assert result.ok
    assert result.verification.verdict is Verdict.VERSION_UNJUDGED


def test_a_failed_upgrade_is_not_verified() -> None:
    result, seen = run(Level.VERSION, disturbance=lambda _frame, _now: [])
    assert not result.ok
    assert result.verification.verdict is Verdict.NOT_ASKED
    error = result.error()
    assert error is not None
    assert error.exit_code == ExitCode.NO_ANSWER
    assert not [event for event in seen if isinstance(event, events.VerificationStarted)]


def test_an_application_that_does_not_answer_is_exit_code_10_in_bounded_time() -> None:
    result, _ = run(
        Level.VERSION, disturbance=lambda frame, _now: [] if frame.can_id == 0x720 else [frame]
    )
    assert result.outcome.ok
    assert result.verification.verdict is Verdict.NO_ANSWER
    assert result.outcome.device_left is DeviceLeft.UNKNOWN
    error = result.error()
    assert error is not None
    assert error.exit_code == ExitCode.VERIFICATION
    assert error.needs_rescue


def test_the_version_answer_that_replaced_a_lost_final_answer_is_counted_too() -> None:
    complete = bytes.fromhex("55AA0C04C5020000")
    result, seen = run(
        Level.VERSION,
        disturbance=lambda frame, _now: [] if frame.data == complete else [frame],
    )
    assert result.ok
    assert result.verification.verdict is Verdict.VERSION_RIGHT
    assert events.VerificationStarted("version") in seen


def test_only_the_bms_has_queries_to_verify_with() -> None:
    assert possible_levels(BMS) == (Level.NONE, Level.VERSION, Level.MEMORY)
    assert possible_levels(WMC) == possible_levels(OBC) == (Level.NONE,)


def test_the_result_cannot_be_read_before_there_is_one() -> None:
    with pytest.raises(RuntimeError, match="not ended"):
        _ = UpgradeSession(planned()).result


# -- the checks, with the test in the place of the application -------------------------------------


class Application:
    """Lets time pass for a check and answers what it asks."""

    def __init__(self, check: Runner[Verification]) -> None:
        self.check = check
        self.now = 50.0
        self.asked: list[Content] = []
        self.announces_at: list[float] = []
        """Times at which a bootloader announces itself."""
        self._wire = Reassembler(BMS.request_id, 1.0)

    def next_question(self) -> Content | None:
        """What is asked next; None when the check is done."""
        while not self.check.done:
            wanted = self.check.deadline()
            assert wanted is not None
            if self.announces_at and self.announces_at[0] <= max(self.now, wanted):
                self.now = max(self.now, self.announces_at.pop(0))
                for piece in ANNOUNCEMENT:
                    self.check.receive(piece, self.now)
            else:
                self.now = max(self.now, wanted)
            self.check.tick(self.now)
            while (frame := self.check.next_frame(self.now)) is not None:
                self.check.frame_sent(self.now)
                for found in self._wire.feed(frame.data, self.now):
                    assert isinstance(found, Message)
                    decoded = catalogue.decode(found)
                    assert decoded is not None
                    self.asked.append(decoded.content)
                    return decoded.content
        return None

    def answer(self, key: tuple[int, int], content: Content) -> None:
        self.now += 0.005
        message = catalogue.encode(catalogue.BY_KEY[key], content)
        for frame in split(message.can_id, encode(message)):
            self.check.receive(frame, self.now)


BOOT_VERSION = BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)
ANNOUNCEMENT = split(BOOT_VERSION.can_id, encode(BOOT_VERSION))
VERSION = (0x720, 0x1540)


def version(serial: str) -> VersionInformation:
    texts = ("BM36", serial, "V1r0r0_20200101", NEW)
    return VersionInformation(*(WireText(encode_text(each, 16)) for each in texts))


NEW_VERSION = version("W1")
MEMORY = (0x725, 0x5688)


def memory(question: Content, data: bytes = BYTES) -> Memory:
    assert isinstance(question, ReadMemory)
    piece = data[question.start - BASE : question.end - BASE]
    return Memory(question.start, question.end, piece.ljust(128, b"\xff"))


def read_all(application: Application, data: bytes = BYTES) -> None:
    while (question := application.next_question()) is not None:
        application.answer(MEMORY, memory(question, data))


def test_the_memory_is_read_piece_by_piece_and_compared() -> None:
    check = memory_check(planned(), UpgradeOptions(), NEW)
    application = Application(check)
    read_all(application)
    assert check.result.verdict is Verdict.MEMORY_RIGHT
    assert check.result.running_version == NEW
    ends = [question.end for question in application.asked if isinstance(question, ReadMemory)]
    assert ends == [BASE + 128, BASE + 256, BASE + len(BYTES)]
    assert check.take_events() == [
        events.MemoryRead(128, len(BYTES)),
        events.MemoryRead(256, len(BYTES)),
        events.MemoryRead(len(BYTES), len(BYTES)),
    ]


def test_an_image_that_lies_at_zero_is_read_from_there() -> None:
    check = memory_check(planned(Image.from_bytes(BYTES, base=0)), UpgradeOptions(), NEW)
    application = Application(check)
    while (question := application.next_question()) is not None:
        assert isinstance(question, ReadMemory)
        piece = BYTES[question.start : question.end].ljust(128, b"\xff")
        application.answer(MEMORY, Memory(question.start, question.end, piece))
    assert check.result.verdict is Verdict.MEMORY_RIGHT


@each("size_bytes, verdict", [(200, Verdict.INTERRUPTED), (100, Verdict.MEMORY_RIGHT)])
def test_a_memory_check_that_is_cancelled_after_an_answer_is_cancelled_unless_it_has_all(
    size_bytes: int, verdict: Verdict
) -> None:
    """The question was repeated: the answer to the other copy may still come."""
    image = Image.from_bytes(BYTES[:size_bytes], base=BASE)
    check = memory_check(planned(image), UpgradeOptions(), NEW)
    application = Application(check)
    question = application.next_question()
    assert application.next_question() == question
    assert question is not None
    application.answer(MEMORY, memory(question))
    assert not check.done
    check.cancel(application.now)
    assert check.result == Verification(
        Level.MEMORY, verdict, NEW if verdict is Verdict.MEMORY_RIGHT else None
    )


def test_a_memory_check_that_is_cancelled_in_a_question_is_reported_as_cancelled() -> None:
    check = memory_check(planned(), UpgradeOptions(), NEW)
    Application(check).next_question()
    check.cancel(0.1)
    assert check.result == Verification(Level.MEMORY, Verdict.INTERRUPTED)


def test_there_is_no_other_verification() -> None:
    with pytest.raises(UsageError, match="'hash'; the levels are none, version, memory"):
        as_level("hash")


def test_the_first_difference_is_named() -> None:
    other = bytearray(BYTES)
    other[200] ^= 0xFF
    other[250] ^= 0xFF
    check = memory_check(planned(), UpgradeOptions(), NEW)
    read_all(Application(check), bytes(other))
    assert check.result.verdict is Verdict.MEMORY_OTHER
    where = f"0x{BASE + 200:08X}: {other[200]:02X} instead of {BYTES[200]:02X}"
    assert where in check.result.detail
    error = check.result.error(BMS)
    assert error is not None
    assert error.exit_code == ExitCode.VERIFICATION


@each(
    "changed, ranges",
    [
        ([200], [(200, 1)]),
        ([0, len(BYTES) - 1], [(0, 1), (len(BYTES) - 1, 1)]),
        ([126, 127, 128, 129], [(126, 4)]),  # across two answers
        ([10, 26], [(10, 17)]),  # 15 equal bytes do not separate
        ([10, 28], [(10, 1), (28, 1)]),
        (list(range(len(BYTES))), [(0, len(BYTES))]),
    ],
)
def test_every_range_that_differs_is_found(
    changed: list[int], ranges: list[tuple[int, int]]
) -> None:
    other = bytearray(BYTES)
    for at in changed:
        other[at] ^= 0xFF
    check = memory_check(planned(), UpgradeOptions(), NEW)
    read_all(Application(check), bytes(other))
    found = [(span.start - BASE, span.size_bytes) for span in check.result.differing]
    assert found == ranges


@each(
    "verdict, exit_code",
    [
        (Verdict.VERSION_OTHER, ExitCode.VERIFICATION),
        (Verdict.MEMORY_OTHER, ExitCode.VERIFICATION),
        (Verdict.IN_BOOTLOADER, ExitCode.VERIFICATION),
        (Verdict.NO_ANSWER, ExitCode.NO_ANSWER),
        (Verdict.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (Verdict.SECOND_TOOL, ExitCode.BUS),
    ],
)
def test_a_comparison_without_an_upgrade_claims_no_completion(
    verdict: Verdict, exit_code: ExitCode
) -> None:
    error = Verification(Level.VERSION, verdict).error(BMS, is_after_upgrade=False)
    assert error is not None
    assert error.exit_code == exit_code
    assert "completed" not in str(error)
    assert not error.needs_rescue
    assert "half of it" not in str(error), "nothing was sent to either"


def test_an_answer_for_another_address_is_not_taken() -> None:
    check = memory_check(planned(), UpgradeOptions(), NEW)
    application = Application(check)
    question = application.next_question()
    assert isinstance(question, ReadMemory)
    application.answer(MEMORY, Memory(question.start + 1, question.end, bytes(128)))
    assert not check.done
    application.answer(MEMORY, memory(question))
    read_all(application)
    verification = check.result
    assert verification.ok


def test_memory_that_is_not_given_ends_in_bounded_time() -> None:
    check = memory_check(planned(), UpgradeOptions(), NEW)
    application = Application(check)
    while application.next_question() is not None:
        pass
    assert check.result.verdict is Verdict.NO_ANSWER
    assert f"0x{BASE:08X}" in check.result.detail
    assert application.now < 50.0 + 2.0


def test_an_image_without_a_base_cannot_be_read_back() -> None:
    with pytest.raises(ValueError, match="base"):
        memory_check(planned(Image.from_bytes(BYTES)), UpgradeOptions(), None)


def test_an_application_that_starts_slowly_is_waited_for() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    while application.now < 53.0:
        assert application.next_question() is not None
    application.answer(VERSION, NEW_VERSION)
    assert application.next_question() is not None, "it is asked again, to count its answers"
    application.answer(VERSION, NEW_VERSION)
    assert application.next_question() is None
    assert check.result.verdict is Verdict.VERSION_RIGHT


_BURST_S = 4 * 0.05


@each(
    "begins_s, pause_s, bursts, verdict",
    [
        (0.3, 0.2, 40, Verdict.IN_BOOTLOADER),
        (0.3, 2.0, 3, Verdict.IN_BOOTLOADER),
        (4.7, 0.2, 40, Verdict.IN_BOOTLOADER),
        (0.3, 0.2, 1, Verdict.NO_ANSWER),
        (0.3, 0.2, 2, Verdict.NO_ANSWER),
        (0.3, 0.9, 2, Verdict.NO_ANSWER),
        (0.3, 4.5, 2, Verdict.NO_ANSWER),
        (4.7, 0.2, 1, Verdict.NO_ANSWER),
    ],
)
def test_a_bootloader_that_announces_itself_beyond_a_burst_runs_no_application(
    begins_s: float, pause_s: float, bursts: int, verdict: Verdict
) -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.announces_at = [
        50.0 + begins_s + burst * (_BURST_S + pause_s) + number * 0.05
        for burst in range(bursts)
        for number in range(4)
    ]
    while application.next_question() is not None:
        pass
    assert check.result.verdict is verdict
    assert application.now < 50.0 + 13.0


@each("starts_at, is_right", [(54.95, True), (54.99, True), (56.5, False)])
def test_an_application_may_start_up_to_the_limit(starts_at: float, *, is_right: bool) -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    while application.next_question() is not None:
        if application.now >= starts_at:
            application.answer(VERSION, NEW_VERSION)
    assert (check.result.verdict is Verdict.VERSION_RIGHT) is is_right


def test_an_application_is_asked_after_a_pause_of_this_computer_as_long_as_the_limit() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.next_question()
    application.now += 5.0
    while application.next_question() is not None:
        application.answer(VERSION, NEW_VERSION)
    assert check.result.verdict is Verdict.VERSION_RIGHT


def test_an_application_that_starts_after_the_bootloader_announced_itself_late_is_right() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.announces_at = [54.8]
    while application.next_question() is not None:
        if application.now > 59.5:
            application.answer(VERSION, NEW_VERSION)
    assert check.result.verdict is Verdict.VERSION_RIGHT


@each(
    "restart_s, verdict, version",
    [
        (0.5, Verdict.VERSION_RIGHT, NEW),
        (inf, Verdict.NO_ANSWER, None),
    ],
)
def test_a_device_that_restarts_after_its_version_answer_is_asked_again(
    restart_s: float, verdict: Verdict, version: str | None
) -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.announces_at = [50.03 + number * 0.05 for number in range(4)]
    while application.next_question() is not None:
        if not 50.02 < application.now < 50.2 + restart_s:
            application.answer(VERSION, NEW_VERSION)
    assert (check.result.verdict, check.result.running_version) == (verdict, version)


def test_a_boot_version_read_at_the_same_moment_as_the_answer_before_it_counts() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.next_question()
    application.answer(VERSION, NEW_VERSION)
    for piece in ANNOUNCEMENT:
        check.receive(piece, application.now)
    assert application.next_question() is not None, "its answers are counted"
    application.answer(VERSION, NEW_VERSION)
    assert application.next_question() is not None, "it is asked again"


def test_all_that_came_in_a_pause_of_this_computer_is_read_before_the_verdict() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    for _ in range(2):
        application.next_question()
        application.answer(VERSION, NEW_VERSION)
    application.now += 1.0
    application.answer(VERSION, NEW_VERSION)
    application.answer(VERSION, version("W2"))
    assert application.next_question() is None
    assert check.result.verdict is Verdict.TWO_DEVICES


def test_a_bootloader_that_announces_itself_beside_the_new_application_is_a_second_device() -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    application.announces_at = [50.09 + number * 0.05 for number in range(40)]
    while application.next_question() is not None:
        application.answer(VERSION, NEW_VERSION)
    assert check.result.verdict is Verdict.TWO_DEVICES


@each(
    "before, now, verdict",
    [
        ("W1", "W2", Verdict.OTHER_UNIT),
        ("W1", "W1", Verdict.VERSION_RIGHT),
        ("", "W2", Verdict.VERSION_RIGHT),
        ("W1", "", Verdict.VERSION_RIGHT),
    ],
)
def test_an_application_with_another_serial_number_than_before_is_another_unit(
    before: str, now: str, verdict: Verdict
) -> None:
    options = UpgradeOptions()
    check = Runner[Verification](
        lambda run: check_version(run, planned(), options, before),
        bitrate_bps=planned().bitrate_bps,
        timings=options.timings,
    )
    application = Application(check)
    while application.next_question() is not None:
        application.answer(VERSION, version(now))
    assert check.result.verdict is verdict
    assert check.result.running_version == NEW


def test_a_unit_that_is_exchanged_during_the_upgrade_is_exit_code_6() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps)
    application = device.application
    assert isinstance(application, BmsApplication)
    bus.attach(device)
    session = UpgradeSession(
        planned(), level=Level.VERSION, identity=Identity(waived=frozenset(IdentityCheck))
    )

    def exchange(event: object) -> None:
        if isinstance(event, events.VerificationStarted):
            other = SerialNumber(WireText(encode_text("W9", 16)))
            application.kept["serial number"] = other

    drive(session, bus.link(), clock, on_event=exchange)
    error = session.result.error()
    assert isinstance(error, WrongDeviceError)
    assert error.code is ErrorCode.OTHER_UNIT
    assert "serial number W9, it was W2605001 before the upgrade" in str(error)
    assert session.result.outcome.is_completed
    assert session.result.outcome.device_left is DeviceLeft.UNKNOWN


@each("level", [Level.NONE, Level.VERSION])
def test_the_version_of_another_unit_replaces_no_lost_final_answer(level: Level) -> None:
    """The first unit is still checking its image when another one is switched on."""
    stage = Stage()
    application = stage.device.application
    assert isinstance(application, BmsApplication)
    complete = bytes.fromhex("55AA0C04C5020000")
    stage.disturb = lambda frame, _now: [] if frame.data == complete else [frame]

    def exchange() -> None:
        if isinstance(stage.events[-1], events.PhaseEntered):
            phase = stage.events[-1].phase
            if phase is events.Phase.CONFIRM:
                other = SerialNumber(WireText(encode_text("W9", 16)))
                application.kept["serial number"] = other

    stage.at_event[events.PhaseEntered] = exchange
    result = stage.flash(verify=level, identity=Identity(waived=frozenset(IdentityCheck)))
    assert result.outcome.ending is Ending.UNCONFIRMED
    assert result.exit_code == ExitCode.UNCONFIRMED
    assert result.outcome.running_version is None
    assert "serial number W9, it was W2605001 before the upgrade" in str(result.error())


@each("sends_until_s, runs", [(60.0, True), (40.0, False)])
def test_an_application_that_sends_when_a_power_cycle_is_awaited_was_not_switched_off(
    *, sends_until_s: float, runs: bool
) -> None:
    session = UpgradeSession(planned(), UpgradeOptions(at_power_up=True))
    now = 0.0
    while not session.done:
        session.tick(now)
        if now < sends_until_s:
            session.receive(Frame(BMS.broadcast_id, b"\x55"), now)
        now += 1.0
    error = session.result.error()
    assert error is not None
    assert error.code is ErrorCode.NO_ANNOUNCEMENT
    assert ("its application runs" in error.cause) is runs
    assert ("flasher flash" in error.remedy) is runs


@each("version, verdict", [(NEW, Verdict.INTERRUPTED), ("V1r0r0_20200101", Verdict.VERSION_OTHER)])
def test_a_version_check_that_is_cancelled_after_an_answer_asks_no_more(
    version: str, verdict: Verdict
) -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    assert application.next_question() is not None
    texts = [WireText(encode_text(text, 16)) for text in ("BM36", "W1", "V1r0r0_20200101", version)]
    application.answer(VERSION, VersionInformation(*texts))
    assert application.next_question() is not None
    check.cancel(application.now)
    assert application.next_question() is None
    assert check.done
    assert check.result.verdict is verdict
    assert check.result.running_version == version


@each("asked", [True, False])
def test_cancelling_a_check_states_that_the_upgrade_was_complete(*, asked: bool) -> None:
    check = version_check(planned(), UpgradeOptions())
    application = Application(check)
    if asked:
        application.next_question()
    check.cancel(application.now)
    error = check.result.error(BMS)
    assert error is not None
    assert error.exit_code == ExitCode.INTERRUPTED
    assert "completed, but" in str(error)
    assert check.deadline() is None


def test_frames_before_the_beginning_and_after_the_end_are_nothing_to_a_check() -> None:
    check = version_check(planned(), UpgradeOptions())
    check.receive(Frame(0x720, b"\x55\xaa"), 0.0)
    assert check.next_frame(0.0) is None
    check.cancel(0.0)
    check.tick(1.0)
    assert check.done
