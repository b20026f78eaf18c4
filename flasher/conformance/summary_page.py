"""Badge and one-page summary of a run, for publication with a release."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher import __version__
from flasher.conformance.profile import profile_keys
from flasher.conformance.reports import group_title
from flasher.conformance.results import CaseResult, CaseText, CaseVerdict, RunReport
from flasher.conformance.trace_excerpt import boot_versions
from flasher.report.base import Status, render_page

_LISTED: Final = 6
"""Room on the page for failed cases, deviations and times, each."""
_NARROW: Final = frozenset(" ,fijlrt")
_WIDTH: Final = 6.9
_NARROW_WIDTH: Final = 3.8
"""Widths of characters in the badge at font size 11."""
_LABEL: Final = "bootloader conformance"
_WRONG: Final = (CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.INCONCLUSIVE)


def badge(report: RunReport) -> str:
    """Render the result as an SVG badge."""
    full = report.passes_in_full
    in_part = report.passes - full
    bad = sum(map(report.count, (CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.NOT_RUN)))
    if report.ok:
        status = Status.WARNING if in_part else Status.GOOD
        text = f"{full + in_part} passed" + (f", {full} in full" if in_part else "")
    else:
        status = Status.BAD
        text = f"{bad} of {len(report.results)} not passed" if bad else "not passed"
    widths = [
        round(sum(_NARROW_WIDTH if char in _NARROW else _WIDTH for char in part))
        for part in (_LABEL, text)
    ]
    return render_page("badge.svg", label=_LABEL, text=text, status=status, widths=widths)


def summary_page(report: RunReport) -> str:
    """Render the one-page summary."""
    by_case = report.by_case()
    columns = [verdict for verdict in CaseVerdict if report.count(verdict)]
    return render_page(
        "release.html",
        report=report,
        status=Status.GOOD if report.ok else Status.BAD,
        word="passed" if report.ok else "not passed",
        version=__version__,
        boot_versions=boot_versions(report),
        columns=columns,
        groups={
            f"{group} {group_title(group)}": [
                sum(one.verdict is verdict for _, one in members) for verdict in columns
            ]
            for group, members in report.by_group().items()
        },
        wrong=_listed(by_case, _WRONG),
        deviating=_listed(by_case, (CaseVerdict.DEVIATION,)),
        not_judged=[
            (text, result)
            for text, result in _listed(by_case, (CaseVerdict.UNSUPPORTED,))
            if not any(text.id in gap.unsupported for gap in report.gaps)
        ],
        listed=_LISTED,
        choices=", ".join(
            f"{path} = {report.profile[path]}"
            for path, key in profile_keys().items()
            if report.profile.get(path, key.default) != key.default
        ),
        times=sorted(report.times, key=lambda row: -row.count)[:_LISTED],
    )


def _listed(
    by_case: Sequence[tuple[CaseText, CaseResult]], verdicts: Sequence[CaseVerdict]
) -> list[tuple[CaseText, CaseResult]]:
    return [(text, result) for text, result in by_case if result.verdict in verdicts]
