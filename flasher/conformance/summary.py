"""What the reports say beside the results themselves: groups by name, verdicts in the order of
their gravity, times as distributions, how the run itself went.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from flasher.conformance.model import CaseResult, Check, Measurement, Outcome, Status
from flasher.conformance.report import CaseText, Report
from flasher.trace.figures import Distribution

GROUP_TITLES: Final[Mapping[str, str]] = {
    "FR": "framing",
    "CR": "checksum",
    "RS": "reset and boot version",
    "UP": "update command",
    "TX": "transfer",
    "EN": "end of transfer",
    "TM": "timing",
    "BU": "bus",
    "PW": "power",
    "SE": "bad input",
    "CO": "concurrency",
}
GRAVITY: Final = (
    Status.PASS,
    Status.INFO,
    Status.UNSUPPORTED,
    Status.DEVIATION,
    Status.INCONCLUSIVE,
    Status.NOT_RUN,
    Status.ERROR,
    Status.FAIL,
)
"""The verdicts from the best to the worst."""
BAD: Final = frozenset({Status.FAIL, Status.ERROR})
"""Verdicts that need somebody to look; cases that were not run have one reason for all of them."""


def group_title(group: str) -> str:
    """What a group is about; its id when it is none of the catalogue's."""
    return GROUP_TITLES.get(group, group)


def worst(statuses: Iterable[Status]) -> Status:
    """The gravest of some verdicts. Raises ValueError for none."""
    return max(statuses, key=GRAVITY.index)


def by_case(report: Report) -> list[tuple[CaseText, list[CaseResult]]]:
    """Every case with its results, in the order of the catalogue."""
    results: dict[str, list[CaseResult]] = {text.id: [] for text in report.cases}
    for result in report.results:
        results[result.case_id].append(result)
    return [(text, results[text.id]) for text in report.cases]


def counts(results: Iterable[CaseResult]) -> dict[Status, int]:
    """How many results have each verdict that occurs, from the best to the worst."""
    found: dict[Status, int] = {}
    for result in results:
        found[result.status] = found.get(result.status, 0) + 1
    return {status: found[status] for status in GRAVITY if status in found}


def outcomes(result: CaseResult) -> dict[Outcome, int]:
    """How many checks of a case ended in each way."""
    return {
        outcome: sum(check.outcome is outcome for check in result.checks) for outcome in Outcome
    }


def reason(result: CaseResult) -> str:
    """Why a result is what it is, in one line: expected and got of what went wrong, or its note."""
    check = result.first_failure
    if check is None:
        return result.note
    return finding(check)


def finding(check: Check) -> str:
    """A check in one line."""
    step = f"{check.step}: " if check.step else ""
    return f"{step}expected {check.expected}; got {check.got}"


def times(report: Report) -> dict[str, list[Measurement]]:
    """All measurements of a run by name, in the order in which the names came first."""
    found: dict[str, list[Measurement]] = {}
    for result in report.results:
        for measurement in result.measurements:
            found.setdefault(measurement.name, []).append(measurement)
    return found


def distribution(measurements: Iterable[Measurement]) -> Distribution:
    """How measured times are spread. Raises ValueError for none."""
    found = Distribution.of(measurement.value_s for measurement in measurements)
    if found is None:
        raise ValueError("no measurements")
    return found


def headline(report: Report) -> str:
    """The run in one line: what came of how many cases."""
    parts = [f"{count} {status.value}" for status, count in counts(report.results).items()]
    return ", ".join(parts) or "no case"


def end_of_run(report: Report) -> list[str]:
    """What a reader must know of how the run itself went; empty for a run to its planned end."""
    lines = []
    if report.stopped:
        lines.append(f"the run ended early: {report.stopped}")
    if report.killed_by:
        lines.append(f"{report.killed_by} left a device that could not be brought back")
    if report.not_upgradable:
        lines.append(
            "the good image could not be flashed before the first case, so that cases about a "
            f"running application had none: {report.not_upgradable}"
        )
    lines += [f"after {rescue.case_id}: {rescue.how}" for rescue in report.rescues]
    if report.resolved_deviations:
        named = ", ".join(dict.fromkeys(report.resolved_deviations))
        lines.append(f"deviations in the profile that are none any more: {named}")
    return lines
