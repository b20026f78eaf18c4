"""Reads the records: units, runs with their parts, tables and figures for reports."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final, TypeVar, cast

from pydantic import ValidationError
from sqlalchemy import Connection, Select, and_, literal, select

from flasher.documents import adapter
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.capability import Capability, capabilities
from flasher.station.records.database import Database
from flasher.station.records.errors import NotFoundError, RecordsDamagedError
from flasher.station.records.filters import filtered
from flasher.station.records.heads import ChainHead
from flasher.station.records.model import (
    DUPLICATES,
    SIGNATURE,
    AuditEvent,
    Figures,
    RunDetails,
    RunFilter,
    RunId,
    RunKind,
    RunRecord,
    RunState,
    StepName,
    UnitLife,
    UnitState,
)
from flasher.station.records.rows import batches
from flasher.station.records.tally import Tally, tallied

_EVERYTHING: Final = RunFilter()
_Row = TypeVar("_Row")
_DUPLICATES: Final = (
    select(schema.measurement.c.text)
    .join_from(schema.step, schema.measurement)
    .where(
        schema.step.c.run_id == schema.run.c.id,
        schema.step.c.position == 1,
        schema.step.c.name == StepName.PLANT.value,
        schema.measurement.c.name == DUPLICATES,
    )
    .scalar_subquery()
    .label("duplicates")
)
_RUN: Final = schema.run.c
RUN_QUERY: Final = (
    select(
        _RUN.id.label("run_id"),
        schema.unit.c.serial,
        schema.unit.c.part,
        schema.lot.c.name.label("lot"),
        _RUN.kind,
        _RUN.is_virtual,
        _RUN.reason,
        _RUN.state,
        _RUN.code,
        _RUN.text,
        _RUN.begun_at,
        _RUN.ended_at,
        (_RUN.ended_monotonic_s - _RUN.begun_monotonic_s).label("duration_s"),
        schema.station.c.name.label("station"),
        schema.socket.c.name.label("socket"),
        schema.operator.c.name.label("operator"),
        schema.recipe.c.name.label("recipe"),
        schema.recipe.c.revision.label("recipe_revision"),
        schema.recipe.c.sha256.label("recipe_sha256"),
        _RUN.verification_reached.label("verified"),
        _RUN.log_sha256,
        _DUPLICATES,
    )
    .join_from(schema.run, schema.unit, _RUN.unit_id == schema.unit.c.id)
    .join(schema.recipe, _RUN.recipe_id == schema.recipe.c.id)
    .outerjoin(schema.lot, _RUN.lot_id == schema.lot.c.id)
    .join(schema.socket, _RUN.socket_id == schema.socket.c.id)
    .join(schema.station, schema.socket.c.station_id == schema.station.c.id)
    .join(schema.operator, _RUN.operator_id == schema.operator.c.id)
)
"""Query of runs with the columns of `RunRecord`."""
_NAMED: Final = ("unit", "station", "socket", "operator", "recipe")
"""Columns with a name that every run has."""
LABELS_LOOKED_BACK: Final = 10_000
"""Newest runs of which `Records.unlabelled` looks for labels."""


class Records:
    """Queries of the records. Every method raises RecordError if they cannot be read."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def table(self, chosen: RunFilter = _EVERYTHING) -> list[RunRecord]:
        """The runs of a filter, for reports."""
        query = filtered(RUN_QUERY, chosen).order_by(schema.run.c.id)
        released = self.released()
        with self._database.reading() as connection:
            return runs_of(connection, query, released)

    def released(self) -> set[int]:
        """Runs that reached the plant after the claim of their unit was released. What they
        recorded themselves, which is signed, does not tell: `RELEASED_MARK` takes its place.
        """
        audit = schema.audit.c
        query = select(audit.run_id).where(audit.event == AuditEvent.CLAIM_RELEASED.value)
        with self._database.reading() as connection:
            return set(connection.execute(query).scalars())

    def run(self, run_id: RunId) -> RunDetails:
        """A run with its parts. Raises NotFoundError."""
        with self._database.reading() as connection:
            for details in details_of(connection, schema.run.c.id == run_id):
                return details
        raise NotFoundError(f"There is no run {run_id}.")

    def units(self, serial: str) -> tuple[UnitLife, ...]:
        """All units with this serial number, one per part number, each with all its runs."""
        unit = schema.unit.c
        query = select(unit.id, unit.part).where(unit.serial == serial).order_by(unit.id)
        with self._database.reading() as connection:
            lives = []
            for unit_id, part in connection.execute(query).all():
                runs = tuple(details_of(connection, schema.run.c.unit_id == unit_id))
                state = UnitState.after(runs[-1].run.state if runs else None)
                lives.append(UnitLife(serial, part, state, runs))
            return tuple(lives)

    def recipe(self, sha256: str) -> str:
        """The text of a recipe with which a run was made."""
        query = select(schema.recipe.c.content).where(schema.recipe.c.sha256 == sha256)
        with self._database.reading() as connection:
            return str(connection.execute(query).scalar_one())

    def known(self, part: str, serials: Collection[str]) -> set[str]:
        """Those of `serials` that belong to recorded units of a part."""
        unit = schema.unit.c
        query = select(unit.serial).where(unit.part == part)
        with self._database.reading() as connection:
            found = (
                connection.execute(query.where(unit.serial.in_(some))).scalars()
                for some in batches(serials)
            )
            return {serial for some in found for serial in some}

    def unit(self, serial: str, part: str | None = None) -> UnitLife:
        """The unit with this serial number. Raises NotFoundError, also if several parts have it."""
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
        tally = Tally()
        with self._database.reading() as connection:
            for row in connection.execute(tallied(chosen)):
                tally.add(row)
        return tally.figures()

    def capabilities(self, chosen: RunFilter = _EVERYTHING) -> list[Capability]:
        """The measurements with limits of the runs of a filter."""
        with self._database.reading() as connection:
            return capabilities(connection, chosen)

    def stations(self) -> tuple[str, ...]:
        with self._database.reading() as connection:
            query = select(schema.station.c.name).order_by(schema.station.c.id)
            return tuple(connection.execute(query).scalars())

    def noted(self, station: str, event: AuditEvent) -> list[dict[str, Any]]:
        """Data of a station's audit rows of one event, oldest first."""
        audit = schema.audit.c
        query = (
            select(audit.data)
            .join(schema.station, schema.station.c.id == audit.station_id)
            .where(schema.station.c.name == station, audit.event == event.value)
            .order_by(audit.number)
        )
        with self._database.reading() as connection:
            return [chain.data_of(data) for data in connection.execute(query).scalars()]

    def unlabelled(self, station: str) -> list[RunRecord]:
        """Runs of a station, of its newest ones, whose label is not known to be printed. A unit
        counts if its last run is a PASS of a product, and no later run of it has got the label.
        """
        audit, of_unit = schema.audit.c, schema.run.alias().c
        own = select(schema.station.c.id).where(schema.station.c.name == station)
        newest = (
            select(audit.run_id, audit.data)
            .where(audit.event == chain.FINISHED, audit.station_id == own.scalar_subquery())
            .order_by(audit.id.desc())
            .limit(LABELS_LOOKED_BACK)
        )
        is_passed = (
            select(and_(of_unit.state == RunState.PASS.value, of_unit.kind != RunKind.GOLDEN.value))
            .where(of_unit.unit_id == _RUN.unit_id)
            .order_by(of_unit.id.desc())
            .limit(1)
        )
        labelled = (
            select(audit.id)
            .join_from(of_unit.id.table, schema.audit, audit.run_id == of_unit.id)
            .where(
                of_unit.unit_id == _RUN.unit_id,
                of_unit.id >= _RUN.id,
                audit.event == AuditEvent.LABELLED.value,
            )
        )
        query = RUN_QUERY.where(is_passed.scalar_subquery(), ~labelled.exists()).order_by(_RUN.id)
        with self._database.reading() as connection:
            rows = connection.execute(newest)
            due = sorted(row.run_id for row in rows if chain.LABEL_DUE in row.data)
            return [
                run
                for some in batches(due)
                for run in runs_of(connection, query.where(_RUN.id.in_(some)), ())
            ]

    def head_of(self, run_id: RunId) -> ChainHead | None:
        """The signed audit row of a finished run; None without one."""
        with self._database.reading() as connection:
            return chain.head_of(connection, run_id)

    def record_sha256(self, run_id: RunId) -> str:
        """SHA-256 over the digests of all parts of a run. Raises KeyError for an unknown run."""
        with self._database.reading() as connection:
            return chain.digest(chain.digests_of(connection, [run_id])[run_id])

    def content_of(self, run_id: RunId) -> tuple[dict[str, Any], dict[str, Any]]:
        """The rows of a finished run by part, and its audit row. Raises KeyError."""
        with self._database.reading() as connection:
            content = chain.contents_of(connection, [run_id])[run_id]
            return content, chain.ending_of(connection, run_id)

    def unit_kinds(self) -> frozenset[bool]:
        """Kinds of units with runs: True for virtual units, False for real ones."""
        is_virtual = schema.run.c.is_virtual
        with self._database.reading() as connection:
            return frozenset(
                nature
                for nature in (False, True)
                if connection.execute(
                    select(literal(1)).where(is_virtual == nature).limit(1)
                ).first()
            )


def runs_of(
    connection: Connection, query: Select[Any], released: Collection[int]
) -> list[RunRecord]:
    """Runs of a `RUN_QUERY`, those in `released` with their mark. Raises RecordsDamagedError."""
    rows = connection.execute(query).mappings()
    return [valid(RunRecord, dict(row)).marked(released) for row in rows]


def valid(kind: type[_Row], row: Mapping[str, Any]) -> _Row:
    """The value of a row. Raises RecordsDamagedError for values that no station writes."""
    try:
        found: _Row = adapter(cast("Any", kind)).validate_python(row)
    except ValidationError as error:
        raise _damaged(error, row.get("run_id")) from error
    return found


def _damaged(error: ValidationError, run_id: object) -> RecordsDamagedError:
    wrong = error.errors()[0]
    name = ".".join(map(str, wrong["loc"]))
    return RecordsDamagedError(
        "The records contain a value that no station writes.",
        where=printable(name if run_id is None else f"run {run_id}, {name}"),
        cause=printable(f"{wrong['msg']}: {wrong['input']!r}"[:200]),
        remedy="List all problems with flasher station verify, those of a plant with flasher plant"
        " verify.",
    )


def details_of(connection: Connection, chosen: Any) -> Iterator[RunDetails]:
    """Runs that meet an SQL condition, with their parts, in order of ids; runs that refer to
    missing rows are left out. Raises RecordsDamagedError for values that no station writes.
    """
    run_ids = connection.execute(select(schema.run.c.id).where(chosen).order_by(schema.run.c.id))
    for some in batches(run_ids.scalars().all()):
        for run_id, content in chain.contents_of(connection, some).items():
            if is_whole(content):
                try:
                    yield details_of_content(content, content["recipe"])
                except ValidationError as error:
                    raise _damaged(error, run_id) from error


def is_whole(content: Mapping[str, Any]) -> bool:
    """True if all rows that the run refers to exist."""
    return all(content[name] is not None for name in _NAMED)


def details_of_content(content: Mapping[str, Any], recipe: Mapping[str, str]) -> RunDetails:
    """Build a run from its rows. Raises ValidationError, KeyError or TypeError for invalid rows."""
    run, unit = content["run"], content["unit"]
    begun_s, ended_s = run["begun_monotonic_s"], run["ended_monotonic_s"]
    images = {each["id"]: each for each in content["artifacts"] if each is not None}
    # Other values than numbers are refused below.
    has_numbers = all(isinstance(each, int | float) for each in (begun_s, ended_s))
    facts = {
        **{name: unit[name] for name in ("serial", "part")},
        "run_id": run["id"],
        "lot": content["lot"] and content["lot"]["name"],
        "duration_s": ended_s - begun_s if has_numbers else ended_s,
        **{name: content[name]["name"] for name in ("station", "socket", "operator")},
        "recipe": recipe["name"],
        "recipe_revision": recipe["revision"],
        "recipe_sha256": recipe["sha256"],
        "verified": run["verification_reached"],
    }
    found = {each["name"]: each["text"] for each in content["measurements"]}
    targets = [
        each
        | {
            "image": images[each["artifact_id"]]["name"],
            "image_sha256": images[each["artifact_id"]]["sha256"],
            "version": images[each["artifact_id"]]["version"],
            "signature": found.get(f"{each['target']} {SIGNATURE}"),
        }
        for each in content["targets"]
        if each["artifact_id"] in images
    ]
    steps = [
        each | {"measurements": [m for m in content["measurements"] if m["step_id"] == each["id"]]}
        for each in content["steps"]
    ]
    details: RunDetails = adapter(RunDetails).validate_python(
        {
            "run": run | facts | {"duplicates": found.get(DUPLICATES)},
            "targets": targets,
            "steps": steps,
            "writes": [each | {"write_id": each["id"]} for each in content["writes"]],
            "attachments": content["attachments"],
        }
    )
    return details
