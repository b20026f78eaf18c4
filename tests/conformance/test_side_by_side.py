"""Comparison of several runs in columns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from flasher.conformance import catalogue
from flasher.conformance.catalogue import Selection
from tests.cli.conftest import Flasher
from tests.report.pages import Page, assert_self_contained

CASES = ("--case", "RS-01", "--case", "RS-04", "--case", "EN-04")


@pytest.fixture
def reports(flasher: Flasher, tmp_path: Path) -> list[Path]:
    """A correct device, a wrong one, and one that was judged only in part."""
    right, wrong, less = (tmp_path / f"{name}.json" for name in ("right", "wrong", "less"))
    bench = ("conformance", "-t", "bms", "--mock", *CASES)
    flasher(*bench, "--json-report", right)
    flasher(*bench, "--json-report", wrong, "--variant", "no-feedback", "--exclude", "EN-04")
    document: dict[str, Any] = json.loads(right.read_text())
    (result,) = (one for one in document["results"] if one["id"] == "RS-04")
    result.update(status="pass_in_part", not_tried=["a thing (no tool)"])
    document["passes_in_full"] = 1
    less.write_text(json.dumps(document))
    return [right, wrong, less]


def test_what_differs_between_runs_is_shown_in_columns(
    flasher: Flasher, reports: list[Path]
) -> None:
    done = flasher("conformance", "compare", *reports)
    assert done.code == 0
    rows = {line.partition("  ")[0].strip(): line for line in done.out.splitlines() if line}
    assert rows["verdict"].split() == ["verdict", "passed", "NOT", "PASSED", "passed"]
    assert "right.json" in done.out.splitlines()[0]
    assert rows["RS-01 reset of the application"].split()[-3:] == ["pass", "fail", "pass"]
    assert "pass in part" in rows[f"RS-04 {catalogue.CASES['RS-04'].title}"]
    assert rows["EN-04 image with a wrong checksum"].split()[-3:] == [
        "unsupported",
        "-",
        "unsupported",
    ]
    assert "3 of 3 cases differ" in done.out
    same = flasher("conformance", "compare", reports[0], reports[0])
    assert "0 of 3 cases differ" in same.out
    assert "RS-01" not in same.out
    assert "RS-01" in flasher("conformance", "compare", reports[0], reports[0], "-v").out


def test_reports_of_one_name_are_named_by_their_folders(
    flasher: Flasher, reports: list[Path], tmp_path: Path
) -> None:
    other = tmp_path / "b" / "right.json"
    other.parent.mkdir()
    other.write_bytes(reports[0].read_bytes())
    document = flasher("conformance", "compare", reports[0], other, "--json").document
    assert [run["name"] for run in document["runs"]] == [str(reports[0]), str(other)]


@pytest.mark.slow
def test_the_comparison_is_a_page_and_a_document_too(
    flasher: Flasher, reports: list[Path], tmp_path: Path
) -> None:
    path = tmp_path / "page.html"
    document = flasher("conformance", "compare", *reports, "--html", path, "--json").document
    assert [run["name"] for run in document["runs"]] == ["right.json", "wrong.json", "less.json"]
    assert [run["passes_in_full"] for run in document["runs"]] == [2, 1, 1]
    (row,) = (case for case in document["cases"] if case["id"] == "RS-04")
    assert row["verdicts"] == ["pass", "pass", "pass_in_part"]
    page = Page(path.read_text(encoding="utf-8"))
    assert_self_contained(page)
    for text in ("3 runs side by side", "pass in part", "not tried: a thing (no tool)"):
        assert text in page.text


def test_one_report_is_no_comparison(flasher: Flasher, reports: list[Path]) -> None:
    assert flasher("conformance", "compare", reports[0]).code == 2
    assert flasher("conformance", "compare", reports[0], reports[0].parent).code == 2


def test_what_is_excluded_is_not_run() -> None:
    chosen = Selection(groups=("RS",), cases=("TX-01",), excluded=("RS-05", "TX")).chosen()
    assert chosen == ["RS-01", "RS-02", "RS-03", "RS-04"]
    assert not Selection(quick=True, excluded=("BU-06",)).has("BU-06")
