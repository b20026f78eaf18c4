"""Reports of runs: figures and rows as JSON, CSV and JUnit XML."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from enum import IntEnum
from functools import cached_property
from typing import Final

from flasher.documents import SCHEMA_VERSION, as_json
from flasher.protocol.text import no_formula
from flasher.report.junit import JUnitCase, JUnitResult, JUnitSuite, junit_xml
from flasher.station.records.capability import Capability
from flasher.station.records.model import (
    Figures,
    PassedTwice,
    RunFilter,
    RunKind,
    RunRecord,
    RunState,
    utc_text,
)
from flasher.station.records.store import Store
from flasher.validation import json_keys

TWICE_MAX: Final = 100
"""Units that passed at two stations that reports show."""


@json_keys("schema filter=chosen figures measurements runs passed_twice")
@dataclass(frozen=True)
class Report:
    """Runs with their figures, read on first access. Raises RecordError."""

    store: Store
    chosen: RunFilter
    """What selects the runs."""

    @property
    def schema(self) -> int:
        """Version of this schema."""
        return SCHEMA_VERSION

    @cached_property
    def figures(self) -> Figures:
        return self.store.read.figures(self.chosen)

    @cached_property
    def measurements(self) -> list[Capability]:
        """Measurements with limits."""
        return self.store.read.capabilities(self.chosen)

    @cached_property
    def runs(self) -> list[RunRecord]:
        """The runs, oldest first."""
        return self.store.read.table(self.chosen)

    @cached_property
    def passed_twice(self) -> Sequence[PassedTwice]:
        """Of a plant: the newest 100 units that passed at two stations, without a recipe that asked
        for it, whatever runs were chosen.
        """
        return self.store.passed_twice(TWICE_MAX)

    def to_json(self) -> str:
        return json.dumps(as_json(self), indent=1) + "\n"

    def to_csv(self) -> str:
        """The runs as CSV with a line of headings; "" without runs."""
        return csv_text([*map(vars, self.runs[:1]), *(vars(run).values() for run in self.runs)])

    def to_measurements_csv(self) -> str:
        """The measurements with limits as CSV with a line of headings; "" without any."""
        rows = [vars(each) for each in self.measurements]
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
    if isinstance(value, IntEnum):
        return value.name.lower()
    if isinstance(value, datetime):
        return utc_text(value)
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


def _junit_case(run: RunRecord) -> JUnitCase:
    virtual = "virtual " if run.is_virtual else ""
    return JUnitCase(
        f"{virtual}{run.recipe} {run.recipe_revision}",
        run.serial,
        run.duration_s or 0.0,
        _JUNIT_RESULTS.get(run.state, JUnitResult.PASSED),
        message=run.text,
        type=run.code,
        timestamp=utc_text(run.begun_at),
    )
