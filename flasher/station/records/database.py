"""Opens the database with durable commits, and checks its settings and schema version.

SQLite's safety depends on settings: each is set on every connection and read back. A setting that
does not take effect (WAL on a network disk) is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from filelock import FileLock, Timeout
from sqlalchemy import Connection, Engine, create_engine, event, inspect, select
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError

from flasher.errors import ErrorCode, UsageError, how_to_install
from flasher.protocol.text import printable
from flasher.station.records.errors import (
    NOT_SAVED,
    OldSchemaError,
    RecordError,
    RecordsDamagedError,
    RecordsMovedError,
    SchemaVersionError,
    StationBusyError,
    mapped,
)
from flasher.station.records.files import FileStore, sync_folder, whole_file
from flasher.station.records.model import DEFAULT_LOCK_TIMEOUT_S, Backup, utc_text
from flasher.station.records.schema import (
    SCHEMA_VERSION,
    alembic_version,
    metadata,
    schema_info,
)
from flasher.station.records.triggers import trigger_statements

_SYNCHRONOUS_FULL: Final = 2
_IMMEDIATE: Final = "flasher_immediate"
_POSTGRESQL: Final = "postgresql+psycopg"
_OPENED: Final = "flasher_file"
"""Key of a connection's `info`: identity of the database file that it opened."""
_BEFORE_ALEMBIC: Final = 2
"""Schema version of records that have no Alembic revision."""


@dataclass(frozen=True)
class Location:
    """The URL of a database, and the folder of its attachments."""

    url: URL
    folder: Path
    shown: str
    """URL or path for messages, without a password."""

    @property
    def file(self) -> Path | None:
        """Path of the SQLite file; None for a server."""
        return Path(str(self.url.database)) if self.url.drivername == "sqlite" else None


def locate(url: str, folder: Path | None = None) -> Location:
    """Parse the records' setting: an SQLAlchemy URL, or the path of an SQLite file. `folder` holds
    the attachments, by default `NAME.files` beside a file. Raises UsageError for an invalid URL.
    """
    try:
        parsed = make_url(url) if "://" in url else URL.create("sqlite", database=url)
    except (ArgumentError, ValueError) as error:
        raise _no_database(url) from error
    backend = parsed.get_backend_name()
    shown = printable(parsed.set(drivername=backend, query={}).render_as_string(hide_password=True))
    if parsed.drivername == "postgresql":
        parsed = parsed.set(drivername=_POSTGRESQL)
    # An @ or a / of a password that is not written as %40 or %2F lands in host or name.
    if parsed.drivername not in ("sqlite", _POSTGRESQL) or "@" in f"{parsed.host}{parsed.database}":
        raise _no_database(url)
    if backend == "sqlite" and parsed.database in (None, "", ":memory:"):
        raise _no_database(url)  # in memory no PASS would be on disk
    if backend == "sqlite" and parsed.query:
        raise UsageError(
            f"The database {shown} has options in its URL; records use none.",
            remedy="Name the file without options.",
        )
    location = Location(parsed, folder or Path(), shown)
    if folder is None:
        if location.file is None:
            raise UsageError(
                f"The database {shown} needs a folder for attachments.",
                remedy="Give a folder on a disk of this computer.",
            )
        folder = location.file.with_name(location.file.name + ".files")
    return Location(parsed, folder, shown)


def locate_records(url: str, folder: Path | None = None) -> Location:
    """`locate` for a station's records, which are in a file. Raises UsageError for a server."""
    location = locate(url, folder or Path())
    if location.url.get_backend_name() != "sqlite":
        raise UsageError(
            f"The records of a station are in a file on its own PC, not at {location.shown}.",
            cause="a station with its records on a server would stop whenever that is away",
            remedy='In the station file: records = "records.sqlite", and the server as `plant`,'
            " which collects the records of all stations; flasher plant report, pages and units"
            " read it. Records that a station has on a server remain there, for the flasher that"
            " made them.",
        )
    return location if folder else locate(url)


def _no_database(url: str) -> UsageError:
    """Shows only the scheme, if there is one: any other part may be a password."""
    scheme, separator, _ = url.partition("://")
    shown = f"{printable(scheme)[:40]}://..." if separator else "What is named"
    return UsageError(
        f"{shown} is neither a file nor the URL of a database.",
        remedy="Name an SQLite file, or postgresql+psycopg://user@host/name; in a password, @ is "
        "written %40 and / is written %2F.",
    )


class Database:
    """A database with durable commits. Open it with `open_database`."""

    def __init__(
        self,
        location: Location,
        lock_timeout_s: float,
        *,
        read_only: bool = False,
        changes_schema: bool = False,
        statement_limit_s: float | None = None,
    ) -> None:
        """`statement_limit_s`: of a server; None: its default."""
        self.location = location
        self._read_only = read_only
        self._changes_schema = changes_schema
        self._lock_timeout_ms = max(1, round(lock_timeout_s * 1000))
        self._statement_limit_s = statement_limit_s
        self.engine = self._engine()

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Open a write transaction, one at a time; it is on disk when the block ends without an
        error. Raises RecordError: then nothing was saved.
        """
        with self._mapped(writes=True), self.engine.connect() as bare:
            connection = bare.execution_options(**{_IMMEDIATE: True})
            self._check_place(bare)
            with connection.begin():
                yield connection
            self._check_place(bare, has_log=True)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Open a read transaction with one consistent snapshot. Raises RecordError."""
        with self._mapped(writes=False), self.engine.connect() as connection:
            if self.engine.dialect.name == "postgresql":
                connection.execution_options(
                    isolation_level="REPEATABLE READ", postgresql_readonly=True
                )
            with connection.begin():
                yield connection

    def _check_place(self, connection: Connection, *, has_log: bool = False) -> None:
        """Check that the file was not moved or deleted, as SQLite would go on writing to it.

        Raises RecordsMovedError.
        """
        file = self.location.file
        if file is None:
            return
        is_there = _identity(file) == connection.info.get(_OPENED)
        if has_log:
            is_there = is_there and file.with_name(file.name + "-wal").exists()
        if not is_there:
            raise RecordsMovedError(
                f"{NOT_SAVED}: the database was moved, deleted or replaced.",
                where=self.location.shown,
                remedy="Put it back with the files beside it; else start the station again.",
            )

    def close(self) -> None:
        self.engine.dispose()

    def _mapped(self, *, writes: bool) -> AbstractContextManager[None]:
        """Map the errors of a block to RecordErrors."""
        return mapped(self.location.shown, writes=writes)

    def _engine(self) -> Engine:
        url, file, timeout_s = self.location.url, self.location.file, self._lock_timeout_ms / 1000
        if file is None:
            return _server_engine(url, timeout_s, self._statement_limit_s)
        options: dict[str, Any] = {"connect_args": {"timeout": timeout_s}}
        if self._read_only:
            options["creator"] = partial(read_only_sqlite, file)
        engine = create_engine(url, **options)
        event.listen(engine, "connect", self._prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine

    def _prepare_sqlite(self, connection: Any, record: Any) -> None:
        if self.location.file is not None:
            record.info[_OPENED] = _identity(self.location.file)
        # `_begin_sqlite` begins transactions: the driver would begin them too late, without a lock.
        connection.isolation_level = None
        if self._read_only:
            connection.execute(f"PRAGMA busy_timeout = {self._lock_timeout_ms}")
            connection.execute("PRAGMA query_only = 1")
            return
        wanted = {
            # The busy timeout comes first: changing the journal needs the lock.
            "busy_timeout": self._lock_timeout_ms,
            "journal_mode": "wal",
            "synchronous": _SYNCHRONOUS_FULL,
            # Alembic replaces a table to change it, while other rows refer to its rows.
            "foreign_keys": 0 if self._changes_schema else 1,
            # Otherwise REPLACE would delete rows without calling triggers.
            "recursive_triggers": 1,
        }
        for name, value in wanted.items():
            connection.execute(f"PRAGMA {name} = {value}")
            (found,) = connection.execute(f"PRAGMA {name}").fetchone()
            if found != value:
                raise RecordError(
                    f"The database keeps {name} = {printable(str(found))} instead of {value}.",
                    where=self.location.shown,
                    cause="it is on a network disk, or on a disk that cannot be written",
                    remedy="Keep the records on a disk of this computer.",
                )


def in_file_name(station: str) -> str:
    """A station's name as a part of file names."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", station)


class StationLock:
    """File lock: one process runs as a station, from `acquire` until `release` or its end."""

    def __init__(self, station: str, folder: Path) -> None:
        self._path = folder / f"station-{in_file_name(station)}.lock"
        self._lock = FileLock(self._path, timeout=0, thread_local=False)

    def acquire(self) -> None:
        """Acquire the lock. Raises StationBusyError while another process holds it, RecordError."""
        if self._lock.is_locked:
            return
        shown = printable(str(self._path))
        with mapped(shown, writes=True):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire()
            except Timeout as error:
                raise StationBusyError(
                    "Another process already runs this station.",
                    where=shown,
                    remedy="Use the running station, or end it first.",
                ) from error

    def release(self) -> None:
        self._lock.release(force=True)


def _server_engine(url: URL, lock_timeout_s: float, statement_limit_s: float | None) -> Engine:
    """As `server.make_engine`. Raises UsageError when its driver is not installed."""
    try:
        from flasher.station.records.server import make_engine  # noqa: PLC0415  an extra
    except ImportError as error:
        raise UsageError(
            "A plant's database needs a driver that is not installed.",
            cause=printable(str(error)),
            remedy=how_to_install("plant"),
            code=ErrorCode.PACKAGE_MISSING,
        ) from error
    return make_engine(url, lock_timeout_s, statement_limit_s)


def read_only_sqlite(file: Path) -> sqlite3.Connection:
    """Open a file without changing it, its journal or, where possible, its folder."""
    log = file.with_name(file.name + "-wal")
    # Without a WAL file no program writes; a read-only folder cannot get one.
    is_still = not log.exists() and not os.access(file.parent, os.W_OK)
    uri = f"{file.resolve().as_uri()}?mode=ro{'&immutable=1' if is_still else ''}"
    return sqlite3.connect(uri, uri=True, check_same_thread=False)


def _identity(file: Path) -> tuple[int, int] | None:
    """Device and inode of a file; None if it does not exist."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino


def _begin_sqlite(connection: Connection) -> None:
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")


def no_records(location: Location) -> UsageError:
    return UsageError(
        f"There are no records at {location.shown}.",
        remedy="Correct the name of the file. `flasher station run` makes those of a new station.",
        code=ErrorCode.FILE_NOT_READ,
    )


def open_database(
    location: Location,
    now: datetime,
    *,
    lock_timeout_s: float,
    create: bool = True,
    read_only: bool = False,
) -> Database:
    """Open a database and check its schema. With `create`, make missing tables.

    Raises UsageError for a missing database, SchemaVersionError for another schema, RecordError.
    """
    if location.file is not None and not location.file.exists() and not create:
        raise no_records(location)
    database = Database(location, lock_timeout_s, read_only=read_only)
    try:
        check_schema(database, now, create=create)
    except BaseException:
        database.close()
        raise
    return database


def open_read_only(location: Location, now: datetime) -> Database:
    """`open_database` for a station's existing records that are only read."""
    return open_database(
        location, now, lock_timeout_s=DEFAULT_LOCK_TIMEOUT_S, create=False, read_only=True
    )


def check_schema(database: Database, now: datetime, *, create: bool) -> None:
    """Check the schema. Raises OldSchemaError if it can be upgraded, SchemaVersionError."""
    where = database.location.shown
    with database.reading() as connection:
        has_tables = inspect(connection).get_table_names()
    if not has_tables and create:
        _create(database, now)
    elif schema_info.name not in has_tables:
        raise SchemaVersionError(
            "The database holds other data than records of flasher.",
            where=where,
            remedy="Name another file, or an empty database.",
        )
    with database.reading() as connection:
        found = revision_of(connection)
    if found == str(SCHEMA_VERSION):
        return
    if not found:
        raise RecordsDamagedError(
            "The records do not name their schema.",
            where=where,
            remedy="Stop. Keep the database, and continue with the last backup.",
        )
    what = f"The records have schema {printable(found)}; this flasher has schema {SCHEMA_VERSION}."
    number = int(found) if found.isdecimal() else SCHEMA_VERSION
    if number >= SCHEMA_VERSION:
        raise SchemaVersionError(
            what,
            where=where,
            cause="they were made by a newer flasher",
            remedy=f"Use that newer flasher.{_way_back(database.location)}",
        )
    cause = "they were made by an older flasher"
    if number < _BEFORE_ALEMBIC:
        raise SchemaVersionError(what, where=where, cause=cause, remedy="Use that older flasher.")
    raise OldSchemaError(
        what,
        where=where,
        cause=cause,
        remedy="Start the station, which backs them up and brings them up to date, or: flasher"
        " station upgrade.",
    )


def before_upgrade(file: Path, revision: str) -> Path:
    """The copy of an SQLite file that an upgrade from this revision makes."""
    return file.with_name(f"{file.name}.schema-{revision}")


def _way_back(location: Location) -> str:
    """Names the copy that the newer flasher made before it upgraded records of this schema."""
    if location.file is None:
        return ""
    copy = before_upgrade(location.file, str(SCHEMA_VERSION))
    if not copy.is_file():
        return ""
    return (
        f" To go back for good, put {printable(copy.name)} in its place, the copy from before the"
        " upgrade: later runs are not in it, which flasher station accept restored records. Keep"
        " the newer file."
    )


def revision_of(connection: Connection) -> str:
    """Alembic revision of the records; "" without one."""
    if inspect(connection).has_table(alembic_version.name):
        query = select(alembic_version.c.version_num)
        return str(connection.execute(query).scalar_one_or_none() or "")
    version = connection.execute(select(schema_info.c.version)).scalar_one_or_none()
    return "" if version is None else str(version)


def records_id_of(connection: Connection) -> str:
    """Id of these records and of every copy of them."""
    return str(connection.execute(select(schema_info.c.records_id)).scalar_one())


def _create(database: Database, now: datetime) -> None:
    """Create all tables and triggers in one transaction, unless another process just did."""
    with database.writing() as connection:
        if inspect(connection).has_table(schema_info.name):
            return
        create_tables(connection, now, uuid4().hex)
        create_triggers(connection)
    if database.location.file is not None:
        sync_folder(database.location.file.parent)


def create_tables(connection: Connection, now: datetime, records_id: str) -> None:
    """Create all tables of records, without their rules."""
    metadata.create_all(connection)
    connection.execute(
        schema_info.insert().values(
            version=SCHEMA_VERSION, created_at=utc_text(now), records_id=records_id
        )
    )
    connection.execute(alembic_version.insert().values(version_num=str(SCHEMA_VERSION)))


def create_triggers(connection: Connection) -> None:
    for statement in trigger_statements():
        connection.exec_driver_sql(statement)


def make_backup(database: Database, files: FileStore, path: Path) -> Backup:
    """Copy a database in use to `path`, and its attachments to `NAME.files` beside it.

    An existing backup is replaced only by a complete one. Raises RecordError, UsageError for a
    path that is the database itself.
    """
    source = database.location.file
    assert source is not None  # noqa: S101  a station's records are in a file
    if path.resolve() == source.resolve():
        raise UsageError("A backup cannot replace the database itself.", remedy="Name another.")
    with mapped(printable(str(path)), writes=True):
        with whole_file(path) as part:
            copy_checked(source, part)
            with contextlib.closing(sqlite3.connect(part)) as copy:
                named = copy.execute("SELECT DISTINCT sha256 FROM attachment").fetchall()
            target = FileStore(path.with_name(path.name + ".files"))
            for (sha256,) in named:
                if not target.path(sha256).exists():
                    target.add("backup", files.path(sha256))
        with path.open("rb") as data:
            sha256 = hashlib.file_digest(data, "sha256").hexdigest()
    return Backup(path, sha256, path.stat().st_size)


def copy_checked(source: Path, part: Path) -> None:
    """Copy a database in use and check the copy. Raises RecordsDamagedError for a corrupt one."""
    with (
        contextlib.closing(read_only_sqlite(source)) as original,
        contextlib.closing(sqlite3.connect(part)) as copy,
    ):
        original.backup(copy)
        # A single file: a WAL beside it could be lost when the backup is copied.
        copy.execute("PRAGMA journal_mode = DELETE")
        (found,) = copy.execute("PRAGMA integrity_check").fetchone()
    if found != "ok":
        raise RecordsDamagedError(
            "The database is damaged: the check of its copy failed.",
            where=printable(str(found)),
            remedy="Keep the last good backup.",
        )
