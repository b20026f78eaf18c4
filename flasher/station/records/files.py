"""Files that belong to records: beside the database, named by their hash, complete or absent.

A file is on disk under its name before a row refers to it. Files without a row are left over from a
crash and do no harm.
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
"""Another station may be writing into the same folder just now."""


class FileStore:
    """The folder of the attachments."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, kind: str, source: Path) -> AttachmentFile:
        """Copy a file in; it is on disk on return. Raises RecordError."""
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
                # Also over a file of that name: its content can only be equal, or damaged.
                Path(part).replace(final)
                sync_folder(final.parent)
            except BaseException:
                with contextlib.suppress(OSError):
                    Path(part).unlink(missing_ok=True)
                raise
        return AttachmentFile(kind, source.name, sha256, size_bytes)

    @property
    def spool(self) -> Path:
        """The folder for traces of active runs."""
        return self.folder / "open"

    def add_spooled(self, run_id: int) -> list[AttachmentFile]:
        """Store the trace that a run of a dead station left. Raises RecordError."""
        plain, packed = self._spooled(run_id)
        # A process that died while it packed the trace has left both, and the plain one is whole.
        for path, kind in ((plain, TORN_TRACE), (packed, TRACE)):
            if path.is_file() and path.stat().st_size:
                return [self.add(kind, path)]
        return []

    def forget_spooled(self, run_id: int) -> None:
        """Take away the trace of a run that is stored by its hash now."""
        for path in self._spooled(run_id):
            with contextlib.suppress(OSError):  # one that stays harms nothing
                path.unlink(missing_ok=True)

    def spooled(self, run_id: int) -> Path:
        """The path of an active run's trace."""
        return self.spool / f"run-{run_id}.log"

    def _spooled(self, run_id: int) -> tuple[Path, Path]:
        plain = self.spooled(run_id)
        return plain, plain.with_name(plain.name + ".gz")

    @contextmanager
    def named(self, file: AttachmentFile) -> Iterator[Path]:
        """The bytes of an attachment under a name of our own with its suffix, for readers that go
        by the suffix: names in the records are not used as paths. Raises RecordError.
        """
        suffix = _SUFFIX.search(file.name)
        data = self.read(file.sha256)
        with tempfile.TemporaryDirectory(prefix="flasher-") as folder:
            path = Path(folder) / f"trace{suffix[0] if suffix else ''}"
            path.write_bytes(data)
            yield path

    def sweep(self, now: datetime) -> None:
        """Take away what a crash left half written, a day later."""
        oldest = now.timestamp() - _PART_AGE_S
        with mapped(printable(str(self.folder)), writes=True):
            for part in self.folder.glob(_PART + "*"):
                if part.stat().st_mtime < oldest:
                    part.unlink(missing_ok=True)

    def path(self, sha256: str) -> Path:
        """The path of the file with this hash."""
        return self.folder / sha256[:2] / sha256

    def read(self, sha256: str) -> bytes:
        """The bytes of a file. Raises RecordsDamagedError when it is missing or changed."""
        path = self.path(sha256)
        shown, remedy = printable(str(path)), "Fetch it from a backup."
        with mapped(shown, writes=False):
            try:
                data = path.read_bytes()
            except FileNotFoundError as error:
                what = "An attachment is missing."
                raise RecordsDamagedError(what, where=shown, remedy=remedy) from error
        if hashlib.sha256(data).hexdigest() != sha256:
            what = "An attachment was changed after it was stored: its hash differs."
            raise RecordsDamagedError(what, where=shown, remedy=remedy)
        return data

    def check(self, sha256: str) -> str:
        """The fault of a file, in words; empty without one."""
        try:
            self.read(sha256)
        except RecordError as error:
            return error.what
        return ""


def sync_folder(folder: Path) -> None:
    """Flush new names in a folder to disk, where the system can."""
    if os.name == "nt":  # Windows has no handle for it, and journals names by itself
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file that takes its own name, on disk, when the block ends without an error."""
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
