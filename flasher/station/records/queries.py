"""Reading the records: units, runs with their parts, tables and figures for reports."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Collection, Iterable
from typing import Any, Final

from sqlalchemy import Connection, Select, case, select

from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.database import Database
from flasher.station.records.errors import NotFoundError
from flasher.station.records.keys import Head
from flasher.station.records.model import (
    AttachmentFile,
    Figures,
    Measurement,
    RunDetails,
    RunFilter,
    RunId,
    RunKind,
    RunRecord,
    RunState,
    StepRecord,
    StepState,
    TargetRecord,
    UnitLife,
    UnitState,
    Verified,
    WriteId,
    WriteRecord,
    utc_moment,
    utc_text,
)

_BATCH: Final = 500
"""Keys in one IN (...): every back end takes so many."""


def details_of(connection: Connection, runs: list[RunRecord]) -> Iterable[RunDetails]:
    """The runs with all that belongs to them, in the same order."""
    for first in range(0, len(runs), _BATCH):
        some = runs[first : first + _BATCH]
        keys = [run.run_id for run in some]
        targets = _grouped(connection, _target_query(), schema.run_target, keys)
        steps = _grouped(connection, select(schema.step), schema.step, keys)
        measured = _measurements(connection, [row.id for rows in steps.values() for row in rows])
        writes = _grouped(connection, select(schema.device_write), schema.device_write, keys)
        files = _grouped(connection, select(schema.attachment), schema.attachment, keys)
        for run in some:
            yield RunDetails(
                run=run,
                targets=tuple(map(_target, targets[run.run_id])),
                steps=tuple(_step(row, measured[row.id]) for row in steps[run.run_id]),
                writes=tuple(map(_write, writes[run.run_id])),
                attachments=tuple(
                    AttachmentFile(row.kind, row.name, row.sha256, row.size_bytes)
                    for row in files[run.run_id]
                ),
            )


def _grouped(
    connection: Connection, query: Select[Any], table: Any, keys: list[RunId]
) -> dict[int, list[Any]]:
    found = defaultdict(list)
    for row in connection.execute(query.where(table.c.run_id.in_(keys)).order_by(table.c.id)):
        found[row.run_id].append(row)
    return found


def _measurements(connection: Connection, steps: list[int]) -> dict[int, list[Measurement]]:
    table = schema.measurement
    found = defaultdict(list)
    for first in range(0, len(steps), _BATCH):
        query = select(table).where(table.c.step_id.in_(steps[first : first + _BATCH]))
        for row in connection.execute(query.order_by(table.c.id)):
            found[row.step_id].append(
                Measurement(
                    row.name, row.value, row.unit, row.low, row.high, row.text, row.expected
                )
            )
    return found


def _target_query() -> Select[Any]:
    artifact = schema.artifact.c
    return select(schema.run_target, artifact.name, artifact.sha256, artifact.version).join_from(
        schema.run_target, schema.artifact
    )


def _target(row: Any) -> TargetRecord:
    return TargetRecord(
        target=row.target,
        image=row.name,
        image_sha256=row.sha256,
        version=row.version,
        required=Verified(row.required),
        reached=None if row.reached is None else Verified(row.reached),
    )


def _step(row: Any, measured: list[Measurement]) -> StepRecord:
    return StepRecord(
        position=row.position,
        name=row.name,
        try_number=row.try_number,
        state=StepState(row.state),
        begun_at=utc_moment(row.begun_at),
        duration_s=row.duration_s,
        code=row.code,
        text=row.text,
        measurements=tuple(measured),
    )


def _write(row: Any) -> WriteRecord:
    return WriteRecord(
        write_id=WriteId(row.id),
        target=row.target,
        what=row.what,
        value=row.value,
        intended_at=utc_moment(row.intended_at),
        verified_at=None if row.verified_at is None else utc_moment(row.verified_at),
        read_back=row.read_back,
    )


_JUDGED: Final = (RunState.PASS.value, RunState.FAIL.value)
"""Runs that say something about the unit; the others are about the station."""


def figures_of(rows: Iterable[Any]) -> Figures:
    """The figures of runs in the order in which they began."""
    first: dict[int, str] = {}
    last: dict[int, str] = {}
    by_state: dict[str, int] = defaultdict(int)
    failures: dict[str, int] = defaultdict(int)
    durations_s: list[float] = []
    virtual_runs = 0
    for unit_id, state, code, duration_s, is_virtual in rows:
        virtual_runs += bool(is_virtual)
        by_state[state] += 1
        if state in _JUDGED:
            first.setdefault(unit_id, state)
            last[unit_id] = state
        if state == RunState.PASS.value:
            durations_s.append(duration_s)
        elif state != RunState.RUNNING.value:
            failures[code] += 1
    passed = RunState.PASS.value
    return Figures(
        runs=sum(by_state.values()),
        units=len(last),
        passed=sum(state == passed for state in last.values()),
        first_passed=sum(state == passed for state in first.values()),
        by_state=dict(by_state),
        virtual_runs=virtual_runs,
        failures=dict(sorted(failures.items(), key=lambda item: (-item[1], item[0]))),
        duration_median_s=statistics.median(durations_s) if durations_s else None,
        duration_longest_s=max(durations_s, default=None),
    )


_EVERYTHING: Final = RunFilter()


class Records:
    """What the records say. Every method raises RecordError when they cannot be read."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def runs(self, chosen: RunFilter = _EVERYTHING) -> tuple[RunRecord, ...]:
        """The runs of a filter, the oldest first."""
        with self._database.reading() as connection:
            rows = connection.execute(_filtered(_run_query(), chosen).order_by(schema.run.c.id))
            return tuple(_run(row) for row in rows)

    def table(
        self, chosen: RunFilter = _EVERYTHING
    ) -> list[dict[str, str | int | float | bool | None]]:
        """The runs of a filter as plain rows, for reports over many of them: names as in
        `RunRecord`, times as texts in UTC, verification by its word.
        """
        query = _filtered(_run_query(_table_columns()), chosen).order_by(schema.run.c.id)
        with self._database.reading() as connection:
            result = connection.execute(query)
            names = tuple(result.keys())
            return [dict(zip(names, row, strict=True)) for row in result]

    def run(self, run_id: RunId) -> RunDetails:
        """A run with its parts. Raises NotFoundError."""
        with self._database.reading() as connection:
            row = connection.execute(_run_query().where(schema.run.c.id == run_id)).one_or_none()
            if row is None:
                raise NotFoundError(f"There is no run {run_id}.")
            return next(iter(details_of(connection, [_run(row)])))

    def units(self, serial: str) -> tuple[UnitLife, ...]:
        """The units with this serial number, one a part: the whole life of each."""
        with self._database.reading() as connection:
            rows = connection.execute(
                select(schema.unit).where(schema.unit.c.serial == serial).order_by(schema.unit.c.id)
            ).all()
            return tuple(_life(connection, row) for row in rows)

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

    def state(self, serial: str, part: str) -> UnitState:
        """What is known of a unit; NEW for one that is not in the records."""
        query = (
            select(schema.run.c.state)
            .join_from(schema.run, schema.unit)
            .where(schema.unit.c.serial == serial, schema.unit.c.part == part)
            .order_by(schema.run.c.id.desc())
            .limit(1)
        )
        with self._database.reading() as connection:
            last = connection.execute(query).scalar_one_or_none()
        return UnitState.after(None if last is None else RunState(last))

    def figures(self, chosen: RunFilter = _EVERYTHING) -> Figures:
        """The figures of a filter."""
        table = schema.run
        columns = (
            table.c.unit_id,
            table.c.state,
            table.c.code,
            (table.c.ended_monotonic_s - table.c.begun_monotonic_s).label("duration_s"),
            table.c.is_virtual,
        )
        query = _filtered(_joined(*columns), chosen).where(table.c.kind != RunKind.GOLDEN.value)
        with self._database.reading() as connection:
            rows = connection.execute(query.order_by(table.c.id)).all()
        return figures_of(rows)

    def stations(self) -> tuple[str, ...]:
        """The names of all stations."""
        with self._database.reading() as connection:
            query = select(schema.station.c.name).order_by(schema.station.c.id)
            return tuple(connection.execute(query).scalars())

    def head_of(self, run_id: RunId) -> Head | None:
        """The signed audit row that vouches for a finished run; None where there is none."""
        with self._database.reading() as connection:
            return chain.head_of(connection, run_id)

    def natures(self) -> frozenset[bool]:
        """Whose runs there are: True for virtual units, False for real ones."""
        with self._database.reading() as connection:
            found = connection.execute(select(schema.run.c.is_virtual).distinct()).scalars()
            return frozenset(map(bool, found))


def run_records(connection: Connection, run_ids: Collection[int]) -> list[RunRecord]:
    """These runs, in the order of their ids; one that is not there, or names what is not there, is
    left out.
    """
    query = _run_query().where(schema.run.c.id.in_(run_ids)).order_by(schema.run.c.id)
    return [_run(row) for row in connection.execute(query)]


def state_of(connection: Connection, run_id: int) -> RunState:
    """The state of a run. Raises NotFoundError."""
    found = connection.execute(
        select(schema.run.c.state).where(schema.run.c.id == run_id)
    ).scalar_one_or_none()
    if found is None:
        raise NotFoundError(f"There is no run {run_id}.")
    return RunState(found)


# -- runs -----------------------------------------------------------------------------------------


def _joined(*columns: Any) -> Select[Any]:
    return (
        select(*columns)
        .join_from(schema.run, schema.unit, schema.run.c.unit_id == schema.unit.c.id)
        .join(schema.recipe, schema.run.c.recipe_id == schema.recipe.c.id)
        .outerjoin(schema.lot, schema.run.c.lot_id == schema.lot.c.id)
    )


_NAMES: Final = (
    schema.unit.c.serial,
    schema.unit.c.part,
    schema.lot.c.name.label("lot"),
    schema.station.c.name.label("station"),
    schema.socket.c.name.label("socket"),
    schema.operator.c.name.label("operator"),
    schema.recipe.c.name.label("recipe"),
    schema.recipe.c.revision.label("recipe_revision"),
    schema.recipe.c.sha256.label("recipe_sha256"),
)


def _table_columns() -> tuple[Any, ...]:
    run = schema.run.c
    words = {int(level): level.name.lower() for level in Verified}
    return (
        run.id.label("run_id"),
        *_NAMES[:3],
        run.kind,
        run.is_virtual,
        run.state,
        run.code,
        run.text,
        run.begun_at,
        run.ended_at,
        (run.ended_monotonic_s - run.begun_monotonic_s).label("duration_s"),
        *_NAMES[3:],
        case(words, value=run.verification_reached).label("verified"),
        run.log_sha256,
        run.reason,
    )


def _run_query(columns: tuple[Any, ...] = (schema.run, *_NAMES)) -> Select[Any]:
    return (
        _joined(*columns)
        .join(schema.socket, schema.run.c.socket_id == schema.socket.c.id)
        .join(schema.station, schema.socket.c.station_id == schema.station.c.id)
        .join(schema.operator, schema.run.c.operator_id == schema.operator.c.id)
    )


def _filtered(query: Select[Any], chosen: RunFilter) -> Select[Any]:
    bounds = {
        schema.lot.c.name: chosen.lot,
        schema.recipe.c.name: chosen.recipe,
        schema.unit.c.serial: chosen.serial,
        schema.unit.c.part: chosen.part,
    }
    for column, value in bounds.items():
        if value is not None:
            query = query.where(column == value)
    if chosen.since is not None:
        query = query.where(schema.run.c.begun_at >= utc_text(chosen.since))
    if chosen.until is not None:
        query = query.where(schema.run.c.begun_at < utc_text(chosen.until))
    return query


def _run(row: Any) -> RunRecord:
    ended_s = row.ended_monotonic_s
    reached = row.verification_reached
    return RunRecord(
        run_id=RunId(row.id),
        serial=row.serial,
        part=row.part,
        lot=row.lot,
        kind=RunKind(row.kind),
        is_virtual=row.is_virtual,
        reason=row.reason,
        state=RunState(row.state),
        code=row.code,
        text=row.text,
        begun_at=utc_moment(row.begun_at),
        ended_at=None if row.ended_at is None else utc_moment(row.ended_at),
        duration_s=None if ended_s is None else ended_s - row.begun_monotonic_s,
        station=row.station,
        socket=row.socket,
        operator=row.operator,
        recipe=row.recipe,
        recipe_revision=row.recipe_revision,
        recipe_sha256=row.recipe_sha256,
        verified=None if reached is None else Verified(reached),
        log_sha256=row.log_sha256,
    )


def _life(connection: Connection, unit: Any) -> UnitLife:
    query = _run_query().where(schema.run.c.unit_id == unit.id).order_by(schema.run.c.id)
    runs = tuple(details_of(connection, [_run(row) for row in connection.execute(query)]))
    state = UnitState.after(runs[-1].run.state if runs else None)
    return UnitLife(unit.serial, unit.part, state, runs)
