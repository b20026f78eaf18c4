"""Takes a station over: makes its records from the plant's database, and continues its audit trail.

The row `taken over` that is sent to the plant decides: the database accepts one continuation of the
last row, so of two PCs one takes the station over, and the rows of the PC that ran it before are
refused from then on.
"""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from secrets import token_hex
from typing import Any, Final
from uuid import UUID

from sqlalchemy import Connection, select

from flasher.errors import ErrorCode, UsageError
from flasher.plant.archive import ArchiveReader, Rows
from flasher.plant.central import Central, ChainRefusedError, Refusal, open_central
from flasher.plant.forwarder import ADD_ROW, ENTER, row_values
from flasher.plant.schema import (
    SHARED_PARTS,
    archive_chain,
    chain_row,
    open_run,
    plant_station,
    trace,
)
from flasher.plant.store import shared_parts
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.database import Database, Location, create_tables, create_triggers
from flasher.station.records.errors import (
    KeyMissingError,
    RecordsDamagedError,
    StationBusyError,
    mapped,
)
from flasher.station.records.files import FileStore, sync_folder
from flasher.station.records.heads import ChainHead
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.records.places import lasts
from flasher.station.records.signatures import SigningKey, fingerprint

_AT_ONCE: Final = 500
_TRIES: Final = 20
"""Attempts while the other PC still sends."""
_SHARED: Final = ("station", "socket", "operator", "lot", "recipe", "artifact", "unit")
"""Tables with rows that runs share."""
_PARTS: Final = {
    "targets": "run_target", "steps": "step", "measurements": "measurement",
    "writes": "device_write", "attachments": "attachment",
}  # fmt: skip


@dataclass(frozen=True)
class TakenOver:
    """A station that this PC has taken over."""

    station: str
    rows: int
    """Audit rows that were made from the plant's database."""
    runs: int
    active: tuple[str, ...]
    """Serial numbers of units that were active at the other PC."""
    set_aside: Path | None
    """Records that this PC had as the station before."""


@dataclass(frozen=True)
class Takeover:
    """What takes a station over, and where from."""

    station: str
    central_url: str
    """The plant's database, for a reader."""
    own_url: str
    """The same database, for the station."""
    location: Location
    key_locations: KeyLocations
    by: str
    reason: str
    archives: Path | None = None
    """Folder of the files of retired months."""

    def run(self, key: bytes | None, now: Callable[[], datetime]) -> TakenOver:
        """Take the station over. `key`: the key file of an export, where this PC has none.

        Raises UsageError, KeyMissingError, StationBusyError if another PC was faster, RecordError.
        Killed at any moment, it can be run again.
        """
        final = self.location.file
        assert final is not None  # noqa: S101  records are in a file
        with open_central(self.central_url) as central:
            with mapped(printable(str(final)), writes=True):
                final.parent.mkdir(parents=True, exist_ok=True)
                self.location.folder.mkdir(parents=True, exist_ok=True)
                part = final.with_name(f".{final.name}.part")
                for path in _with_log(part):
                    path.unlink(missing_ok=True)
            try:
                found, head = self._make(central, part, key, now)
                aside = _set_aside(final)
                with mapped(printable(str(final)), writes=True):
                    part.replace(final)
                    sync_folder(final.parent)
            finally:
                with suppress(OSError):
                    for path in _with_log(part):
                        path.unlink(missing_ok=True)
        self.key_locations.beside_key.of(self.station, found.records_id).append([head], found.key)
        return TakenOver(self.station, found.end.number, found.runs, tuple(found.active), aside)

    def _make(
        self, central: Central, part: Path, key: bytes | None, now: Callable[[], datetime]
    ) -> tuple[_Copy, ChainHead]:
        location = Location(
            self.location.url.set(database=str(part)), self.location.folder, self.location.shown
        )
        with (
            closing(Database(location, DEFAULT_LOCK_TIMEOUT_S, changes_schema=True)) as database,
            closing(Central(self.own_url)) as own,
        ):
            copy = _Copy(self.station, FileStore(location.folder), self.archives)
            before: int | None = None
            for attempt in range(_TRIES):
                with central.reading() as source:
                    with database.writing() as connection:
                        copy.extend(source, connection, now())
                    copy.key = self._key(copy, key)
                    open_runs = copy.open_runs(source)
                before = len(copy.takeovers) if before is None else before
                if len(copy.takeovers) > before:
                    raise StationBusyError(
                        f"Another PC takes {printable(self.station)} over: {copy.takeovers[-1]}.",
                        where=central.shown,
                        remedy="Use that PC. If it cannot go on, run this command again.",
                    )
                try:
                    with database.writing() as connection:
                        copy.add_open(connection, open_runs)
                        trail = chain.Trail(connection, self.station, copy.key)
                        trail.append(now(), chain.TAKEN_OVER, self._data(copy, connection))
                        _send(own, copy, connection, self.station)
                    break
                except ChainRefusedError as error:
                    # The other PC has sent something meanwhile.
                    if error.refusal is not Refusal.FORKED or attempt + 1 == _TRIES:
                        raise
            with database.writing() as connection:
                create_triggers(connection)
        return copy, trail.heads[0]

    def _key(self, copy: _Copy, given: bytes | None) -> SigningKey:
        """The signing key, which is put to the other keys of this PC. Raises KeyMissingError."""
        path = self.key_locations.key_file(self.station, copy.records_id)
        key = SigningKey.load(path)
        if (key is None or key.public != copy.end.key) and given is not None:
            exported = SigningKey.parse(given)
            if exported.public == copy.end.key:
                if key is not None:
                    path.replace(path.with_name(path.name + ".before"))
                exported.save(path)
                key = exported
        if key is None or key.public != copy.end.key:
            raise KeyMissingError(
                f"The signing key of {printable(self.station)} (fingerprint"
                f" {fingerprint(copy.end.key)}) is neither on this PC nor in the export.",
                where=printable(str(path)),
                cause="the export was made before the key was changed" if given else "",
                remedy="Make an export on the PC that ran the station last (flasher station"
                " export), or put its key file there.",
            )
        return key

    def _data(self, copy: _Copy, connection: Connection) -> dict[str, Any]:
        """Content of the row: who decided it, and the numbers that stay free."""

        def has(head: ChainHead) -> bool:
            return chain.hash_at(connection, self.station, head.number) == head.hash

        places = (self.key_locations.beside_key, *self.key_locations.elsewhere)
        lost = [
            head.number
            for place, last in lasts(places, self.station, copy.records_id)
            if isinstance(last, ChainHead) and not has(last)
            for head in place.of(self.station, copy.records_id).entries()
            if isinstance(head, ChainHead) and not has(head)
        ]
        given_up = {"lost_from": min(lost), "lost_to": max(lost)} if lost else {}
        return {
            "computer": platform.node()[:64],
            # Equal rows would be taken for one: two PCs, or two tries, differ in any case.
            "takeover": token_hex(16),
            "runs_from": copy.last_run + chain.RUNS_LEFT_FREE + 1,
            "by": self.by,
            "reason": self.reason,
            **given_up,
        }


class _Copy:
    """Copies a station's rows from the plant's database, and from the files of retired months, in
    the order of its audit trail.
    """

    def __init__(self, name: str, files: FileStore, archives: Path | None) -> None:
        self._name = name
        self._files = files
        self._archives = archives
        self._seen: dict[str, set[int]] = {name: set() for name in _SHARED}
        self._own_id = 0
        self._version: Any = None
        self.key: SigningKey
        self.end = chain.ChainEnd()
        """The last row that was copied."""
        self.records_id = ""
        self.station = UUID(int=0)
        self.runs = self.last_run = 0
        self.takeovers: list[str] = []
        """Computers that took the station over."""
        self.active: list[str] = []
        self._claimed: dict[int, Mapping[str, Any]] = {}
        """Data of the claims of runs that have not ended."""

    def extend(self, source: Connection, connection: Connection, now: datetime) -> None:
        """Copy the rows after the last one. Raises UsageError, RecordsDamagedError."""
        if not self.end.number:
            self._begin(source, connection, now)
        with closing(self._rows(source)) as found:
            for some in found:
                self._check(some.rows)
                self._add(source, connection, some)

    def _rows(self, source: Connection) -> Generator[Rows, None, None]:
        """Read the rows after the last one. Raises UsageError, RecordError."""
        for path in self._retired(source):
            with closing(ArchiveReader(path).read()) as found:
                for some in found:
                    rows = [row for row in some.rows if row["number"] > self.end.number]
                    if some.station == self.station and rows:
                        yield replace(some, rows=rows)
        query = (
            select(chain_row)
            .where(chain_row.c.station == self.station, chain_row.c.number > self.end.number)
            .order_by(chain_row.c.number)
            .execution_options(yield_per=_AT_ONCE)
        )
        with source.execute(query) as found_rows:
            for each in found_rows.mappings().partitions(_AT_ONCE):
                parts = shared_parts(source, self.station, map(_digests, each))
                yield Rows(self.station, list(map(dict, each)), parts, {})

    def _retired(self, source: Connection) -> Sequence[Path]:
        """Files with rows after the last one, oldest first. Raises UsageError."""
        query = select(archive_chain.c.file).where(
            archive_chain.c.station == self.station, archive_chain.c.last > self.end.number
        )
        names = source.execute(query.order_by(archive_chain.c.last)).scalars().all()
        if names and self._archives is None:
            raise UsageError(
                f"Rows of {printable(self._name)} are in {len(names)} file(s) of retired months,"
                f" from {printable(names[0])} to {printable(names[-1])}.",
                remedy="Add --archive FOLDER, with the files that flasher plant retire wrote.",
                code=ErrorCode.RECORDS_NOT_FOUND,
            )
        paths = [Path(self._archives or "", name) for name in names]
        for path in paths:
            if not path.exists():
                raise UsageError(
                    f"The file {printable(path.name)} with retired rows of {printable(self._name)}"
                    " is not in the folder.",
                    where=printable(str(path.parent)),
                    remedy="Put all files that flasher plant retire wrote into this folder.",
                    code=ErrorCode.RECORDS_NOT_FOUND,
                )
        return paths

    def _begin(self, source: Connection, connection: Connection, now: datetime) -> None:
        query = select(plant_station).where(plant_station.c.name == self._name)
        station = source.execute(query).mappings().one_or_none()
        if station is None or station["station"] is None:
            raise UsageError(
                f"The plant's database has no records of a station {printable(self._name)}.",
                remedy="Correct its name in the station file; flasher plant status lists them.",
                code=ErrorCode.RECORDS_NOT_FOUND,
            )
        self.station, self.records_id = station["station"], station["records_id"]
        create_tables(connection, now, self.records_id)
        self._own_id = self._own_id_in(source)
        self._insert(connection, "station", [{"id": self._own_id, "name": self._name}])

    def _own_id_in(self, source: Connection) -> int:
        """Id of the station in its records, which the digests of its runs cover."""
        with closing(self._rows(source)) as found:
            for some in found:
                for row in some.rows:
                    own = some.parts.get(_digests(row).get("station", ""))
                    if own is not None:
                        return int(own["id"])
        return 1

    def _check(self, rows: Sequence[Mapping[Any, Any]]) -> None:
        """Check hashes and signatures. Raises RecordsDamagedError, UsageError."""
        for row in rows:
            data = chain.data_of(row["data"])
            # The run's id at the station is what was signed.
            if self.end.add({**row, "run_id": row["run_number"]}):
                raise self._damaged(row["number"])
            if row["event"] == chain.CLAIMED:
                self._claimed[row["run_number"]] = data
            elif row["event"] in chain.ENDINGS:
                self._claimed.pop(row["run_number"], None)
            elif row["event"] == chain.TAKEN_OVER:
                self.takeovers.append(f"{data.get('computer')} at {row['at'][:19]}")
                self.last_run = max(self.last_run, chain.runs_from(data) - 1)
            elif row["event"] in (chain.BEGUN, chain.MIGRATED):
                self._version = data.get("version")
            self.last_run = max(self.last_run, row["run_number"] or 0)
        if self._version != schema.SCHEMA_VERSION:
            raise UsageError(
                f"The station's records have schema {self._version}; this flasher has schema"
                f" {schema.SCHEMA_VERSION}.",
                remedy="Use the same version of flasher as the station; flasher plant status"
                " shows it.",
                code=ErrorCode.RECORDS_VERSION,
            )

    def _damaged(self, number: int) -> RecordsDamagedError:
        return RecordsDamagedError(
            f"Row {number} of {printable(self._name)} in the plant's database, or in a file of a"
            " retired month, is not as the station signed it.",
            remedy="flasher plant verify reports what was changed. Take the station's own records"
            " or their backup.",
        )

    def _add(self, source: Connection, connection: Connection, some: Rows) -> None:
        """Add audit rows with the runs that end in them. Raises RecordsDamagedError."""
        rows = some.rows
        for row in rows:
            if row["event"] not in chain.ENDINGS:
                continue
            own, digests = row["content"], _digests(row)
            if any(digests.get(name) not in some.parts for name in SHARED_PARTS):
                raise self._damaged(row["number"])
            named = {name: some.parts[digests[name]] for name in SHARED_PARTS}
            self._add_shared(connection, named, own)
            self._insert(connection, "run", [own["run"]])
            for name, table in _PARTS.items():
                self._insert(connection, table, own[name])
            self._fetch(source, [file["sha256"] for file in own["attachments"]], some.traces)
            self.runs += 1
        others = {"id", "run_id", "station_id"}
        names = [each.name for each in schema.audit.c if each.name not in others]
        connection.execute(
            schema.audit.insert(),
            [
                {name: row[name] for name in names}
                | {"run_id": row["run_number"], "station_id": self._own_id}
                for row in rows
            ],
        )

    def _add_shared(
        self, connection: Connection, named: Mapping[str, Any], own: Mapping[str, Any]
    ) -> None:
        for name in SHARED_PARTS[:-1]:
            if named[name] is not None:
                self._insert(connection, name, [named[name]])
        self._insert(connection, "artifact", named["artifacts"])
        self._insert(connection, "unit", [own["unit"]])

    def _insert(self, connection: Connection, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Insert rows with their ids; those that runs share are inserted once."""
        table = schema.metadata.tables[name]
        seen = self._seen.get(name, set())
        new = {row["id"]: row for row in rows if row["id"] not in seen}
        if name in self._seen:
            seen.update(new)
        if new:
            names = [each.name for each in table.c]
            values = [{name: row[name] for name in names} for row in new.values()]
            connection.execute(table.insert(), values)

    def _fetch(
        self, source: Connection, wanted: Iterable[str], retired: Mapping[str, bytes]
    ) -> None:
        """Fetch attachments that are not here. One that the plant lacks is left out: `verify`
        reports it.
        """
        for sha256 in wanted:
            if self._files.check(sha256):
                query = select(trace.c.data).where(trace.c.sha256 == sha256)
                data = retired.get(sha256) or source.execute(query).scalar_one_or_none()
                if data is not None:
                    with tempfile.TemporaryDirectory(prefix="flasher-") as folder:
                        path = Path(folder) / "attachment"
                        path.write_bytes(data)
                        self._files.add("attachment", path)

    # -- runs that were active --------------------------------------------------------------------

    def open_runs(self, source: Connection) -> list[tuple[Mapping[str, Any], Mapping[str, Any]]]:
        """Contents of active runs, each with the rows that it refers to. Raises
        RecordsDamagedError.
        """
        query = select(open_run.c.run_number, open_run.c.content).where(
            open_run.c.station == self.station, open_run.c.run_number.in_(list(self._claimed))
        )
        contents = {row.run_number: row.content for row in source.execute(query)}
        stated = {number: data["digests"] for number, data in self._claimed.items()}
        parts = shared_parts(source, self.station, stated.values())
        found: list[tuple[Mapping[str, Any], Mapping[str, Any]]] = []
        for number, digests in stated.items():
            own: dict[str, Any] = contents.get(number) or {}
            named = {name: parts.get(digests[name]) for name in SHARED_PARTS}
            shown = own and own | named | {chain.CLAIM: chain.claim_of(own)}
            if not shown or any(
                chain.digest(shown[name]) != digest for name, digest in digests.items()
            ):
                raise RecordsDamagedError(
                    f"Run {number} of {printable(self._name)}, which had not ended, is not in the"
                    " plant's database as it was signed.",
                    remedy="Let the other PC send until the run has ended, or take its records.",
                )
            found.append((own, named))
        return found

    def add_open(
        self, connection: Connection, runs: Iterable[tuple[Mapping[str, Any], Mapping[str, Any]]]
    ) -> None:
        """Add active runs; the station ends them as interrupted when it starts. One may have ended
        at the other PC before its claim was sent: how it ended is not here.
        """
        before = {name: set(ids) for name, ids in self._seen.items()}
        self.active = []
        for own, named in runs:
            self._add_shared(connection, named, own)
            self._insert(connection, "run", [{**own["run"], **chain.UNENDED}])
            self._insert(connection, "run_target", [t | {"reached": None} for t in own["targets"]])
            self.active.append(own["unit"]["serial"])
        self._seen = before  # a refused attempt takes them back


def _send(own: Central, copy: _Copy, connection: Connection, name: str) -> None:
    """Send the row that takes the station over. Raises ChainRefusedError, RecordError."""
    query = select(schema.audit).where(schema.audit.c.event == chain.TAKEN_OVER)
    query = query.order_by(schema.audit.c.number.desc()).limit(1)
    row = connection.execute(query).mappings().one()
    with own.writing() as central:
        central.execute(ENTER, {"records": copy.records_id, "station": name})
        central.execute(ADD_ROW, row_values(row, copy.station))


def _digests(row: Mapping[Any, Any]) -> dict[str, str]:
    found: dict[str, str] = chain.data_of(row["data"]).get("digests", {})
    return found


def _with_log(file: Path) -> tuple[Path, ...]:
    return (file, *(file.with_name(file.name + end) for end in ("-wal", "-shm")))


def _set_aside(file: Path) -> Path | None:
    """Rename the records that this PC had; None without any. Raises RecordError."""
    if not file.exists():
        return None
    number = 1
    while (aside := file.with_name(f"{file.name}.before-{number}")).exists():
        number += 1
    with mapped(printable(str(file)), writes=True):
        for path, target in zip(_with_log(file)[1:], _with_log(aside)[1:], strict=True):
            if path.exists():
                path.replace(target)
        file.replace(aside)
    return aside
