"""EN on the mock: a correct device passes with every choice, each wrong one fails its case."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flasher.conformance.catalogue import Selection
from flasher.conformance.mock import (
    GOOD_IMAGE,
    MOCK_PROFILE,
    SECOND_IMAGE,
    MockSubject,
    device_maker,
    profile_of_mock,
)
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.mock.model import AnyMessage, MockDevice
from flasher.protocol import messages
from flasher.protocol.spec import Command
from tests.loops import each

from .bench import PROFILE
from .verdicts import cases_of, not_passed, verdicts

CASES = ("EN-01", "EN-02", "EN-04", "EN-07", "EN-08")


@pytest.mark.slow
def test_the_mock_passes_with_images_that_carry_a_checksum() -> None:
    assert tuple(cases_of("EN")) == CASES
    assert not_passed(*CASES, image_checksum="crc32") == []


def test_without_a_checksum_of_its_own_there_is_nothing_to_refuse_an_image_for() -> None:
    assert verdicts(["EN-04"]) == {"EN-04": CaseVerdict.UNSUPPORTED}


@pytest.mark.slow
def test_a_target_without_a_version_query_passes_all_but_the_version() -> None:
    found = verdicts(CASES, target="obc", image_checksum="crc32")
    assert found.pop("EN-08") is CaseVerdict.UNSUPPORTED
    assert set(found.values()) == {CaseVerdict.PASS}


@pytest.mark.slow
def test_the_mock_passes_by_its_profile_whatever_it_chooses() -> None:
    choices: dict[str, Any] = {
        "repeated_end": "silence",
        "without_application": "listens",
        "after_complete": "restarts",
        "reset_in_bootloader": "restarts",
        "pause_in_transfer": "waits",
    }
    assert not_passed(*CASES, image_checksum="crc32", **choices) == []
    starts_late: dict[str, Any] = {"start_delay_s": 1.0, "states": {"en_02": "either"}}
    assert not_passed("EN-02", image_checksum="crc32", **starts_late) == []


@pytest.mark.slow
@each(
    "case_id, states",
    [
        ("EN-01", {"en_03": "restarts"}),
        ("EN-02", {"en_02": "silence"}),
        ("EN-04", {"en_02": "silence"}),
    ],
)
def test_a_device_that_chooses_otherwise_than_its_profile_states_fails(
    case_id: str, states: dict[str, str]
) -> None:
    assert not_passed(case_id, states=states, image_checksum="crc32") == [case_id]


@pytest.mark.slow
def test_without_a_second_image_the_rest_of_a_row_of_upgrades_is_judged() -> None:
    found = verdicts(["EN-01", "EN-07", "EN-08"], with_second_image=False)
    assert found == {
        "EN-01": CaseVerdict.PASS_IN_PART,
        "EN-07": CaseVerdict.PASS_IN_PART,
        "EN-08": CaseVerdict.UNSUPPORTED,
    }


class _CompletesAfterRefusing(MockDevice):
    """Refuses an end mark other than 04, and then takes it all the same."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if isinstance(row, messages.Malformed) and row.message.command == Command.END_OF_TRANSFER:
            self._send(messages.Nak(1))
            super()._take_row(messages.EndOfTransfer(), now)
        else:
            super()._take_row(row, now)


def test_an_end_mark_that_is_refused_and_then_taken_fails() -> None:
    subject = MockSubject(make_device=device_maker(_CompletesAfterRefusing))
    selection = Selection(cases=("EN-02",))
    report = run(subject, PROFILE, selection=selection)
    failure = report.results[0].first_failure
    assert failure is not None
    assert failure.step.startswith("end of transfer with")
    assert "complete" in failure.got


@pytest.mark.slow
@each("checksum", ("none", "crc32"))
def test_a_good_image_of_the_user_is_padded_to_the_end_of_a_sector(checksum: str) -> None:
    device = replace(MOCK_PROFILE, image_checksum=checksum)  # type: ignore[arg-type]
    subject = MockSubject(profile=device, good_image=GOOD_IMAGE, second_image=SECOND_IMAGE)
    report = run(subject, profile_of_mock(device), selection=Selection(cases=("EN-01",)))
    (result,) = report.results
    assert result.verdict is CaseVerdict.PASS
    steps = {check.step for check in result.checks}
    assert steps >= {f"the good image padded to {size} bytes" for size in (8191, 8192, 8193)}


def test_a_device_without_room_for_a_padded_image_is_judged_in_part() -> None:
    device = replace(MOCK_PROFILE, application_area_bytes=8192)
    subject = MockSubject(profile=device, good_image=GOOD_IMAGE, second_image=SECOND_IMAGE)
    report = run(subject, profile_of_mock(device), selection=Selection(cases=("EN-01",)))
    (result,) = report.results
    assert result.verdict is CaseVerdict.PASS_IN_PART
    assert "an image that ends with a sector" in result.not_tried[0]
