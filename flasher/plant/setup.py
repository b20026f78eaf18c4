"""Creates the plant's database, its roles, and the stations that may send to it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from importlib import import_module
from typing import Final
from uuid import uuid4

from sqlalchemy import Connection, inspect, select, text
from sqlalchemy.dialects.postgresql import insert

from flasher.errors import ErrorCode, UsageError
from flasher.plant import claim_functions, functions, queue, release_functions, takeover_functions
from flasher.plant.central import Central, plant_location, schema_of
from flasher.plant.schema import (
    PLANT_SCHEMA,
    STATION_TABLES,
    VERSION_TABLE,
    metadata,
    plant_station,
)
from flasher.protocol.text import printable
from flasher.station.records import schema as station_schema
from flasher.station.records.model import utc_text
from flasher.station.records.server import ServerLock

STATIONS: Final = "flasher_stations"
"""Role with the rights of a station; each station's own role is a member."""
READERS: Final = "flasher_readers"
"""Role with the right to read everything."""
PUBLISHERS: Final = "flasher_publishers"
"""Role with the right to publish and to withdraw recipes, and to read everything."""
DELIVERERS: Final = "flasher_deliverers"
"""Role with the right to read everything and to hand runs over to the plant's systems."""
_GROUPS: Final = (STATIONS, READERS, PUBLISHERS, DELIVERERS)
MIGRATIONS: Final = "flasher.plant:migrations"
_CHANGE_LIMIT_S: Final = 3600.0


@dataclass(frozen=True)
class StationRole:
    """A station and its role."""

    role: str
    station: str


@dataclass(frozen=True)
class Setup:
    """What `setup` did."""

    before: str | None
    """Schema of the tables before; None if the database was empty."""
    created: tuple[StationRole, ...]
    """Roles that were created; they have no password yet."""
    stations: tuple[StationRole, ...]


def role_of(station: str) -> str:
    """Name of a station's role."""
    return "flasher_" + (re.sub(r"[^a-z0-9]+", "_", station.lower()).strip("_") or "station")[:50]


def create_database(url: str) -> bool:
    """Create the database of a URL; False if it exists. Raises UsageError, RecordError."""
    name = str(plant_location(url).url.database)
    with closing(Central(url, database="postgres")) as server, server.outside_transaction() as own:
        known = text("SELECT 1 FROM pg_database WHERE datname = :name")
        if own.execute(known, {"name": name}).first() is not None:
            return False
        may = text("SELECT rolcreatedb OR rolsuper FROM pg_roles WHERE rolname = current_user")
        if not own.execute(may).scalar_one():
            raise UsageError(
                f"There is no database {printable(name)}, and this user may not create it.",
                where=server.shown,
                remedy="An administrator of the server runs what `flasher plant init --print`"
                " prints.",
            )
        own.exec_driver_sql(f"CREATE DATABASE {_quoted(own, name)}")
    return True


def setup(
    url: str, stations: Sequence[str], now: datetime, *, renewed: Sequence[str] = ()
) -> Setup:
    """Create or upgrade the tables, and the roles of `stations`. `renewed`: stations that send from
    new records from now on. Raises UsageError, RecordError.
    """
    with (
        closing(Central(url, statement_limit_s=_CHANGE_LIMIT_S)) as central,
        central.writing() as connection,
    ):
        ServerLock.SETUP.hold(connection)
        # The functions prefer the records' tables to temporary ones.
        connection.execute(
            text(
                "SELECT set_config('search_path', quote_ident(current_schema()) || ', pg_temp',"
                " true)"
            )
        )
        before = _bring_up_to_date(connection, central, now)
        for role in _GROUPS:
            _make(connection, role)
        _execute(connection, *queue.statements(connection))
        _execute(
            connection,
            *functions.FUNCTIONS,
            *claim_functions.FUNCTIONS,
            *takeover_functions.FUNCTIONS,
            *release_functions.FUNCTIONS,
            *queue.FUNCTIONS,
        )
        database = connection.execute(text("SELECT current_database()")).scalar_one()
        quoted = {role: _quoted(connection, role) for role in _GROUPS}
        _execute(
            connection,
            functions.rights(_quoted(connection, database), quoted[STATIONS], quoted[READERS]),
            claim_functions.rights(quoted[STATIONS]),
            takeover_functions.rights(quoted[STATIONS], quoted[READERS]),
            release_functions.rights(quoted[STATIONS], quoted[READERS], quoted[PUBLISHERS]),
            queue.rights(quoted[DELIVERERS], quoted[READERS]),
        )
        made, named = [], []
        for station in dict.fromkeys((*stations, *renewed)):
            role = _add_station(connection, station)
            named.append(StationRole(role, station))
            if _make(connection, role, logs_in=True):
                made.append(StationRole(role, station))
            connection.exec_driver_sql(
                f"GRANT {_quoted(connection, STATIONS)} TO {_quoted(connection, role)}"
            )
            _check_role(connection, role)
        for station in renewed:
            connection.execute(
                plant_station.update()
                .where(plant_station.c.name == station)
                .values(station=None, records_id=None, entered_at=None)
            )
    return Setup(before, tuple(made), tuple(named))


def _bring_up_to_date(connection: Connection, central: Central, now: datetime) -> str | None:
    """Create all tables, or run missing migrations. Returns the schema before; None without any
    tables.
    """
    tables = inspect(connection).get_table_names()
    if VERSION_TABLE in tables:
        before = schema_of(connection, central.shown)
        metadata.create_all(connection)
        _alembic(connection, "upgrade")
        return before
    if tables:
        raise UsageError(
            f"The database {central.location.shown} holds other data.",
            cause=f"it has the table {printable(tables[0])}",
            remedy="Name a database of its own for the plant; init creates it.",
            code=ErrorCode.RECORDS,
        )
    station_schema.metadata.create_all(connection, STATION_TABLES)
    metadata.create_all(connection)
    _execute(connection, *functions.FUNCTIONS, *takeover_functions.FUNCTIONS)
    _execute(connection, functions.ONCE, takeover_functions.ONCE)
    # As in a station's records: pages check this version.
    version = station_schema.SCHEMA_VERSION
    connection.execute(
        station_schema.schema_info.insert().values(
            version=version, created_at=utc_text(now), records_id=uuid4().hex
        )
    )
    connection.execute(station_schema.alembic_version.insert().values(version_num=str(version)))
    _alembic(connection, "stamp")
    return None


def _alembic(connection: Connection, action: str) -> None:
    command, config = import_module("alembic.command"), import_module("alembic.config").Config()
    config.set_main_option("script_location", MIGRATIONS)
    config.attributes["connection"] = connection
    getattr(command, action)(config, PLANT_SCHEMA)


def _add_station(connection: Connection, name: str) -> str:
    """Register a station; returns its role. Raises UsageError."""
    table = plant_station.c
    role = role_of(name)
    if role in _GROUPS:
        raise UsageError(
            f"A station cannot be called {printable(name)}: {role} is a role of all stations.",
            remedy="Give it another name.",
        )
    connection.execute(insert(plant_station).values(role=role, name=name).on_conflict_do_nothing())
    query = select(table.name).where(table.role == role)
    found = connection.execute(query).scalar_one_or_none()
    if found != name:
        raise UsageError(
            f"The station {printable(name)} would have the role {role} of the station"
            f" {printable(str(found))}.",
            remedy="Give the stations names that differ in letters or digits.",
        )
    return role


def _make(connection: Connection, role: str, *, logs_in: bool = False) -> bool:
    """Create a role; False if it exists."""
    known = text("SELECT 1 FROM pg_roles WHERE rolname = :role")
    if connection.execute(known, {"role": role}).first() is not None:
        return False
    word = "LOGIN" if logs_in else "NOLOGIN"
    connection.exec_driver_sql(f"CREATE ROLE {_quoted(connection, role)} {word}")
    return True


def _check_role(connection: Connection, role: str) -> None:
    """Check that a station's role has no further rights. Raises UsageError."""
    query = text(
        "SELECT rolsuper OR rolbypassrls OR rolcreaterole OR rolreplication OR"
        " pg_has_role(:role, (SELECT relowner FROM pg_class WHERE oid = 'chain_row'::regclass),"
        " 'MEMBER') OR pg_has_role(:role, :readers, 'MEMBER')"
        " FROM pg_roles WHERE rolname = :role"
    )
    if connection.execute(query, {"role": role, "readers": READERS}).scalar_one():
        raise UsageError(
            f"The role {printable(role)} has more rights than a station may have.",
            cause="it is a superuser, the owner of the records, a reader, or may make roles",
            remedy="Take these rights away, or name the station differently.",
        )


def _quoted(connection: Connection, name: str) -> str:
    return str(connection.dialect.identifier_preparer.quote(name))


def _execute(connection: Connection, *statements: str) -> None:
    """Execute SQL that may contain %."""
    for statement in statements:
        connection.execution_options(no_parameters=True).exec_driver_sql(statement)
