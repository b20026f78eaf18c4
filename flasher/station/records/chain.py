"""Audit trail of a station: a hash chain of append-only rows, signed with the station's key.

The row of a finished run holds the digests of the run and its parts, so that a change that avoided
the triggers is detected (`examination`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cache
from typing import Any, Final

from sqlalchemy import Connection, Row, Select, Table, bindparam, func, select

from flasher.station.records import schema
from flasher.station.records.heads import ChainHead
from flasher.station.records.model import AuditEvent, RunState, utc_text
from flasher.station.records.rows import KEYS, beside_index, find_or_insert, grouped, insert
from flasher.station.records.schema import audit, station
from flasher.station.records.signatures import SigningKey, is_signed
from flasher.station.records.triggers import fingerprint_of

GENESIS: Final = "0" * 64
"""Previous hash of the first row."""
BEGUN: Final = "begun"
"""First row of a chain: station, records id, schema and public key."""
CLAIMED: Final = "claimed"
FINISHED: Final = "finished"
INTERRUPTED: Final = "interrupted"
MIGRATED: Final = "migrated"
"""The schema was upgraded: problems found in the old one, and the new schema."""
KEY_ROTATED: Final = "key rotated"
"""A new key, in a row signed with the old key; later rows are signed with the new one."""
KEY_LOST: Final = "key lost"
"""A new key, in a row signed with the new key itself, because the old one was lost."""
CLOCK: Final = "clock"
"""An operator confirmed the clock although later times are recorded."""
RESTORED: Final = "restored"
"""An operator accepted an older copy of the records, whose missing rows are lost."""
TAKEN_OVER: Final = "taken over"
"""A person let another PC continue the station. Rows that only the PC before it has are a branch;
the numbers of runs before `runs_from` are left to it."""
BRANCH: Final = "branch"
"""Rows of another PC follow, which it recorded as this station after it had been taken over."""
BROUGHT_IN: Final = "brought in"
"""A row of a branch that belongs to no run."""
RUNS_LEFT_FREE: Final = 100_000
"""Numbers that a takeover leaves to the runs of the PC before: two months at a unit a minute."""
RECIPE: Final = "recipe"
"""A recipe was used for the first time."""
LABEL_DUE: Final = "label_due"
"""Key of a FINISHED row: the station prints a label for this PASS; LABELLED states that it has."""
ENDINGS: Final = (FINISHED, INTERRUPTED)
"""Rows that hold the digests of a run that ended."""
WITH_DIGESTS: Final = (CLAIMED, *ENDINGS)
"""Rows that hold digests of their run; others name one that began before."""
_KEYS: Final = (BEGUN, KEY_ROTATED, KEY_LOST)
LOSSES: Final = (RESTORED, TAKEN_OVER)
"""Rows that may accept a range of rows as lost."""
_CANONICAL: Final = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), ensure_ascii=True, default=repr
)
EVENTS: Final = (
    BEGUN, CLAIMED, FINISHED, INTERRUPTED, RECIPE, *(event.value for event in AuditEvent), CLOCK,
    RESTORED, TAKEN_OVER, BRANCH, BROUGHT_IN, KEY_ROTATED, KEY_LOST, MIGRATED,
)  # fmt: skip
"""All events of audit rows."""

_LAST: Final = (
    select(audit.c.number, audit.c.hash)
    .where(audit.c.station_id == bindparam("station_id"))
    .order_by(audit.c.number.desc())
    .limit(1)
)
_STATION_ID: Final = select(station.c.id).where(station.c.name == bindparam("station"))
# No join: a server would sort all rows of the chain, where an index has them in order.
_OF_STATION: Final = audit.c.station_id == _STATION_ID.scalar_subquery()
_HASH_AT: Final = select(audit.c.hash).where(_OF_STATION, audit.c.number == bindparam("number"))
_LATEST: Final = (
    select(audit.c.at)
    .where(_OF_STATION, beside_index(audit.c.number) >= bindparam("since"))
    .order_by(audit.c.at.desc())
    .limit(1)
)
_WITHOUT_RUN: Final = select(audit).where(
    audit.c.run_id.is_(None), audit.c.event.in_(bindparam("events", expanding=True))
)


class Trail:
    """Appends rows to a station's chain, inside a write transaction."""

    def __init__(self, connection: Connection, station_name: str, key: SigningKey) -> None:
        self.connection = connection
        self.station = station_name
        self.key = key
        self.heads: list[ChainHead] = []
        """Heads of the rows that were added."""

    def append(
        self, now: datetime, event: str, data: Mapping[str, Any], run_id: int | None = None
    ) -> None:
        """Append a signed row."""
        station_id = find_or_insert(self.connection, station, name=self.station)
        last = self.connection.execute(_LAST, {"station_id": station_id}).one_or_none()
        number, before = (1, GENESIS) if last is None else (last.number + 1, last.hash)
        row: dict[str, Any] = {
            "number": number,
            "at": utc_text(now),
            "event": event,
            "run_id": run_id,
            "data": canonical(data),
            "previous_hash": before,
        }
        found = row_hash(row)
        signature = self.key.sign(found)
        insert(
            self.connection, audit, **row, station_id=station_id, hash=found, signature=signature
        )
        head = ChainHead(self.station, number, row["at"], found, signature, self.key.public)
        self.heads.append(head)

    def begin(self, now: datetime, records_id: str) -> None:
        """Append the first row of the chain."""
        begun = {
            "key": self.key.public,
            "station": self.station,
            "records": records_id,
            "version": schema.SCHEMA_VERSION,
            "schema": fingerprint_of(self.connection),
        }
        self.append(now, BEGUN, begun)


def canonical(data: Any) -> str:
    """Canonical JSON: equal data gives equal text."""
    return _CANONICAL.encode(data)


def digest(data: Any) -> str:
    """SHA-256 of canonical JSON, in hexadecimal digits."""
    return hashlib.sha256(canonical(data).encode("ascii")).hexdigest()


def data_of(text: str) -> dict[str, Any]:
    """Parse an object of `canonical`; returns {} for any other text."""
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def row_hash(row: Mapping[Any, Any]) -> str:
    """Hash of an audit row. It includes the previous hash, so it covers the chain so far."""
    columns = ("previous_hash", "number", "at", "event", "run_id", "data")
    return digest([row[name] for name in columns])


def key_of(event: str, data: Mapping[str, Any]) -> str | None:
    """The public key that a row introduces; None for other rows."""
    found = data.get("key") if event in _KEYS else None
    return found if isinstance(found, str) else None


class RowFault(StrEnum):
    """What is wrong with an audit row."""

    BROKEN = "the chain is broken: the previous row is missing or changed"
    CHANGED = "it was changed after it was written"
    UNSIGNED = "it is not signed with the key of the station"


@dataclass
class ChainEnd:
    """The end of a chain that is checked row by row."""

    number: int = 0
    hash: str = GENESIS
    key: str = ""
    """Public key that signs the next row."""

    def add(self, row: Mapping[Any, Any]) -> list[RowFault]:
        """Check the next row; returns its faults. Rows after a changed one are checked as well."""
        following = key_of(row["event"], data_of(row["data"]))
        # Only a rotated key is introduced by the one before it.
        key = self.key if following is None or row["event"] == KEY_ROTATED else following
        faults = []
        if (row["number"], row["previous_hash"]) != (self.number + 1, self.hash):
            faults.append(RowFault.BROKEN)
        if row["hash"] != row_hash(row):
            faults.append(RowFault.CHANGED)
        if not is_signed(row["hash"], row["signature"], key):
            faults.append(RowFault.UNSIGNED)
        self.number, self.hash, self.key = self.number + 1, row["hash"], following or key
        return faults


def key_in_force(
    connection: Connection, station_name: str, before: int | None = None
) -> str | None:
    """The public key that signs row `before`, or else the next row. None for an empty chain."""
    rows = [
        row
        for row in rows_without_run(connection, station_name, _KEYS)
        if before is None or row.number < before
    ]
    return key_of(rows[-1].event, data_of(rows[-1].data)) if rows else None


def rows_without_run(
    connection: Connection, station_name: str, events: Iterable[str]
) -> list[Row[Any]]:
    """A station's audit rows of these events that belong to no run, in order.

    They are few among millions of rows; the index of `run_id` finds them.
    """
    wanted = connection.execute(_STATION_ID, {"station": station_name}).scalar_one_or_none()
    rows = connection.execute(_WITHOUT_RUN, {"events": list(events)})
    found = (row for row in rows if row.station_id == wanted)
    return sorted(found, key=lambda row: row.number)


def rows_after(station_name: str, number: int) -> Select[Any]:
    """Query of a station's audit rows after row `number`, in order."""
    after = select(audit).where(_OF_STATION, audit.c.number > number).order_by(audit.c.number)
    return after.params(station=station_name)


def last_number(connection: Connection, station_name: str) -> int:
    """Number of a station's last audit row; 0 for an empty chain."""
    last = connection.execute(
        select(func.max(audit.c.number)).where(_OF_STATION), {"station": station_name}
    )
    return int(last.scalar_one() or 0)


def head_of(connection: Connection, run_id: int) -> ChainHead | None:
    """The chain head after a finished run; None without an audit row."""
    row = ending_of(connection, run_id)
    if not row:
        return None
    key = key_in_force(connection, row["name"], row["number"])
    facts = {name: row[name] for name in ("number", "at", "hash", "signature")}
    return ChainHead(row["name"], **facts, key=key or "")


def accepted_losses(connection: Connection, station_name: str) -> list[range]:
    """Ranges of rows that operators accepted as lost when they restored older records, or that
    are a branch of another PC.
    """
    rows = rows_without_run(connection, station_name, LOSSES)
    return [lost_of(data_of(row.data)) for row in rows]


def last_takeover(connection: Connection, station_name: str) -> str:
    """Hash of the row with which this PC took the station over; "" for the first PC."""
    rows = rows_without_run(connection, station_name, [TAKEN_OVER])
    return rows[-1].hash if rows else ""


def runs_from(data: Mapping[str, Any]) -> int:
    """The lowest number for a run after a TAKEN_OVER row."""
    found = data.get("runs_from")
    return found if isinstance(found, int) else 1


def lost_of(data: Mapping[str, Any]) -> range:
    """Range of rows that a row of `LOSSES` accepts as lost."""
    first, last = data.get("lost_from"), data.get("lost_to")
    if isinstance(first, int) and isinstance(last, int):
        return range(first, last + 1)
    return range(0)


def ending_of(connection: Connection, run_id: int) -> dict[str, Any]:
    """Audit row of a finished run with the `name` of its station; {} without one."""
    query = (
        select(audit, station.c.name)
        .join_from(audit, station)
        .where(audit.c.run_id == run_id, audit.c.event.in_(ENDINGS))
    )
    row = connection.execute(query.order_by(audit.c.id.desc()).limit(1)).mappings().one_or_none()
    return {} if row is None else dict(row)


def hash_at(connection: Connection, station_name: str, number: int) -> str | None:
    """Hash of row `number`; None if the chain has no such row."""
    found = connection.execute(_HASH_AT, {"station": station_name, "number": number})
    return found.scalar_one_or_none()


def latest(connection: Connection, station_name: str) -> str | None:
    """The latest time in the chain since the clock was last confirmed; None without rows."""
    released = rows_without_run(connection, station_name, [CLOCK])
    since = released[-1].number if released else 0
    found = connection.execute(_LATEST, {"station": station_name, "since": since})
    return found.scalar_one_or_none()


CLAIM: Final = "claim"
"""Name of a run's digest that is computed when the run begins."""
NAMED: Final = {
    "unit": "serial number or part",
    "station": "the station's name",
    "socket": "the socket's name",
    "operator": "the operator's name",
    "lot": "the lot's name",
    "recipe": "the recipe's name, revision or content",
    "artifacts": "an image's name, version, size or hash",
}
"""Rows that several runs refer to, as `verify` names them."""
OWN: Final = {
    "run": "the run itself",
    CLAIM: "its claim",
    "targets": "the verification of its targets",
    "steps": "its steps",
    "measurements": "its measurements",
    "writes": "its writes",
    "attachments": "its attachments",
}
"""Parts of a run, as `verify` names them."""
CLAIM_PARTS: Final = (CLAIM, *NAMED)
OUTCOME: Final = frozenset(
    ["state", "code", "text", "ended_at", "ended_monotonic_s", "verification_reached", "log_sha256"]
)
"""Columns of a run that are set when it ends."""
UNENDED: Final[dict[str, Any]] = dict.fromkeys(OUTCOME) | {
    "state": RunState.RUNNING.value, "code": "", "text": "",
}  # fmt: skip
"""Values of these columns before."""


_MEASUREMENTS: Final = (
    select(schema.measurement, schema.step.c.run_id)
    .join_from(schema.measurement, schema.step)
    .where(schema.step.c.run_id.in_(KEYS))
    .order_by(schema.measurement.c.id)
)


@cache
def _rows_by(table: Table, column: str) -> Select[Any]:
    return select(table).where(table.c[column].in_(KEYS)).order_by(table.c.id)


def digests_of(connection: Connection, run_ids: Iterable[int]) -> dict[int, dict[str, str]]:
    """Digests of the parts of runs, by run id; missing runs are left out.

    They cover names and contents of the rows that a run refers to, not only their ids.
    """
    return digests_in(contents_of(connection, run_ids))


def digests_in(contents: Mapping[int, Mapping[str, Any]]) -> dict[int, dict[str, str]]:
    """Digests of runs whose rows are already read."""
    known: dict[int, str] = {}

    def digest_of(value: Any) -> str:
        """Cached by identity: runs share the objects of recipes and operators."""
        if id(value) not in known:
            known[id(value)] = digest(value)
        return known[id(value)]

    return {
        run_id: {name: digest_of(value) for name, value in content.items()}
        for run_id, content in contents.items()
    }


def claim_of(content: Mapping[str, Any]) -> list[Any]:
    """The part of a run that does not change after its claim."""
    claim = {name: value for name, value in content["run"].items() if name not in OUTCOME}
    return [claim, [{**each, "reached": None} for each in content["targets"]]]


def contents_of(connection: Connection, run_ids: Iterable[int]) -> dict[int, dict[str, Any]]:
    """Rows of runs, and all rows that they refer to, by run id and part."""
    wanted = list(run_ids)

    def by_id(table: Table, ids: Iterable[Any]) -> dict[Any, dict[str, Any]]:
        found = grouped(connection, _rows_by(table, "id"), "id", ids)
        return {key: row for key, (row,) in found.items()}

    def named_by(rows: Iterable[Mapping[str, Any]], table: Table) -> dict[Any, dict[str, Any]]:
        """Rows of a table that other rows refer to, by id."""
        return by_id(table, dict.fromkeys(row[f"{table.name}_id"] for row in rows))

    def parts_of(table: Table) -> dict[int, list[dict[str, Any]]]:
        return grouped(connection, _rows_by(table, "run_id"), "run_id", wanted)

    targets = parts_of(schema.run_target)
    parts = {
        "steps": parts_of(schema.step),
        "measurements": grouped(connection, _MEASUREMENTS, "run_id", wanted),
        "writes": parts_of(schema.device_write),
        "attachments": parts_of(schema.attachment),
        "targets": targets,
    }
    runs = by_id(schema.run, wanted)
    of_runs = {
        table.name: named_by(runs.values(), table)
        for table in (schema.unit, schema.socket, schema.operator, schema.recipe, schema.lot)
    }
    stations = named_by(of_runs["socket"].values(), schema.station)
    artifacts = named_by((target for some in targets.values() for target in some), schema.artifact)
    found = {}
    for run_id, row in runs.items():
        others = {name: rows.get(row[f"{name}_id"]) for name, rows in of_runs.items()}
        socket = others["socket"]
        found[run_id] = {
            "run": row,
            CLAIM: claim_of({"run": row, "targets": targets[run_id]}),
            **others,
            "station": socket and stations.get(socket["station_id"]),
            "artifacts": [artifacts.get(each["artifact_id"]) for each in targets[run_id]],
            **{name: rows[run_id] for name, rows in parts.items()},
        }
    return found
