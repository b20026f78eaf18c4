"""What one story after the other uses again: a place in memory, and the statements that SQLAlchemy
has compiled for the records. Each story has records of its own all the same.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

from sqlalchemy import Engine

from flasher.station.records.database import Database

_make_engine = Database._engine
_engines: dict[str, Engine] = {}


@cache
def _place() -> tempfile.TemporaryDirectory[str]:
    shared = Path("/dev/shm")  # noqa: S108
    return tempfile.TemporaryDirectory(dir=shared if shared.is_dir() else None)


@contextmanager
def empty_folder() -> Iterator[Path]:
    """A folder of the same name each time, for one story at a time."""
    folder = Path(_place().name) / "story"
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@contextmanager
def same_engine() -> Iterator[None]:
    """A database that is opened here has the engine of the one before with the same name."""

    def engine(database: Database) -> Engine:
        name = str(database.location.url)
        if name not in _engines:
            _engines[name] = _make_engine(database)
        return _engines[name]

    with patch.object(Database, "_engine", engine):
        yield
