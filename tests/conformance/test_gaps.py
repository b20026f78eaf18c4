"""Gaps of a bench: the suite's forecast matches the result of the run.

`python -m tests.campaigns.whole_suites` includes the longest cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from flasher.conformance.catalogue import (
    CASES,
    FULL_BENCH,
    MISSING_ON_BARE_BENCH,
    Requirement,
    Selection,
    bench_gaps,
    catalogue_order,
    missing_requirements,
)
from flasher.conformance.firmware import Firmware
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import CaseVerdict, Unsupported
from flasher.conformance.runner import SuiteOptions, run
from flasher.conformance.wire import RawFrame
from flasher.mock.store import AREA_START
from tests.loops import each
from tests.variant_matrix import NOT_OF_MODEL

AREA_BYTES = 34 * 1024
LONGEST = ("CR-01", "CR-02", "TX-07", "TM-05", "BU-01", "PW-01", "SE-01", "SE-03", "CO-01")
SHORT = [case_id for case_id in catalogue_order(CASES) if case_id not in LONGEST]
BENCHES = [("bms", 0), ("bms", AREA_START), ("wmc", AREA_START)]
"""Targets, with the address at which the bench can query the application's memory."""


def bare(target: str) -> MockSubject:
    """A device on a bench with only an adapter and a good image."""
    subject = MockSubject(target, profile=replace(MOCK_PROFILE, application_area_bytes=AREA_BYTES))
    subject.has_power = subject.has_readback = False
    subject.has_bus_off = subject.has_timed_cuts = False
    subject.second_image = None
    subject.firmware = Firmware(subject.good_image, None)
    subject.port.sends_error_frames = False
    send = subject.port.send

    def send_standard(frame: RawFrame) -> None:
        if frame.is_error:
            raise Unsupported("an adapter sends no error frames")
        send(frame)

    subject.port.send = send_standard  # type: ignore[method-assign]
    return subject


def check_bare_bench(target: str, address: int, cases: Sequence[str]) -> None:
    """The forecast of a bare bench names what it cannot judge of these cases."""
    subject = bare(target)
    given = profile_of_mock(subject.device.profile).given
    profile = ConformanceProfile({**given, "device.application_address": address})
    foreseen = bench_gaps(missing_requirements(subject, profile), cases)
    selection = Selection(cases=(*cases, "BU-07"))
    report = run(subject, profile, selection=selection, options=SuiteOptions(upgrades=4))
    assert report.gaps == foreseen
    is_printed = target == "bms" and address
    assert is_printed != any(
        gap.requirement == Requirement.IMAGE_READBACK.value for gap in foreseen
    )
    verdicts = {result.case_id: result.verdict for result in report.results}
    unsupported = {case_id for gap in foreseen for case_id in gap.unsupported}
    in_part = {case_id for gap in foreseen for case_id in gap.in_part}
    assert in_part == {
        case_id for case_id, verdict in verdicts.items() if verdict is CaseVerdict.PASS_IN_PART
    }
    assert {*unsupported, "BU-07"} == {
        case_id for case_id, verdict in verdicts.items() if verdict is CaseVerdict.UNSUPPORTED
    }


def check_full_bench(cases: Sequence[str]) -> None:
    """On a complete bench each of these cases passes in full."""
    cases = [case_id for case_id in cases if case_id not in NOT_OF_MODEL]
    subject = MockSubject(
        profile=replace(MOCK_PROFILE, application_area_bytes=AREA_BYTES, image_checksum="crc32")
    )
    judged_by = profile_of_mock(subject.device.profile)
    selection = Selection(cases=tuple(cases))
    report = run(subject, judged_by, selection=selection, options=SuiteOptions(upgrades=4))
    foreseen = bench_gaps(missing_requirements(subject, judged_by), {*CASES} - {*NOT_OF_MODEL})
    assert report.gaps == foreseen == ()
    count = len(cases)
    assert report.in_full == f"{count} of {count} passes were judged in full"


@pytest.mark.slow
@each("target, address", BENCHES)
def test_what_a_bare_bench_cannot_judge_is_reported_beforehand(target: str, address: int) -> None:
    check_bare_bench(target, address, SHORT)


@pytest.mark.slow
def test_on_a_bench_with_everything_every_pass_is_in_full() -> None:
    """These; `test_the_mock_passes` of each other group wants all of its cases to."""
    check_full_bench([case_id for case_id in SHORT if case_id.startswith(("BR", "SO", "SP"))])


def test_more_of_a_bench_judges_more() -> None:
    chosen = catalogue_order(CASES)
    bare_bench, full_bench = (
        bench_gaps(MISSING_ON_BARE_BENCH, chosen),
        bench_gaps(set(MISSING_ON_BARE_BENCH).difference(FULL_BENCH), chosen),
    )
    assert [gap.requirement for gap in bare_bench[:4]] == [need.value for need in FULL_BENCH]
    assert [gap.remedy for gap in bare_bench[:2]] == ["--power-cmd", "--readback-cmd"]
    assert "device.application_address" in bare_bench[2].remedy
    cannot = [{case for gap in one for case in gap.unsupported} for one in (bare_bench, full_bench)]
    assert cannot == [
        {"RS-05", "PW-01", "PW-02", "PW-04", "EN-08", "BU-02"},
        {"BU-02", "PW-04"},
    ]
    assert [gap.in_part for gap in full_bench] == [(), ("PW-01",), (), ("FR-09",)]
