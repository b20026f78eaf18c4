"""The parts of runs, read for many runs at once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, Final

from sqlalchemy import Connection, Select, select

from flasher.station.records import schema
from flasher.station.records.model import (
    AttachmentFile,
    Measurement,
    RunDetails,
    RunId,
    RunRecord,
    StepRecord,
    StepState,
    TargetRecord,
    WriteId,
    WriteRecord,
    utc_moment,
)
from flasher.station.steps import Verified

_BATCH: Final = 500
"""Keys in one IN (...): every back end takes so many."""


def details_of(connection: Connection, runs: list[RunRecord]) -> Iterable[RunDetails]:
    """The runs with all that belongs to them, in the same order."""
    for first in range(0, len(runs), _BATCH):
        some = runs[first : first + _BATCH]
        keys = [run.run_id for run in some]
        targets = _grouped(connection, _target_query(), schema.run_target, keys)
        steps = _grouped(connection, select(schema.step), schema.step, keys)
        measured = _measurements(connection, [row.id for rows in steps.values() for row in rows])
        writes = _grouped(connection, select(schema.device_write), schema.device_write, keys)
        files = _grouped(connection, select(schema.attachment), schema.attachment, keys)
        for run in some:
            yield RunDetails(
                run=run,
                targets=tuple(map(_target, targets[run.run_id])),
                steps=tuple(_step(row, measured[row.id]) for row in steps[run.run_id]),
                writes=tuple(map(_write, writes[run.run_id])),
                attachments=tuple(
                    AttachmentFile(row.kind, row.name, row.sha256, row.size_bytes)
                    for row in files[run.run_id]
                ),
            )


def _grouped(
    connection: Connection, query: Select[Any], table: Any, keys: list[RunId]
) -> dict[int, list[Any]]:
    found = defaultdict(list)
    for row in connection.execute(query.where(table.c.run_id.in_(keys)).order_by(table.c.id)):
        found[row.run_id].append(row)
    return found


def _measurements(connection: Connection, steps: list[int]) -> dict[int, list[Measurement]]:
    table = schema.measurement
    found = defaultdict(list)
    for first in range(0, len(steps), _BATCH):
        query = select(table).where(table.c.step_id.in_(steps[first : first + _BATCH]))
        for row in connection.execute(query.order_by(table.c.id)):
            found[row.step_id].append(
                Measurement(
                    row.name, row.value, row.unit, row.low, row.high, row.text, row.expected
                )
            )
    return found


def _target_query() -> Select[Any]:
    artifact = schema.artifact.c
    return select(schema.run_target, artifact.name, artifact.sha256, artifact.version).join_from(
        schema.run_target, schema.artifact
    )


def _target(row: Any) -> TargetRecord:
    return TargetRecord(
        target=row.target,
        image=row.name,
        image_sha256=row.sha256,
        version=row.version,
        required=Verified(row.required),
        reached=None if row.reached is None else Verified(row.reached),
    )


def _step(row: Any, measured: list[Measurement]) -> StepRecord:
    return StepRecord(
        position=row.position,
        name=row.name,
        try_number=row.try_number,
        state=StepState(row.state),
        begun_at=utc_moment(row.begun_at),
        duration_s=row.duration_s,
        code=row.code,
        text=row.text,
        measurements=tuple(measured),
    )


def _write(row: Any) -> WriteRecord:
    return WriteRecord(
        write_id=WriteId(row.id),
        target=row.target,
        what=row.what,
        value=row.value,
        intended_at=utc_moment(row.intended_at),
        verified_at=None if row.verified_at is None else utc_moment(row.verified_at),
        read_back=row.read_back,
    )
