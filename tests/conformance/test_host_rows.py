"""The table of the host's rows is complete, and the tests that it names exist."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from flasher.conformance.catalogue import CASES, HOST_CASES, NOT_IMPLEMENTED, WEAR
from tests.loops import each

from .host_rows import HOST_ROWS

TESTS = Path(__file__).parents[1]
ROWS = {
    "BR": 1,
    "FR": 10,
    "CR": 4,
    "RS": 9,
    "UP": 8,
    "TX": 13,
    "EN": 8,
    "TM": 5,
    "BU": 7,
    "PW": 4,
    "SE": 4,
    "CO": 4,
}
"""Number of rows of each group of the catalogue."""
NO_HOST = {
    "BR-01",
    *("RS-01", "RS-02", "RS-03", "RS-04", "RS-05"),
    *("UP-01", "UP-02", "UP-03", "UP-04", "UP-06", "UP-08"),
    *("TX-01", "TX-03", "TX-04", "TX-05", "TX-06", "TX-07", "TX-08", "TX-12", "TX-13"),
    *("EN-01", "EN-02", "EN-04", "EN-07", "EN-08"),
    *("TM-05", "BU-07", "PW-01", "PW-02", "PW-04", "SE-04", "CO-04"),
}
"""Rows that only concern a bootloader."""


@cache
def functions(path: Path) -> frozenset[str]:
    """Names of the test functions at the top of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    )


@pytest.mark.slow
@each("row", HOST_ROWS)
def test_the_tests_of_a_row_exist(row: str) -> None:
    assert HOST_ROWS[row]
    for node in HOST_ROWS[row]:
        path, _, name = node.partition("::")
        assert (TESTS / path).is_file(), node
        assert name in functions(TESTS / path), node


def test_every_row_of_the_catalogue_has_a_case_or_tests_of_the_host() -> None:
    rows = {f"{group}-{at:02}" for group, count in ROWS.items() for at in range(1, count + 1)}
    assert set(HOST_ROWS) | NO_HOST == rows
    assert not set(HOST_ROWS) & NO_HOST
    assert rows == set(CASES).difference(WEAR) | set(NOT_IMPLEMENTED) | set(HOST_CASES)


def test_what_the_suite_leaves_to_the_hosts_tests_is_in_the_table() -> None:
    assert set(HOST_CASES) <= set(HOST_ROWS)
    assert not set(HOST_CASES) & set(CASES)
    assert set(CASES) >= NO_HOST - set(NOT_IMPLEMENTED)
