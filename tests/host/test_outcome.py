"""The error of each ending: exit code, error code, where, cause and next step."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import pytest

from flasher.errors import ErrorCode, ExitCode, UsageError
from flasher.events import Phase
from flasher.host.outcome import (
    DeviceLeft,
    Outcome,
    Statistics,
    describe_progress,
    ended_before_start,
)
from flasher.host.table import Ending
from flasher.host.verify import (
    GOOD,
    Level,
    Verdict,
    Verification,
    as_level,
    check_level,
    default_level,
    possible_levels,
)
from flasher.image.plan import plan
from flasher.protocol.spec import BMS, WELLING, WMC, Target
from tests.host.bench import image_of
from tests.loops import each

PLAN = plan(image_of(300), BMS, WELLING.bitrate_bps)


def outcome(ending: Ending, phase: Phase = Phase.TRANSFER, **changes: object) -> Outcome:
    early = ended_before_start(PLAN, ending, "", phase, duration_s=1.5)
    return replace(early, **changes)  # type: ignore[arg-type]


@each(
    "ending, exit_code, code",
    [
        (Ending.NO_BOOT_VERSION, ExitCode.NO_ANSWER, ErrorCode.NO_BOOT_VERSION),
        (Ending.NO_ANNOUNCEMENT, ExitCode.NO_ANSWER, ErrorCode.NO_ANNOUNCEMENT),
        (Ending.NO_REQUEST, ExitCode.NO_ANSWER, ErrorCode.NO_REQUEST),
        (Ending.UNHEARING, ExitCode.NO_ANSWER, ErrorCode.UNHEARING),
        (Ending.WRONG_DEVICE, ExitCode.WRONG_DEVICE, ErrorCode.WRONG_DEVICE),
        (Ending.BOOT_TOO_OLD, ExitCode.WRONG_DEVICE, ErrorCode.BOOT_TOO_OLD),
        (Ending.NOT_FOR_DEVICE, ExitCode.WRONG_DEVICE, ErrorCode.NOT_FOR_DEVICE),
        (Ending.UNCHECKED, ExitCode.WRONG_DEVICE, ErrorCode.UNCHECKED),
        (Ending.IN_USE, ExitCode.WRONG_DEVICE, ErrorCode.VEHICLE_IN_USE),
        (Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE, ErrorCode.TWO_DEVICES),
        (Ending.SECOND_TOOL, ExitCode.BUS, ErrorCode.SECOND_TOOL),
        (Ending.PACKET_FAILED, ExitCode.TRANSFER, ErrorCode.PACKET_FAILED),
        (Ending.RESTARTED, ExitCode.TRANSFER, ErrorCode.RESTARTED),
        (Ending.BROKEN_PROTOCOL, ExitCode.TRANSFER, ErrorCode.BROKEN_PROTOCOL),
        (Ending.REFUSED, ExitCode.REFUSED, ErrorCode.REFUSED),
        (Ending.UNCONFIRMED, ExitCode.UNCONFIRMED, ErrorCode.UNCONFIRMED),
        (Ending.OTHER_VERSION, ExitCode.VERIFICATION, ErrorCode.OTHER_VERSION),
        (Ending.CANCELLED, ExitCode.INTERRUPTED, None),
    ],
)
def test_each_bad_ending_has_its_exit_code_and_error_code(
    ending: Ending, exit_code: ExitCode, code: ErrorCode | None
) -> None:
    error = outcome(ending).error()
    assert error is not None
    assert error.exit_code == exit_code
    assert code is None or error.code is code
    assert error.what.startswith("BMS: ")
    assert error.remedy.endswith(
        "This run erased nothing; what the other tool has done is not known."
        if ending is Ending.SECOND_TOOL
        else "State of the device: this run erased nothing: the device is as it was before."
    )
    assert not error.needs_rescue
    assert "{" not in f"{error.what}{error.cause}{error.remedy}"


@each("ending", [Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION])
def test_a_good_ending_is_no_error(ending: Ending) -> None:
    good = outcome(ending)
    assert good.ok
    assert good.error() is None
    assert good.is_completed is (ending is Ending.COMPLETED)
    assert not good.nothing_to_do


@each(
    "phase, left, exit_code",
    [
        (Phase.LISTEN, DeviceLeft.UNTOUCHED, ExitCode.NO_ANSWER),
        (Phase.IDENTIFY, DeviceLeft.UNTOUCHED, ExitCode.NO_ANSWER),
        (Phase.RESET, DeviceLeft.UNTOUCHED, ExitCode.NO_ANSWER),
        (Phase.BOOT, DeviceLeft.UNTOUCHED, ExitCode.NO_ANSWER),
        (Phase.UPDATE, DeviceLeft.PERHAPS_ERASED, ExitCode.NO_ANSWER),
        (Phase.TRANSFER, DeviceLeft.NO_APPLICATION, ExitCode.TRANSFER),
        (Phase.END, DeviceLeft.NO_APPLICATION, ExitCode.TRANSFER),
        (Phase.END, DeviceLeft.UNKNOWN, ExitCode.UNCONFIRMED),
        (Phase.CONFIRM, DeviceLeft.UNKNOWN, ExitCode.UNCONFIRMED),
    ],
)
def test_a_passed_deadline_is_named_by_what_had_been_reached(
    phase: Phase, left: DeviceLeft, exit_code: ExitCode
) -> None:
    error = outcome(Ending.OUT_OF_TIME, phase, device_left=left).error()
    assert error is not None
    assert error.exit_code == exit_code
    assert error.needs_rescue is (left is not DeviceLeft.UNTOUCHED)
    assert "--timeout" in error.remedy


def test_the_next_step_depends_on_what_was_tried_and_on_what_is_left() -> None:
    silent = outcome(Ending.NO_BOOT_VERSION).error()
    tried = outcome(Ending.NO_BOOT_VERSION, sent_into_silence=True).error()
    assert silent is not None
    assert tried is not None
    assert "--in-session" in silent.remedy
    assert "--in-session" not in tried.remedy
    other = outcome(Ending.NO_REQUEST, sent_into_silence=True).error()
    assert other is not None
    assert other.code is ErrorCode.NO_REQUEST
    early = outcome(Ending.TWO_DEVICES).error()
    late = outcome(Ending.TWO_DEVICES, device_left=DeviceLeft.NO_APPLICATION).error()
    assert early is not None
    assert late is not None
    assert "Each of the two may have the new image" in late.remedy
    assert "Each of the two may have" not in early.remedy
    assert late.needs_rescue
    assert late.code is ErrorCode.TWO_DEVICES


@each("ending", [Ending.NO_REQUEST, Ending.UNHEARING, Ending.PACKET_FAILED, Ending.REFUSED])
def test_an_unusual_frame_gap_is_a_likely_cause_of_silence_only(ending: Ending) -> None:
    usual, unusual = (outcome(ending, frame_gap_s=gap_s).error() for gap_s in (0.01, 0.05))
    assert usual is not None
    assert unusual is not None
    is_silence = ending is not Ending.REFUSED
    assert ("50 ms apart" in unusual.cause) is is_silence
    assert unusual.cause.endswith(usual.cause)
    assert "apart" not in usual.cause


def test_what_was_seen_is_in_brackets_and_the_waiver_is_named() -> None:
    seen = outcome(Ending.WRONG_DEVICE, detail="boot version 'OBC'").error()
    assert seen is not None
    assert seen.what == "BMS: another device answers (boot version 'OBC')."
    assert seen.waiver == "boot-name"
    plain = outcome(Ending.IN_USE, waiver="in-use").error()
    assert plain is not None
    assert plain.what == "BMS: the vehicle is in use."
    assert plain.waiver == "in-use"
    old = outcome(Ending.BOOT_TOO_OLD).error()
    assert old is not None
    assert old.waiver == "boot-version"
    none = outcome(Ending.NO_REQUEST).error()
    assert none is not None
    assert none.waiver == ""


@each(
    "packet, attempt, text",
    [
        (None, 1, "transferring"),
        (2, 1, "transferring, packet 2 of 3"),
        (2, 2, "transferring, packet 2 of 3, attempt 2"),
        (0, 0, "transferring"),
    ],
)
def test_where_it_was(packet: int | None, attempt: int, text: str) -> None:
    assert describe_progress(Phase.TRANSFER, packet, 3, attempt) == text
    figures = Statistics(attempts=attempt)
    where = outcome(Ending.PACKET_FAILED, packet=packet, statistics=figures)
    assert where.where == text
    error = where.error()
    assert error is not None
    assert error.where == text


def test_what_ends_before_the_start_has_no_figures_but_its_time() -> None:
    early = ended_before_start(PLAN, Ending.IN_USE, "", duration_s=1.5)
    assert early.statistics == Statistics(0, 0, 0, 0, 0, 1.5, None)
    assert early.phase is Phase.IDENTIFY
    assert (early.total_packets, early.packet, early.boot_version) == (3, None, None)
    assert early.device_left is DeviceLeft.UNTOUCHED
    assert not early.sent_into_silence
    assert Statistics() == Statistics(0, 0, 0, 0, 0, 0.0, None)


@each("left", list(DeviceLeft))
def test_a_device_needs_rescue_unless_it_is_untouched_or_runs_an_application(
    left: DeviceLeft,
) -> None:
    has_application = (DeviceLeft.UNTOUCHED, DeviceLeft.NEW, DeviceLeft.OTHER)
    assert left.needs_rescue is (left not in has_application)


@each("verdict", [each for each in Verdict if each not in GOOD and each is not Verdict.INTERRUPTED])
def test_a_bad_verdict_does_not_claim_that_the_device_has_the_image(verdict: Verdict) -> None:
    assert Verification(Level.VERSION, verdict).device_left is not DeviceLeft.NEW


# -- verification ---------------------------------------------------------------------------------


@each(
    "verdict, exit_code, code, needs_rescue",
    [
        (Verdict.VERSION_OTHER, ExitCode.VERIFICATION, ErrorCode.OTHER_VERSION, False),
        (Verdict.NO_ANSWER, ExitCode.VERIFICATION, ErrorCode.VERIFICATION, True),
        (Verdict.IN_BOOTLOADER, ExitCode.VERIFICATION, ErrorCode.IN_BOOTLOADER, True),
        (Verdict.MEMORY_OTHER, ExitCode.VERIFICATION, ErrorCode.VERIFICATION, False),
        (Verdict.TWO_DEVICES, ExitCode.WRONG_DEVICE, ErrorCode.TWO_DEVICES, True),
        (Verdict.SECOND_TOOL, ExitCode.BUS, ErrorCode.SECOND_TOOL, True),
        (Verdict.INTERRUPTED, ExitCode.INTERRUPTED, None, False),
    ],
)
def test_each_bad_verdict_has_its_error(
    verdict: Verdict, exit_code: ExitCode, code: ErrorCode | None, *, needs_rescue: bool
) -> None:
    for detail, end in (("", "."), ("seen so", " (seen so).")):
        found = Verification(Level.VERSION, verdict, None, detail)
        assert not found.ok
        error = found.error(BMS)
        assert error is not None
        assert error.exit_code == exit_code
        assert code is None or error.code is code
        assert error.needs_rescue is needs_rescue
        assert error.what.startswith("BMS: completed, but ")
        assert error.what.endswith(end)
        assert error.what.count("(") == bool(detail)
        assert error.where == "verification by version"


@each("verdict", [Verdict.VERSION_RIGHT, Verdict.VERSION_UNJUDGED, Verdict.MEMORY_RIGHT])
def test_a_good_verdict_is_no_error(verdict: Verdict) -> None:
    assert Verification(Level.VERSION, verdict).ok
    assert Verification(Level.VERSION, verdict).error(BMS) is None


def test_what_can_be_verified_and_what_is_by_default() -> None:
    assert possible_levels(BMS) == (Level.NONE, Level.VERSION, Level.MEMORY)
    assert possible_levels(WMC) == (Level.NONE,)
    assert default_level(BMS) is Level.VERSION
    assert default_level(WMC) is Level.NONE
    assert as_level("memory") is as_level(Level.MEMORY) is Level.MEMORY


@each(
    "target, level, base, what",
    [
        (BMS, Level.VERSION, None, ""),
        (BMS, Level.MEMORY, 0x1000, ""),
        (BMS, Level.MEMORY, 0, ""),
        (BMS, Level.MEMORY, None, "The memory cannot be read back without addresses."),
        (
            BMS,
            Level.MEMORY,
            0xFFFF_FFFE,
            "0xFFFFFFFE to 0x10000012A is not a valid memory range.",
        ),
        (WMC, Level.VERSION, None, "A WMC cannot be verified by version."),
        (WMC, Level.NONE, None, ""),
    ],
)
def test_what_cannot_be_verified_is_refused_before(
    target: Target, level: Level, base: int | None, what: str
) -> None:
    made = replace(PLAN, image=replace(PLAN.image, base=base), target=target)
    with pytest.raises(UsageError) if what else nullcontext() as refused:
        check_level(made, level)
    assert (refused.value.what if refused else "") == what
