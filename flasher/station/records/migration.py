"""Brings records of version 1 up to date, in one transaction and with a backup made first.

Version 1 had one audit trail for all stations, with one digest for a run and without signatures. It
is looked at once more, then kept as `audit_1`; the new chain names its end, what was wrong with it,
and vouches for every finished run as it is now.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from sqlalchemy import Column, Connection, Integer, MetaData, String, Table, inspect, select, text

from flasher.errors import UsageError
from flasher.station.records import chain, schema
from flasher.station.records.chain import CLAIM_PARTS, Trail, digests_of
from flasher.station.records.database import Database, StationLock, copy_sqlite, locate
from flasher.station.records.files import whole_file
from flasher.station.records.keys import Keeping
from flasher.station.records.rows import batches
from flasher.station.records.signatures import SigningKey
from flasher.station.records.triggers import final_table, trigger_statements

_OLD: Final = Table(
    "audit_1",
    MetaData(),
    Column("id", Integer),
    *(Column(name, String) for name in ("at", "event", "data", "previous_hash", "hash")),
    Column("run_id", Integer),
)


@dataclass(frozen=True)
class Migrated:
    """What was done."""

    station: str
    runs: int
    backup: Path
    problems: tuple[str, ...]
    """What was wrong with the records before."""


def migrate(
    url: str,
    *,
    folder: Path | None,
    keeping: Keeping,
    choose: Callable[[tuple[str, ...]], str],
    lock_timeout_s: float,
) -> Migrated:
    """Bring the SQLite records at `url` up to date. `choose` gets the names of their stations, and
    says whose key signs the new chain.

    Raises UsageError for records that need none of it or that are no file, StationBusyError while a
    station runs, RecordError.
    """
    location = locate(url, folder)
    if location.file is None or not location.file.exists():
        raise UsageError(
            f"There are no records in a file at {location.shown}.",
            remedy="Name the file of the records. In other databases there are none of version 1.",
        )
    database = Database(location, lock_timeout_s, read_only=False)
    with closing(database), ExitStack() as held:
        with database.reading() as connection:
            names = _stations_of_version_1(connection, location.shown)
        station = choose(names)
        for name in dict.fromkeys((*names, station)):
            lock = StationLock(name, location.folder)
            held.callback(lock.release)
            lock.acquire()
        backup = _backup(location.file)
        records_id = uuid4().hex
        path = keeping.key_file(station, records_id)
        key = SigningKey.make(path)
        try:
            with database.writing() as connection:
                trail = Trail(connection, station, key)
                problems, runs = _migrate(trail, records_id)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        keeping.heads_file(station, records_id).append(trail.heads, key)
    return Migrated(station, runs, backup, problems)


def _stations_of_version_1(connection: Connection, shown: str) -> tuple[str, ...]:
    has_tables = inspect(connection).get_table_names()
    version = None
    if schema.schema_info.name in has_tables:
        version = connection.execute(select(schema.schema_info.c.version)).scalar_one_or_none()
    if version != 1:
        raise UsageError(
            f"{shown} holds no records of version 1.", remedy="Use it as it is, or name another."
        )
    return tuple(connection.execute(select(schema.station.c.name)).scalars())


def _backup(file: Path) -> Path:
    backup = file.with_name(f"{file.name}.version-1")
    while backup.exists():
        backup = backup.with_name(backup.name + "-again")
    with whole_file(backup) as part:
        copy_sqlite(file, part)
    return backup


def _migrate(trail: Trail, records_id: str) -> tuple[tuple[str, ...], int]:
    connection = trail.connection
    triggers = "SELECT name FROM sqlite_master WHERE type = 'trigger'"
    for name in connection.execute(text(triggers)).scalars().all():
        connection.exec_driver_sql(f"DROP TRIGGER {name}")
    connection.exec_driver_sql("DROP INDEX ix_audit_run_id")
    connection.exec_driver_sql("ALTER TABLE audit RENAME TO audit_1")
    column = "records_id VARCHAR(32) NOT NULL DEFAULT ''"
    connection.exec_driver_sql(f"ALTER TABLE schema_info ADD COLUMN {column}")
    info = {"version": schema.SCHEMA_VERSION, "records_id": records_id}
    connection.execute(schema.schema_info.update().values(**info))
    schema.audit.create(connection)
    for statement in (*trigger_statements("sqlite"), *final_table("sqlite", "audit_1")):
        connection.exec_driver_sql(statement)
    return _vouch(trail, records_id)


def _vouch(trail: Trail, records_id: str) -> tuple[tuple[str, ...], int]:
    connection = trail.connection
    now = datetime.now(UTC)
    problems = tuple(_old_problems(connection))
    end = connection.execute(select(_OLD.c.hash).order_by(_OLD.c.id.desc()).limit(1))
    trail.begin(now, records_id)
    was = {"version": 1, "hash": end.scalar_one_or_none(), "problems": problems}
    trail.append(now, chain.MIGRATED, was)
    run = schema.run
    found = connection.execute(select(run.c.id, run.c.state).order_by(run.c.id))
    states = {run_id: state for run_id, state in found}  # noqa: C416  rows are no plain pairs
    for some in batches(states):
        for run_id, digests in sorted(digests_of(connection, some).items()):
            is_over = states[run_id] != "RUNNING"
            event = chain.MIGRATED_RUN if is_over else chain.CLAIMED
            if not is_over:
                digests = {name: digests[name] for name in CLAIM_PARTS}  # noqa: PLW2901
            trail.append(now, event, {"state": states[run_id], "digests": digests}, run_id)
    return problems, len(states)


# -- version 1 ------------------------------------------------------------------------------------


def _old_problems(connection: Connection) -> Iterator[str]:
    """What is wrong with the trail of version 1, and with the runs that it vouches for."""
    before = chain.GENESIS
    vouched: dict[int, Any] = {}
    for row in connection.execute(select(_OLD).order_by(_OLD.c.id)).mappings().all():
        hashed = [row[name] for name in ("previous_hash", "at", "event", "run_id", "data")]
        if row["previous_hash"] != before or row["hash"] != chain.digest(hashed):
            yield f"audit row {row['id']} of version 1: it, or the row before it, was changed"
        before = row["hash"]
        if row["event"] in (chain.FINISHED, chain.INTERRUPTED):
            vouched[row["run_id"]] = chain.data_of(row["data"]).get("digest")
    over = select(schema.run.c.id).where(schema.run.c.state != "RUNNING").order_by(schema.run.c.id)
    for run_id in connection.execute(over).scalars().all():
        if vouched.pop(run_id, None) != _old_digest(connection, run_id):
            yield f"run {run_id}: it was changed after it was finished, or was never vouched for"
    for run_id in vouched:
        yield f"run {run_id}: it is missing"


def _old_digest(connection: Connection, run_id: int) -> str:
    """The digest over a run as version 1 made it."""
    run, unit, step = schema.run, schema.unit, schema.step
    head = connection.execute(
        select(
            run,
            unit.c.part,
            unit.c.serial,
            schema.socket.c.name,
            schema.operator.c.name,
            schema.recipe.c.sha256,
            schema.lot.c.name,
        )
        .join_from(run, unit)
        .join(schema.socket)
        .join(schema.operator)
        .join(schema.recipe)
        .outerjoin(schema.lot, run.c.lot_id == schema.lot.c.id)
        .where(run.c.id == run_id)
    ).one_or_none()
    parts: list[Any] = [None if head is None else list(head)]
    steps = select(step.c.id).where(step.c.run_id == run_id)
    measurement, write, file = schema.measurement, schema.device_write, schema.attachment
    for query in (
        select(schema.run_target, schema.artifact.c.sha256, schema.artifact.c.version)
        .join_from(schema.run_target, schema.artifact)
        .where(schema.run_target.c.run_id == run_id)
        .order_by(schema.run_target.c.id),
        select(step).where(step.c.run_id == run_id).order_by(step.c.id),
        select(measurement).where(measurement.c.step_id.in_(steps)).order_by(measurement.c.id),
        select(write).where(write.c.run_id == run_id).order_by(write.c.id),
        select(file).where(file.c.run_id == run_id).order_by(file.c.id),
    ):
        parts.append([list(row) for row in connection.execute(query)])  # noqa: PERF401
    return chain.digest(parts)
