"""What cases are judged by: clauses as the vendor's document numbers them, and readings."""

from __future__ import annotations

import pytest

from flasher.conformance import cases  # noqa: F401  registers them
from flasher.conformance.catalogue import CASES, case
from flasher.conformance.clauses import CLAUSES, contents


def test_a_case_cannot_name_a_clause_that_does_not_exist() -> None:
    with pytest.raises(ValueError, match=r"there is no clause '4\.1', '5'"):
        case("XX-01", "", clause="4.1; Welling 4.1; 5", stimulus="", expectation="")(print)
    assert "XX-01" not in CASES


def test_every_clause_of_the_document_that_is_listed_has_a_case() -> None:
    named = {label for one in CASES.values() for label in contents(one.clause)}
    assert [label for label in CLAUSES if label[0] != "R" and label not in named] == []
