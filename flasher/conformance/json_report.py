"""The report of a run as JSON: what `--json` and `--json-report` give, and `diff` reads.

What a clock says is in `started_at`, in keys that end in `_s` and in the histograms of these: two
runs with one seed differ in nothing else. Frames are not in it, they go into trace files.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from flasher.conformance.reports import ByResult, distribution
from flasher.conformance.results import (
    CaseResult,
    CaseText,
    CaseVerdict,
    Check,
    CheckOutcome,
    Gap,
    Rescue,
    RunReport,
)

if TYPE_CHECKING:
    from pydantic import TypeAdapter

SCHEMA_VERSION: Final = 2
"""Counts up when a field changes its meaning or goes away; not for a new one."""
BINS: Final = 20
CHECKS_KEPT: Final = 50
"""Checks of one case that are told, those that did not pass; all are counted."""


@dataclass(frozen=True)
class CheckCounts:
    """How many checks of a case ended how."""

    passed: int
    failed: int
    inconclusive: int
    unsupported: int


@dataclass(frozen=True)
class ResultDocument:
    """What came of one run of a case."""

    id: str
    repeat: int
    status: CaseVerdict
    seed: str
    note: str
    checks: CheckCounts
    findings: Sequence[Check]
    """The checks that did not pass, the first ones of many."""
    not_tried: Sequence[str]
    """The parts that this bench could not try, each with the reason."""
    infos: Sequence[str]
    deviation_resolved: bool
    """The profile documents a deviation, but the case passes."""
    duration_s: float
    replay: str
    """The command that runs this case alone, with its seed; empty where there is none."""
    trace_file: str
    """Name of the file with its frames; empty without one."""


@dataclass(frozen=True)
class HistogramDocument:
    """How often values fell into bins of one width: as many counts as edges, less one."""

    edges_s: Sequence[float]
    counts: Sequence[int]


@dataclass(frozen=True)
class TimesDocument:
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


@dataclass(frozen=True)
class ReportDocument:
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
    final_image_seen_by: Sequence[str]
    """By what it was verified: version, readback; with neither, some application answers."""
    passes: int
    """Cases that passed, in full or in part."""
    passes_in_full: int
    not_tried: dict[str, list[str]]
    """Reasons why parts were not tried, with the cases that passed without them."""
    counts: dict[str, int]
    """How many results have each status."""
    cases: Sequence[CaseText]
    results: Sequence[ResultDocument]
    rescues: Sequence[Rescue]
    times: Sequence[TimesDocument]
    gaps: Sequence[Gap]
    """What this bench could not judge of the selected cases, by what it lacks."""
    not_selected: Sequence[str]
    host_cases: Sequence[str]
    """Cases of the catalogue about the tool, which are no part of this suite."""


@cache
def adapter() -> TypeAdapter[ReportDocument]:
    """Reads and writes the document. Raises pydantic.ValidationError for what is none."""
    from pydantic import TypeAdapter  # noqa: PLC0415  slow

    return TypeAdapter(ReportDocument)


def report_document(
    report: RunReport, *, started_at: str, replays: ByResult, trace_files: ByResult
) -> ReportDocument:
    """The document of a run. `replays` and `trace_files` are by case id and repeat."""
    same: dict[str, Any] = {one.name: getattr(report, one.name) for one in fields(report)}
    same["results"] = [
        _result(result, replays.get(result.key, ""), trace_files.get(result.key, ""))
        for result in report.results
    ]
    return ReportDocument(
        **same,
        report_schema=SCHEMA_VERSION,
        passed=report.ok,
        started_at=started_at,
        passes=report.count(CaseVerdict.PASS) + report.count(CaseVerdict.PASS_IN_PART),
        passes_in_full=report.count(CaseVerdict.PASS),
        not_tried=report.not_tried(),
        counts={verdict.value: report.count(verdict) for verdict in CaseVerdict},
        times=[
            TimesDocument(
                name=name,
                **asdict(distribution(found)),
                uncertainty_s=max(one.uncertainty_s for one in found),
                histogram=_histogram([one.value_s for one in found]),
            )
            for name, found in report.times().items()
        ],
    )


def _result(result: CaseResult, replay: str, trace_file: str) -> ResultDocument:
    bad = [check for check in result.checks if check.outcome is not CheckOutcome.PASS]
    return ResultDocument(
        id=result.case_id,
        repeat=result.repeat,
        status=result.verdict,
        seed=result.seed,
        note=result.note,
        checks=CheckCounts(
            passed=result.count(CheckOutcome.PASS),
            failed=result.count(CheckOutcome.FAIL),
            inconclusive=result.count(CheckOutcome.INCONCLUSIVE),
            unsupported=result.count(CheckOutcome.UNSUPPORTED),
        ),
        findings=bad[:CHECKS_KEPT],
        not_tried=result.not_tried,
        infos=result.infos,
        deviation_resolved=result.deviation_resolved,
        duration_s=result.duration_s,
        replay=replay,
        trace_file=trace_file,
    )


def _histogram(values_s: Sequence[float]) -> HistogramDocument:
    low_s, high_s = min(values_s), max(values_s)
    width_s = (high_s - low_s) / BINS
    if width_s <= 0:
        return HistogramDocument(edges_s=[low_s, high_s], counts=[len(values_s)])
    counts = [0] * BINS
    for value_s in values_s:
        counts[min(BINS - 1, int((value_s - low_s) / width_s))] += 1
    edges_s = [low_s + index * width_s for index in range(BINS)] + [high_s]
    return HistogramDocument(edges_s=edges_s, counts=counts)


def to_json(document: ReportDocument) -> dict[str, Any]:
    """The document in JSON's types."""
    plain: dict[str, Any] = adapter().dump_python(document, mode="json")
    return plain


def to_bytes(document: ReportDocument) -> bytes:
    """The document as a file, a key a line, so that two of them can be compared as text too."""
    return (json.dumps(to_json(document), indent=1) + "\n").encode("ascii")
