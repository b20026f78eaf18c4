"""Rows that are made when they are first needed: stations, operators, units, recipes, ...

All run inside the caller's transaction, which already holds the write lock.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import PurePath
from typing import Any

from sqlalchemy import Connection, Table, select

from flasher.station.recipe_file import LoadedRecipe, LoadedTarget
from flasher.station.records import schema
from flasher.station.records.chain import Trail


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
