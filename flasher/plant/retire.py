# ruff: noqa: S608  all of this SQL is written here
"""Retires the records of old months: moves them from the plant's database to files.

A month is deleted only after its file is on the disk, was read again from its begin to its end, and
every audit row, run and trace in it was verified. The deletion is one transaction, which also
records the file: a command that is interrupted at any moment loses nothing, and goes on when it is
called again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final
from uuid import UUID

from sqlalchemy import Connection, func, select, text

from flasher.errors import ErrorCode, UsageError
from flasher.plant.archive import MONTH, ArchivedChain, month_after, write_archive
from flasher.plant.archive_check import ArchiveExaminer, ExaminedArchive
from flasher.plant.central import Central
from flasher.plant.deliveries import DeliveryState
from flasher.plant.schema import (
    archive_chain,
    archive_file,
    chain_row,
    plant_delivery,
    plant_receiver,
    plant_station,
)
from flasher.protocol.text import printable
from flasher.station.records.chain import GENESIS
from flasher.station.records.database import records_id_of
from flasher.station.records.errors import RecordError, RecordsDamagedError
from flasher.station.records.model import DUPLICATES, FLASH, Problem, StepName
from flasher.station.records.server import ServerLock

LIMIT_S: Final = 3600.0
"""Time limit of one statement."""
_FILES_MAX: Final = 1000
"""Files of one month: later ones hold what arrived late."""


@dataclass(frozen=True)
class DueMonth:
    """A month that would be retired."""

    month: str
    rows: int
    runs: int


@dataclass(frozen=True)
class RetiredMonth:
    """A month that is in a file now."""

    month: str
    file: str
    size_bytes: int
    rows: int
    runs: int
    traces: int
    stations: int
    problems: tuple[Problem, ...] = ()
    """Problems that the records had before; they are in the file as they were."""


class ArchiveRefusedError(RecordError):
    """The records of a month do not agree with what was signed. Nothing was deleted."""

    def __init__(self, month: str, problems: tuple[Problem, ...], where: str) -> None:
        first = problems[0]
        super().__init__(
            f"The records of {month} have {len(problems)} problem(s): nothing was deleted.",
            where=where,
            cause=printable(f"{first.where}: {first.what}"),
            remedy="Run flasher plant verify. To archive them as they are: --with-problems.",
        )
        self.problems = problems


def month_before(now: datetime, months: int) -> str:
    """The month that began `months` whole months before the month of a time."""
    count = now.year * 12 + now.month - 1 - months
    return f"{count // 12:04}-{count % 12 + 1:02}"


class Retirement:
    """Retires months of a plant's database. Raises UsageError if this user does not own it."""

    def __init__(
        self,
        central: Central,
        folder: Path,
        progress: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> None:
        self._central, self._folder, self._progress = central, folder, progress
        self._done = self._total = 0
        # What another version keeps beside a run would be left, or be lost.
        central.check_schema()
        central.check_owner("retire records")
        with central.reading() as connection:
            self._plant = records_id_of(connection)

    def months(self, before: str) -> list[DueMonth]:
        """Months before `before` with what would be retired of them; nothing is changed."""
        row, month = chain_row.c, func.substr(chain_row.c.at, 1, 7).label("month")
        # As `_chains`: what follows a younger row, or is the newest one, stays.
        younger = func.min(row.number).filter(row.at >= before)
        ends = (
            select(row.station, func.coalesce(younger, func.max(row.number)).label("number"))
            .group_by(row.station)
            .subquery()
        )
        query = (
            select(month, func.count(), func.count(row.content))
            .join(ends, (ends.c.station == row.station) & (row.number < ends.c.number))
            .group_by(month)
            .order_by(month)
        )
        with self._central.reading() as connection:
            return [DueMonth(each, rows, runs) for each, rows, runs in connection.execute(query)]

    def retire(self, before: str, *, with_problems: bool = False) -> Iterator[RetiredMonth]:
        """Retire every month before `before`, oldest first. Raises RecordError, UsageError."""
        while True:
            with self._central.reading() as connection:
                month = _oldest_month(connection)
                if month is None or month >= before:
                    return
                chains = tuple(_chains(connection, month_after(month)))
                self._check_handed_over(connection, month, chains)
                name = self._name(connection, month)
                path = self._written(connection, month, name, chains)
            found = self._examined(path, chains)
            if found.problems and not with_problems:
                raise ArchiveRefusedError(month, found.problems, printable(str(path)))
            self._delete(month, path.name, found, chains)
            manifest = found.manifest
            yield RetiredMonth(
                month, path.name, found.size_bytes, manifest.rows, manifest.runs, manifest.traces,
                len(chains), found.problems,
            )  # fmt: skip

    def _check_handed_over(
        self, connection: Connection, month: str, chains: tuple[ArchivedChain, ...]
    ) -> None:
        """Refuse a month with runs that are still to be handed over: they would not be found."""
        row, settled = plant_delivery.c, [each for each in DeliveryState if each.is_settled]
        for each in chains:
            query = (
                select(row.receiver, func.count())
                .where(
                    row.station == each.station,
                    row.number.between(each.first, each.last),
                    row.state.not_in(settled),
                    row.receiver.in_(
                        select(plant_receiver.c.name).where(plant_receiver.c.stopped_at.is_(None))
                    ),
                )
                .group_by(row.receiver)
                .order_by(row.receiver)
            )
            for receiver, count in connection.execute(query):
                raise RecordError(
                    f"{count} {'run' if count == 1 else 'runs'} of {month} from station"
                    f" {printable(each.name)} {'is' if count == 1 else 'are'} not handed over to"
                    f" {printable(receiver)} yet: nothing was deleted.",
                    where=self._central.shown,
                    remedy="flasher plant deliveries --database URL shows why. Let flasher plant"
                    " deliver finish, or retire earlier months only.",
                )

    def _name(self, connection: Connection, month: str) -> Iterator[str]:
        """Names for a file of a month that no other one has, by the database."""
        query = select(archive_file.c.name).where(archive_file.c.month == month)
        taken = set(connection.execute(query).scalars())
        for number in range(1, _FILES_MAX):
            name = f"flasher-{self._plant[:8]}-{month}{f'-{number}' if number > 1 else ''}.tar.gz"
            if name not in taken:
                yield name

    def _written(
        self,
        connection: Connection,
        month: str,
        names: Iterator[str],
        chains: tuple[ArchivedChain, ...],
    ) -> Path:
        """Write the file of a month, unless an interrupted call has written it."""
        self._done = 0
        self._total = 2 * sum(each.last - each.first + 1 for each in chains)
        for name in names:
            path = self._folder / name
            if not path.exists():
                break
            try:
                if not self._examined(path, chains).problems:
                    return path
            except RecordError:
                continue  # it is something else: it stays
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_archive(connection, path, self._plant, month, chains, self._count)
        except OSError as error:
            raise UsageError(
                f"The archive cannot be written: {error.strerror}. Nothing was deleted.",
                where=printable(str(path)),
                remedy="Make room, or name another folder with --archive.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            ) from error
        return path

    def _examined(self, path: Path, chains: tuple[ArchivedChain, ...]) -> ExaminedArchive:
        rows = self._done

        def show(done: int, _total: int) -> None:
            self._progress(rows + done, self._total)

        return ArchiveExaminer(self._central, path, chains, show).examine_file()

    def _count(self, rows: int) -> None:
        self._done += rows
        self._progress(self._done, self._total)

    def _delete(
        self, month: str, name: str, found: ExaminedArchive, chains: tuple[ArchivedChain, ...]
    ) -> None:
        """Delete what is in the file, and record the file, in one transaction."""
        with self._central.writing() as connection:
            ServerLock.RETIRING.hold(connection)
            for each in chains:
                if last_archived(connection, each.station).last != each.first - 1:
                    raise RecordError(
                        "Another call retires records of this database, too.",
                        where=self._central.shown,
                        remedy="Wait until it has ended, and call it again.",
                    )
            self._check_handed_over(connection, month, chains)
            connection.execute(
                archive_file.insert().values(
                    name=name,
                    month=month,
                    sha256=found.sha256,
                    size_bytes=found.size_bytes,
                    written_at=func.now(),
                )
            )
            for each in chains:
                facts = {**vars(each), "keys": list(found.keys[each.station]), "file": name}
                connection.execute(archive_chain.insert().values(facts))
            for statement in _DELETIONS:
                connection.execute(text(statement), {"file": name})


def recorded_chains(connection: Connection) -> dict[str, list[ArchivedChain]]:
    """What each file has to contain, as the database states it, oldest first."""
    query = select(archive_chain).order_by(archive_chain.c.station, archive_chain.c.last)
    found: dict[str, list[ArchivedChain]] = {}
    keys: Mapping[UUID, tuple[str, ...]] = {}
    for row in connection.execute(query).mappings():
        facts = dict(row)
        file, after = facts.pop("file"), tuple(facts.pop("keys"))
        before = keys.get(facts["station"], ())
        found.setdefault(file, []).append(ArchivedChain(**facts, keys=before))
        keys = {**keys, facts["station"]: after}
    return found


@dataclass(frozen=True)
class LastArchived:
    """End of the part of a chain that is in files."""

    last: int = 0
    hash: str = GENESIS
    keys: tuple[str, ...] = ()
    name: str = ""
    records_id: str = ""


def last_archived(connection: Connection, station: UUID) -> LastArchived:
    query = (
        select(archive_chain)
        .where(archive_chain.c.station == station)
        .order_by(archive_chain.c.last.desc())
        .limit(1)
    )
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        return LastArchived()
    return LastArchived(
        row["last"], row["hash"], tuple(row["keys"]), row["name"], row["records_id"]
    )


def _stations(connection: Connection) -> list[UUID]:
    return list(connection.execute(select(chain_row.c.station).distinct()).scalars())


def _oldest_month(connection: Connection) -> str | None:
    """Month of the oldest audit row that may be retired; None without any."""
    firsts = []
    for station in _stations(connection):
        # The newest row stays: the next one continues it.
        query = (
            select(chain_row.c.number, chain_row.c.at)
            .where(chain_row.c.station == station)
            .order_by(chain_row.c.number)
            .limit(2)
        )
        rows = connection.execute(query).all()
        if len(rows) > 1:
            firsts.append(rows[0])
    if not firsts:
        return None
    first = min(firsts, key=lambda row: row.at)
    month: str = first.at[:7]
    if not MONTH.fullmatch(month):
        raise RecordsDamagedError(
            f"Audit row {first.number} has no time: {printable(first.at)!r}.",
            remedy="Run flasher plant verify.",
        )
    return month


def _chains(connection: Connection, end: str) -> Iterator[ArchivedChain]:
    """The rows of each chain before the first one that is not older than `end`."""
    row = chain_row.c
    names = select(plant_station.c.station, plant_station.c.name, plant_station.c.records_id)
    known = {station: (name, records) for station, name, records in connection.execute(names)}
    for station in _stations(connection):
        before = last_archived(connection, station)
        of_chain = select(row.number).where(row.station == station)
        younger = of_chain.where(row.at >= end).order_by(row.number).limit(1)
        newest = of_chain.order_by(row.number.desc()).limit(1)
        stop = connection.execute(younger).scalar_one_or_none()
        last = connection.execute(newest).scalar_one() - 1
        if stop is not None:
            last = min(last, stop - 1)
        if last <= before.last:
            continue
        hash_at = select(row.hash).where(row.station == station, row.number == last)
        name, records = before.name, before.records_id
        if not before.last:
            begun = select(row.data).where(row.station == station, row.number == 1)
            data = json.loads(connection.execute(begun).scalar_one())
            fallback = known.get(station, ("", ""))
            name = str(data.get("station", fallback[0]))
            records = str(data.get("records", fallback[1]))
        yield ArchivedChain(
            station, name, records, before.last + 1, last, before.hash,
            connection.execute(hash_at).scalar_one(), before.keys,
        )  # fmt: skip


_GONE: Final = """
CREATE TEMPORARY TABLE gone ON COMMIT DROP AS
    SELECT c.run_id, c.station, c.run_number, CAST(:file AS text) AS file FROM chain_row c
        JOIN archive_chain a ON a.station = c.station AND c.number BETWEEN a.first AND a.last
        WHERE a.file = :file AND c.content IS NOT NULL
    UNION SELECT k.run_id, k.station, k.run_number, k.file FROM kept_run k
        JOIN run r ON r.id = k.run_id
        WHERE EXISTS (SELECT FROM run l WHERE l.unit_id = r.unit_id AND l.id > r.id);
"""
"""Runs that leave the database, and those that stayed before and have a later one now."""
_KEPT: Final = f"""
CREATE TEMPORARY TABLE kept ON COMMIT DROP AS SELECT g.* FROM gone g JOIN run r ON r.id = g.run_id
    WHERE NOT EXISTS (SELECT FROM run l WHERE l.unit_id = r.unit_id AND l.id > r.id)
    OR EXISTS (SELECT FROM device_write w WHERE w.run_id = r.id AND w.what = '{FLASH}'
        AND NOT EXISTS (SELECT FROM run l JOIN device_write m ON m.run_id = l.id
            WHERE l.unit_id = r.unit_id AND l.id > r.id AND m.target = w.target
            AND m.what = '{FLASH}'))
    OR EXISTS (SELECT FROM plant_pass p WHERE p.unit_id = r.unit_id AND p.run_id = r.id)
    OR r.id IN (SELECT run_id FROM plant_duplicate UNION SELECT first_run_id FROM plant_duplicate);
"""
"""The last run of a unit, the last transfer to each target, and what claims compare with."""
_MARK: Final = (
    f"s.position = 1 AND s.name = '{StepName.PLANT}' AND s.run_id IN (SELECT run_id FROM kept)"
)
"""The step with the mark of a unit whose duplicates were not checked."""
_DELETIONS: Final = (
    _GONE,
    "CREATE INDEX ON gone (run_id); ANALYZE gone",
    _KEPT,
    "CREATE INDEX ON kept (run_id); ANALYZE kept",
    "DELETE FROM kept_run k USING gone g WHERE g.run_id = k.run_id",
    (
        "INSERT INTO kept_run (run_id, station, run_number, file)"
        " SELECT run_id, station, run_number, file FROM kept"
    ),
    (
        "CREATE TEMPORARY TABLE old_trace ON COMMIT DROP AS SELECT DISTINCT a.sha256"
        " FROM attachment a JOIN gone g USING (run_id)"
    ),
    "DELETE FROM attachment a USING gone g WHERE a.run_id = g.run_id",
    (
        "DELETE FROM measurement m USING step s, gone g WHERE m.step_id = s.id"
        f" AND s.run_id = g.run_id AND NOT (m.name = '{DUPLICATES}' AND {_MARK})"
    ),
    f"DELETE FROM step s USING gone g WHERE s.run_id = g.run_id AND NOT ({_MARK})",
    "DELETE FROM gone g USING kept k WHERE k.run_id = g.run_id",
    "DELETE FROM device_write w USING gone g WHERE w.run_id = g.run_id",
    "DELETE FROM run_target t USING gone g WHERE t.run_id = g.run_id",
    "DELETE FROM run r USING gone g WHERE r.id = g.run_id",
    (
        "DELETE FROM chain_row c USING archive_chain a WHERE a.file = :file"
        " AND c.station = a.station AND c.number BETWEEN a.first AND a.last"
    ),
    # Stations wait until the end of this transaction before they add a trace.
    "LOCK TABLE trace IN SHARE ROW EXCLUSIVE MODE",
    (
        "DELETE FROM trace t USING old_trace o WHERE t.sha256 = o.sha256"
        " AND NOT EXISTS (SELECT FROM attachment a WHERE a.sha256 = t.sha256)"
    ),
)
