"""Files of retired records: a month of all stations, as the stations signed it.

A file is a tar of gzip. For each station, in the order of its audit trail: what its runs share
(`parts/STATION/SHA256.json`), the traces (`traces/SHA256`), and then the audit rows that refer to
both (`rows/STATION/FIRST.jsonl`), some hundred at a time. `manifest.json` comes last.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import re
import tarfile
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final
from uuid import UUID

from pydantic import TypeAdapter, ValidationError
from sqlalchemy import Connection, select

from flasher.errors import UsageError
from flasher.plant.schema import SHARED_PARTS, chain_row, shared_part, trace
from flasher.protocol.text import printable
from flasher.station.records import chain
from flasher.station.records.errors import RecordError, RecordsDamagedError
from flasher.station.records.files import whole_file
from flasher.station.records.rows import batches

FORMAT: Final = 1
MONTH: Final = re.compile(r"[0-9]{4}-(?:0[1-9]|1[0-2])")
_ROWS: Final = 200
_LEVEL: Final = 6
_MEMBER_MAX: Final = 256 * 1024 * 1024
_MANIFEST: Final = "manifest.json"
_FIELDS: Final = (
    "number", "at", "event", "run_number", "data", "previous_hash", "hash", "signature", "content",
)  # fmt: skip


@dataclass(frozen=True)
class ArchivedChain:
    """The part of a station's audit trail in a file."""

    station: UUID
    name: str
    records_id: str
    first: int
    last: int
    previous_hash: str
    """Hash of the row before `first`."""
    hash: str
    """Hash of row `last`."""
    keys: tuple[str, ...]
    """Public keys before `first`; the last one signs it."""


@dataclass(frozen=True)
class Manifest:
    """Content of a file."""

    format: int
    plant: str
    """Id of the plant's records."""
    month: str
    chains: tuple[ArchivedChain, ...]
    rows: int
    runs: int
    traces: int
    missing: tuple[str, ...]
    """Attachments that the plant did not have."""


@dataclass(frozen=True)
class Rows:
    """Some rows of a chain with what they refer to."""

    station: UUID
    rows: list[dict[str, Any]]
    parts: Mapping[str, Any]
    """What runs share, by digest; of this station so far."""
    traces: Mapping[str, bytes]
    """By SHA-256, of these rows."""


_READ: Final = TypeAdapter(Manifest)


def month_after(month: str) -> str:
    """Raises UsageError if it is no month."""
    if not MONTH.fullmatch(month):
        raise UsageError(
            f"{month!a:.40} is not a month.", where="--before", remedy="Write 2024-01."
        )
    year, number = int(month[:4]), int(month[5:])
    return f"{year + number // 12:04}-{number % 12 + 1:02}"


def write_archive(
    connection: Connection,
    path: Path,
    plant: str,
    month: str,
    chains: tuple[ArchivedChain, ...],
    progress: Callable[[int], None],
) -> None:
    """Write a file; it has its name only when it is whole and on the disk. Raises OSError."""
    with (
        whole_file(path) as part,
        part.open("wb") as file,
        gzip.GzipFile("", "wb", _LEVEL, file, mtime=0) as packed,
        tarfile.open(fileobj=packed, mode="w|") as tar,
    ):
        writer = _Writer(connection, tar)
        for each in chains:
            writer.add_chain(each, progress)
        manifest = Manifest(
            FORMAT, plant, month, chains, writer.rows, writer.runs, writer.traces,
            tuple(writer.missing),
        )  # fmt: skip
        writer.add(_MANIFEST, _READ.dump_json(manifest, indent=1))


class _Writer:
    """Writes the members of a file, and counts them."""

    def __init__(self, connection: Connection, tar: tarfile.TarFile) -> None:
        self._connection, self._tar = connection, tar
        self.rows = self.runs = self.traces = 0
        self.missing: list[str] = []

    def add(self, name: str, data: bytes) -> None:
        member = tarfile.TarInfo(name)
        member.size = len(data)
        self._tar.addfile(member, io.BytesIO(data))
        _forget(self._tar)

    def add_chain(self, of: ArchivedChain, progress: Callable[[int], None]) -> None:
        written: set[str] = set()
        at = of.first - 1
        while at < of.last:
            query = (
                select(*(chain_row.c[name] for name in _FIELDS))
                .where(chain_row.c.station == of.station, chain_row.c.number > at)
                .where(chain_row.c.number <= of.last)
                .order_by(chain_row.c.number)
                .limit(_ROWS)
            )
            rows = [dict(row) for row in self._connection.execute(query).mappings()]
            if not rows:
                raise RecordsDamagedError(f"Audit row {at + 1} of {printable(of.name)} is missing.")
            ended = [row for row in rows if row["content"] is not None]
            digests = {
                found
                for row in ended
                for name, found in chain.data_of(row["data"]).get("digests", {}).items()
                if name in SHARED_PARTS
            }
            self._add_parts(of.station, digests - written)
            written |= digests
            self._add_traces(
                [file["sha256"] for row in ended for file in row["content"].get("attachments", ())]
            )
            lines = "".join(f"{chain.canonical(row)}\n" for row in rows)
            self.add(f"rows/{of.station}/{rows[0]['number']}.jsonl", lines.encode("ascii"))
            self.rows += len(rows)
            self.runs += len(ended)
            at = rows[-1]["number"]
            progress(len(rows))

    def _add_parts(self, station: UUID, digests: set[str]) -> None:
        for some in batches(sorted(digests)):
            query = select(shared_part.c.sha256, shared_part.c.content).where(
                shared_part.c.station == station, shared_part.c.sha256.in_(some)
            )
            for sha256, content in self._connection.execute(query):
                self.add(f"parts/{station}/{sha256}.json", content.encode("utf-8"))

    def _add_traces(self, wanted: list[str]) -> None:
        for sha256 in dict.fromkeys(wanted):
            query = select(trace.c.data).where(trace.c.sha256 == sha256)
            data = self._connection.execute(query).scalar_one_or_none()
            if data is None:
                self.missing.append(sha256)
                continue
            self.add(f"traces/{sha256}", bytes(data))
            self.traces += 1


class ArchiveReader:
    """Reads a file once, from its begin to its end. `manifest` is known after that."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.manifest: Manifest | None = None
        self.sha256 = ""
        self.size_bytes = 0

    def read(self) -> Generator[Rows, None, None]:
        """Read all rows. Raises RecordError."""
        shown = printable(str(self._path))
        try:
            with self._path.open("rb") as file:
                hashed = _Hashed(file)
                with tarfile.open(fileobj=hashed, mode="r|gz") as tar:
                    yield from self._members(tar)
                while hashed.read(1 << 20):
                    pass
            self.sha256, self.size_bytes = hashed.sha256.hexdigest(), hashed.size_bytes
        except (tarfile.TarError, EOFError, OSError, ValueError, KeyError) as error:
            if isinstance(error, OSError) and error.strerror:
                raise RecordError(
                    f"The archive cannot be read: {error.strerror}.", where=shown
                ) from error
            raise RecordsDamagedError(
                "The archive is damaged.", where=shown, cause=printable(str(error))
            ) from error
        if self.manifest is None:
            raise RecordsDamagedError("The archive has no end.", where=shown)

    def _members(self, tar: tarfile.TarFile) -> Iterator[Rows]:
        parts: dict[str, Any] = {}
        traces: dict[str, bytes] = {}
        of: UUID | None = None
        while (member := tar.next()) is not None:
            _forget(tar)
            if member.size > _MEMBER_MAX:
                raise ValueError(f"{member.name} is too large")
            stream = tar.extractfile(member)
            data = b"" if stream is None else stream.read()
            match PurePosixPath(member.name).parts:
                case ("parts", station, name):
                    if UUID(station) != of:
                        of, parts = UUID(station), {}
                    sha256 = name.removesuffix(".json")
                    if hashlib.sha256(data).hexdigest() == sha256:
                        parts[sha256] = json.loads(data)
                case ("traces", sha256):
                    traces[sha256] = data
                case ("rows", station, _):
                    if UUID(station) != of:
                        of, parts = UUID(station), {}
                    rows = [json.loads(line) for line in data.splitlines()]
                    yield Rows(of, rows, parts, traces)
                    traces = {}
                case (name,) if name == _MANIFEST:
                    with suppress(ValidationError):
                        self.manifest = _READ.validate_json(data)
                case _:
                    raise ValueError(f"{printable(member.name)} does not belong to it")


def _forget(tar: tarfile.TarFile) -> None:
    """Drop the list of members, which has all that were written or read: millions."""
    tar.members = []  # type: ignore[attr-defined]


class _Hashed(io.RawIOBase):
    """A file whose bytes are counted and hashed as they are read."""

    def __init__(self, file: io.BufferedReader) -> None:
        self._file = file
        self.sha256 = hashlib.sha256()
        self.size_bytes = 0

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self.sha256.update(data)
        self.size_bytes += len(data)
        return data
