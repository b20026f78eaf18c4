"""Reports of a run for programs: JSON, JUnit XML, and candump logs of cases."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from flasher.conformance.catalogue import GROUPS
from flasher.conformance.results import (
    FINAL_IMAGE_OK,
    LINE_JOINT,
    CaseResult,
    CaseText,
    CaseVerdict,
    CheckOutcome,
    Histogram,
    MeasuredTime,
    RunReport,
    Times,
    TraceEntry,
)
from flasher.protocol.frame import Frame
from flasher.report.junit import JUnitCase, JUnitResult, JUnitSuite, junit_xml
from flasher.trace.figures import Distribution

if TYPE_CHECKING:
    from pydantic import TypeAdapter

TRACED: Final = frozenset(
    {CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.INCONCLUSIVE, CaseVerdict.DEVIATION}
)
"""Verdicts that get a trace file."""
_FINDINGS: Final = 20
_RUN: Final = "run"
"""JUnit suite for the run itself: whether it was completed, and the good image."""
_JUNIT_RESULTS: Final = {
    CaseVerdict.FAIL: JUnitResult.FAILURE,
    CaseVerdict.ERROR: JUnitResult.ERROR,
    CaseVerdict.NOT_RUN: JUnitResult.ERROR,
    CaseVerdict.UNSUPPORTED: JUnitResult.SKIPPED,
    CaseVerdict.INCONCLUSIVE: JUnitResult.SKIPPED,
}
"""A case that was not judged is skipped with its reason. A case that was not run because the run
broke off is an error, so that a CI server does not show green.
"""

BINS: Final = 20
ByResult = Mapping[tuple[str, int], str]
"""A text for each result, by case id and repeat."""
_NONE: Final[ByResult] = {}


def group_title(group: str) -> str:
    """Title of a group, or its id when it is not in the catalogue."""
    return GROUPS.get(group, group)


def distribution(measurements: Iterable[MeasuredTime]) -> Distribution:
    """Distribution of measured times. Raises ValueError for none."""
    found = Distribution.of(measurement.value_s for measurement in measurements)
    if found is None:
        raise ValueError("no measurements")
    return found


def completed(
    report: RunReport, *, started_at: str, replays: ByResult = _NONE, trace_files: ByResult = _NONE
) -> RunReport:
    """Complete a report for output: start time (ISO), distribution of times, and by case id and
    repeat the replay commands and trace files of its results.
    """
    return replace(
        report,
        started_at=started_at,
        results=tuple(
            replace(
                result,
                replay=replays.get(result.key, ""),
                trace_file=trace_files.get(result.key, ""),
            )
            for result in report.results
        ),
        times=tuple(
            Times(
                name,
                **asdict(distribution(found)),
                uncertainty_s=max(one.uncertainty_s for one in found),
                histogram=_histogram([one.value_s for one in found]),
            )
            for name, found in report.measured().items()
        ),
    )


def _histogram(values_s: Sequence[float]) -> Histogram:
    low_s, high_s = min(values_s), max(values_s)
    width_s = (high_s - low_s) / BINS
    if width_s <= 0:
        return Histogram(edges_s=[low_s, high_s], counts=[len(values_s)])
    counts = [0] * BINS
    for value_s in values_s:
        counts[min(BINS - 1, int((value_s - low_s) / width_s))] += 1
    edges_s = [low_s + index * width_s for index in range(BINS)] + [high_s]
    return Histogram(edges_s=edges_s, counts=counts)


# -- JSON -----------------------------------------------------------------------------------------

# Only `started_at`, keys that end in `_s` and histograms depend on the clock; otherwise two runs
# with the same seed are equal. Frames are in separate trace files.


@cache
def adapter() -> TypeAdapter[RunReport]:
    """Reads and writes reports. Raises pydantic.ValidationError for invalid data."""
    from pydantic import TypeAdapter  # noqa: PLC0415  slow

    return TypeAdapter(RunReport)


def to_json(report: RunReport) -> dict[str, Any]:
    """Convert the report to plain JSON types: output of `--json` and `--json-report`, input of
    `diff`.
    """
    plain: dict[str, Any] = adapter().dump_python(report, mode="json", by_alias=True)
    return plain


def to_bytes(report: RunReport) -> bytes:
    """Encode the report with one key per line, so that files can be compared as text."""
    return (json.dumps(to_json(report), indent=1) + "\n").encode("ascii")


# -- JUnit ----------------------------------------------------------------------------------------


def junit_report(report: RunReport) -> bytes:
    """JUnit XML with one suite per group."""
    properties = {
        "subject": report.subject,
        "target": report.target,
        "bitrate_bps": report.bitrate_bps,
        "seed": report.seed,
        "profile": report.profile_source,
        "timestamp_source": report.timestamp_source,
        "uncertainty_s": report.uncertainty_s,
        "judged_in_full": report.in_full,
        "not_tried": "; ".join(
            f"{why}: {' '.join(case_ids)}" for why, case_ids in report.not_tried.items()
        ),
        "final_image": report.final_image_text,
        "bench_is": "; ".join(map(str, report.gaps)),
    }
    suites = {
        f"{group} {group_title(group)}": [
            _junit_case(text, result, report) for text, result in members
        ]
        for group, members in report.by_group().items()
    }
    suites[_RUN] = _junit_run(report)
    return junit_xml(
        f"conformance {report.subject}",
        [JUnitSuite(name, cases, report.started_at, properties) for name, cases in suites.items()],
        report.duration_s,
    )


def _junit_case(text: CaseText, result: CaseResult, report: RunReport) -> JUnitCase:
    repeat = f" (repeat {result.repeat})" if result.repeat > 1 else ""
    ended = _JUNIT_RESULTS.get(result.verdict, JUnitResult.PASSED)
    is_broken = report.adapter_failed or report.killed_by
    has_verdicts = any(
        one.verdict is not CaseVerdict.NOT_RUN and one.checks for one in report.results
    )
    if result.verdict is CaseVerdict.NOT_RUN and has_verdicts and not is_broken:
        ended = JUnitResult.SKIPPED  # it was stopped on request, or by its time limit
    word = result.verdict.text
    message, kind, details = result.reason or word, word, ""
    if ended is JUnitResult.SKIPPED:
        message, kind = f"{word}: {message}", ""
    elif ended in (JUnitResult.FAILURE, JUnitResult.ERROR):
        details = failure_details(text, result)
    elif report.strict and result.deviation_resolved:
        ended, kind = JUnitResult.FAILURE, "resolved deviation"
        message = f"the profile documents a deviation ({text.deviation}), but it passes"
    elif report.strict and result.verdict is CaseVerdict.PASS_IN_PART:
        ended = JUnitResult.FAILURE
    is_deviation = result.verdict is CaseVerdict.DEVIATION
    output = [f"deviation: {text.deviation}"] if is_deviation else []
    if result.verdict is CaseVerdict.PASS_IN_PART:
        output.append(word)
    output += [f"not tried: {part}" for part in result.not_tried]
    return JUnitCase(
        f"conformance.{text.group}",
        f"{text.id} {text.title}{repeat}",
        result.duration_s,
        ended,
        message,
        kind,
        details,
        "\n".join([*output, *result.infos]),
    )


def failure_details(text: CaseText, result: CaseResult) -> str:
    """Clauses, stimulus, failed checks, seed and replay command of a case, line by line."""
    failed = [check for check in result.checks if check.outcome is CheckOutcome.FAIL]
    lines = [f"clause: {label}: {content}" for label, content in text.clauses.items()]
    lines.append(f"stimulus: {text.stimulus}")
    lines += (str(check).replace(LINE_JOINT, "\n  ") for check in failed[:_FINDINGS])
    if len(failed) > _FINDINGS:
        lines.append(f"{len(failed) - _FINDINGS} more failed checks")
    lines.append(f"seed: {result.seed}")
    return "\n".join([*lines, f"replay: {result.replay}"] if result.replay else lines)


def _junit_run(report: RunReport) -> list[JUnitCase]:
    """Two test cases for the run itself, so that an incomplete run does not pass."""
    broken = report.stopped or report.not_upgradable
    whole = JUnitResult.ERROR if broken else JUnitResult.PASSED
    if not report.final_image:
        image, message, kind = JUnitResult.SKIPPED, "no case was run", ""
    else:
        verified = report.final_image == FINAL_IMAGE_OK
        image = JUnitResult.PASSED if verified else JUnitResult.ERROR
        message, kind = report.final_image_text, "final image"
    class_name, remarks = f"conformance.{_RUN}", "; ".join(report.remarks())
    return [
        JUnitCase(class_name, "the run goes to its planned end", 0.0, whole, remarks, "stopped"),
        JUnitCase(
            *(class_name, "the good image is back on the device", 0.0, image, message, kind),
            output=report.final_image_text,
        ),
    ]


# -- traces ---------------------------------------------------------------------------------------


def trace_file_name(result: CaseResult) -> str:
    """Name of a result's trace file: "TX-03.log", for repetitions "TX-03-2.log"."""
    repeat = f"-{result.repeat}" if result.repeat > 1 else ""
    return f"{result.case_id}{repeat}.log"


def is_traced(result: CaseResult) -> bool:
    """True for a result that gets a trace file."""
    return result.verdict in TRACED and bool(result.trace)


def candump(trace: Iterable[TraceEntry]) -> bytes:
    """Encode frames as a candump log; times start with the case, sent frames are marked `T`."""
    from flasher.python_can import can  # noqa: PLC0415  slow
    from flasher.trace.recorder import ONE_TOOL_CHANNEL, message_of  # noqa: PLC0415

    text = io.StringIO()
    # `flasher explain` recognises traces of a single tool by this channel.
    writer = can.CanutilsLogWriter(text, channel=ONE_TOOL_CHANNEL)
    for entry in trace:
        frame = Frame(*entry.frame)
        writer.on_message_received(
            message_of(frame, sent=entry.sent, at_s=entry.at_s, channel=ONE_TOOL_CHANNEL)
        )
    return text.getvalue().encode("ascii")
