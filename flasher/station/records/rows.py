"""Reads and adds rows of any table, inside the caller's transaction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, Final, TypeVar

from sqlalchemy import Connection, Integer, Select, Table, select
from sqlalchemy.sql.expression import ColumnElement

_Key = TypeVar("_Key")
_BATCH: Final = 500
"""Keys in one IN (...); every database allows this number."""


def insert(connection: Connection, table: Table, **values: Any) -> int:
    """Insert a row; returns its id."""
    key = connection.execute(table.insert().values(**values)).inserted_primary_key
    assert key is not None  # noqa: S101  every table here has a key of one column
    return int(key[0])


def find_or_insert(connection: Connection, table: Table, **key: Any) -> int:
    """Find the row with these values, or insert it; returns its id."""
    found = connection.execute(select(table.c.id).filter_by(**key)).scalar_one_or_none()
    return insert(connection, table, **key) if found is None else int(found)


def batches(keys: Iterable[_Key]) -> Iterator[list[_Key]]:
    """Split keys into batches for IN (...)."""
    rest = iter(keys)
    while some := list(islice(rest, _BATCH)):
        yield some


def grouped(
    connection: Connection, query: Select[Any], column: Any, keys: Iterable[int]
) -> dict[int, list[dict[str, Any]]]:
    """Rows of an ordered query, grouped by the value of `column`, for these keys."""
    found = defaultdict(list)
    for some in batches(keys):
        rows = connection.execute(query.where(column.in_(some)))
        names = list(rows.keys())  # once: each row of a result would look them up anew
        for row in rows:
            each = dict(zip(names, row, strict=True))
            found[each[column.name]].append(each)
    return found


def beside_index(column: ColumnElement[Any]) -> ColumnElement[Any]:
    """A column in an expression, so that the database does not use its index."""
    return column + 0 if isinstance(column.type, Integer) else column.concat("")
