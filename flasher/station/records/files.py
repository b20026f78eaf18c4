"""Stores attachments beside the database, named by their SHA-256, complete or absent.

A file is on disk before a row refers to it. A file without a row is harmless: a crash left it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Final

from flasher.protocol.text import printable
from flasher.station.records.errors import RecordError, RecordsDamagedError, mapped
from flasher.station.records.model import TORN_TRACE, TRACE, AttachmentFile

_CHUNK_BYTES: Final = 1 << 20
_PART: Final = ".part-"
_SUFFIX: Final = re.compile(r"(?:\.[a-z0-9]{1,4}){1,2}$")
_PART_AGE_S: Final = 86_400.0
"""Younger partial files may belong to another station that uses the folder."""


class FileStore:
    """The folder of the attachments."""

    cause_missing = ""
    remedy = "Fetch it from a backup."
    """What to do about an attachment that is missing or damaged."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, kind: str, source: Path) -> AttachmentFile:
        """Copy a file into the folder; it is on disk on return. Raises RecordError."""
        with (
            mapped(printable(str(source)), writes=True),
            source.open("rb") as stream,
            mapped(printable(str(self.folder)), writes=True),
        ):
            self.folder.mkdir(parents=True, exist_ok=True)
            handle, part = tempfile.mkstemp(prefix=_PART, dir=self.folder)
            try:
                digest, size_bytes = hashlib.sha256(), 0
                with os.fdopen(handle, "wb") as out:
                    while chunk := stream.read(_CHUNK_BYTES):
                        digest.update(chunk)
                        out.write(chunk)
                        size_bytes += len(chunk)
                    out.flush()
                    os.fsync(out.fileno())
                sha256 = digest.hexdigest()
                final = self.path(sha256)
                if not final.parent.exists():
                    final.parent.mkdir(exist_ok=True)
                    sync_folder(self.folder)
                # Replaces a file of that name: its content is equal or damaged.
                Path(part).replace(final)
                sync_folder(final.parent)
            except BaseException:
                with contextlib.suppress(OSError):
                    Path(part).unlink(missing_ok=True)
                raise
        return AttachmentFile(kind, source.name, sha256, size_bytes)

    @property
    def spool(self) -> Path:
        """Folder for the traces of active runs."""
        return self.folder / "open"

    def add_spooled(self, run_id: int) -> list[AttachmentFile]:
        """Store the trace of an interrupted run. Raises RecordError."""
        plain, packed = self._spooled(run_id)
        # A process that died while it packed the trace has left both, and the plain one is whole.
        for path, kind in ((plain, TORN_TRACE), (packed, TRACE)):
            if path.is_file() and path.stat().st_size:
                return [self.add(kind, path)]
        return []

    def forget_spooled(self, run_id: int) -> None:
        """Delete the spooled trace of a run whose trace is stored."""
        for path in self._spooled(run_id):
            with contextlib.suppress(OSError):  # one that stays harms nothing
                path.unlink(missing_ok=True)

    def spooled(self, run_id: int) -> Path:
        """Path of the trace of an active run."""
        return self.spool / f"run-{run_id}.log"

    def _spooled(self, run_id: int) -> tuple[Path, Path]:
        plain = self.spooled(run_id)
        return plain, plain.with_name(plain.name + ".gz")

    @contextmanager
    def temporary_copy(self, file: AttachmentFile) -> Iterator[Path]:
        """Copy an attachment to a temporary file that has its suffix, for readers that need one.

        Names in the records are not used as paths. Raises RecordError.
        """
        suffix = _SUFFIX.search(file.name)
        data = self.read(file.sha256)
        with tempfile.TemporaryDirectory(prefix="flasher-") as folder:
            path = Path(folder) / f"trace{suffix[0] if suffix else ''}"
            path.write_bytes(data)
            yield path

    def sweep(self, now: datetime) -> None:
        """Delete partial files that a crash left, after a day."""
        oldest = now.timestamp() - _PART_AGE_S
        with mapped(printable(str(self.folder)), writes=True):
            for part in self.folder.glob(_PART + "*"):
                if part.stat().st_mtime < oldest:
                    part.unlink(missing_ok=True)

    def path(self, sha256: str) -> Path:
        return self.folder / sha256[:2] / sha256

    def read(self, sha256: str) -> bytes:
        """Read an attachment and check its hash. Raises RecordsDamagedError, RecordError."""
        data = self._stored(sha256)
        if data is None:
            what, cause = "An attachment is missing.", self.cause_missing
        elif hashlib.sha256(data).hexdigest() != sha256:
            what, cause = "An attachment was changed after it was stored: its hash differs.", ""
        else:
            return data
        raise RecordsDamagedError(what, where=self._place(sha256), cause=cause, remedy=self.remedy)

    def _stored(self, sha256: str) -> bytes | None:
        """Content of an attachment; None if it is missing."""
        with mapped(self._place(sha256), writes=False):
            try:
                return self.path(sha256).read_bytes()
            except FileNotFoundError:
                return None

    def _place(self, sha256: str) -> str:
        """Where an attachment is stored, for messages."""
        return printable(str(self.path(sha256)))

    def check(self, sha256: str) -> str:
        """Fault of a file, in words; "" if it is intact."""
        try:
            self.read(sha256)
        except RecordError as error:
            return error.what
        return ""


def sync_folder(folder: Path) -> None:
    """Flush names of new files in a folder to disk, if the system can."""
    if os.name == "nt":  # Windows has no handle for it, and journals names by itself
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path; renames it to `path`, on disk, after a block without an error."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        with part.open("rb+") as written:
            os.fsync(written.fileno())
        part.replace(path)
        sync_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
