"""Requirements matrix: each clause with the cases that test it and their verdicts in a run."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import NamedTuple

from flasher.conformance.catalogue import CASES, catalogue_order
from flasher.conformance.clauses import CLAUSES, clause_texts
from flasher.conformance.diff import reasons_of, verdicts_of
from flasher.conformance.results import CaseVerdict, RunReport

NOT_JUDGED: frozenset[CaseVerdict | None] = frozenset(
    {None, CaseVerdict.UNSUPPORTED, CaseVerdict.NOT_RUN, CaseVerdict.ERROR}
)


class CaseOfClause(NamedTuple):
    """A case that tests a clause."""

    id: str
    title: str
    verdict: CaseVerdict | None
    """Its worst one; None when it was not selected."""
    reason: str


class ClauseRow(NamedTuple):
    """A clause of the vendor's document, or a reading of this project."""

    label: str
    text: str
    cases: Sequence[CaseOfClause]

    @property
    def is_judged(self) -> bool:
        """True when a case has judged it."""
        return any(case.verdict not in NOT_JUDGED for case in self.cases)


def requirements_matrix(report: RunReport) -> list[ClauseRow]:
    """Make a row for each clause, in the order of the document."""
    from flasher.conformance import cases  # noqa: F401, PLC0415  registers the cases

    verdicts, reasons = verdicts_of(report), reasons_of(report)
    named = {case_id: clause_texts(case.clause) for case_id, case in CASES.items()}
    return [
        ClauseRow(
            label,
            text,
            [
                CaseOfClause(
                    case_id, CASES[case_id].title, verdicts.get(case_id), reasons.get(case_id, "")
                )
                for case_id in catalogue_order(CASES)
                if label in named[case_id]
            ],
        )
        for label, text in CLAUSES.items()
    ]


def matrix_csv(rows: Sequence[ClauseRow]) -> str:
    """Write a line for each clause and case; a clause without a case has one line."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(("clause", "text", "case", "title", "verdict", "reason"))
    for row in rows:
        for case in row.cases:
            verdict = "not selected" if case.verdict is None else case.verdict.text
            writer.writerow((row.label, row.text, case.id, case.title, verdict, case.reason))
        if not row.cases:
            writer.writerow((row.label, row.text, "", "", "no case", ""))
    return text.getvalue()
