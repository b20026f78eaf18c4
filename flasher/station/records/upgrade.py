"""Upgrades records of an older schema in one transaction, after a backup.

Alembic makes the changes (`migrations`). The old triggers and indexes are compared with the audit
trail, which then records the differences and the new schema.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, inspect, select, update

from flasher.errors import ErrorCode, UsageError, how_to_install
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.chain import Trail
from flasher.station.records.database import (
    Database,
    Location,
    StationLock,
    before_upgrade,
    check_schema,
    copy_checked,
    create_triggers,
    revision_of,
)
from flasher.station.records.errors import (
    NOT_SAVED,
    OldSchemaError,
    RecordError,
    RecordsDamagedError,
    mapped,
)
from flasher.station.records.files import whole_file
from flasher.station.records.keys import KeyLocations
from flasher.station.records.signing import Signer
from flasher.station.records.triggers import (
    drop_triggers,
    fingerprint_of,
    stated_differences,
)

CHANGES: Final = "flasher.station.records:migrations"
"""Alembic's script location."""
NEWEST: Final = str(schema.SCHEMA_VERSION)


@dataclass(frozen=True)
class Upgraded:
    """Result of a schema upgrade."""

    before: str
    """Schema version before the upgrade."""
    after: str
    backup: Path | None
    """The backup; None if nothing was changed."""
    problems: tuple[str, ...]
    """Differences between the old schema and the one that the audit trail records."""


def upgrade(
    location: Location,
    *,
    choose: Callable[[tuple[str, ...]], str],
    key_locations: KeyLocations,
    now: Callable[[], datetime],
    lock_timeout_s: float,
) -> Upgraded:
    """Upgrade the records. `choose` gets the names of their stations and returns the one whose
    audit trail records and signs it.

    Raises StationBusyError while a station runs, UsageError, RecordError: nothing was changed.
    """
    file = location.file
    assert file is not None  # noqa: S101  records are in a file
    database = Database(location, lock_timeout_s, changes_schema=True)
    with closing(database), ExitStack() as held:
        with suppress(OldSchemaError):
            check_schema(database, now(), create=False)
            return Upgraded(NEWEST, NEWEST, None, ())
        with database.reading() as connection:
            before, begun = revision_of(connection), _stations(connection)
        if importlib.util.find_spec("alembic") is None:
            raise UsageError(
                "Records of an older flasher need a package that is not installed: alembic.",
                remedy=how_to_install("station"),
                code=ErrorCode.PACKAGE_MISSING,
            )
        station = choose(begun) if begun else None
        if station is not None and station not in begun:
            raise UsageError(
                f"Records of schema {before} have to be brought to schema {NEWEST} by a station"
                f" that they know, and {printable(station)} is none.",
                remedy="flasher station upgrade, with --sockets FILE of one of:"
                f" {', '.join(map(printable, begun))}.",
            )
        for name in begun:
            lock = StationLock(name, location.folder)
            held.callback(lock.release)
            lock.acquire()
        with database.reading() as connection:
            if revision_of(connection) == NEWEST:  # another process was faster
                return Upgraded(NEWEST, NEWEST, None, ())
        with _unchanged_on_error(before), _backup(file, before) as backup:
            if station is None:
                with database.writing() as connection:
                    _change(connection)
                return Upgraded(before, NEWEST, backup, ())
            signer = Signer(database, station, now, key_locations)
            signer.begin()
            with signer.writing() as trail:
                problems = _change_signed(trail, now())
            return Upgraded(before, NEWEST, backup, problems)


def _stations(connection: Connection) -> tuple[str, ...]:
    """Stations with signed audit rows."""
    station = schema.station.c
    signed = select(schema.audit.c.id).where(schema.audit.c.station_id == station.id).exists()
    return tuple(
        connection.execute(select(station.name).where(signed).order_by(station.id)).scalars()
    )


@contextmanager
def _unchanged_on_error(before: str) -> Iterator[None]:
    try:
        yield
    except RecordError as error:
        error.what = error.what.replace(
            NOT_SAVED, f"The records were not brought to schema {NEWEST}, they keep schema {before}"
        )
        raise


@contextmanager
def _backup(file: Path, before: str) -> Iterator[Path]:
    """Back up an SQLite file; the backup is deleted if the change fails."""
    backup = before_upgrade(file, before)
    while backup.exists():
        backup = backup.with_name(backup.name + "-again")
    with mapped(printable(str(backup)), writes=True), whole_file(backup) as part:
        copy_checked(file, part)
    try:
        yield backup
    except BaseException:
        with suppress(OSError):
            backup.unlink()
        raise


def _change_signed(trail: Trail, now: datetime) -> tuple[str, ...]:
    connection = trail.connection
    wrong = stated_differences(_stated(connection), fingerprint_of(connection))
    problems = tuple(f"schema, {printable(name)}: {what}" for name, what in wrong)
    _change(connection)
    data = {
        "version": schema.SCHEMA_VERSION,
        "problems": problems,
        "schema": fingerprint_of(connection),
    }
    trail.append(now, chain.MIGRATED, data)
    return problems


def _stated(connection: Connection) -> list[tuple[object, Mapping[str, str]]]:
    """Version and schema that each chain recorded last."""
    audit = schema.audit.c
    query = select(audit.station_id, audit.data).where(
        audit.event.in_((chain.BEGUN, chain.MIGRATED))
    )
    last = {
        row.station_id: chain.data_of(row.data)
        for row in connection.execute(query.order_by(audit.number))
    }
    return [(data.get("version"), data.get("schema") or {}) for data in last.values()]


def _change(connection: Connection) -> None:
    # Imported here: a start without changes does not need it.
    from alembic import command  # noqa: PLC0415
    from alembic.config import Config  # noqa: PLC0415

    missing = _missing_rows(connection)
    drop_triggers(connection)
    before = revision_of(connection)
    if not inspect(connection).has_table(schema.alembic_version.name):
        schema.alembic_version.create(connection)
        connection.execute(schema.alembic_version.insert().values(version_num=before))
    config = Config()
    config.set_main_option("script_location", CHANGES)
    config.attributes["connection"] = connection
    command.upgrade(config, NEWEST)
    create_triggers(connection)
    connection.execute(update(schema.schema_info).values(version=schema.SCHEMA_VERSION))
    if _missing_rows(connection) != missing:
        raise RecordsDamagedError(f"{NOT_SAVED}: rows would refer to missing rows.")


def _missing_rows(connection: Connection) -> list[Any]:
    """References to missing rows, which SQLite does not check during the change."""
    return [tuple(row) for row in connection.exec_driver_sql("PRAGMA foreign_key_check").all()]
