"""Cases on several processes: the same report as from one, a stop, a process that is killed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.catalogue import Selection
from flasher.conformance.mock import MockSubject
from flasher.conformance.parallel import run_in_processes
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import RunObserver, SuiteOptions
from tests.cli.conftest import Flasher

from .bench import PROFILE

CASES = ("FR-02", "RS-01", "UP-03", "TX-01", "TX-03", "EN-02", "PW-02", "SP-01")
WRONG = ("conformance", "-t", "bms", "--mock", "--variant", "accepts-early-end")


def _without_times(document: dict[str, Any]) -> dict[str, Any]:
    report = document["report"]
    results = [{**each, "duration_s": 0} for each in report["results"]]
    for finding in (finding for each in results for finding in each["findings"]):
        finding["at_s"] = round(finding["at_s"], 6)  # a sum of times of its own in each process
    return {**report, "results": results, "started_at": "", "duration_s": 0, "times": []}


@pytest.mark.slow
def test_two_processes_report_what_one_does(flasher: Flasher) -> None:
    selected = [word for case_id in CASES[:-1] for word in ("--case", case_id)]
    one = flasher("--json", *WRONG, *selected, "--repeat", "2")
    two = flasher("--json", *WRONG, *selected, "--repeat", "2", "--jobs", "2")
    assert (one.code, two.code) == (12, 12)
    assert _without_times(two.document) == _without_times(one.document)


@pytest.mark.slow
def test_without_a_case_several_processes_report_what_one_does(flasher: Flasher) -> None:
    none = ("conformance", "-t", "bms", "--mock", "--case", "RS-01", "--exclude", "RS-01")
    one, two = flasher("--json", *none), flasher("--json", *none, "--jobs", "2")
    assert one.code == two.code
    assert _without_times(two.document) == _without_times(one.document)


@pytest.mark.slow
def test_a_stop_ends_all_processes() -> None:
    report = run_in_processes(
        BenchOptions("bms", is_mock=True),
        MockSubject(),
        PROFILE,
        jobs=2,
        selection=Selection(cases=("SO-01", "SP-01")),
        suite=SuiteOptions(upgrades=100_000),
        observer=RunObserver(),
        stopped=lambda: True,
    )
    assert [result.case_id for result in report.results] == ["SO-01", "SP-01"]
    assert {result.verdict for result in report.results} == {CaseVerdict.NOT_RUN}
    assert "stopped" in report.stopped
    assert not report.ok


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_run_and_nothing_passes(flasher: Flasher) -> None:
    subject = "tests.conformance.wrong_bootloaders:KillsItsSuite"
    line = ("conformance", "-t", "bms", "--subject", subject)
    ran = flasher(*line, "--jobs", "2", "--case", "RS-01", "--case", "TX-01")
    assert ran.code not in (0, 1)
    assert "a process of the run was killed" in ran.out + ran.err


def test_a_device_on_a_bus_is_tested_by_one_process(flasher: Flasher, tmp_path: Path) -> None:
    image = tmp_path / "image.bin"
    image.write_bytes(bytes(100))
    bus = ("-i", "virtual", "-c", "jobs", "--good-image", image)
    ran = flasher("conformance", "-t", "bms", *bus, "--jobs", "2")
    assert ran.code == 2
    assert "there is one device on a bus" in ran.err
