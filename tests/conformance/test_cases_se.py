"""SE on the mock: a correct device passes with every choice, each wrong one fails its case."""

from __future__ import annotations

from typing import Any

import pytest

from tests.loops import each

from .verdicts import cases_of, not_passed

CASES = ("SE-01", "SE-03", "SE-04")


@pytest.mark.slow
def test_the_mock_passes() -> None:
    assert tuple(cases_of("SE")) == CASES
    assert not_passed(*CASES) == []


@pytest.mark.slow
def test_a_target_without_a_version_query_passes() -> None:
    assert not_passed("SE-03", "SE-04", target="wmc") == []


@pytest.mark.slow
@pytest.mark.no_cover
@each(
    "cases, choices",
    [
        (("SE-01",), {"pause_in_transfer": "waits"}),
        (("SE-03",), {"update_in_transfer": "ignored", "after_complete": "restarts"}),
        (("SE-03",), {"erase_time_s": 0.2, "reset_in_transfer": "restarts"}),
        (("SE-04",), {"bad_packet": "silence"}),
        (("SE-04",), {"bad_packet": "nak_received", "largest_image_bytes": 1300}),
    ],
)
def test_the_mock_passes_by_its_profile_whatever_it_chooses(
    cases: tuple[str, ...], choices: dict[str, Any]
) -> None:
    assert not_passed(*cases, **choices) == []
