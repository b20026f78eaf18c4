"""Reports of runs: figures and rows as JSON, CSV and JUnit XML."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime
from decimal import Decimal
from functools import cached_property
from typing import Any, Final

from flasher.protocol.text import no_formula
from flasher.report.junit import JUnitCase, JUnitResult, JUnitSuite, junit_xml
from flasher.station.records.capability import Capability
from flasher.station.records.model import (
    Figures,
    ReportedRun,
    RunFilter,
    RunKind,
    RunState,
    utc_text,
)
from flasher.station.records.queries import Records

SCHEMA_VERSION: Final = 1


@dataclass(frozen=True)
class Report:
    """The runs of a filter and their figures, read on first access. Raises RecordError."""

    records: Records
    chosen: RunFilter

    @cached_property
    def figures(self) -> Figures:
        return self.records.figures(self.chosen)

    @cached_property
    def runs(self) -> list[ReportedRun]:
        """The runs, oldest first."""
        return self.records.table(self.chosen)

    @cached_property
    def capabilities(self) -> list[Capability]:
        return self.records.capabilities(self.chosen)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON types; times are UTC texts."""
        shares = {
            "yield_share": self.figures.yield_share,
            "first_pass_share": self.figures.first_pass_share,
        }
        return {
            "schema": SCHEMA_VERSION,
            "filter": {
                name: utc_text(value) if isinstance(value, datetime) else value
                for name, value in asdict(self.chosen).items()
            },
            "figures": asdict(self.figures) | shares,
            "measurements": [asdict(each) for each in self.capabilities],
            "runs": [vars(run) for run in self.runs],
        }

    def to_json(self) -> str:
        return json.dumps(self.to_dict(), indent=1) + "\n"

    def to_csv(self) -> str:
        """The runs as CSV with a line of headings; "" without runs."""
        return csv_text([*map(vars, self.runs[:1]), *(vars(run).values() for run in self.runs)])

    def to_measurements_csv(self) -> str:
        """The measurements with limits as CSV with a line of headings; "" without any."""
        rows = [vars(each) for each in self.capabilities]
        return csv_text([*rows[:1], *(map(_exact, row.values()) for row in rows)])

    def to_junit(self) -> str:
        """The runs as JUnit XML test cases: FAIL is a failure, ERROR and INTERRUPTED are errors,
        ABORTED is skipped. Golden units and active runs are left out.
        """
        cases = [
            _junit_case(run)
            for run in self.runs
            if run.kind is not RunKind.GOLDEN and run.state is not RunState.RUNNING
        ]
        return junit_xml("station", [JUnitSuite("station", cases)]).decode("ascii")


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV for a spreadsheet."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\r\n").writerows(map(csv_cell, row) for row in rows)
    return out.getvalue()


def _exact(value: object) -> object:
    """A number with its leading digits, however small it is."""
    return Decimal(f"{value:.9g}") if isinstance(value, float) else value


def csv_cell(value: object) -> str:
    """Format a cell of CSV; a text that a spreadsheet would take for a formula is escaped."""
    if isinstance(value, str):
        return no_formula(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3f}"
    return "" if value is None else str(value)


_JUNIT_RESULTS: Final = {
    RunState.FAIL: JUnitResult.FAILURE,
    RunState.ERROR: JUnitResult.ERROR,
    RunState.INTERRUPTED: JUnitResult.ERROR,
    RunState.ABORTED: JUnitResult.SKIPPED,
}


def _junit_case(run: ReportedRun) -> JUnitCase:
    virtual = "virtual " if run.is_virtual else ""
    return JUnitCase(
        f"{virtual}{run.recipe} {run.recipe_revision}",
        run.serial,
        run.duration_s or 0.0,
        _JUNIT_RESULTS.get(run.state, JUnitResult.PASSED),
        message=run.text,
        type=run.code,
        timestamp=run.begun_at,
    )
