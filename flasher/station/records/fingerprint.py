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
SELECT 'trigger ' || t.tgname, pg_get_triggerdef(t.oid) || t.tgenabled::text
FROM pg_trigger t JOIN pg_class c ON c.oid = t.tgrelid
WHERE NOT t.tgisinternal AND c.relnamespace = current_schema()::regnamespace
UNION ALL
SELECT 'function ' || proname, pg_get_functiondef(oid) FROM pg_proc
WHERE pronamespace = current_schema()::regnamespace AND prokind = 'f'
UNION ALL
SELECT 'constraint ' || c.relname || '.' || conname, pg_get_constraintdef(o.oid)
FROM pg_constraint o JOIN pg_class c ON c.oid = o.conrelid
WHERE connamespace = current_schema()::regnamespace AND contype <> 'n'
UNION ALL
SELECT 'index ' || indexname, indexdef FROM pg_indexes WHERE schemaname = current_schema()
UNION ALL
SELECT 'column ' || c.relname || '.' || attname,
    format_type(atttypid, atttypmod) || attnotnull::text
FROM pg_attribute JOIN pg_class c ON c.oid = attrelid
WHERE c.relnamespace = current_schema()::regnamespace AND c.relkind = 'r'
    AND attnum > 0 AND NOT attisdropped
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
