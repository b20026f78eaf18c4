"""Comparison of any number of runs: verdicts and times with one column per run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.conformance.diff import reasons_of, verdicts_of
from flasher.conformance.results import CaseVerdict, RunReport
from flasher.protocol.text import printable

_FACTS: Final = (
    "subject",
    "target",
    "started_at",
    "bitrate_bps",
    "seed",
    "timestamp_source",
    "profile_source",
    "stopped",
)
"""Properties of a run to show where they differ."""


@dataclass(frozen=True)
class RunColumn:
    """One run."""

    name: str
    """Name of its file."""
    subject: str
    passed: bool
    passes: int
    passes_in_full: int
    counts: dict[str, int]


@dataclass(frozen=True)
class CaseRow:
    """A case in all runs."""

    id: str
    group: str
    title: str
    verdicts: Sequence[CaseVerdict | None]
    """The worst verdict of each run's repeats; None (null) where the run does not have the case."""
    reasons: Sequence[str]
    """Reason given by each run."""

    @property
    def differs(self) -> bool:
        """True when the verdicts differ."""
        return len(set(self.verdicts)) > 1


@dataclass(frozen=True)
class FactRow:
    """Another property that differs between the runs."""

    name: str
    values: Sequence[str]


@dataclass(frozen=True)
class TimeRow:
    """Times of one name in all runs, None (null) where a run has none."""

    name: str
    medians_s: Sequence[float | None]
    p95s_s: Sequence[float | None]


@dataclass(frozen=True)
class SideBySide:
    """Several runs in columns."""

    runs: Sequence[RunColumn]
    cases: Sequence[CaseRow]
    facts: Sequence[FactRow]
    """Properties and profile keys that differ between the runs."""
    times: Sequence[TimeRow]


def side_by_side(paths: Sequence[Path], reports: Sequence[RunReport]) -> SideBySide:
    """Arrange the reports, which were read from `paths`, in columns."""
    are_different = len({path.name for path in paths}) == len(paths)
    columns = [
        RunColumn(
            printable(path.name if are_different else str(path)),
            report.subject,
            report.ok,
            report.passes,
            report.passes_in_full,
            {name: count for name, count in report.counts.items() if count},
        )
        for path, report in zip(paths, reports, strict=True)
    ]
    cases = {case.id: case for report in reports for case in report.cases}
    verdicts = [verdicts_of(report) for report in reports]
    reasons = [reasons_of(report) for report in reports]
    rows = [
        CaseRow(
            case.id,
            case.group,
            case.title,
            [found.get(case.id) for found in verdicts],
            [found.get(case.id, "") for found in reasons],
        )
        for case in cases.values()
    ]
    facts = [FactRow(key, [str(getattr(report, key)) for report in reports]) for key in _FACTS]
    keys = dict.fromkeys(key for report in reports for key in report.profile)
    facts += [
        FactRow(f"profile, {key}", [str(report.profile.get(key, "")) for report in reports])
        for key in keys
    ]
    measured = [{times.name: times for times in report.times} for report in reports]
    times = [
        TimeRow(
            name,
            [found[name].median_s if name in found else None for found in measured],
            [found[name].p95_s if name in found else None for found in measured],
        )
        for name in dict.fromkeys(name for found in measured for name in found)
    ]
    return SideBySide(columns, rows, [row for row in facts if len(set(row.values)) > 1], times)
