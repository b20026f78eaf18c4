"""Comparison of two runs: changed verdicts, changed times, new and missing cases.

Reads files of `--json-report` or output of `--json`. A case that was repeated counts with its worst
verdict.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.conformance.reports import adapter
from flasher.conformance.results import SCHEMA_VERSION, CaseVerdict, RunReport, worst
from flasher.errors import UsageError
from flasher.files import JSON_MAX_SIZE, parse_json, read
from flasher.protocol.text import printable

THRESHOLD_PERCENT: Final = 10.0
"""A median or 95th percentile counts as slower when it grew by more than this and by more than the
uncertainty of both measurements together.
"""
_NOT_JUDGED: Final = frozenset({CaseVerdict.UNSUPPORTED, CaseVerdict.NOT_RUN})
_RANKS: Final = {verdict: rank for rank, verdict in enumerate(CaseVerdict)} | {CaseVerdict.INFO: 0}
_CONDITIONS: Final = ("target", "bitrate_bps", "seed", "timestamp_source", "profile_source")


@dataclass(frozen=True)
class VerdictChange:
    """A case whose verdict changed."""

    id: str
    title: str
    before: CaseVerdict | None
    """None (null) when the case was not judged."""
    after: CaseVerdict | None
    reason: str
    """Reason given by the newer run."""


@dataclass(frozen=True)
class TimeChange:
    """A measured time that changed by more than the threshold."""

    name: str
    figure: str
    """median or p95"""
    before_s: float
    after_s: float

    @property
    def percent(self) -> float:
        """Change in percent; negative when faster."""
        return (self.after_s / self.before_s - 1) * 100 if self.before_s else float("inf")


@dataclass(frozen=True)
class Difference:
    """Difference between two runs."""

    threshold_percent: float
    better: Sequence[VerdictChange]
    worse: Sequence[VerdictChange]
    new: Sequence[VerdictChange]
    gone: Sequence[VerdictChange]
    """Judged in the older run but not in the newer one."""
    less: Sequence[VerdictChange]
    """Passed in full in the older run, in part in the newer one."""
    more: Sequence[VerdictChange]
    slower: Sequence[TimeChange]
    faster: Sequence[TimeChange]
    unchanged: int
    conditions: Sequence[str]
    """Other differences between the runs."""

    @property
    def is_worse(self) -> bool:
        """True when a case judged in both runs got worse or a new case fails."""
        return bool(self.worse) or any(
            change.after in (CaseVerdict.FAIL, CaseVerdict.ERROR) for change in self.new
        )


def read_report(path: Path) -> RunReport:
    """Read a report. Raises UsageError for a file that cannot be read or is not a report."""
    from pydantic import ValidationError  # noqa: PLC0415  slow

    raw = read(path, JSON_MAX_SIZE, what="report")
    try:
        document = parse_json(raw)
    except ValueError as error:
        why = f"it is not valid JSON ({printable(str(error))})"
        raise _not_a_report(path, why) from error
    if isinstance(document, dict) and isinstance(document.get("report"), dict):
        document = document["report"]  # what --json prints
    if not isinstance(document, dict) or "report_schema" not in document:
        raise _not_a_report(path, "it contains no conformance report")
    if document["report_schema"] != SCHEMA_VERSION:
        found = printable(str(document["report_schema"])[:20])
        why = f"its schema version is {found}, and this program reads {SCHEMA_VERSION}"
        raise _not_a_report(path, why, "Run the suite again, and compare reports of one version.")
    try:
        return adapter().validate_python(document)
    except ValidationError as error:
        wrong = error.errors()[0]
        place = ".".join(map(str, wrong["loc"]))
        why = f"a part is missing or invalid ({printable(place)[:80]}: {wrong['msg']})"
        raise _not_a_report(path, why) from error


def _not_a_report(
    path: Path,
    why: str,
    remedy: str = "Compare files that `flasher conformance --json-report FILE` wrote.",
) -> UsageError:
    return UsageError(
        f"{printable(str(path))} is not a report of the conformance suite: {why}.", remedy=remedy
    )


def compare(
    old: RunReport, new: RunReport, threshold_percent: float = THRESHOLD_PERCENT
) -> Difference:
    """Compare `new` with `old`."""
    before, after = _judged(old), _judged(new)
    titles = {case.id: case.title for case in (*old.cases, *new.cases)}
    reasons = reasons_of(new)
    kinds = ("better", "worse", "new", "gone", "less", "more")
    found: dict[str, list[VerdictChange]] = {kind: [] for kind in kinds}
    unchanged = 0
    for case_id in dict.fromkeys((*after, *before)):
        was, is_now = before.get(case_id), after.get(case_id)
        if was is None:
            kind = "new"
        elif is_now is None:
            kind = "gone"
        elif _RANKS[is_now] == _RANKS[was]:
            unchanged += 1
            continue
        elif {was, is_now} == {CaseVerdict.PASS, CaseVerdict.PASS_IN_PART}:
            kind = "more" if is_now is CaseVerdict.PASS else "less"
        else:
            kind = "worse" if _RANKS[is_now] > _RANKS[was] else "better"
        change = VerdictChange(
            case_id, titles.get(case_id, ""), was, is_now, reasons.get(case_id, "")
        )
        found[kind].append(change)
    moved = _changed_times(old, new, threshold_percent)
    return Difference(
        threshold_percent=threshold_percent,
        **found,
        slower=[one for one in moved if one.after_s > one.before_s],
        faster=[one for one in moved if one.after_s < one.before_s],
        unchanged=unchanged,
        conditions=_other_conditions(old, new),
    )


def verdicts_of(report: RunReport) -> dict[str, CaseVerdict]:
    """The worst verdict of every case."""
    found: dict[str, list[CaseVerdict]] = {}
    for result in report.results:
        found.setdefault(result.case_id, []).append(result.verdict)
    return {case_id: worst(verdicts) for case_id, verdicts in found.items()}


def _judged(report: RunReport) -> dict[str, CaseVerdict]:
    verdicts = verdicts_of(report)
    return {case_id: each for case_id, each in verdicts.items() if each not in _NOT_JUDGED}


def reasons_of(report: RunReport) -> dict[str, str]:
    """The first non-empty reason of each case."""
    found: dict[str, str] = {}
    for result in report.results:
        reason = result.note
        if result.verdict is CaseVerdict.PASS_IN_PART:
            reason = f"not tried: {'; '.join(result.not_tried)}"
        elif result.findings:
            reason = str(result.findings[0])
        if reason:
            found.setdefault(result.case_id, reason)
    return found


def _changed_times(old: RunReport, new: RunReport, threshold_percent: float) -> list[TimeChange]:
    """Times whose median or 95th percentile changed by more than the threshold."""
    found = []
    by_name = {times.name: times for times in old.times}
    for after in new.times:
        before = by_name.get(after.name)
        if before is None:
            continue
        unsure_s = before.uncertainty_s + after.uncertainty_s
        for figure, was_s, is_s in (
            ("median", before.median_s, after.median_s),
            ("p95", before.p95_s, after.p95_s),
        ):
            grown_s = abs(is_s - was_s)
            if grown_s > unsure_s and grown_s > min(was_s, is_s) * threshold_percent / 100:
                found.append(TimeChange(after.name, figure, was_s, is_s))
                break
    return found


def _other_conditions(old: RunReport, new: RunReport) -> list[str]:
    pairs = [(key, getattr(old, key), getattr(new, key)) for key in _CONDITIONS]
    pairs += [
        (f"profile, {key[:60]}", old.profile.get(key), new.profile.get(key))
        for key in dict.fromkeys((*old.profile, *new.profile))
    ]
    return [
        f"{printable(key)}: {printable(str(was)[:60])}, then {printable(str(is_now)[:60])}"
        for key, was, is_now in pairs
        if was != is_now
    ]
