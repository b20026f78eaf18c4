"""What `flasher conformance` prints with `--json`, as types, and the comparison of two runs
as one of them. The report itself is `flasher.conformance.json_report`.
"""

from __future__ import annotations

from typing import Annotated, Final

from typing_extensions import TypedDict

from flasher.conformance.diff import Change, Difference, Slowdown
from flasher.conformance.json_report import ReportDocument, verdict_name
from flasher.conformance.results import CaseVerdict


class ConformanceDocument(TypedDict):
    """What came of a run."""

    report: ReportDocument


class ListedCaseDocument(TypedDict):
    """A case that --list shows."""

    id: str
    group: str
    title: str
    """For a case that cannot be run, the reason."""
    clause: str
    requires: list[str]
    choices: list[str]
    """Keys of the profile that it depends on."""
    can_be_run: bool


class CaseListDocument(TypedDict):
    """The cases that are selected."""

    cases: list[ListedCaseDocument]


class VerdictChangeDocument(TypedDict):
    """A case whose verdict is another one in the newer run."""

    id: str
    title: str
    before: Annotated[str, CaseVerdict] | None
    """null where it was not judged."""
    after: Annotated[str, CaseVerdict] | None
    reason: str


class SlowdownDocument(TypedDict):
    """A measured time that is another one in the newer run."""

    name: str
    figure: str
    """median or p95"""
    before_s: float
    after_s: float


class DifferenceDocument(TypedDict):
    """Two runs compared."""

    threshold_percent: float
    better: list[VerdictChangeDocument]
    worse: list[VerdictChangeDocument]
    new: list[VerdictChangeDocument]
    gone: list[VerdictChangeDocument]
    """Judged in the older run, not in the newer one."""
    slower: list[SlowdownDocument]
    faster: list[SlowdownDocument]
    unchanged: int
    conditions: list[str]
    """What else differs between the runs."""


class ProfileKeyDocument(TypedDict):
    """A key of the profile."""

    key: str
    """With the table that it stands in, as limits.ack_s."""
    default: str | int | float
    allowed: str
    meaning: str


class ProfileKeysDocument(TypedDict):
    """What a profile may say."""

    keys: list[ProfileKeyDocument]
    toml: str
    """A whole profile, as it is printed without --json."""


DOCUMENTS: Final = (
    ConformanceDocument,
    CaseListDocument,
    DifferenceDocument,
    ProfileKeysDocument,
)


def difference_document(found: Difference) -> DifferenceDocument:
    return DifferenceDocument(
        threshold_percent=found.threshold_percent,
        better=[_change(one) for one in found.better],
        worse=[_change(one) for one in found.worse],
        new=[_change(one) for one in found.new],
        gone=[_change(one) for one in found.gone],
        slower=[_slowdown(one) for one in found.slower],
        faster=[_slowdown(one) for one in found.faster],
        unchanged=found.unchanged,
        conditions=list(found.conditions),
    )


def _change(change: Change) -> VerdictChangeDocument:
    return VerdictChangeDocument(
        id=change.case_id,
        title=change.title,
        before=None if change.before is None else verdict_name(change.before),
        after=None if change.after is None else verdict_name(change.after),
        reason=change.reason,
    )


def _slowdown(found: Slowdown) -> SlowdownDocument:
    return SlowdownDocument(
        name=found.name, figure=found.figure, before_s=found.before_s, after_s=found.after_s
    )
