"""The report of a run as JSON: what `--json` and `--json-report` give, and `diff` reads.

What a clock says is in `started_at`, in keys that end in `_s` and in the histograms of these: two
runs with one seed differ in nothing else. Frames are not in it, they go into trace files.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Annotated, Final

from typing_extensions import TypedDict

from flasher.conformance.reports import ByResult, distribution
from flasher.conformance.results import (
    CaseResult,
    CaseText,
    CaseVerdict,
    CheckOutcome,
    Measurement,
    RunReport,
)

SCHEMA_VERSION: Final = 1
"""Counts up when a field changes its meaning or goes away; not for a new one."""
BINS: Final = 20
CHECKS_KEPT: Final = 50
"""Checks of one case that are told, those that did not pass; all are counted."""


class TextDocument(TypedDict):
    """A case of the catalogue, as far as the run is concerned with it."""

    id: str
    group: str
    title: str
    """For a case that cannot be run, the reason."""
    clause: str
    stimulus: str
    expectation: str
    requires: list[str]
    choices: dict[str, str]
    """Keys of the profile that it is judged by, with their values."""
    deviation: str
    """The profile's reason why the product differs; empty for none."""


class CaseCheckDocument(TypedDict):
    """One thing that was looked at and did not pass."""

    step: str
    outcome: Annotated[str, CheckOutcome]
    expected: str
    got: str
    at_s: float


class OutcomesDocument(TypedDict):
    """How many checks of a case ended how."""

    passed: int
    failed: int
    inconclusive: int
    unsupported: int


class HistogramDocument(TypedDict):
    """How often values fell into bins of one width: as many counts as edges, less one."""

    edges_s: list[float]
    counts: list[int]


class TimesDocument(TypedDict):
    """How the times of one name are spread. Percentiles are values that were measured."""

    name: str
    count: int
    minimum_s: float
    median_s: float
    p95_s: float
    p99_s: float
    maximum_s: float
    uncertainty_s: float
    """How far a single value may be off: the greatest of them."""
    histogram: HistogramDocument


class ResultDocument(TypedDict):
    """What came of one run of a case."""

    id: str
    repeat: int
    status: Annotated[str, CaseVerdict]
    seed: str
    note: str
    checks: OutcomesDocument
    findings: list[CaseCheckDocument]
    """The checks that did not pass, the first ones of many."""
    infos: list[str]
    deviation_resolved: bool
    """The profile documents a deviation, but the case passes."""
    duration_s: float
    replay: str
    """The command that runs this case alone, with its seed; empty where there is none."""
    trace_file: str
    """Name of the file with its frames; empty without one."""


class RescueDocument(TypedDict):
    """A case after which only power brought the device back."""

    id: str
    how: str


class ReportDocument(TypedDict):
    """A run of the conformance suite."""

    report_schema: int
    """Version of this part."""
    passed: bool
    """True when nothing failed, nothing was left out by an early end, and the good image is back on
    the device.
    """
    started_at: str
    """In UTC."""
    duration_s: float
    subject: str
    target: str
    bitrate_bps: int
    timestamp_source: str
    uncertainty_s: float
    seed: str
    strict: bool
    profile_source: str
    profile: dict[str, str | int | float]
    stopped: str
    """Why the run ended before its planned end; empty for a whole one."""
    adapter_failed: bool
    killed_by: str
    """The case after which the device could not be brought back; empty for none."""
    not_upgradable: str
    """Why the good image could not be flashed at first; empty when it could."""
    final_image: str
    """"verified", or what came of the good image at the end."""
    counts: dict[str, int]
    """How many results have each status."""
    cases: list[TextDocument]
    results: list[ResultDocument]
    rescues: list[RescueDocument]
    times: list[TimesDocument]
    not_selected: list[str]
    host_cases: list[str]
    """Cases of the catalogue about the tool, which are no part of this suite."""


def verdict_name(verdict: CaseVerdict) -> str:
    """A verdict as JSON has it."""
    return verdict.name.lower()


def report_document(
    report: RunReport,
    *,
    started_at: str,
    replays: ByResult,
    trace_files: ByResult,
) -> ReportDocument:
    """The document of a run. `replays` and `trace_files` are by case id and repeat."""
    return ReportDocument(
        report_schema=SCHEMA_VERSION,
        passed=report.ok,
        started_at=started_at,
        duration_s=report.duration_s,
        subject=report.subject,
        target=report.target,
        bitrate_bps=report.bitrate_bps,
        timestamp_source=report.timestamp_source,
        uncertainty_s=report.uncertainty_s,
        seed=report.seed,
        strict=report.strict,
        profile_source=report.profile_source,
        profile=dict(report.profile),
        stopped=report.stopped,
        adapter_failed=report.adapter_failed,
        killed_by=report.killed_by,
        not_upgradable=report.not_upgradable,
        final_image=report.final_image,
        counts={verdict_name(verdict): report.count(verdict) for verdict in CaseVerdict},
        cases=[_text(text) for text in report.cases],
        results=[
            _result(result, replays.get(result.key, ""), trace_files.get(result.key, ""))
            for result in report.results
        ],
        rescues=[RescueDocument(id=rescue.case_id, how=rescue.how) for rescue in report.rescues],
        times=[_times(name, found) for name, found in report.times().items()],
        not_selected=list(report.not_selected),
        host_cases=list(report.host_cases),
    )


def _text(text: CaseText) -> TextDocument:
    return TextDocument(
        id=text.id,
        group=text.group,
        title=text.title,
        clause=text.clause,
        stimulus=text.stimulus,
        expectation=text.expectation,
        requires=list(text.requires),
        choices=dict(text.choices),
        deviation=text.deviation,
    )


def _result(result: CaseResult, replay: str, trace_file: str) -> ResultDocument:
    bad = [check for check in result.checks if check.outcome is not CheckOutcome.PASS]
    return ResultDocument(
        id=result.case_id,
        repeat=result.repeat,
        status=verdict_name(result.verdict),
        seed=result.seed,
        note=result.note,
        checks=OutcomesDocument(
            passed=result.count(CheckOutcome.PASS),
            failed=result.count(CheckOutcome.FAIL),
            inconclusive=result.count(CheckOutcome.INCONCLUSIVE),
            unsupported=result.count(CheckOutcome.UNSUPPORTED),
        ),
        findings=[
            CaseCheckDocument(
                step=check.step,
                outcome=check.outcome.name.lower(),
                expected=check.expected,
                got=check.got,
                at_s=check.at_s,
            )
            for check in bad[:CHECKS_KEPT]
        ],
        infos=list(result.infos),
        deviation_resolved=result.deviation_resolved,
        duration_s=result.duration_s,
        replay=replay,
        trace_file=trace_file,
    )


def _times(name: str, measurements: Iterable[Measurement]) -> TimesDocument:
    found = list(measurements)
    spread = distribution(found)
    return TimesDocument(
        name=name,
        count=spread.count,
        minimum_s=spread.minimum_s,
        median_s=spread.median_s,
        p95_s=spread.p95_s,
        p99_s=spread.p99_s,
        maximum_s=spread.maximum_s,
        uncertainty_s=max(one.uncertainty_s for one in found),
        histogram=_histogram([one.value_s for one in found]),
    )


def _histogram(values: list[float]) -> HistogramDocument:
    low, high = min(values), max(values)
    width = (high - low) / BINS
    if width <= 0:
        return HistogramDocument(edges_s=[low, high], counts=[len(values)])
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int((value - low) / width))] += 1
    return HistogramDocument(
        edges_s=[low + index * width for index in range(BINS)] + [high], counts=counts
    )


def to_bytes(document: ReportDocument) -> bytes:
    """The document as a file, a key a line, so that two of them can be compared as text too."""
    return (json.dumps(document, indent=1) + "\n").encode("ascii")
