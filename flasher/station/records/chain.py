"""The audit trail: append-only rows, each hashed together with the hash of the row before it.

The row of a finished run also holds a digest over the run and all its parts, so that a change made
behind the triggers' back is found by `check_chain` and `run_digest`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, select

from flasher.station.records.model import Problem, utc_text
from flasher.station.records.schema import (
    artifact,
    attachment,
    audit,
    device_write,
    lot,
    measurement,
    operator,
    recipe,
    run,
    run_target,
    socket,
    step,
    unit,
)

GENESIS: Final = "0" * 64
"""The hash before the first row."""
FINISHED: Final = "finished"
INTERRUPTED: Final = "interrupted"


def append(
    connection: Connection,
    now: datetime,
    event: str,
    data: Mapping[str, Any],
    run_id: int | None = None,
) -> None:
    """Add a row to the trail, in the transaction of what it tells."""
    previous = connection.execute(
        select(audit.c.hash).order_by(audit.c.id.desc()).limit(1)
    ).scalar_one_or_none()
    row = {"at": utc_text(now), "event": event, "run_id": run_id, "data": canonical(data)}
    before = previous or GENESIS
    connection.execute(
        audit.insert().values(**row, previous_hash=before, hash=_row_hash(before, row))
    )


def canonical(data: Any) -> str:
    """One text for equal data."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def _row_hash(previous: str, row: Mapping[Any, Any]) -> str:
    return _hash([previous, row["at"], row["event"], row["run_id"], row["data"]])


def _hash(data: Any) -> str:
    return hashlib.sha256(canonical(data).encode("ascii")).hexdigest()


def run_digest(connection: Connection, run_id: int) -> str:
    """The digest over a run and everything that belongs to it, names instead of keys of tables."""
    head = connection.execute(
        select(
            run,
            unit.c.part,
            unit.c.serial,
            socket.c.name.label("socket_name"),
            operator.c.name.label("operator_name"),
            recipe.c.sha256.label("recipe_sha256"),
            lot.c.name.label("lot_name"),
        )
        .join_from(run, unit)
        .join(socket)
        .join(operator)
        .join(recipe)
        .outerjoin(lot, run.c.lot_id == lot.c.id)
        .where(run.c.id == run_id)
    ).one()
    parts: list[Any] = [list(head)]
    steps = select(step.c.id).where(step.c.run_id == run_id)
    for query in (
        select(run_target, artifact.c.sha256, artifact.c.version)
        .join_from(run_target, artifact)
        .where(run_target.c.run_id == run_id)
        .order_by(run_target.c.id),
        select(step).where(step.c.run_id == run_id).order_by(step.c.id),
        select(measurement).where(measurement.c.step_id.in_(steps)).order_by(measurement.c.id),
        select(device_write).where(device_write.c.run_id == run_id).order_by(device_write.c.id),
        select(attachment).where(attachment.c.run_id == run_id).order_by(attachment.c.id),
    ):
        parts.append([list(row) for row in connection.execute(query)])  # noqa: PERF401
    return _hash(parts)


def check_chain(connection: Connection) -> Iterator[Problem]:
    """What is wrong with the trail, and with the runs that it vouches for."""
    before = GENESIS
    vouched: set[int] = set()
    for row in connection.execute(select(audit).order_by(audit.c.id)).mappings().all():
        where = f"audit row {row['id']}"
        if row["previous_hash"] != before:
            yield Problem(where, "the chain is broken: the row before it is missing or changed")
        if row["hash"] != _row_hash(row["previous_hash"], row):
            yield Problem(where, "it was changed after it was written")
        before = row["hash"]
        if row["event"] in (FINISHED, INTERRUPTED) and row["run_id"] is not None:
            vouched.add(row["run_id"])
            yield from _check_run(connection, row["run_id"], row["data"])
    finished = select(run.c.id).where(run.c.state != "RUNNING").order_by(run.c.id)
    for run_id in connection.execute(finished).scalars():
        if run_id not in vouched:
            yield Problem(f"run {run_id}", "it is finished, but the audit trail does not know it")


def _check_run(connection: Connection, run_id: int, data: str) -> Iterator[Problem]:
    exists = connection.execute(select(run.c.id).where(run.c.id == run_id)).one_or_none()
    if exists is None:
        yield Problem(f"run {run_id}", "it is missing")
        return
    try:
        stated = json.loads(data).get("digest")
    except (ValueError, AttributeError):
        stated = None
    if stated != run_digest(connection, run_id):
        yield Problem(f"run {run_id}", "it was changed after it was finished")
