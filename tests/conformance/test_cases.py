"""The cases on the mock: a correct device passes with every choice, a wrong one fails."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flasher.conformance.catalogue import CASES, GROUPS, Selection, group_of
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import ConformanceProfile, profile_keys
from flasher.conformance.results import CaseVerdict, CheckOutcome
from flasher.conformance.runner import run
from tests.loops import each

MINE = ("RS", "UP")


def failed(
    name: str | None = None, *, only: tuple[str, ...] = (), target: str = "bms", **choices: Any
) -> list[str]:
    """Cases of these groups, or of `only`, that a device does not pass."""
    profile = replace(MOCK_PROFILE, **choices)
    make_device = None if name is None else variant_maker(name)
    subject = MockSubject(target, profile=profile, make_device=make_device)
    # A variant includes choices of its own.
    judged_by = profile_of_mock(subject.device.profile)
    selection = Selection(only) if only else Selection(groups=MINE)
    report = run(subject, judged_by, selection=selection)
    return [result.case_id for result in report.results if result.verdict is not CaseVerdict.PASS]


@pytest.mark.slow
@each("target", ["wmc", "bms"])
def test_the_mock_passes(target: str) -> None:
    assert failed(target=target) == []


def test_the_mock_passes_as_obc() -> None:
    assert failed(target="obc", only=("RS-01", "RS-04", "UP-06")) == []


@pytest.mark.slow
@pytest.mark.parametrize(  # a whole suite each
    "choices",
    [
        {"reset_in_bootloader": "restarts", "without_application": "listens"},
        {"window_s": 0.05, "update_in_transfer": "ignored", "pause_in_transfer": "waits"},
        {"pause_in_transfer": "waits", "reset_in_transfer": "restarts", "window_s": 1.0},
        {"upgrade_in_application": "silence", "after_complete": "restarts"},
        {"largest_image_bytes": 1300, "image_checksum": "crc32", "start_delay_s": 1.0},
        {"erased_pages": "all", "erase_time_s": 0.01, "program_time_s": 0.02},
    ],
)
def test_the_mock_passes_by_its_profile_whatever_it_chooses(choices: dict[str, Any]) -> None:
    assert failed(**choices) == []


def test_a_choice_that_the_profile_does_not_state_fails() -> None:
    device = replace(MOCK_PROFILE, reset_in_bootloader="restarts", update_in_transfer="ignored")
    report = run(
        MockSubject(profile=device),
        profile_of_mock(),
        selection=Selection(cases=("RS-02", "UP-08")),
    )
    assert [result.verdict for result in report.results] == [CaseVerdict.FAIL, CaseVerdict.FAIL]


def test_every_case_states_all_that_a_report_shows() -> None:
    for case_id, case in CASES.items():
        assert group_of(case_id) in GROUPS
        assert all((case.title, case.clause, case.stimulus, case.expectation)), case_id
        assert set(case.choices) <= set(profile_keys()), case_id


@each("choice, is_right, expected", (("once", True, "once"), ("each", False, "twice")))
def test_a_repeated_update_command_names_how_often_it_is_answered(
    choice: str, is_right: bool, expected: str
) -> None:
    profile = ConformanceProfile({**profile_of_mock().given, "up_05": choice})
    report = run(MockSubject("bms"), profile, selection=Selection(("UP-05",)))
    (check,) = (one for one in report.results[0].checks if one.expected.endswith(expected))
    assert check.expected == f"request transfer {expected}"
    assert check.got == "once"
    assert (check.outcome is CheckOutcome.PASS) == is_right


def test_a_burst_that_is_too_long_names_how_many_boot_versions_were_expected() -> None:
    profile = ConformanceProfile({**profile_of_mock().given, "device.versions": 3})
    report = run(MockSubject("bms"), profile, selection=Selection(("RS-01",)))
    failure = report.results[0].first_failure
    assert failure is not None
    assert failure.expected == "0 more boot versions (a burst has 3)"
