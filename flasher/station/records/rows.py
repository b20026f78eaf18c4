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
"""Keys in one IN (...): every back end takes so many."""


def insert(connection: Connection, table: Table, **values: Any) -> int:
    """Add a row; its id."""
    key = connection.execute(table.insert().values(**values)).inserted_primary_key
    assert key is not None  # noqa: S101  every table here has a key of one column
    return int(key[0])


def named(connection: Connection, table: Table, **key: Any) -> int:
    """The id of the row with these values, made if there is none."""
    found = connection.execute(select(table.c.id).filter_by(**key)).scalar_one_or_none()
    return insert(connection, table, **key) if found is None else int(found)


def batches(keys: Iterable[_Key]) -> Iterator[list[_Key]]:
    """The keys in parts that fit into one IN (...)."""
    rest = iter(keys)
    while some := list(islice(rest, _BATCH)):
        yield some


def grouped(
    connection: Connection, query: Select[Any], column: Any, keys: Iterable[int]
) -> dict[int, list[dict[str, Any]]]:
    """The rows of an ordered query by the value that they have in `column`, for these values."""
    found = defaultdict(list)
    for some in batches(keys):
        rows = connection.execute(query.where(column.in_(some)))
        names = list(rows.keys())  # once: each row of a result would look them up anew
        for row in rows:
            each = dict(zip(names, row, strict=True))
            found[each[column.name]].append(each)
    return found


def beside_index(column: ColumnElement[Any]) -> ColumnElement[Any]:
    """The value of a column, as a database finds it in no index: another one is to lead."""
    return column + 0 if isinstance(column.type, Integer) else column.concat("")
