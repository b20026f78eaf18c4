"""WHERE conditions of a `RunFilter`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from sqlalchemy import Select, select
from sqlalchemy.sql.expression import ColumnElement

from flasher.station.records import schema
from flasher.station.records.model import RunFilter, RunKind, RunState, utc_text
from flasher.station.records.rows import beside_index

JUDGED: Final = (RunState.PASS.value, RunState.FAIL.value)
"""Runs with a verdict on the unit; other ends are faults of the station."""
WITHOUT_CAUSE: Final = (RunState.PASS.value, RunState.RUNNING.value)


def counting(chosen: RunFilter, *columns: Any) -> Select[Any]:
    """Select columns of the runs that figures count: without golden units."""
    query = filtered(select(*columns).select_from(schema.run), chosen)
    return query.where(beside_index(schema.run.c.kind) != RunKind.GOLDEN.value)


def filtered(query: Select[Any], chosen: RunFilter) -> Select[Any]:
    """Restrict a query of runs to a filter."""
    run = schema.run.c
    # Use the index of the time or the lot; others would read runs of all years.
    by_time = chosen.since is not None and chosen.lot is None
    named: list[tuple[ColumnElement[Any], Select[Any] | None]] = [*named_in(chosen)]
    for column, ids in [*named, (run.unit_id, units_of(chosen))]:
        if ids is not None:
            query = query.where((beside_index(column) if by_time else column).in_(ids))
    for column, value in ((run.state, chosen.state), (run.code, chosen.code)):
        if value is not None:
            query = query.where((beside_index(column) if by_time else column) == value)
    return query.where(*begun_in(chosen, run.begun_at))


def begun_in(chosen: RunFilter, begun_at: ColumnElement[str]) -> list[ColumnElement[bool]]:
    """Conditions on the start time of runs."""
    found = []
    if chosen.since is not None:
        found.append(begun_at >= utc_text(chosen.since))
    if chosen.until is not None:
        found.append(begun_at < utc_text(chosen.until))
    return found


def named_in(chosen: RunFilter) -> Iterator[tuple[ColumnElement[Any], Select[Any]]]:
    """For each name in a filter: the column of the run, and a query for the ids with that name."""
    lot, recipe, socket, run = schema.lot.c, schema.recipe.c, schema.socket.c, schema.run.c
    if chosen.lot is not None:
        yield run.lot_id, select(lot.id).where(lot.name == chosen.lot)
    if chosen.recipe is not None:
        yield run.recipe_id, select(recipe.id).where(recipe.name == chosen.recipe)
    if chosen.part is not None:  # a unit is of the part of its recipes
        yield run.recipe_id, select(recipe.id).where(recipe.part == chosen.part)
    if chosen.socket is not None:
        yield run.socket_id, select(socket.id).where(socket.name == chosen.socket)
    if chosen.station is not None:
        of_station = select(socket.id).join(schema.station)
        yield run.socket_id, of_station.where(schema.station.c.name == chosen.station)


def units_of(chosen: RunFilter) -> Select[Any] | None:
    """Query for the ids of units whose serial number matches; None if the filter has none."""
    unit = schema.unit.c
    query = select(unit.id)
    if chosen.serial is not None:
        query = query.where(unit.serial == chosen.serial)
    if chosen.search is not None:
        query = query.where(unit.serial.icontains(chosen.search, autoescape=True))
    return None if chosen.serial is None and chosen.search is None else query
