"""Frames of an SQLite file (.db) as python-can writes it.

SQLite makes and removes files beside a database that it opens, and repairs it. So a copy is read,
in a folder of its own: what is only looked at stays as it is, and what another program had not yet
written into the file itself is read too.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from io import BufferedIOBase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from flasher.files import opened
from flasher.protocol.frame import Frame
from flasher.trace.bounds import UnfitError

_FRAMES: Final = "SELECT ts, arbitration_id, extended, remote, error, data FROM messages"
_IS_TABLE: Final = (
    "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'messages' AND rootpage > 0"
)
"""A view, or a table that a program makes up, may have rows without end."""
_COMPANIONS: Final = ("-journal", "-wal")
"""What SQLite writes beside a database; both hold what belongs into it."""
_COPIED_MAX_SIZE: Final = 256 * 1024 * 1024
_PIECE_SIZE: Final = 1024 * 1024
_VALUE_MAX: Final = 65_536
"""In bytes, of one value."""
_ROW_MIN_SIZE: Final = 8
"""In bytes, of the smallest row of seven columns: a damaged file may lead in circles."""


def frames_of_database(source: BufferedIOBase, path: Path) -> Iterator[tuple[float, Frame]]:
    """Time in seconds and frame of each row. `path` leads to what belongs to the file.

    Raises UnfitError, and sqlite3.Error for what is no such database.
    """
    with _copied(source, path) as copy, closing(sqlite3.connect(copy)) as connection:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _VALUE_MAX)
        if connection.execute(_IS_TABLE).fetchone() is None:
            raise UnfitError("there is no table messages in it")
        left = copy.stat().st_size // _ROW_MIN_SIZE
        for at_s, can_id, extended, remote, error, held in connection.execute(_FRAMES):
            left -= 1
            if left < 0:
                raise UnfitError("it has more rows than it has room for")
            data = b"" if held is None and remote else held
            kinds = (
                isinstance(at_s, int | float),
                isinstance(can_id, int),
                isinstance(data, bytes),
            )
            if not all(kinds):
                raise UnfitError("a row lacks its time, its id or its data")
            yield (
                float(at_s),
                Frame(can_id, data, bool(extended) and not error, bool(remote), bool(error)),
            )


@contextmanager
def _copied(source: BufferedIOBase, path: Path) -> Iterator[Path]:
    with TemporaryDirectory(prefix="flasher-") as folder:
        copy = Path(folder) / "trace.db"
        with copy.open("wb") as file:
            while piece := source.read(_PIECE_SIZE):
                if file.tell() > _COPIED_MAX_SIZE:
                    raise UnfitError(f"it has more than {_COPIED_MAX_SIZE:,} bytes")
                file.write(piece)
        for companion in _COMPANIONS:
            beside = path.with_name(path.name + companion)
            if beside.exists():
                with (
                    opened(beside, _COPIED_MAX_SIZE, may_grow=True) as (file_beside, _),
                    copy.with_name(copy.name + companion).open("wb") as file,
                ):
                    shutil.copyfileobj(file_beside, file)
        yield copy
