"""Counts runs one by one: states, causes, units and durations."""

from __future__ import annotations

import statistics
from collections import Counter
from typing import Any

from sqlalchemy import Select, func, select

from flasher.station.records import schema
from flasher.station.records.database import Database
from flasher.station.records.filters import JUDGED, WITHOUT_CAUSE, counting
from flasher.station.records.model import Figures, RunFilter, RunState, UnitTally
from flasher.station.records.rollup import ended_after


class Tally:
    """Counts runs, those of a unit in order."""

    def __init__(self) -> None:
        self.by_state: Counter[RunState] = Counter()
        self._failures: Counter[str] = Counter()
        self.virtual_runs = 0
        self._durations_s: list[float] = []
        self._units = UnitTally()

    def add(self, row: Any) -> None:
        """Add a row of `tallied`."""
        unit_id, state, code, is_virtual, duration_s = row
        self.by_state[RunState(state)] += 1
        self.virtual_runs += bool(is_virtual)
        is_passed = state == RunState.PASS.value
        if is_passed:
            self._durations_s.append(duration_s)
        if state not in WITHOUT_CAUSE:
            self._failures[code] += 1
        if state in JUDGED:
            self._units.add(unit_id, is_passed=is_passed)

    def figures(self, active: Tally | None = None) -> Figures:
        """Figures of these runs; `active`: others that have not ended."""
        self._durations_s.sort()  # sorting them again is quick
        others = Tally() if active is None else active
        by_state = self.by_state + others.by_state
        failures = sorted(self._failures.items(), key=lambda item: (-item[1], item[0]))
        return Figures(
            **vars(self._units.units),
            runs=by_state.total(),
            by_state=dict(by_state),
            virtual_runs=self.virtual_runs + others.virtual_runs,
            failures=dict(failures),
            duration_median_s=statistics.median(self._durations_s) if self._durations_s else None,
            duration_longest_s=self._durations_s[-1] if self._durations_s else None,
        )


def tallied(chosen: RunFilter) -> Select[Any]:
    """Query of the runs of a filter for a `Tally`."""
    run = schema.run.c
    duration_s = run.ended_monotonic_s - run.begun_monotonic_s
    query = counting(chosen, run.unit_id, run.state, run.code, run.is_virtual, duration_s)
    return query.order_by(run.id)


class Totals:
    """Figures of the runs of a filter; each call reads those that have ended since the last."""

    def __init__(self, database: Database, chosen: RunFilter) -> None:
        self._database, self._chosen = database, chosen
        self._tally = Tally()
        self._newest: int | None = None
        """Id of the last audit row at the last call."""

    def figures(self) -> Figures:
        """Raises RecordError."""
        query = tallied(self._chosen)
        if self._newest is not None:
            rest = ended_after(self._newest, self._chosen)
            query = tallied(rest.chosen).where(*rest.conditions)
        with self._database.reading() as connection:
            newest = connection.execute(select(func.max(schema.audit.c.id))).scalar_one()
            rows = connection.execute(query).all()
        active = Tally()
        for row in rows:
            (active if row.state == RunState.RUNNING.value else self._tally).add(row)
        self._newest = newest
        return self._tally.figures(active)
