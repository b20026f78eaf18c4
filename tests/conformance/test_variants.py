"""Every wrong bootloader fails the case of its clause, and every case detects one.

The table is docs/reference/variants.md; the gate compares more of it by `tests.variant_matrix
--quick`.
"""

from __future__ import annotations

import pytest

from flasher.conformance.catalogue import BRING_UP, CASES, WEAR
from flasher.mock.variants import VARIANTS
from tests.loops import each
from tests.variant_matrix import NOT_OF_MODEL, Row, groups_passed, listed_rows, row_of

LISTED = listed_rows()
_NAMES = list(VARIANTS)
SAMPLE = [
    _NAMES[0],
    *_NAMES[4:-1:8],
    "noise-hangs",
    "writes-anywhere",
    "any-message-is-life",
    "hears-other-targets",
    "doubled-frame-hangs",
    "swallows-after-bad",
    "big-endian-nak",
    "back-to-back-lost",
    "header-in-data-restarts",
    "trusts-length",
    "accepts-skipped-number",
    _NAMES[-1],
]
"""Some variants of each clause (the gate judges all); those listed by name cover branches that no
other test reaches.
"""


def test_the_table_has_every_variant() -> None:
    assert list(LISTED) == list(VARIANTS)


def test_every_variant_fails_the_case_of_its_clause() -> None:
    missed = [name for name, fails in LISTED.items() if VARIANTS[name].clause not in fails]
    assert missed == []


def test_every_case_fails_on_a_variant_of_its_own_clause() -> None:
    """Each variant is correct except for its clause."""
    named = {VARIANTS[name].clause for name in LISTED}
    assert set(CASES).difference(WEAR, {BRING_UP}, NOT_OF_MODEL) == named


def test_a_variant_that_takes_no_upgrade_fails_the_bring_up() -> None:
    failing = {name for name, fails in LISTED.items() if BRING_UP in fails}
    # The host takes its device for two devices (R27), but the suite's tester upgrades it.
    takes_none = {name for name in LISTED if not VARIANTS[name].upgrade_works} - {"acks-twice"}
    assert failing >= takes_none


def test_a_variant_fails_nothing_but_its_clause_and_what_it_declares_to_touch() -> None:
    for name, fails in LISTED.items():
        variant = VARIANTS[name]
        if variant.upgrade_works and not variant.everywhere:
            assert set(fails) <= {variant.clause, *variant.also, BRING_UP}, name
            assert groups_passed(Row(name, fails, 0)), name


@pytest.mark.slow
@each("name", SAMPLE)
def test_the_suite_agrees_with_the_table_on_the_case_of_the_clause(name: str) -> None:
    clause = VARIANTS[name].clause
    assert row_of(name, [clause]).fails == (clause,)
