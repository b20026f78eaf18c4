"""A consistent copy of the records while the station runs: whole and checked, or not there.

The attachments that the copy names are copied first-come: they are never changed once they are
there, so those beside the copy are those of the copy.
"""

from __future__ import annotations

import contextlib
import hashlib
import sqlite3
from pathlib import Path

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.records.database import Database, read_only_sqlite
from flasher.station.records.errors import RecordsDamagedError, mapped
from flasher.station.records.files import FileStore, whole_file
from flasher.station.records.model import Backup


def make_backup(database: Database, files: FileStore, path: Path) -> Backup:
    """Copy the database to `path` and the attachments that it names to `NAME.files` beside it.

    A file that is at `path` is replaced only by a whole copy. Raises RecordError; UsageError for
    a back end that has tools of its own, or a place that is the database itself.
    """
    source = database.location.file
    if source is None:
        raise UsageError(
            f"{database.backend} records are not copied by flasher.",
            remedy="Use the backup of the database itself (pg_dump), and copy the files folder.",
        )
    if path.resolve() == source.resolve():
        raise UsageError("A backup cannot replace the database itself.", remedy="Name another.")
    with mapped(printable(str(path)), writes=True):
        with whole_file(path) as part:
            copy_sqlite(source, part)
            names = _check(part)
            target = FileStore(path.with_name(path.name + ".files"))
            for sha256 in names:
                if not target.path(sha256).exists():
                    target.add("backup", files.path(sha256))
        data = path.read_bytes()
    return Backup(path, hashlib.sha256(data).hexdigest(), len(data))


def copy_sqlite(source: Path, part: Path) -> None:
    """A consistent copy of a database that others may be using."""
    with (
        contextlib.closing(read_only_sqlite(source)) as original,
        contextlib.closing(sqlite3.connect(part)) as copy,
    ):
        original.backup(copy)
        # One file, without a log beside it that would be lost in copying it on.
        copy.execute("PRAGMA journal_mode = DELETE")


def _check(part: Path) -> list[str]:
    """Raises RecordsDamagedError for a copy that is not whole; else the attachments it names."""
    with contextlib.closing(sqlite3.connect(part)) as copy:
        (found,) = copy.execute("PRAGMA integrity_check").fetchone()
        if found != "ok":
            raise RecordsDamagedError(
                "The database is damaged: the copy does not hold together.",
                where=printable(str(found)),
                remedy="Keep the last good backup.",
            )
        return [row[0] for row in copy.execute("SELECT DISTINCT sha256 FROM attachment")]
