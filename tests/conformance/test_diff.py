"""Comparison of two runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flasher.conformance.catalogue import Selection
from flasher.conformance.mock import MockSubject, variant_maker
from flasher.conformance.reports import completed, to_bytes
from flasher.conformance.runner import run
from flasher.errors import ExitCode
from tests.cli.conftest import Flasher

from .bench import PROFILE

Change = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def made() -> bytes:
    """Report of a run in which RS-01 fails and EN-04 is not judged."""
    subject = MockSubject("bms", make_device=variant_maker("announces-three-times"))
    selection = Selection(cases=("RS-01", "RS-04", "UP-05", "EN-04"))
    report = run(subject, PROFILE, selection=selection)
    return to_bytes(completed(report, started_at=""))


@pytest.fixture
def old(made: bytes, tmp_path: Path) -> Path:
    """The same as a file."""
    path = tmp_path / "old.json"
    path.write_bytes(made)
    return path


def changed(old: Path, change: Change) -> Path:
    """The same report with one change."""
    document = json.loads(old.read_text())
    change(document)
    path = old.with_name("new.json")
    path.write_text(json.dumps(document))
    return path


def result_of(document: dict[str, Any], case_id: str) -> dict[str, Any]:
    (found,) = (result for result in document["results"] if result["id"] == case_id)
    assert isinstance(found, dict)
    return found


def set_status(case_id: str, status: str) -> Change:
    return lambda document: result_of(document, case_id).update(status=status)


def test_a_run_compared_with_itself_is_the_same(flasher: Flasher, old: Path) -> None:
    done = flasher("conformance", "diff", old, old)
    assert done.code == 0
    for count in ("0 worse, 0 better, 0 new, 0 gone, 3 unchanged", "0 judged less", "; 0 slower"):
        assert count in done.out


@pytest.mark.parametrize(
    ("case_id", "status", "kind", "code"),
    [
        ("RS-01", "pass", "better", 0),
        ("RS-01", "deviation", "better", 0),
        ("RS-04", "fail", "worse", 12),
        ("RS-04", "deviation", "worse", 12),
        ("RS-04", "inconclusive", "worse", 12),
        ("RS-04", "info", "", 0),
        ("RS-04", "unsupported", "gone", 0),
        ("RS-04", "not_run", "gone", 0),
        ("EN-04", "pass", "new", 0),
        ("EN-04", "fail", "new", 12),
    ],
)
def test_another_verdict_is_named(
    flasher: Flasher, old: Path, case_id: str, status: str, kind: str, code: int
) -> None:
    new = changed(old, set_status(case_id, status))
    done = flasher("conformance", "diff", old, new)
    assert done.code == code
    lines = [line for line in done.out.splitlines() if case_id in line]
    assert [line.partition(" ")[0] for line in lines] == ([kind] if kind else [])
    document = flasher("conformance", "diff", old, new, "--json").document
    assert document["exit_code"] == code
    assert [one["id"] for one in document.get(kind, [])] == ([case_id] if kind else [])


def test_a_case_that_is_in_one_run_only_is_new_or_gone(flasher: Flasher, old: Path) -> None:
    def without(document: dict[str, Any]) -> None:
        document["results"].remove(result_of(document, "RS-04"))

    new = changed(old, without)
    gone = flasher("conformance", "diff", old, new)
    assert (gone.code, "gone    RS-04" in gone.out) == (0, True)
    assert flasher("conformance", "diff", old, new, "--strict").code == ExitCode.PARTIAL
    assert "new     RS-04" in flasher("conformance", "diff", new, old).out


def test_a_case_that_is_judged_less_fully_is_worse_for_a_strict_comparison(
    flasher: Flasher, old: Path
) -> None:
    def in_part(document: dict[str, Any]) -> None:
        what = ["the flash holds the image (the bench has no readback)"]
        result_of(document, "RS-04").update(status="pass_in_part", not_tried=what)

    new = changed(old, in_part)
    less = flasher("conformance", "diff", old, new)
    assert less.code == 0
    assert "less    RS-04" in less.out
    assert "the bench has no readback" in less.out
    assert flasher("conformance", "diff", old, new, "--strict").code == ExitCode.PARTIAL
    assert "more    RS-04" in flasher("conformance", "diff", new, old).out


def test_the_worst_of_several_repeats_counts(flasher: Flasher, old: Path) -> None:
    def twice(document: dict[str, Any]) -> None:
        again = {**result_of(document, "RS-04"), "repeat": 2, "status": "fail"}
        document["results"].append(again)

    assert flasher("conformance", "diff", old, changed(old, twice)).code == 12


def slower(factor: float, uncertainty_s: float = 0.0) -> Change:
    def change(document: dict[str, Any]) -> None:
        (times,) = (one for one in document["times"] if one["name"] == "packet to ACK")
        times["median_s"] *= factor
        times["p95_s"] *= factor
        times["uncertainty_s"] = uncertainty_s

    return change


@pytest.mark.parametrize(
    ("change", "words", "kind"),
    [
        (slower(1.2), (), "slower"),
        (slower(1.09), (), ""),
        (slower(1.09), ("--threshold", "5"), "slower"),
        (slower(1.2), ("--threshold", "25"), ""),
        (slower(0.5), (), "faster"),
        (slower(1.2, uncertainty_s=0.002), (), ""),
    ],
)
def test_a_time_is_slower_beyond_threshold_and_uncertainty(
    flasher: Flasher, old: Path, change: Change, words: tuple[str, ...], kind: str
) -> None:
    new = changed(old, change)
    done = flasher("conformance", "diff", old, new, *words)
    assert done.code == 0
    lines = [line for line in done.out.splitlines() if "packet to ACK" in line]
    assert [line.partition(" ")[0] for line in lines] == ([kind] if kind else [])
    strict = flasher("conformance", "diff", old, new, *words, "--strict")
    assert strict.code == (12 if kind == "slower" else 0)


def test_other_conditions_are_reported(flasher: Flasher, old: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        document["seed"] = "2"
        document["profile"]["limits.ack_s"] = 0.7

    done = flasher("conformance", "diff", old, changed(old, change))
    assert "not the same: seed: 1, then 2" in done.out
    assert "not the same: profile, limits.ack_s: 0.5, then 0.7" in done.out


def test_what_json_prints_can_be_compared_too(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "printed.json"
    path.write_text(flasher("conformance", "-t", "bms", "--mock", "--case", "RS-04", "--json").out)
    assert flasher("conformance", "diff", path, path).code == 0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no json",
        "[]",
        "{}",
        '{"report_schema": 99}',
        '{"report_schema": 1}',
        '{"report_schema": 1, "results": 5}',
        "[" * 100_000,
    ],
)
def test_a_file_that_is_no_report_is_wrong_usage(
    flasher: Flasher, old: Path, tmp_path: Path, text: str
) -> None:
    path = tmp_path / "wrong.json"
    path.write_text(text)
    for words in ((old, path), (path, old), (old, tmp_path / "missing.json")):
        done = flasher("conformance", "diff", *words)
        assert done.code == 2
        assert "Traceback" not in done.err


def test_text_of_a_report_is_shown_harmlessly(flasher: Flasher, old: Path) -> None:
    def change(document: dict[str, Any]) -> None:
        result_of(document, "RS-04").update(status="fail", note="\x1b[2J")
        document["cases"][1]["title"] = "\x1b[31mred"

    done = flasher("conformance", "diff", old, changed(old, change))
    assert "\x1b" not in done.out
    assert "\\x1b[31mred" in done.out
