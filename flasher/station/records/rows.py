"""Adds rows to the records, inside the caller's transaction, which holds the write lock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import PurePath
from typing import Any

from sqlalchemy import Connection, Table, func, select, update

from flasher.station.recipe_file import LoadedRecipe, LoadedTarget
from flasher.station.records import chain, schema
from flasher.station.records.chain import Trail, digests_of
from flasher.station.records.errors import NotFoundError
from flasher.station.records.model import AttachmentFile, Ending, Measurement, RunState, utc_text


def named(connection: Connection, table: Table, **key: Any) -> int:
    """The id of the row with these values, made if there is none."""
    query = select(table.c.id).where(*(table.c[name] == value for name, value in key.items()))
    found = connection.execute(query).scalar_one_or_none()
    return int(insert(connection, table, **key) if found is None else found)


def insert(connection: Connection, table: Table, **values: Any) -> int:
    """Add a row; its id."""
    key = connection.execute(table.insert().values(**values)).inserted_primary_key
    assert key is not None  # noqa: S101  every table here has a key of one column
    return int(key[0])


def recipe_row(trail: Trail, loaded: LoadedRecipe, now: datetime) -> int:
    """The recipe with its whole text, so that it can be read years later."""
    connection = trail.connection
    table = schema.recipe
    query = select(table.c.id).where(table.c.sha256 == loaded.sha256)
    found = connection.execute(query).scalar_one_or_none()
    if found is not None:
        return int(found)
    recipe = loaded.recipe
    facts = {"name": recipe.name, "revision": recipe.revision, "sha256": loaded.sha256}
    trail.append(now, "recipe", facts)
    return insert(
        connection,
        table,
        **facts,
        part=recipe.part,
        content=loaded.content,
        verification_required=int(loaded.required),
        allow_completed_not_read_back=recipe.allow_completed_not_read_back,
    )


def add_targets(connection: Connection, run_id: int, targets: tuple[LoadedTarget, ...]) -> None:
    """What a run has to do, target by target."""
    for position, target in enumerate(targets, 1):
        image = target.image
        artifact_id = named(
            connection,
            schema.artifact,
            target=target.name,
            sha256=image.sha256,
            name=PurePath(image.source).name,
            version=target.version,
            size_bytes=image.size_bytes,
        )
        connection.execute(
            schema.run_target.insert().values(
                run_id=run_id,
                artifact_id=artifact_id,
                position=position,
                target=target.name,
                required=int(target.required),
            )
        )


def add_step(
    connection: Connection,
    run_id: int,
    name: str,
    measurements: Sequence[Measurement],
    **values: Any,
) -> None:
    """The next step of a run, with its measurements."""
    table = schema.step
    position, tries = connection.execute(
        select(
            func.coalesce(func.max(table.c.position), 0),
            func.count().filter(table.c.name == name),
        ).where(table.c.run_id == run_id)
    ).one()
    step_id = insert(
        connection,
        table,
        run_id=run_id,
        position=position + 1,
        name=name,
        try_number=tries + 1,
        **values,
    )
    for each in measurements:
        connection.execute(
            schema.measurement.insert().values(
                step_id=step_id,
                name=each.name,
                value=each.value,
                unit=each.unit,
                low=each.low,
                high=each.high,
                text=each.text,
                expected=each.expected,
            )
        )


def is_saved(connection: Connection, run_id: int, ending: Ending) -> bool:
    """True when the run was finished with this very ending. Raises NotFoundError."""
    table = schema.run.c
    row = connection.execute(
        select(table.state, table.code, table.text, table.log_sha256).where(table.id == run_id)
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"There is no run {run_id}.")
    return tuple(row) == (ending.state.value, ending.code, ending.text, ending.log_sha256)


def add_attachments(connection: Connection, run_id: int, files: Iterable[AttachmentFile]) -> None:
    """Name stored files in the records of a run."""
    for file in files:
        connection.execute(
            schema.attachment.insert().values(
                run_id=run_id,
                kind=file.kind,
                name=file.name,
                sha256=file.sha256,
                size_bytes=file.size_bytes,
            )
        )


def add_ending(connection: Connection, run_id: int, ending: Ending) -> None:
    """The attachments of an ending, and how far each target was verified."""
    add_attachments(connection, run_id, ending.attachments)
    for target, reached in ending.verified.items():
        changed = connection.execute(
            update(schema.run_target)
            .where(schema.run_target.c.run_id == run_id)
            .where(schema.run_target.c.target == target)
            .values(reached=int(reached))
        )
        one_row(changed.rowcount, f"target {target} of run {run_id}")


def end_run(trail: Trail, run_id: int, now: datetime, **values: Any) -> None:
    """End a run, and let the audit trail vouch for it and all its parts."""
    connection = trail.connection
    begun_at = connection.execute(
        select(schema.run.c.begun_at).where(schema.run.c.id == run_id)
    ).scalar_one()
    connection.execute(
        update(schema.run)
        .where(schema.run.c.id == run_id)
        # A clock that was set back does not make a run end before it began.
        .values(ended_at=max(utc_text(now), begun_at), **values)
    )
    interrupted = values["state"] == RunState.INTERRUPTED.value
    event = chain.INTERRUPTED if interrupted else chain.FINISHED
    digests = digests_of(connection, [run_id])[run_id]
    trail.append(now, event, {"state": values["state"], "digests": digests}, run_id)


def weakest(connection: Connection, run_id: int) -> int | None:
    """How far all of a run's targets were verified at least; None when one was not."""
    table = schema.run_target.c
    levels = list(connection.execute(select(table.reached).where(table.run_id == run_id)).scalars())
    return None if not levels or None in levels else min(levels)


def one_row(count: int, what: str) -> None:
    """Raises NotFoundError when a change found nothing to change."""
    if count != 1:
        raise NotFoundError(f"There is no {what}.")
