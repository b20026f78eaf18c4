"""HTML report of a run: verdict, cases, decoded frames of failures, distribution of times.

Limits everything that grows with a run; the template `conformance.html` does the layout.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from flasher.conformance.matrix import ClauseRow
from flasher.conformance.reports import group_title
from flasher.conformance.results import (
    CaseResult,
    CaseText,
    CaseVerdict,
    CheckOutcome,
    RunReport,
    Times,
)
from flasher.conformance.side_by_side import SideBySide
from flasher.conformance.trace_excerpt import excerpt, frame_lines
from flasher.report import chart
from flasher.report.base import Status, render_page

CHECKS_SHOWN: Final = 12
"""Checks to list per case, those that did not pass first."""
MESSAGES_BAD: Final = 80
"""Messages to show of a failed case, up to its first failed check."""
MESSAGES_GOOD: Final = 20
"""Messages to show of other cases, from the start."""
HISTOGRAM_LEAST: Final = 5
"""Smallest number of values that gets a histogram."""
TRACES_OPEN: Final = 5
"""With more failed cases than this, their traces are collapsed and not printed."""
FRAMES_BAD: Final = 300
"""Raw frames to show of a failed case, up to its first failed check."""
FRAMES_IN_PART: Final = 60
"""Raw frames to show of other cases that did not pass in full, from the start."""
_INFOS_SHOWN: Final = 20
_CLOCK_S: Final = 1e-6
"""Times that differ by less than this are equal: no histogram."""
_COLOURS: Final = {
    CaseVerdict.PASS: Status.GOOD,
    CaseVerdict.PASS_IN_PART: Status.GOOD,
    CaseVerdict.FAIL: Status.BAD,
    CaseVerdict.ERROR: Status.BAD,
    CaseVerdict.DEVIATION: Status.WARNING,
    CaseVerdict.INCONCLUSIVE: Status.WARNING,
    CaseVerdict.UNSUPPORTED: Status.NEUTRAL,
    CaseVerdict.INFO: Status.NEUTRAL,
    CaseVerdict.NOT_RUN: Status.NEUTRAL,
}
_CHECK_COLOURS: Final = {
    CheckOutcome.FAIL: Status.BAD,
    CheckOutcome.INCONCLUSIVE: Status.WARNING,
    CheckOutcome.UNSUPPORTED: Status.NEUTRAL,
    CheckOutcome.PASS: Status.GOOD,
}
"""Colours of outcomes, in the order in which checks are listed."""


def html_page(report: RunReport) -> str:
    groups = {
        f"{group} {group_title(group)}": [_case(text, result) for text, result in members]
        for group, members in report.by_group().items()
    }
    others = {
        title: [case for case in cases if case["status"] is not Status.BAD]
        for title, cases in groups.items()
    }
    return render_page(
        "conformance.html",
        report=report,
        status=Status.GOOD if report.ok else Status.BAD,
        word="passed" if report.ok else "not passed",
        groups=groups,
        troubled=[
            case for cases in groups.values() for case in cases if case["status"] is Status.BAD
        ],
        traces_open=TRACES_OPEN,
        others={title: cases for title, cases in others.items() if cases},
        times=_times(report),
    )


def comparison_page(found: SideBySide) -> str:
    """Render the page that compares several runs."""
    return render_page(
        "side_by_side.html",
        found=found,
        colours=_COLOURS,
        in_part=CaseVerdict.PASS_IN_PART,
        differing=[case for case in found.cases if case.differs],
    )


def matrix_page(report: RunReport, rows: Sequence[ClauseRow]) -> str:
    """Render the requirements matrix of a run."""
    return render_page(
        "matrix.html",
        report=report,
        rows=rows,
        colours=_COLOURS,
        in_part=CaseVerdict.PASS_IN_PART,
    )


def _times(report: RunReport) -> list[tuple[Times, dict[str, chart.HistogramChart]]]:
    """All measurements of each name, with a drawing for each width; none for too few values."""
    views = []
    measured = report.measured()
    for found in report.times:
        drawings = {}
        is_spread = found.minimum_s > 0 and found.maximum_s - found.minimum_s > _CLOCK_S
        if found.count >= HISTOGRAM_LEAST and is_spread:
            values_s = [one.value_s for one in measured[found.name]]
            drawings = {width: chart.histogram(values_s, at) for width, at in chart.WIDTHS.items()}
        views.append((found, drawings))
    return views


def _case(text: CaseText, result: CaseResult) -> dict[str, Any]:
    """A result with its case, prepared for the template."""
    colour = _COLOURS[result.verdict]
    is_wrong = colour is not Status.GOOD
    trace = excerpt(
        result,
        MESSAGES_BAD if is_wrong else MESSAGES_GOOD,
        FRAMES_BAD if is_wrong else FRAMES_IN_PART,
    )
    repeat = f" (repeat {result.repeat})" if result.repeat > 1 else ""
    order = list(_CHECK_COLOURS)
    checks = sorted(result.checks, key=lambda check: order.index(check.outcome))
    is_pass = result.verdict is CaseVerdict.PASS
    return {
        "text": text,
        "result": result,
        "title": text.title + repeat,
        "status": colour,
        "replay": result.replay if colour in (Status.BAD, Status.WARNING) else "",
        "checks": [(check, _CHECK_COLOURS[check.outcome]) for check in checks[:CHECKS_SHOWN]],
        "infos": result.infos[:_INFOS_SHOWN],
        "trace": trace,
        "raw": "" if is_pass else "\n".join(frame_lines(trace.frames)),
        "in_part": result.verdict is CaseVerdict.PASS_IN_PART,
    }
