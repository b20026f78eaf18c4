"""Finds the newest runs of a filter quickly, however many runs are recorded, by choosing an index.

The database would choose by statistics that are missing or wrong (runs of a lot are close
together), and then read all runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Connection, Select, exists, func, literal, select, union_all
from sqlalchemy.sql.expression import ColumnElement

from flasher.station.records import schema
from flasher.station.records.filters import begun_in, named_in, units_of
from flasher.station.records.model import RunFilter
from flasher.station.records.rows import beside_index

_LEAD_MAX: Final = 50
"""Number of values of a column that are looked up one by one."""
_UNITS_MAX: Final = 5000
"""Number of units whose runs are all read. A text that more units contain is soon found."""
_SHORT: Final = 20_000
"""Number of runs that are read one by one."""


@dataclass(frozen=True)
class PageCursor:
    """Start of a page of rows: before or after the row with an id, or the newest rows."""

    before: int | None = None
    after: int | None = None

    def of(self, query: Select[Any], row_id: ColumnElement[int]) -> Select[Any]:
        """Restrict and order a query, so that the rows next to the cursor come first."""
        if self.after is not None:
            return query.where(row_id > self.after).order_by(row_id)
        if self.before is not None:
            query = query.where(row_id < self.before)
        return query.order_by(row_id.desc())


def newest_runs(
    connection: Connection, chosen: RunFilter, cursor: PageCursor, size: int
) -> list[int]:
    """Ids of at most `size` runs of a filter, those next to the cursor first."""
    run, run_id = schema.run.c, schema.run.c.id
    conditions: list[ColumnElement[bool]] = []
    is_short = False
    begun = begun_in(chosen, run.begun_at)
    if begun:
        # Without the index of ids, along which a server would search for the first run.
        plain = beside_index(run_id)
        bounds = select(func.min(plain), func.max(plain)).where(*begun)
        low, high = connection.execute(bounds).one()
        if low is None:
            return []
        conditions += [run_id >= low, run_id <= high]
        conditions += begun_in(chosen, beside_index(run.begun_at))
        is_short = high - low <= _SHORT
    lead: tuple[ColumnElement[Any], list[Any]] | None = None
    for column, query in _allowed(chosen):
        values = list(connection.execute(query.limit(_LEAD_MAX + 1)).scalars())
        if not values:
            return []
        is_lead = lead is None and not is_short and len(values) <= _LEAD_MAX
        if is_lead:
            lead = column, values
        else:
            allowed = values if len(values) <= _LEAD_MAX else query
            conditions.append(beside_index(column).in_(allowed))
    units = units_of(chosen)
    if units is not None:
        unit_ids = list(connection.execute(units.limit(_UNITS_MAX + 1)).scalars())
        if len(unit_ids) <= _UNITS_MAX:
            if lead is not None:
                conditions.append(beside_index(lead[0]).in_(lead[1]))
            of_units = select(run_id).where(run.unit_id.in_(unit_ids), *conditions)
            found = cursor.of(of_units, beside_index(run_id)).limit(size)
            return list(connection.execute(found).scalars())
        conditions.append(exists(units.where(schema.unit.c.id == run.unit_id)))
    everything = select(run_id).where(*conditions)
    if lead is None:
        return list(connection.execute(cursor.of(everything, run_id).limit(size)).scalars())
    column, values = lead
    parts = (cursor.of(everything.where(column == value), run_id).limit(size) for value in values)
    some = union_all(*(select(part.subquery()) for part in parts)).subquery()
    return list(connection.execute(cursor.of(select(some.c.id), some.c.id).limit(size)).scalars())


def _allowed(chosen: RunFilter) -> Iterator[tuple[ColumnElement[Any], Select[Any]]]:
    """Columns that a filter restricts, with queries for their values; the lot, with the fewest
    runs, comes first.
    """
    run = schema.run.c
    named = list(named_in(chosen))
    yield from ((column, ids) for column, ids in named if column is run.lot_id)
    if chosen.code is not None:
        yield run.code, select(literal(chosen.code))
    if chosen.state is not None:
        yield run.state, select(literal(chosen.state.value))
    yield from ((column, ids) for column, ids in named if column is not run.lot_id)
