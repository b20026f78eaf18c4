"""Reads and adds rows of any table, inside the caller's transaction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import islice
from typing import Any, Final, TypeVar

from sqlalchemy import (
    BindParameter,
    Connection,
    Insert,
    Integer,
    Select,
    Table,
    bindparam,
    select,
)
from sqlalchemy.sql.expression import ColumnElement

_Key = TypeVar("_Key")
_BATCH: Final = 500
"""Keys in one IN (...); every database allows this number."""
KEYS: Final[BindParameter[Any]] = bindparam("keys", expanding=True)
"""Keys of the rows of `grouped`."""


def insert(connection: Connection, table: Table, **values: Any) -> int:
    """Insert a row; returns its id."""
    key = connection.execute(_into(table), values).inserted_primary_key
    assert key is not None  # noqa: S101  every table here has a key of one column
    return int(key[0])


def find_or_insert(connection: Connection, table: Table, **key: str | int) -> int:
    """Find the row with these values, or insert it; returns its id."""
    found = connection.execute(_id_by(table, *key), key).scalar_one_or_none()
    return insert(connection, table, **key) if found is None else int(found)


# Building a statement and its cache key takes SQLAlchemy longer than executing it.


@cache
def _into(table: Table) -> Insert:
    return table.insert()


@cache
def _id_by(table: Table, *names: str) -> Select[Any]:
    return select(table.c.id).where(*(table.c[name] == bindparam(name) for name in names))


def batches(keys: Iterable[_Key]) -> Iterator[list[_Key]]:
    """Split keys into batches for IN (...)."""
    rest = iter(keys)
    while some := list(islice(rest, _BATCH)):
        yield some


def grouped(
    connection: Connection, query: Select[Any], column: str, keys: Iterable[int]
) -> dict[int, list[dict[str, Any]]]:
    """Rows of an ordered query with `column.in_(KEYS)`, grouped by the value of this column."""
    found = defaultdict(list)
    for some in batches(keys):
        rows = connection.execute(query, {KEYS.key: some})
        names = list(rows.keys())  # once: each row of a result would look them up again
        for row in rows:
            each = dict(zip(names, row, strict=True))
            found[each[column]].append(each)
    return found


def beside_index(column: ColumnElement[Any]) -> ColumnElement[Any]:
    """A column in an expression, so that the database does not use its index."""
    return column + 0 if isinstance(column.type, Integer) else column.concat("")
