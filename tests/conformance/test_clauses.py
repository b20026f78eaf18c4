"""Clauses of the vendor's document and readings of this project."""

from __future__ import annotations

from dataclasses import fields

import pytest

from flasher.conformance.catalogue import CASES, case
from flasher.conformance.clauses import CLAUSES, READINGS, clause_texts
from flasher.conformance.profile import profile_keys
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import TARGETS
from flasher.settings.profile import ApplicationArea, Profile
from tests import readings_document
from tests.readings_document import HOLDERS


def test_a_case_cannot_name_a_clause_that_does_not_exist() -> None:
    with pytest.raises(ValueError, match=r"clause '4\.1', '5'"):
        case("XX-01", "", clause="4.1; Welling 4.1; 5", stimulus="", expectation="")(print)
    assert "XX-01" not in CASES


def test_every_clause_of_the_document_that_is_listed_has_a_case() -> None:
    named = {label for one in CASES.values() for label in clause_texts(one.clause)}
    assert [label for label in CLAUSES if label[0] != "R" and label not in named] == []


def test_the_document_of_the_readings_is_drawn_from_them() -> None:
    drawn = "draw it anew: python -m tests.readings_document"
    assert readings_document.DOCUMENT.read_text(encoding="utf-8") == (
        readings_document.readings_document()
    ), drawn


def test_every_reading_has_a_case_or_a_test_that_exists() -> None:
    named = {label for one in CASES.values() for label in clause_texts(one.clause)}
    assert [number for number in READINGS if number not in {*named, *HOLDERS}] == []
    for test in (test for tests in HOLDERS.values() for test in tests):
        path, _, name = test.partition("::")
        source = (readings_document.ROOT / path).read_text(encoding="utf-8")
        assert f"\ndef {name}(" in source, test


def test_the_options_that_readings_name_exist() -> None:
    """The project's numbers are complete, and all options exist."""
    assert list(READINGS) == [f"R{number}" for number in range(1, 29)]
    area = ApplicationArea(start=0, size_bytes=1)
    of_host = dict(Profile(TARGETS["bms"], application_area=area).values())
    of_model = {known.name for known in fields(DeviceProfile)}
    for number, reading in READINGS.items():
        assert set(reading.suite) <= set(profile_keys()), number
        assert set(reading.host) <= set(of_host), number
        assert set(reading.model) <= of_model, number
