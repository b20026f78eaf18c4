"""Text output of `flasher conformance`: summary of a run, comparison of two, list of cases."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Final

from flasher.cli.output import counted, duration
from flasher.cli.terminal import columns
from flasher.conformance.diff import Difference, VerdictChange
from flasher.conformance.reports import group_title
from flasher.conformance.results import (
    LINE_JOINT,
    CaseResult,
    CaseText,
    CaseVerdict,
    CheckOutcome,
    Gap,
    InitResult,
    RunReport,
    Times,
    count_text,
)
from flasher.conformance.side_by_side import SideBySide
from flasher.protocol.text import printable

_TEXT_LIMIT: Final = 160
_REASON_LIMIT: Final = 240
"""Of why a case did not pass; -v shows all of it."""
_CELL: Final = 40
_NOTES_SHOWN: Final = 12
FAILED: Final = frozenset(
    {CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.INCONCLUSIVE, CaseVerdict.NOT_RUN}
)
"""Verdicts of cases that did not pass."""
_TOLD: Final = (
    CaseVerdict.FAIL,
    CaseVerdict.ERROR,
    CaseVerdict.INCONCLUSIVE,
    CaseVerdict.DEVIATION,
)
"""Verdicts with one line per case; unsupported cases share one per reason."""
_MS: Final = 1000
_SHADES: Final = " .:-=+*#%@"
_ADDRESS: Final = re.compile(r"\b0x[0-9a-fA-F]+|==\d+==")
"""What differs between two reports of the same crash."""
_DRAWN_LEAST: Final = 20
_DRAWN_MS: Final = 0.1
"""Times that differ by less count as equal."""


# -- a run ----------------------------------------------------------------------------------------


def report_lines(report: RunReport, *, verbose: bool = False) -> Iterator[str]:
    """The summary of a run: groups, failures with the command to repeat each, times, the verdict.

    `verbose` lists every case and every failed check.
    """
    yield printable(
        f"{report.subject}, target {report.target}, profile: {report.profile_source}, "
        f"seed {report.seed}"
    )
    yield ""
    yield from columns(
        (group, group_title(group), count_text(result for _, result in members))
        for group, members in report.by_group().items()
    )
    cases = report.by_case()
    if verbose:
        yield ""
        for text, result in cases:
            why = f": {result.reason}" if result.verdict is CaseVerdict.PASS_IN_PART else ""
            yield printable(f"{result.verdict.text:<12}  {text.id}  {text.title}{why}")
    crashes: set[str] = set()
    for status in _TOLD:
        lines = [
            line
            for text, result in cases
            if result.verdict is status
            for line in _case_lines(text, result, crashes, verbose=verbose)
        ]
        if lines:
            yield ""
            yield from lines
    yield from _not_judged(report)
    yield from _times(report, verbose=verbose)
    if report.gaps:
        yield ""
        yield from (printable(f"this bench is {gap}") for gap in report.gaps)
    yield ""
    for line in report.remarks():
        yield printable(f"note: {line}")
    if report.final_image:
        yield printable(f"good image at the end: {report.final_image_text}")
    if report.in_full:
        yield report.in_full
    verdict = "passed" if report.ok else "NOT PASSED"
    yield f"{verdict}: {report.headline}; {duration(report.duration_s)} on the bus"


def _case_lines(
    text: CaseText, result: CaseResult, crashes: set[str], *, verbose: bool
) -> Iterator[str]:
    """One line: case, expected, actual, and the command to repeat it. After a crash that is not
    among `crashes` yet, also all that the bootloader printed.
    """
    repeat = f" (repeat {result.repeat})" if result.repeat > 1 else ""
    reason, failure = result.reason, result.first_failure
    limit = _REASON_LIMIT
    if failure is not None:  # the profile keys in it take no room from the rest
        limit += len(failure.expected_by) - len(failure.expected)
    if result.verdict is CaseVerdict.DEVIATION:
        reason = f"{reason} (profile: {text.deviation})"
    head = f"{result.verdict.text.upper()} {text.id}{repeat} {text.title} [{text.clause}]"
    replay = f" | replay: {result.replay}" if result.replay else ""
    yield printable(f"{head}: {reason if verbose else _short(reason, limit)}") + replay
    crash, *printed = result.reason.split(LINE_JOINT)
    place = _ADDRESS.sub("", crash)
    if printed and place not in crashes:
        crashes.add(place)
        yield from (printable(f"    {line}") for line in (crash, *printed))
    failed = [one for one in result.checks if one.outcome is CheckOutcome.FAIL]
    if verbose:
        for label, content in text.clauses.items():
            yield printable(f"    {label}: {content}")
        for one in failed[1:]:
            yield printable(f"    also: {one}")
    elif len(failed) > 1:
        yield f"    and {counted(len(failed) - 1, 'more failed check')}"


def tried_lines(report: RunReport, asked: InitResult) -> Iterator[str]:
    """The cases that did not pass by a profile that was just determined, each with the keys that
    decide it and what was observed about them; in one line when all passed.
    """
    from flasher.conformance.profile import profile_keys  # noqa: PLC0415  loads pydantic

    bad = [(text, result) for text, result in report.by_case() if result.verdict in FAILED]
    headline = f"quick cases by this profile: {report.headline}"
    if not (bad or report.remarks()):
        yield headline
        return
    keys, seen = profile_keys(), {one.key: one.seen for one in asked.answers}
    yield f"{headline}. What does not pass is a fault of the device, or of a key:"
    for text, result in bad:
        yield printable(f"{result.verdict.text.upper()} {text.id} {text.title}: {result.reason}")
        failure = result.first_failure
        judged_by = {} if failure is None else failure.judged_by
        for key, value in judged_by.items():
            shown = value if isinstance(value, str) else f"{value:g}"
            choices = f" ({keys[key].allowed})" if keys[key].choices else ""
            yield printable(f"    {key} = {shown}{choices}: {_short(seen[key])}")
        if not judged_by:
            yield "    no key allows this"
    yield from (printable(f"note: {line}") for line in report.remarks())


def _not_judged(report: RunReport) -> Iterator[str]:
    """Cases without a full verdict, grouped by reason."""
    reasons: dict[tuple[CaseVerdict, str], list[str]] = {}
    for result in report.results:
        if result.verdict in (CaseVerdict.UNSUPPORTED, CaseVerdict.NOT_RUN):
            unsupported = CheckOutcome.UNSUPPORTED
            whys = [check.got for check in result.checks if check.outcome is unsupported]
            why = result.note or next(iter(whys), "no reason given")
            reasons.setdefault((result.verdict, why), []).append(result.case_id)
    for why, case_ids in report.not_tried.items():
        reasons[CaseVerdict.PASS_IN_PART, why] = case_ids
    if reasons:
        yield ""
    for (status, why), case_ids in reasons.items():
        named = list(dict.fromkeys(case_ids))
        yield printable(f"{status.text}: {_some(named)}: {_short(why)}")


def _times(report: RunReport, *, verbose: bool) -> Iterator[str]:
    if not report.times:
        return
    yield ""
    unsure = f" +- {report.uncertainty_s * _MS:g} ms" if report.uncertainty_s else ""
    yield f"times in ms (time stamps: {printable(report.timestamp_source)}{unsure})"
    rows: list[tuple[str, ...]] = [("", "count", "least", "median", "p95", "p99", "most", "")]
    for of in report.times:
        if of.count < 2 and not verbose and len(report.times) > _NOTES_SHOWN:
            continue
        values_s = (of.minimum_s, of.median_s, of.p95_s, of.p99_s, of.maximum_s)
        figures = (f"{value * _MS:.1f}" for value in values_s)
        rows.append((printable(of.name), f"{of.count}", *figures, _drawn(of)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (f"{cell:>{width}}" for cell, width in zip(row[1:], widths[1:], strict=True))
        yield (f"  {row[0]:<{widths[0]}}  " + "  ".join(cells)).rstrip()


def _drawn(of: Times) -> str:
    """A histogram in one word, lowest value first: the darker, the more; empty without data."""
    if of.count < _DRAWN_LEAST or (of.maximum_s - of.minimum_s) * _MS < _DRAWN_MS:
        return ""
    counts = of.histogram.counts
    darkest = len(_SHADES) - 1
    return f"|{''.join(_SHADES[ceil(count / max(counts) * darkest)] for count in counts)}|"


# -- what a bench cannot judge --------------------------------------------------------------------


def gap_lines(bench: str, gaps: Sequence[Gap]) -> Iterator[str]:
    """Cases that a bench cannot judge, one line per missing thing."""
    yield f"{bench}: {'judges all in full' if not gaps else ''}".rstrip()
    for gap in gaps:
        costs = {"cannot be run": gap.unsupported, "judged in part": gap.in_part}
        shown = "; ".join(f"{_some(ids)} {what}" for what, ids in costs.items() if ids)
        yield printable(f"  without {gap.lacks}: {shown} (it takes {gap.remedy})")


def _some(case_ids: Sequence[str]) -> str:
    more = len(case_ids) - _NOTES_SHOWN
    shown = " ".join(case_ids[:_NOTES_SHOWN])
    return f"{shown} and {more} more" if more > 0 else shown


# -- the list -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ListedCase:
    """A case that --list shows."""

    id: str
    group: str
    title: str
    """Why the case cannot be run."""
    clause: str
    clauses: Mapping[str, str]
    """Each of the clauses that `clause` names, with its content."""
    requires: tuple[str, ...]
    in_part_without: tuple[str, ...]
    """Needed on a bench to judge all of it."""
    choices: tuple[str, ...]
    """Keys of the profile that it depends on."""
    can_be_run: bool
    only_when_named: bool
    """It wears the device, so it runs only when it or its group is named."""


def list_lines(cases: Sequence[ListedCase], *, verbose: bool = False) -> Iterator[str]:
    """The catalogue, one line per case; with `verbose` also the texts of its clauses."""
    width = max((len(case.title) for case in cases if case.can_be_run), default=0)
    for case in cases:
        if not case.can_be_run:
            yield f"{case.id}  cannot be run: {case.title}"
            continue
        notes = [", ".join(case.requires)] if case.requires else []
        if case.only_when_named:
            notes.append("only when named")
        if case.in_part_without:
            notes.append(f"in part without {', '.join(case.in_part_without)}")
        needs = f"  ({'; '.join(notes)})" if notes else ""
        yield f"{case.id}  {case.title:<{width}}  {case.clause}{needs}"
        if verbose:
            yield from (f"       {label}: {content}" for label, content in case.clauses.items())
    can_be_run = sum(case.can_be_run for case in cases)
    yield f"{counted(len(cases), 'case')}, {can_be_run} of them can be run"


# -- two runs -------------------------------------------------------------------------------------


def difference_lines(found: Difference) -> Iterator[str]:
    """Cases that became better, worse or slower."""
    for condition in found.conditions:
        yield f"not the same: {condition}"
    for kind in ("worse", "better", "new", "gone", "less", "more"):
        changes: Sequence[VerdictChange] = getattr(found, kind)
        for change in changes:
            before = "not judged" if change.before is None else change.before.text
            after = "not judged" if change.after is None else change.after.text
            why = f": {_short(change.reason)}" if change.reason else ""
            line = f"{change.id} {_short(change.title)}: {before}, now {after}{why}"
            yield printable(f"{kind:<6}  {line}")
    for one in (*found.slower, *found.faster):
        kind = "slower" if one.after_s > one.before_s else "faster"
        yield printable(
            f"{kind:<6}  {one.name}, {one.figure}: {one.before_s * _MS:.1f} ms, "
            f"now {one.after_s * _MS:.1f} ms ({one.percent:+.0f} %)"
        )
    yield (
        f"{len(found.worse)} worse, {len(found.better)} better, {len(found.new)} new, "
        f"{len(found.gone)} gone, {found.unchanged} unchanged; {len(found.less)} judged less "
        f"fully, {len(found.more)} more fully; {len(found.slower)} slower and "
        f"{len(found.faster)} faster by more than {found.threshold_percent:g} % and the uncertainty"
    )


def side_by_side_lines(found: SideBySide, *, verbose: bool = False) -> Iterator[str]:
    """Differences between runs, side by side; `verbose` lists all cases."""
    head = ["", *(run.name for run in found.runs)]
    rows = [["verdict", *("passed" if run.passed else "NOT PASSED" for run in found.runs)]]
    rows.append(["passes", *(f"{run.passes}, {run.passes_in_full} in full" for run in found.runs)])
    rows += [[row.name, *row.values] for row in found.facts]
    yield from _table([head, *rows])
    shown = [case for case in found.cases if verbose or case.differs]
    if shown:
        yield ""
        yield from _table(
            [
                f"{case.id} {case.title}",
                *("-" if each is None else each.text for each in case.verdicts),
            ]
            for case in shown
        )
    if found.times:
        yield ""
        yield "median and 95th percentile in ms"
        yield from _table(
            [row.name, *map(_median_and_p95, row.medians_s, row.p95s_s)] for row in found.times
        )
    differ = sum(case.differs for case in found.cases)
    yield ""
    yield f"{differ} of {counted(len(found.cases), 'case')} differ"


def _median_and_p95(median_s: float | None, p95_s: float | None) -> str:
    if median_s is None or p95_s is None:
        return "-"
    return f"{median_s * _MS:.1f}, {p95_s * _MS:.1f}"


def _table(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield from columns([_short(printable(cell), _CELL) for cell in row] for row in rows)


def _short(text: str, limit: int = _TEXT_LIMIT) -> str:
    return text if len(text) <= limit else text[: limit - 3] + "..."
