# ruff: noqa: S608  names are quoted by the dialect, all else is written here
"""Grants the rights of stations and readers on a PostgreSQL server.

A station adds records and ends its runs, a reader reads; neither can delete, or change a table, a
trigger or a right. The owner of the tables can, so no station should be the owner.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from sqlalchemy import Connection, text

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.records.database import Database, Location
from flasher.station.records.schema import (
    alembic_version,
    device_write,
    metadata,
    run,
    run_target,
    schema_info,
)

_ENDED_LATER: Final = (run, run_target, device_write)
"""Tables whose rows change during a run; triggers limit the changes."""
_FORBIDDEN: Final = ("DELETE", "TRUNCATE", "TRIGGER")


def check_roles(location: Location, station: str, reader: str) -> None:
    """Check the roles. Raises UsageError for records in a file, or two equal roles."""
    if location.url.get_backend_name() != "postgresql":
        raise UsageError(
            "Only records on a PostgreSQL server have roles.",
            where=location.shown,
            remedy="For a file, set the rights of its folder.",
        )
    if station == reader:
        raise UsageError(
            "A station and a reader need roles of their own.", remedy="Name two different ones."
        )


def grant_roles(database: Database, station: str, reader: str) -> tuple[str, ...]:
    """Create missing roles, grant each exactly its rights; returns created ones (no password yet).

    Raises UsageError for a role with too many rights, RecordError if the user may not grant
    them.
    """
    with database.writing() as connection:
        made = tuple(name for name in (station, reader) if _make(connection, name))
        quoted = connection.dialect.identifier_preparer.quote
        schema = quoted(connection.execute(text("SELECT current_schema()")).scalar_one())
        name = quoted(connection.execute(text("SELECT current_database()")).scalar_one())
        both = f"{quoted(station)}, {quoted(reader)}"
        for statement in (
            f"REVOKE CREATE ON SCHEMA {schema} FROM PUBLIC, {both}",
            f"REVOKE TEMPORARY ON DATABASE {name} FROM PUBLIC, {both}",
            f"REVOKE ALL ON ALL TABLES IN SCHEMA {schema} FROM PUBLIC, {both}",
            f"REVOKE ALL ON ALL SEQUENCES IN SCHEMA {schema} FROM PUBLIC, {both}",
            f"GRANT CONNECT ON DATABASE {name} TO {both}",
            f"GRANT USAGE ON SCHEMA {schema} TO {both}",
            *_grants(schema, readers=both, stations=quoted(station)),
        ):
            connection.exec_driver_sql(statement)
        for role in (station, reader):
            _check(connection, role)
    return made


def grant_again(connection: Connection) -> None:
    """Grant existing roles their rights on tables that an upgrade added."""
    quoted = connection.dialect.identifier_preparer.quote
    schema = quoted(connection.execute(text("SELECT current_schema()")).scalar_one())

    def roles(right: str) -> str:
        query = text(
            "SELECT DISTINCT rolname FROM pg_class, aclexplode(relacl) AS given"
            " JOIN pg_roles AS role ON role.oid = given.grantee"
            " WHERE relnamespace = current_schema()::regnamespace AND relname = 'run'"
            " AND privilege_type = :right AND given.grantee <> relowner"
        )
        return ", ".join(map(quoted, connection.execute(query, {"right": right}).scalars()))

    readers, stations = roles("SELECT"), roles("INSERT")
    for statement in _grants(schema, readers=readers, stations=stations):
        connection.exec_driver_sql(statement)


def _grants(schema: str, *, readers: str, stations: str) -> Iterator[str]:
    """GRANT statements for `readers` (stations included) and `stations`; both may be empty."""
    if readers:
        yield f"GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {readers}"
    if stations:
        added = set(metadata.sorted_tables) - {schema_info, alembic_version}
        yield f"GRANT INSERT ON {_names(added)} TO {stations}"
        yield f"GRANT UPDATE ON {_names(_ENDED_LATER)} TO {stations}"
        yield f"GRANT USAGE ON ALL SEQUENCES IN SCHEMA {schema} TO {stations}"


def _names(tables: Iterable[object]) -> str:
    return ", ".join(sorted(str(table) for table in tables))


def _make(connection: Connection, role: str) -> bool:
    """Create a role that may log in; False if it exists."""
    known = text("SELECT 1 FROM pg_roles WHERE rolname = :role")
    if connection.execute(known, {"role": role}).first() is not None:
        return False
    quoted = connection.dialect.identifier_preparer.quote(role)
    connection.exec_driver_sql(f"CREATE ROLE {quoted} LOGIN")
    return True


def _check(connection: Connection, role: str) -> None:
    """Check that a role has no further rights, as superuser, owner or member. Raises UsageError."""
    rights = " OR ".join(f"has_table_privilege(:role, oid, '{right}')" for right in _FORBIDDEN)
    query = text(
        f"SELECT has_schema_privilege(:role, current_schema(), 'CREATE') OR EXISTS (SELECT 1"
        f" FROM pg_class WHERE relnamespace = current_schema()::regnamespace AND relkind = 'r'"
        f" AND (pg_has_role(:role, relowner, 'MEMBER') OR {rights}))"
    )
    if connection.execute(query, {"role": role}).scalar_one():
        raise UsageError(
            f"The role {printable(role)} could change or delete records, whatever it is granted.",
            cause="it owns them, is a superuser, or a member of a role that may",
            remedy="Name another role; the owner of the records is for this command alone.",
        )
