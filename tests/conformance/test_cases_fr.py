"""Framing, checksum and timing on the mock: a correct device passes with every profile choice that
a case depends on; a wrong one fails the case of its clause.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flasher.conformance.cases.cr import VECTORS
from flasher.conformance.catalogue import CASES, Selection
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import CaseVerdict, CheckOutcome, RunReport
from flasher.conformance.runner import run
from tests.loops import each

MINE = ("FR", "CR", "TM")
LONGEST = ("CR-01", "CR-02")
SHORT = tuple(
    case_id for case_id in CASES if case_id.partition("-")[0] in MINE and case_id not in LONGEST
)


def report(
    name: str | None = None,
    *,
    only: tuple[str, ...] = SHORT,
    target: str = "bms",
    judged_by: Mapping[str, str | float] | None = None,
    **choices: Any,
) -> RunReport:
    """Run only these cases with the device's own profile, changed by `judged_by`."""
    profile = replace(MOCK_PROFILE, **choices)
    make_device = None if name is None else variant_maker(name)
    subject = MockSubject(target, profile=profile, make_device=make_device)
    given = {**profile_of_mock(subject.device.profile).given, **(judged_by or {})}
    return run(subject, ConformanceProfile(given), selection=Selection(only))


def failed(done: RunReport) -> list[str]:
    return [result.case_id for result in done.results if result.verdict is not CaseVerdict.PASS]


@pytest.mark.slow
@each(
    "target, only",
    [("bms", SHORT), ("wmc", ("FR-08", "CR-03", "CR-04")), ("obc", ("FR-01", "CR-04", "TM-05"))],
)
def test_the_mock_passes(target: str, only: tuple[str, ...]) -> None:
    assert failed(report(target=target, only=only)) == []


@pytest.mark.slow
@each(
    "only, choices",
    [
        (SHORT, {"bad_packet": "silence", "update_in_transfer": "ignored", "window_s": 0.05}),
        (
            ("FR-01", "FR-06", "FR-08", "CR-03", "CR-04", "TM-05"),
            {
                "bad_packet": "nak_received",
                "repeated_packet": "nak_next",
                "reset_in_transfer": "restarts",
                "largest_image_bytes": 1300,
                "after_complete": "restarts",
            },
        ),
        (
            ("FR-01", "FR-04", "FR-07", "FR-10", "CR-03", "TM-02", "TM-05"),
            {"transfer_timeout_s": 1.0, "erase_time_s": 0.05, "program_time_s": 0.02},
        ),
    ],
)
def test_the_mock_passes_by_its_profile_whatever_it_chooses(
    only: tuple[str, ...], choices: dict[str, Any]
) -> None:
    assert failed(report(only=only, **choices)) == []


@pytest.mark.slow
@pytest.mark.no_cover
def test_a_device_that_answers_nothing_to_damaged_packets_is_judged_all_the_same() -> None:
    assert failed(report(only=("CR-02",), bad_packet="silence", pause_in_transfer="waits")) == []


@pytest.mark.slow
def test_no_damaged_packet_is_taken_by_the_mock() -> None:
    assert failed(report(only=LONGEST)) == []


@pytest.mark.slow
@each(
    "name, case_id, key, value",
    [
        ("short-frame-ends-message", "FR-01", "fr_01", "rejected"),
        ("header-at-frame-start-only", "FR-02", "fr_02", "lost"),
        ("padding-is-fatal", "FR-07", "fr_07", "rejected"),
    ],
)
def test_what_a_product_documents_otherwise_is_right_and_has_to_be_true(
    name: str, case_id: str, key: str, value: str
) -> None:
    """The P rows: the device's own choice and "either" pass, the other choice fails."""
    only = (case_id,)
    assert failed(report(name, only=only, judged_by={key: value})) == []
    assert failed(report(name, only=only, judged_by={key: "either"})) == []
    assert failed(report(only=only, judged_by={key: value})) == [case_id]


def test_a_device_that_looks_past_a_wrong_tail_does_not_drop_what_is_there() -> None:
    assert failed(report(only=("FR-04",), judged_by={"fr_04": "dropped"})) == ["FR-04"]
    assert failed(report(only=("FR-04",), judged_by={"fr_04": "either"})) == []


def test_a_device_that_drops_short_frames_minds_no_empty_ones() -> None:
    assert failed(report("short-frame-ends-message", only=("FR-09",))) == []


def test_gaps_that_no_product_promises_are_observed_only() -> None:
    done = report("drops-after-20-ms-gap", only=("TM-02",), judged_by={"tm_02": "either"})
    assert failed(done) == []
    infos = done.results[0].infos
    assert "gap of 10.0 ms: accepted" in infos
    assert "gap of 50.0 ms: rejected" in infos


def test_times_are_judged_all_together_and_report_how_they_are_spread() -> None:
    """TM-05: the report shows one slow answer among many, and the exceeded limit."""
    done = report("slow-sixteenth-packet", only=("TM-05",))
    (check,) = (one for one in done.results[0].checks if one.outcome is CheckOutcome.FAIL)
    assert check.expected == "packet to ACK at most 500 ms"
    assert "median 1." in check.got
    assert "max 600.8 ms" in check.got
    names = {one.name for one in done.results[0].measurements}
    assert names >= {"reset to first boot version", "end of transfer to complete"}


@pytest.mark.slow
def test_a_time_that_is_never_measured_is_no_pass() -> None:
    done = report("stays-in-bootloader", only=("TM-05",))
    assert failed(done) == []
    limits: dict[str, str | float] = {"limits.complete_s": 0.0001}
    done = report(only=("TM-05",), judged_by=limits)
    assert failed(done) == ["TM-05"]


def test_the_written_out_messages_are_those_of_the_specification() -> None:
    """CR-04."""
    path = Path(__file__).parents[1] / "vectors.json"
    known = {vector["wire"] for vector in json.loads(path.read_text("utf-8"))["vectors"]}
    assert all(text in known for texts in VECTORS.values() for text in texts.values())


def test_the_device_is_left_as_it_was() -> None:
    done = report(only=("FR-05", "CR-03"))
    assert done.ok
    assert done.rescues == ()
