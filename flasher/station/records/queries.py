"""Reading the records: units, runs with their parts, tables and figures for reports."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from typing import Any, Final

from pydantic import TypeAdapter
from sqlalchemy import Connection, Select, case, literal, select
from sqlalchemy.sql.expression import ColumnElement

from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.database import Database
from flasher.station.records.errors import NotFoundError
from flasher.station.records.heads import Head
from flasher.station.records.model import (
    Figures,
    RunDetails,
    RunFilter,
    RunId,
    RunKind,
    RunState,
    UnitLife,
    UnitState,
    Verified,
    utc_text,
)
from flasher.station.records.rows import batches, beside_index, grouped

_EVERYTHING: Final = RunFilter()
JUDGED: Final = (RunState.PASS.value, RunState.FAIL.value)
"""Runs that say something about the unit; the others are about the station."""
VERIFIED: Final = case(
    {int(level): level.name.lower() for level in Verified}, value=schema.run.c.verification_reached
).label("verified")
"""How far a run was verified, by its word."""
_DETAILS: Final = TypeAdapter(list[RunDetails])


class Records:
    """What the records say. Every method raises RecordError when they cannot be read."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def table(
        self, chosen: RunFilter = _EVERYTHING
    ) -> list[dict[str, str | int | float | bool | None]]:
        """The runs of a filter as plain rows, for reports over many of them: names as in
        `RunRecord`, times as texts in UTC, verification by its word.
        """
        query = filtered(run_query(VERIFIED), chosen).order_by(schema.run.c.id)
        with self._database.reading() as connection:
            return [dict(row) for row in connection.execute(query).mappings()]

    def run(self, run_id: RunId) -> RunDetails:
        """A run with its parts. Raises NotFoundError."""
        with self._database.reading() as connection:
            for details in details_of(connection, schema.run.c.id == run_id):
                return details
        raise NotFoundError(f"There is no run {run_id}.")

    def units(self, serial: str) -> tuple[UnitLife, ...]:
        """The units with this serial number, one a part: the whole life of each."""
        unit = schema.unit.c
        query = select(unit.id, unit.part).where(unit.serial == serial).order_by(unit.id)
        with self._database.reading() as connection:
            lives = []
            for unit_id, part in connection.execute(query).all():
                runs = tuple(details_of(connection, schema.run.c.unit_id == unit_id))
                state = UnitState.after(runs[-1].run.state if runs else None)
                lives.append(UnitLife(serial, part, state, runs))
            return tuple(lives)

    def known(self, part: str, serials: Collection[str]) -> set[str]:
        """Those of some serial numbers that units of a part have."""
        unit = schema.unit.c
        query = select(unit.serial).where(unit.part == part)
        with self._database.reading() as connection:
            found = (
                connection.execute(query.where(unit.serial.in_(some))).scalars()
                for some in batches(serials)
            )
            return {serial for some in found for serial in some}

    def unit(self, serial: str, part: str | None = None) -> UnitLife:
        """The one unit with this serial number. Raises NotFoundError, also for several parts."""
        found = [life for life in self.units(serial) if part in (None, life.part)]
        shown = printable(serial)
        if not found:
            raise NotFoundError(
                f"There is no unit {shown} in the records.", remedy="Check the serial number."
            )
        if len(found) > 1:
            parts = ", ".join(life.part for life in found)
            raise NotFoundError(
                f"{shown} is a serial number of several parts.", remedy=f"Name one of: {parts}."
            )
        return found[0]

    def figures(self, chosen: RunFilter = _EVERYTHING) -> Figures:
        run = schema.run.c
        duration_s = run.ended_monotonic_s - run.begun_monotonic_s
        query = select(run.unit_id, run.state, run.code, duration_s, run.is_virtual)
        query = filtered(query, chosen).where(run.kind != RunKind.GOLDEN.value)
        with self._database.reading() as connection:
            return _figures_of(connection.execute(query.order_by(run.id)))

    def stations(self) -> tuple[str, ...]:
        with self._database.reading() as connection:
            query = select(schema.station.c.name).order_by(schema.station.c.id)
            return tuple(connection.execute(query).scalars())

    def head_of(self, run_id: RunId) -> Head | None:
        """The signed audit row that vouches for a finished run; None where there is none."""
        with self._database.reading() as connection:
            return chain.head_of(connection, run_id)

    def record_sha256(self, run_id: RunId) -> str:
        """The hash of a run with all that belongs to it: over the digests that its audit row has.
        Raises KeyError for a run that is not there.
        """
        with self._database.reading() as connection:
            return chain.digest(chain.digests_of(connection, [run_id])[run_id])

    def content_of(self, run_id: RunId) -> tuple[dict[str, Any], dict[str, Any]]:
        """The rows of a finished run by what they are, and the audit row that vouches for them.
        Raises KeyError for a run that is not there.
        """
        with self._database.reading() as connection:
            content = chain.contents_of(connection, [run_id])[run_id]
            return content, chain.ending_of(connection, run_id)

    def natures(self) -> frozenset[bool]:
        """Whose runs there are: True for virtual units, False for real ones."""
        is_virtual = schema.run.c.is_virtual
        with self._database.reading() as connection:
            return frozenset(
                nature
                for nature in (False, True)
                if connection.execute(
                    select(literal(1)).where(is_virtual == nature).limit(1)
                ).first()
            )


def details_of(connection: Connection, chosen: Any) -> Iterator[RunDetails]:
    """The runs that a condition chooses, with their parts, in the order of their ids; one that
    names what is not there is left out. Raises ValidationError for what no station writes.
    """
    query = run_query(schema.run.c.verification_reached.label("verified")).where(chosen)
    runs = connection.execute(query.order_by(schema.run.c.id)).mappings()
    by_id = {row["run_id"]: row for row in runs}
    artifact, measurement = schema.artifact.c, schema.measurement
    of_target = select(
        schema.run_target,
        artifact.name.label("image"),
        artifact.sha256.label("image_sha256"),
        artifact.version,
    ).join_from(schema.run_target, schema.artifact)
    write = schema.device_write
    queries = {
        "targets": (schema.run_target, of_target),
        "steps": (schema.step, select(schema.step)),
        "writes": (write, select(write, write.c.id.label("write_id"))),
        "attachments": (schema.attachment, select(schema.attachment)),
    }
    for some in batches(by_id):
        parts = {
            name: grouped(connection, select_parts.order_by(table.c.id), table.c.run_id, some)
            for name, (table, select_parts) in queries.items()
        }
        steps = [step for rows in parts["steps"].values() for step in rows]
        measured = grouped(
            connection,
            select(measurement).order_by(measurement.c.id),
            measurement.c.step_id,
            [step["id"] for step in steps],
        )
        for step in steps:
            step["measurements"] = measured[step["id"]]
        yield from _DETAILS.validate_python(
            [
                {"run": dict(by_id[run_id]), **{name: rows[run_id] for name, rows in parts.items()}}
                for run_id in some
            ]
        )


def run_query(verified: Any) -> Select[Any]:
    """Runs with the columns of `RunRecord`."""
    run = schema.run.c
    return (
        select(
            run.id.label("run_id"),
            schema.unit.c.serial,
            schema.unit.c.part,
            schema.lot.c.name.label("lot"),
            run.kind,
            run.is_virtual,
            run.state,
            run.code,
            run.text,
            run.begun_at,
            run.ended_at,
            (run.ended_monotonic_s - run.begun_monotonic_s).label("duration_s"),
            schema.station.c.name.label("station"),
            schema.socket.c.name.label("socket"),
            schema.operator.c.name.label("operator"),
            schema.recipe.c.name.label("recipe"),
            schema.recipe.c.revision.label("recipe_revision"),
            schema.recipe.c.sha256.label("recipe_sha256"),
            verified,
            run.log_sha256,
            run.reason,
        )
        .join_from(schema.run, schema.unit, run.unit_id == schema.unit.c.id)
        .join(schema.recipe, run.recipe_id == schema.recipe.c.id)
        .outerjoin(schema.lot, run.lot_id == schema.lot.c.id)
        .join(schema.socket, run.socket_id == schema.socket.c.id)
        .join(schema.station, schema.socket.c.station_id == schema.station.c.id)
        .join(schema.operator, run.operator_id == schema.operator.c.id)
    )


def filtered(query: Select[Any], chosen: RunFilter) -> Select[Any]:
    """A query about runs, for those of a filter."""
    run = schema.run.c
    # Runs of a time lie together; a lot has few. All else would lead through runs of all years.
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
    """The bounds of time of a filter."""
    found = []
    if chosen.since is not None:
        found.append(begun_at >= utc_text(chosen.since))
    if chosen.until is not None:
        found.append(begun_at < utc_text(chosen.until))
    return found


def named_in(chosen: RunFilter) -> Iterator[tuple[ColumnElement[Any], Select[Any]]]:
    """What a filter names and few rows have, by the column of the run: the ids that it allows."""
    lot, recipe, socket, run = schema.lot.c, schema.recipe.c, schema.socket.c, schema.run.c
    if chosen.lot is not None:
        yield run.lot_id, select(lot.id).where(lot.name == chosen.lot)
    if chosen.recipe is not None:
        yield run.recipe_id, select(recipe.id).where(recipe.name == chosen.recipe)
    if chosen.part is not None:  # a unit is of the part of its recipes
        yield run.recipe_id, select(recipe.id).where(recipe.part == chosen.part)
    if chosen.socket is not None:
        yield run.socket_id, select(socket.id).where(socket.name == chosen.socket)


def units_of(chosen: RunFilter) -> Select[Any] | None:
    """The ids of the units of a filter; None: it names no serial number."""
    unit = schema.unit.c
    query = select(unit.id)
    if chosen.serial is not None:
        query = query.where(unit.serial == chosen.serial)
    if chosen.search is not None:
        query = query.where(unit.serial.icontains(chosen.search, autoescape=True))
    return None if chosen.serial is None and chosen.search is None else query


def _figures_of(rows: Iterable[Any]) -> Figures:
    """The figures of runs in the order in which they began."""
    first: dict[int, str] = {}
    last: dict[int, str] = {}
    by_state: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    durations_s: list[float] = []
    virtual_runs = 0
    passed = RunState.PASS.value
    for unit_id, state, code, duration_s, is_virtual in rows:
        virtual_runs += bool(is_virtual)
        by_state[state] += 1
        if state in JUDGED:
            first.setdefault(unit_id, state)
            last[unit_id] = state
        if state == passed:
            durations_s.append(duration_s)
        elif state != RunState.RUNNING.value:
            failures[code] += 1
    return Figures(
        runs=by_state.total(),
        units=len(last),
        passed=list(last.values()).count(passed),
        first_passed=list(first.values()).count(passed),
        by_state=dict(by_state),
        virtual_runs=virtual_runs,
        failures=dict(sorted(failures.items(), key=lambda item: (-item[1], item[0]))),
        duration_median_s=statistics.median(durations_s) if durations_s else None,
        duration_longest_s=max(durations_s, default=None),
    )
