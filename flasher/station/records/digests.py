"""The hashes of a run and of everything that it names: names and contents, not keys of tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any, Final

from sqlalchemy import Connection, Table, select

from flasher.station.records import schema
from flasher.station.records.chain import digest

CLAIM: Final = "claim"
"""What a run was begun with; it stands before the run has ended."""
NAMED: Final = {
    "unit": "serial number or part",
    "station": "the station's name",
    "socket": "the socket's name",
    "operator": "the operator's name",
    "lot": "the lot's name",
    "recipe": "the recipe's name, revision or content",
    "artifacts": "an image's name, version, size or hash",
}
"""Rows that several runs name, in words."""
OWN: Final = {
    "run": "the run itself",
    CLAIM: "what it was claimed with",
    "targets": "how far its targets were verified",
    "steps": "its steps",
    "measurements": "its measurements",
    "writes": "what was written",
    "attachments": "its attachments",
}
"""What belongs to one run, in words."""
CLAIMED: Final = (CLAIM, *NAMED)
_OUTCOME: Final = frozenset(
    ["state", "code", "text", "ended_at", "ended_monotonic_s", "verification_reached", "log_sha256"]
)
"""Columns of a run that its end writes."""
_BATCH: Final = 500
"""Keys in one IN (...): every back end takes so many."""


def batches(run_ids: Iterable[int]) -> Iterator[list[int]]:
    """Runs in parts of a size that `digests_of` takes."""
    rest = iter(run_ids)
    while some := list(islice(rest, _BATCH)):
        yield some


def digests_of(connection: Connection, run_ids: Sequence[int]) -> dict[int, dict[str, str]]:
    """The digests of runs, by what they cover; a run that is not there is left
    out.
    """
    named = _Named(connection)
    found = {}
    targets = _parts(connection, schema.run_target, run_ids)
    parts = {
        "steps": _parts(connection, schema.step, run_ids),
        "measurements": _measurements(connection, run_ids),
        "writes": _parts(connection, schema.device_write, run_ids),
        "attachments": _parts(connection, schema.attachment, run_ids),
        "targets": targets,
    }
    for row in _rows(connection, schema.run, schema.run.c.id, run_ids):
        run_id = row["id"]
        claim = {name: value for name, value in row.items() if name not in _OUTCOME}
        wanted = [{**each, "reached": None} for each in targets[run_id]]
        socket = named.row(schema.socket, row["socket_id"])
        data = {
            "run": row,
            CLAIM: [claim, wanted],
            "unit": named.row(schema.unit, row["unit_id"]),
            "socket": socket,
            "station": named.row(schema.station, socket and socket["station_id"]),
            "operator": named.row(schema.operator, row["operator_id"]),
            "recipe": named.row(schema.recipe, row["recipe_id"]),
            "lot": named.row(schema.lot, row["lot_id"]),
            "artifacts": [
                named.row(schema.artifact, each["artifact_id"]) for each in targets[run_id]
            ],
            **{name: rows[run_id] for name, rows in parts.items()},
        }
        found[run_id] = {name: digest(value) for name, value in data.items()}
    return found


class _Named:
    """Rows by their keys, each read once."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._known: dict[tuple[str, Any], dict[str, Any] | None] = {}

    def row(self, table: Table, key: Any) -> dict[str, Any] | None:
        if (table.name, key) not in self._known:
            rows = _rows(self._connection, table, table.c.id, [key])
            self._known[table.name, key] = rows[0] if rows else None
        return self._known[table.name, key]


def _parts(
    connection: Connection, table: Table, run_ids: Collection[int]
) -> dict[int, list[dict[str, Any]]]:
    found = defaultdict(list)
    for row in _rows(connection, table, table.c.run_id, run_ids):
        found[row["run_id"]].append(row)
    return found


def _measurements(
    connection: Connection, run_ids: Collection[int]
) -> dict[int, list[dict[str, Any]]]:
    table, step = schema.measurement, schema.step
    query = (
        select(table, step.c.run_id)
        .join_from(table, step)
        .where(step.c.run_id.in_(run_ids))
        .order_by(table.c.id)
    )
    found = defaultdict(list)
    for row in connection.execute(query).mappings():
        found[row["run_id"]].append(dict(row))
    return found


def _rows(
    connection: Connection, table: Table, column: Any, keys: Collection[Any]
) -> list[dict[str, Any]]:
    query = select(table).where(column.in_(keys)).order_by(table.c.id)
    return [dict(row) for row in connection.execute(query).mappings()]
