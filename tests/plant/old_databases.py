"""Plants' databases as older versions of flasher made them.

`old/N.sql` is what `pg_dump --inserts` wrote of an empty database with revision N.
"""

from __future__ import annotations

from pathlib import Path

from tests.plant.factory import Plant

_FOLDER = Path(__file__).with_name("old")
REVISIONS = sorted(int(path.stem) for path in _FOLDER.glob("*.sql"))
_QUERIES = {
    "columns": "SELECT table_name, column_name, data_type, is_nullable, column_default"
    " FROM information_schema.columns WHERE table_schema = 'public'",
    "indexes": "SELECT tablename, indexname, indexdef FROM pg_indexes WHERE schemaname = 'public'",
    # The server writes an expression differently after pg_dump: those of checks are left out.
    "constraints": "SELECT conrelid::regclass::text, conname, CASE WHEN contype <> 'c'"
    " THEN pg_get_constraintdef(oid) END"
    " FROM pg_constraint WHERE connamespace = 'public'::regnamespace",
    "triggers": "SELECT tgrelid::regclass::text, tgname, pg_get_triggerdef(oid) FROM pg_trigger"
    " WHERE NOT tgisinternal",
    "policies": "SELECT tablename, policyname, roles, cmd, qual, with_check FROM pg_policies",
    "functions": "SELECT proname, prosrc, proacl::text FROM pg_proc"
    " WHERE pronamespace = 'public'::regnamespace",
    "rights": "SELECT relname, relacl::text FROM pg_class"
    " WHERE relnamespace = 'public'::regnamespace AND relkind IN ('r', 'v')",
}


def make_old(plant: Plant, revision: int) -> None:
    """Replace the plant's empty database by one of an older revision."""
    with plant.server.connect() as admin:
        admin.autocommit = True
        admin.execute(f"DROP DATABASE {plant.database}".encode())
        admin.execute(f"CREATE DATABASE {plant.database}".encode())
    with plant.connect() as owner:
        # As pg_dump sets it: a function may stand before its tables.
        owner.execute("SET check_function_bodies = false")
        owner.execute((_FOLDER / f"{revision}.sql").read_bytes())


def described(plant: Plant) -> dict[str, list[str]]:
    """Everything about the tables, functions and rights of a database."""
    return {name: sorted(map(repr, plant.rows(query))) for name, query in _QUERIES.items()}
