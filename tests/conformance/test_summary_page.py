"""Badge and summary of a run."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

from flasher.conformance.reports import completed
from flasher.conformance.results import CaseVerdict
from flasher.conformance.summary_page import badge, summary_page
from tests.cli.conftest import Flasher
from tests.report.pages import Page, assert_self_contained, assert_visible

from .bench import passes_once, run_case
from .test_reports import hostile_report

MOCK = ("conformance", "-t", "bms", "--mock")


def title_of(drawing: str) -> str:
    title = ET.fromstring(drawing)[0].text  # noqa: S314  our own drawing
    assert title is not None
    return title


def test_the_badge_states_how_a_run_ended_and_how_much_was_judged() -> None:
    report = run_case(passes_once)
    assert title_of(badge(report)) == "bootloader conformance: 1 passed"
    (result,) = report.results
    in_part = replace(report, results=(replace(result, verdict=CaseVerdict.PASS_IN_PART),))
    assert title_of(badge(in_part)) == "bootloader conformance: 1 passed, 0 in full"
    failed = replace(report, results=(replace(result, verdict=CaseVerdict.FAIL), result))
    assert title_of(badge(failed)) == "bootloader conformance: 1 of 2 not passed"
    lost = replace(report, final_image="no boot version")
    assert title_of(badge(lost)) == "bootloader conformance: not passed"
    assert len({drawing.count("#14713a") for drawing in map(badge, (report, in_part))}) == 2


def test_a_run_writes_both(flasher: Flasher, tmp_path: Path) -> None:
    drawing, sheet = tmp_path / "badge.svg", tmp_path / "summary.html"
    files = ("--badge", drawing, "--summary", sheet)
    done = flasher(*MOCK, "--case", "RS-01", "--case", "EN-04", "--variant", "no-feedback", *files)
    assert done.code == 12
    assert title_of(drawing.read_text()) == "bootloader conformance: 1 of 2 not passed"
    page = Page(sheet.read_text(encoding="utf-8"))
    assert_self_contained(page)
    for text in (
        "BMS V1.0.0",
        "flashed and verified by version and readback",
        "RS-01 reset of the application: fail, expected general feedback",
        "without images with their own checksum: 1 cannot be run",
        "cases that were not selected",
    ):
        assert text in page.text
    again = flasher(*MOCK, "--case", "RS-01", "--variant", "no-feedback", *files)
    assert "--badge" not in again.out  # the command that repeats a case writes no files


def test_hostile_text_does_nothing_on_the_summary() -> None:
    html = summary_page(completed(hostile_report(), started_at=""))
    assert_self_contained(Page(html))
    assert_visible(html)
