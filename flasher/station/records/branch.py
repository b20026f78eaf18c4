"""Merges a branch into the records of a station.

A branch is what another PC with a copy of the records recorded after they had been taken over.

Each row of the branch becomes a row of the station's audit trail that holds the signed original;
runs keep their numbers, which the station left free (`RUNS_LEFT_FREE`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import zip_longest
from typing import Any, Final

from sqlalchemy import Connection, and_, func, select, update

from flasher.errors import ErrorCode
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.database import Database
from flasher.station.records.errors import NotFoundError, RecordError, UnprovenError
from flasher.station.records.files import FileStore
from flasher.station.records.model import AuditEvent, RunKind, RunState, utc_text
from flasher.station.records.rows import find_or_insert, insert
from flasher.station.records.store import Store

_ROW: Final = (
    "number", "at", "event", "run_id", "data", "previous_hash", "hash", "signature",
)  # fmt: skip
_DIED: Final = {
    "state": RunState.INTERRUPTED.value,
    "code": "STATION_DIED",
    "text": "The station ended before this run did. The unit has to be checked.",
}


@dataclass(frozen=True)
class BroughtIn:
    """A branch that was brought into a station's records."""

    station: str
    first: int
    """Number of its first row."""
    last: int
    head: str
    """Hash of its last row, which names the branch."""
    runs: tuple[int, ...]
    """Its runs, by their numbers in the station's records."""
    conflicts: tuple[str, ...]
    """Serial numbers of units that passed in the branch and in the station's records."""


def bring_in(
    store: Store, branch: Database, files: FileStore, *, by: str, reason: str, now: datetime
) -> BroughtIn:
    """Bring the rows of `branch` that `store` lacks into its records, in one transaction. The
    process has to be the station. Raises NotFoundError without such rows, UnprovenError for rows
    that the station's key did not sign, RecordError: then nothing was changed.
    """
    with branch.reading() as other:
        with store.database.reading() as own:
            fork = _fork(own, other, store.station, branch.location.shown)
            key = chain.key_in_force(own, store.station, fork + 1)
        found = other.execute(chain.rows_after(store.station, fork)).mappings()
        rows = [{name: each[name] for name in _ROW} for each in found]
        takeover = chain.last_takeover(other, store.station)
        if not rows:
            raise NotFoundError(
                "The station has every row of these records.",
                where=branch.location.shown,
                remedy="Nothing is to be brought in.",
            )
        made = {row["run_id"] for row in rows if row["event"] in chain.WITH_DIGESTS}
        contents = chain.contents_of(other, made)
        last = chain.hash_at(other, store.station, fork) or chain.GENESIS
        _check(rows, contents, chain.ChainEnd(fork, last, key or ""))
    for content in contents.values():
        for file in content["attachments"]:
            if files.path(file["sha256"]).exists():
                store.files.add(file["kind"], files.path(file["sha256"]))
    with store.signer.writing() as trail:
        connection = trail.connection
        named = {"first": rows[0]["number"], "last": rows[-1]["number"], "head": rows[-1]["hash"]}
        decided = {"takeover": takeover, "by": by, "reason": reason}
        trail.append(now, chain.BRANCH, {**named, **decided})
        numbers = _free_numbers(connection, contents)
        added = {
            run_id: _Run(content, numbers[run_id]).add(connection, store.station, now)
            for run_id, content in contents.items()
        }
        digests = chain.digests_of(connection, numbers.values())
        for row in rows:
            run_id = numbers.get(row["run_id"])
            event, data = chain.BROUGHT_IN, dict[str, Any](original=row)
            if run_id is not None and row["event"] == chain.CLAIMED:
                claim = {part: digests[run_id][part] for part in chain.CLAIM_PARTS}
                event, data = chain.CLAIMED, data | {"digests": claim}
            elif run_id is not None and row["event"] in chain.ENDINGS:
                event = row["event"]
                data |= {"state": added[row["run_id"]], "digests": digests[run_id]}
            elif run_id is not None and row["event"] == AuditEvent.LABELLED.value:
                event = row["event"]
            trail.append(now, event, data, run_id)
        for run_id, content in contents.items():
            if content["run"]["state"] == RunState.RUNNING.value:
                ended = {"state": _DIED["state"], "digests": digests[numbers[run_id]]}
                trail.append(now, chain.INTERRUPTED, ended, numbers[run_id])
        conflicts = _passed_twice(connection, numbers.values())
    return BroughtIn(store.station, **named, runs=tuple(numbers.values()), conflicts=conflicts)


@dataclass(frozen=True)
class Branch:
    """A branch in a station's records."""

    takeover: str | None
    """Hash of the row with which its PC took the station over; "" for the first PC, None if the
    records do not state it.
    """
    head: str
    """Hash of its last row."""
    last: int
    """Number of its last row."""
    here: int
    """Number of the last of its rows that is here: a PC that took the station over while the
    branch was sent lacks the rest.
    """

    @property
    def is_whole(self) -> bool:
        return self.here == self.last


def branches(connection: Connection, station: str) -> list[Branch]:
    """What was brought into a station's records, in order, also within another branch."""
    found = []
    events = (chain.BRANCH, chain.BROUGHT_IN, chain.TAKEN_OVER)
    rows = []
    for row in chain.rows_without_run(connection, station, events):
        event, data = row.event, chain.data_of(row.data)
        if event == chain.BROUGHT_IN:
            original = data["original"]
            event, data = original["event"], chain.data_of(original["data"])
        if event in (chain.BRANCH, chain.TAKEN_OVER):
            rows.append((row.number, event, data))
    for (number, event, data), following in zip_longest(rows, rows[1:]):
        if event == chain.BRANCH:
            here = data["last"]
            if following is not None:
                here = min(here, data["first"] + following[0] - number - 2)
            found.append(Branch(data.get("takeover"), data["head"], data["last"], here))
    return found


def _fork(own: Connection, other: Connection, station: str, where: str) -> int:
    """The last row of `other` that the station has, or has brought in. Raises RecordError."""
    for each in reversed(branches(own, station)):
        if chain.hash_at(other, station, each.last) == each.head:
            return each.here
    low, high = 0, chain.last_number(other, station)
    while low < high:  # rows are equal up to the fork, and none after it
        middle = (low + high + 1) // 2
        found = chain.hash_at(own, station, middle)
        if found is not None and found == chain.hash_at(other, station, middle):
            low = middle
        else:
            high = middle - 1
    if not low:
        raise RecordError(
            f"These are not records of the station {printable(station)}.",
            where=where,
            remedy="Name the records of the PC that ran as this station.",
            code=ErrorCode.RECORDS,
        )
    return low


def _check(
    rows: Sequence[Mapping[str, Any]],
    contents: Mapping[int, Mapping[str, Any]],
    end: chain.ChainEnd,
) -> None:
    """Check hashes, signatures and digests of a branch. Raises UnprovenError."""
    digests = chain.digests_in(contents)
    for row in rows:
        has_digests = row["event"] in chain.WITH_DIGESTS
        stated = chain.data_of(row["data"]).get("digests", {}) if has_digests else {}
        found = digests.get(row["run_id"], {})
        if end.add(row) or any(found.get(part) != digest for part, digest in stated.items()):
            raise UnprovenError(
                f"The records were changed: row {row['number']}, or its run, is not as it was"
                " signed. Nothing was brought in.",
                remedy="Find out what was changed: flasher station verify --database FILE.",
            )


def _free_numbers(connection: Connection, contents: Mapping[int, Any]) -> dict[int, int]:
    """Numbers of the branch's runs in the station's records: their own where these are free."""
    run = schema.run.c
    taken = set(connection.execute(select(run.id).where(run.id.in_(list(contents)))).scalars())
    following = max(contents, default=0)
    numbers = {}
    for run_id in contents:
        if run_id in taken:
            following += 1
        numbers[run_id] = following if run_id in taken else run_id
    return numbers


def _passed_twice(connection: Connection, run_ids: Iterable[int]) -> tuple[str, ...]:
    run, unit = schema.run.c, schema.unit.c
    # As at two stations of a plant: others passed again because the recipe asked for it.
    kinds = (RunKind.PRODUCTION.value, RunKind.RECHECK.value)
    passed = and_(run.state == RunState.PASS.value, run.kind.in_(kinds))
    brought = select(run.unit_id).where(run.id.in_(list(run_ids)), passed)
    query = (
        select(unit.serial)
        .join_from(schema.run, schema.unit)
        .where(passed, run.unit_id.in_(brought))
        .group_by(unit.id, unit.serial)
        .having(func.count() > 1)
        .order_by(unit.serial)
    )
    return tuple(connection.execute(query).scalars())


class _Run:
    """Adds a run of a branch under ids of the station's records, by their rules."""

    def __init__(self, content: Mapping[str, Any], number: int) -> None:
        self._content = content
        self._number = number

    def add(self, connection: Connection, station: str, now: datetime) -> str:
        """Add the run; returns its state."""
        content, number = self._content, self._number
        run = dict(content["run"])
        if run["state"] == RunState.RUNNING.value:
            run |= _DIED | {"ended_at": max(utc_text(now), run["begun_at"])}
        socket = {"name": content["socket"]["name"]}
        socket["station_id"] = find_or_insert(connection, schema.station, name=station)
        ids = {
            "unit_id": self._id(connection, "unit", "part", "serial"),
            "operator_id": self._id(connection, "operator", "name"),
            "recipe_id": self._id(connection, "recipe", "sha256"),
            "lot_id": content["lot"] and self._id(connection, "lot", "part", "name"),
            "socket_id": find_or_insert(connection, schema.socket, **socket),
        }
        insert(connection, schema.run, **(run | chain.UNENDED | ids | {"id": number}))
        for target, image in zip(content["targets"], content["artifacts"], strict=True):
            image_id = _found(connection, "artifact", image, "target", "sha256", "name")
            self._part(connection, "run_target", target, artifact_id=image_id)
        steps = {each["id"]: self._part(connection, "step", each) for each in content["steps"]}
        for each in content["measurements"]:
            values = {column.name: each[column.name] for column in schema.measurement.c}
            del values["id"]
            insert(connection, schema.measurement, **values | {"step_id": steps[each["step_id"]]})
        for table, part in (("device_write", "writes"), ("attachment", "attachments")):
            for each in content[part]:
                self._part(connection, table, each)
        outcome = {name: run[name] for name in chain.OUTCOME}
        connection.execute(update(schema.run).where(schema.run.c.id == number).values(**outcome))
        return str(run["state"])

    def _part(
        self, connection: Connection, name: str, values: Mapping[str, Any], **more: Any
    ) -> int:
        rest = {key: value for key, value in values.items() if key != "id"}
        return insert(
            connection, schema.metadata.tables[name], **rest | {"run_id": self._number} | more
        )

    def _id(self, connection: Connection, name: str, *columns: str) -> int:
        return _found(connection, name, self._content[name], *columns)


def _found(connection: Connection, name: str, row: Mapping[str, Any], *columns: str) -> int:
    """Id of a row that runs share, by the columns that identify it; it is added if needed."""
    table = schema.metadata.tables[name]
    query = select(table.c.id).where(*(table.c[column] == row[column] for column in columns))
    found = connection.execute(query).scalar_one_or_none()
    if found is not None:
        return int(found)
    return insert(connection, table, **{key: row[key] for key in row if key != "id"})
