"""The fingerprint of tables, indexes and triggers as they are in the database now: who takes a rule
away, or writes a weaker one, changes it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Final

from sqlalchemy import Connection, text

_SQLITE: Final = """
SELECT type || ' ' || name, sql FROM sqlite_master WHERE name NOT LIKE 'sqlite_stat%'
"""
_POSTGRESQL: Final = """
SELECT 'trigger ' || t.tgname, pg_get_triggerdef(t.oid) || t.tgenabled
FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid
WHERE NOT t.tgisinternal AND c.relnamespace = current_schema()::regnamespace
UNION ALL
SELECT 'function ' || proname, pg_get_functiondef(oid) FROM pg_proc
WHERE pronamespace = current_schema()::regnamespace AND prokind = 'f'
UNION ALL
SELECT 'constraint ' || conrelid::regclass || '.' || conname, pg_get_constraintdef(oid)
FROM pg_constraint WHERE connamespace = current_schema()::regnamespace AND contype <> 'n'
UNION ALL
SELECT 'index ' || indexname, indexdef FROM pg_indexes WHERE schemaname = current_schema()
UNION ALL
SELECT 'column ' || table_name || '.' || column_name,
    data_type || ' ' || is_nullable || ' ' || COALESCE(character_maximum_length, 0)
FROM information_schema.columns WHERE table_schema = current_schema()
"""
_QUERIES: Final = {"sqlite": _SQLITE, "postgresql": _POSTGRESQL}


def fingerprint_of(connection: Connection) -> dict[str, str]:
    """A short hash for each table, index, trigger, ... by its name; empty for a back end of which
    it cannot be read.
    """
    query = _QUERIES.get(connection.dialect.name)
    if query is None:
        return {}
    return {
        name: hashlib.sha256((sql or "").encode()).hexdigest()[:16]
        for name, sql in connection.execute(text(query)).all()
    }


def differences(stated: Mapping[str, str], found: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """What is not as it was stated: its name, and what is wrong with it."""
    for name in sorted(stated.keys() | found.keys()):
        if name not in found:
            yield name, "it was taken away"
        elif name not in stated:
            yield name, "it was added"
        elif stated[name] != found[name]:
            yield name, "it was changed"
