"""JUnit XML, JSON and HTML reports: content, well-formedness, escaping."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any, Final

import pytest

from flasher.cli.bench.conformance import ConformanceDocument
from flasher.cli.bench.conformance_text import report_lines
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import CASES, MISSING_ON_BARE_BENCH, Requirement, Selection
from flasher.conformance.html_report import MESSAGES_BAD, html_page
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.reports import (
    BINS,
    candump,
    completed,
    is_traced,
    junit_report,
    to_bytes,
    to_json,
    trace_file_name,
)
from flasher.conformance.results import (
    CHECKS_KEPT,
    CaseResult,
    CaseVerdict,
    Check,
    CheckOutcome,
    MeasuredTime,
    RunReport,
)
from flasher.conformance.runner import SuiteOptions, run
from flasher.conformance.summary_page import summary_page
from flasher.mock.store import AREA_START
from tests.loops import each
from tests.report.pages import Page, assert_self_contained, assert_visible
from tests.schema import schema_of
from tests.schema_document import mismatches

from .bench import PROFILE, fails_once, passes_once, run_case

AT: Final = "2026-01-02T03:04:05+00:00"
HOSTILE: Final = "\x1b[2J<script>alert(1)</script>\"><img onerror=x> ]]> \u202e\x00 & 'quoted'"
SUITE_KEYS: Final = {
    *("name", "tests", "failures", "errors", "skipped", "time", "timestamp", "hostname"),
}


def wrong_run(*case_ids: str, seed: str = "1") -> RunReport:
    """A run on a device that announces itself three times."""
    return run(
        MockSubject("bms", make_device=variant_maker("announces-three-times")),
        PROFILE,
        selection=Selection(cases=case_ids or ("RS-01", "RS-04", "EN-04")),
        options=SuiteOptions(seed=seed),
    )


def with_status(status: CaseVerdict, **more: Any) -> RunReport:
    """A run of one case with this verdict."""
    report = run_case(passes_once)
    result = replace(report.results[0], verdict=status, **more)
    return replace(report, results=(result,))


def hostile_report() -> RunReport:
    check = Check(HOSTILE, CheckOutcome.FAIL, HOSTILE, HOSTILE * 50, 0.1)
    report = with_status(CaseVerdict.FAIL, note=HOSTILE, checks=(check,) * 99, infos=(HOSTILE,))
    return replace(report, subject=HOSTILE, stopped=HOSTILE, final_image=HOSTILE)


def document_of(report: RunReport) -> dict[str, Any]:
    loaded = json.loads(to_bytes(completed(report, started_at=AT)))
    assert isinstance(loaded, dict)
    return loaded


def junit_of(report: RunReport) -> ET.Element:
    return ET.fromstring(junit_report(completed(report, started_at=AT)))  # noqa: S314  our own


def page_of(report: RunReport, **replays: str) -> str:
    commands = {(case_id.replace("_", "-"), 1): words for case_id, words in replays.items()}
    return html_page(completed(report, started_at=AT, replays=commands))


# -- JSON -----------------------------------------------------------------------------------------


@pytest.mark.slow
@each("make", [wrong_run, hostile_report, lambda: run_case(passes_once)])
def test_the_document_is_as_its_schema_states(make: Any) -> None:
    document = {"report": document_of(make())}
    assert not mismatches(document, schema_of(ConformanceDocument))


def test_the_document_reports_what_went_wrong_and_how_to_see_it_again() -> None:
    written = completed(
        wrong_run(),
        started_at=AT,
        replays={("RS-01", 1): "flasher ..."},
        trace_files={("RS-01", 1): "RS-01.log"},
    )
    made = to_json(written)
    assert not made["passed"]
    assert made["counts"]["fail"] == 1
    assert made["counts"]["unsupported"] == 1
    first = made["results"][0]
    assert (first["id"], first["status"]) == ("RS-01", "fail")
    assert first["findings"][0]["expected"] == "boot version"
    assert first["checks"]["passed"] > 0
    assert (first["replay"], first["trace_file"]) == ("flasher ...", "RS-01.log")
    assert [case["id"] for case in made["cases"]] == ["RS-01", "RS-04", "EN-04"]


@pytest.mark.slow
@each("address, by", [(AREA_START, ["version", "memory over the bus"]), (0, ["version"])])
def test_all_forms_state_alike_with_what_the_flash_was_compared(
    address: int, by: list[str]
) -> None:
    small = replace(MOCK_PROFILE, application_area_bytes=4096)
    device = MockSubject(profile=small)
    device.has_readback = False
    given = profile_of_mock(small).given
    profile = ConformanceProfile({**given, "device.application_address": address})
    report = run(device, profile, selection=Selection(cases=("UP-08", "TX-07")))
    document, how = document_of(report), report.final_image_text
    report = completed(report, started_at=AT)
    assert document["final_image_seen_by"] == by
    assert how.endswith("no readback was possible" if address == 0 else "memory over the bus")
    lacks = [gap["requirement"] for gap in document["gaps"]]
    assert lacks == ["readback", "image-readback"][: 1 if address else 2]
    junit = junit_of(report).iter("property")
    properties = {one.get("name", ""): one.get("value", "") for one in junit}
    assert properties["final_image"] == how
    lacking, _ = MISSING_ON_BARE_BENCH[Requirement.IMAGE_READBACK]
    pages = (page_of(report), summary_page(report))
    texts = ["\n".join(report_lines(report)), *(Page(html).text for html in pages)]
    assert all(how in text for text in texts)
    for text in (properties["bench_is"], *texts):
        assert (lacking in text) == (address == 0)


def test_many_failed_checks_are_counted_and_the_first_ones_reported() -> None:
    (result,) = document_of(hostile_report())["results"]
    assert result["checks"]["failed"] == 99
    assert len(result["findings"]) == CHECKS_KEPT


@each("verbose", (False, True))
def test_a_long_reason_is_shown_whole_on_request(verbose: bool) -> None:
    checks = [
        Check("step", CheckOutcome.FAIL, "silence", f"{'ACK 1, ' * 50}{last}", 0.1)
        for last in ("the last one", "the very last one")
    ]
    report = with_status(CaseVerdict.FAIL, checks=tuple(checks))
    text = "\n".join(report_lines(report, verbose=verbose))
    assert ("the last one" in text, "the very last one" in text) == (verbose, verbose)


def test_times_are_reported_with_their_histogram() -> None:
    values = [index / 1000 for index in range(1, 102)]
    measured = tuple(MeasuredTime("t", value, 0.002) for value in values)
    (times,) = document_of(with_status(CaseVerdict.PASS, measurements=measured))["times"]
    assert (times["count"], times["median_s"], times["p95_s"]) == (101, 0.051, 0.096)
    assert times["uncertainty_s"] == 0.002
    assert len(times["histogram"]["counts"]) == BINS
    assert len(times["histogram"]["edges_s"]) == BINS + 1
    assert sum(times["histogram"]["counts"]) == 101


@pytest.mark.slow
def test_two_runs_with_one_seed_differ_in_times_only() -> None:
    cases = ("RS-01", "UP-04", "UP-08")
    first, second = (without_times(document_of(wrong_run(*cases, seed="7"))) for _ in range(2))
    assert first == second
    assert first != without_times(document_of(wrong_run(*cases, seed="8")))


def without_times(value: Any) -> Any:
    """A document without fields that depend on the clock."""
    if isinstance(value, dict):
        return {
            key: without_times(item)
            for key, item in value.items()
            if not key.endswith("_s") and key not in ("started_at", "histogram")
        }
    return [without_times(item) for item in value] if isinstance(value, list) else value


# -- JUnit ----------------------------------------------------------------------------------------


def assert_valid(root: ET.Element) -> None:
    """Follows the schema used by CI servers: elements, their order and their attributes."""
    assert root.tag == "testsuites"
    for suite in root:
        assert suite.tag == "testsuite"
        assert set(suite.attrib) == SUITE_KEYS
        assert next(child.tag for child in suite) == "properties"
        cases = suite.findall("testcase")
        assert len(cases) == len(suite) - 1 == int(suite.get("tests", ""))
        for kind, key in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
            assert sum(case.find(kind) is not None for case in cases) == int(suite.get(key, ""))
        for case in cases:
            assert set(case.attrib) == {"name", "classname", "time"}
            assert float(case.get("time", "")) >= 0
            tags = [child.tag for child in case]
            assert tags in ([], ["system-out"]) or tags[0] in ("failure", "error", "skipped")
            assert len(tags) <= 2
    assert set(root.attrib) == {"name", "tests", "failures", "errors", "time"}
    for key in ("tests", "failures", "errors"):
        assert int(root.get(key, "")) == sum(int(suite.get(key, "")) for suite in root)


def verdict_of(report: RunReport) -> tuple[str, str]:
    """Name of the element for the verdict of the one case, and its message."""
    root = junit_of(report)
    assert_valid(root)
    case = root[0].find("testcase")
    assert case is not None
    for child in case:
        return child.tag, child.get("message", child.text or "")
    return "", ""


@pytest.mark.slow
def test_every_verdict_has_its_element() -> None:
    assert verdict_of(run_case(passes_once)) == ("", "")
    assert verdict_of(run_case(fails_once)) == ("failure", "expected one; got two")
    noted = {"note": "the reason", "checks": ()}
    for status, tag in (
        (CaseVerdict.ERROR, "error"),
        (CaseVerdict.UNSUPPORTED, "skipped"),
        (CaseVerdict.INCONCLUSIVE, "skipped"),
    ):
        found, message = verdict_of(with_status(status, **noted))
        assert (found, "the reason" in message) == (tag, True)
    assert verdict_of(with_status(CaseVerdict.INFO, infos=("seen",)))[0] == "system-out"


def test_a_deviation_is_reported_and_one_that_is_none_any_more_fails_a_strict_run() -> None:
    profile = ConformanceProfile(PROFILE.given, deviations={"FR-00": "by design"})
    assert verdict_of(run_case(fails_once, profile=profile)) == (
        "system-out",
        "deviation: by design",
    )
    assert verdict_of(run_case(passes_once, profile=profile)) == ("", "")
    assert verdict_of(run_case(passes_once, profile=profile, strict=True))[0] == "failure"


def test_a_run_that_broke_off_is_no_green_one() -> None:
    report = with_status(CaseVerdict.NOT_RUN, note="the adapter failed")
    root = junit_of(replace(report, stopped="the adapter failed", adapter_failed=True))
    assert_valid(root)
    assert root.get("errors") == "2"
    lost = junit_of(replace(report, final_image="no boot version"))
    errors = [error.get("message") for error in root.iter("error")]
    assert errors[1] == "the run ended early: the adapter failed"
    assert "no boot version" in [error.get("message") for error in lost.iter("error")]


def test_a_failure_reports_stimulus_seed_and_replay() -> None:
    run = completed(wrong_run(), started_at=AT, replays={("RS-01", 1): "flasher x"})
    root = ET.fromstring(junit_report(run))  # noqa: S314  our own
    assert_valid(root)
    failure = root.find(".//failure")
    assert failure is not None
    text = failure.text or ""
    assert "stimulus: reset to the running application" in text
    assert "seed: 1/RS-01/1" in text
    assert "replay: flasher x" in text


def test_hostile_text_makes_no_broken_xml() -> None:
    root = junit_of(hostile_report())
    assert_valid(root)
    text = ET.tostring(root, encoding="unicode")
    assert "\x1b" not in text
    assert "<script>" not in text


# -- the page -------------------------------------------------------------------------------------


def test_a_page_of_a_good_run_is_green_and_has_every_case() -> None:
    report = run_case(passes_once, before_others=True)
    page = Page(page_of(report))
    assert_self_contained(page)
    assert "passed 2 pass" in page.text
    assert "What went wrong" not in page.text
    assert ("div", "class", "verdict good") in page.attributes
    for text in ("FR-00", "a test", "RS-04", CASES["RS-04"].title):
        assert text in page.text


def test_a_page_shows_stimulus_expected_got_and_the_decoded_trace() -> None:
    page = Page(page_of(wrong_run(), RS_01="flasher conformance --case RS-01"))
    assert_self_contained(page)
    for text in (
        "What went wrong",
        "reset to the running application",
        "nothing within 0.2 s",
        "flasher conformance --case RS-01",
        "name BMS, version V1.0.0",
        "needs images with",
        "general feedback",
        "simulated bus, exact",
    ):
        assert text in page.text
    assert ("div", "class", "verdict bad") in page.attributes


def test_times_are_drawn_for_a_desk_and_for_a_phone() -> None:
    measured = tuple(MeasuredTime("t", index / 100, 0.002) for index in range(1, 20))
    report = with_status(CaseVerdict.PASS, measurements=measured)
    report = replace(report, uncertainty_s=0.002, timestamp_source="host")
    page = Page(page_of(report))
    assert_self_contained(page)
    assert len(page.drawings) == 2
    assert "host; one of them may be off by 2 ms" in page.text
    assert "\u00b1 2 ms" in page.text


def test_hostile_text_is_shown_and_does_nothing() -> None:
    html = page_of(hostile_report())
    page = Page(html)
    assert_self_contained(page)
    assert_visible(html)
    assert "<script>alert(1)</script>" in page.text


@pytest.mark.slow
def test_a_page_stays_small_however_much_a_case_reports() -> None:
    def talks(bench: Bench) -> None:
        for _ in range(300):
            bench.send(bench.encoder.query_version())
            bench.wait(0.01)
            bench.check(False, "a", "b" * 1000)

    report = run_case(talks)
    results = report.results * 60
    html = page_of(replace(report, results=results))
    assert len(html) < 60 * MESSAGES_BAD * 400
    assert "288 more checks are not listed" in html


def test_a_run_without_a_case_has_reports_too() -> None:
    empty = run_case(passes_once)
    empty = replace(empty, cases=(), results=())
    assert "No case was selected." in page_of(empty)
    assert_valid(junit_of(empty))
    assert document_of(empty)["results"] == []


# -- traces ---------------------------------------------------------------------------------------


def test_a_trace_is_a_candump_log_with_both_directions() -> None:
    report = wrong_run("RS-01")
    (result,) = report.results
    assert is_traced(result)
    lines = candump(result.trace).decode("ascii").splitlines()
    assert len(lines) == len(result.trace)
    assert lines[0].endswith("752#55AA160742055245 T") or " 752#55AA160742055245" in lines[0]


def test_only_what_did_not_pass_has_a_trace_file_and_repeats_have_their_own() -> None:
    (passed,) = run_case(passes_once).results
    assert not is_traced(passed)
    second = CaseResult("TX-03", CaseVerdict.FAIL, repeat=2)
    assert trace_file_name(second) == "TX-03-2.log"
    assert not is_traced(second)
