"""`flasher plant verify`: examines every chain, every run and every trace of a plant's database."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final
from uuid import UUID

from sqlalchemy import Connection, func, select

from flasher.plant.archive import ArchivedChain
from flasher.plant.archive_check import (
    ArchiveExaminer,
    AssembledExaminer,
    assembled,
    differing,
)
from flasher.plant.retire import last_archived, recorded_chains
from flasher.plant.schema import archive_file, chain_row, kept_run
from flasher.plant.store import PlantStore, shared_parts
from flasher.protocol.text import printable
from flasher.station.records import chain, schema
from flasher.station.records.errors import RecordError
from flasher.station.records.examination import ExaminedTrail, same_traces
from flasher.station.records.model import Problem
from flasher.station.records.rows import batches
from flasher.station.records.signatures import fingerprint

_AT_ONCE: Final = 500
_UNSENT: Final = (
    select(schema.run.c.id)
    .outerjoin(
        chain_row, (chain_row.c.run_id == schema.run.c.id) & chain_row.c.content.is_not(None)
    )
    .outerjoin(kept_run, kept_run.c.run_id == schema.run.c.id)
    .where(chain_row.c.id.is_(None), kept_run.c.run_id.is_(None))
    .order_by(schema.run.c.id)
    .limit(_AT_ONCE)
)
"""Runs that no chain and no file has."""


@dataclass(frozen=True)
class ExaminedStation:
    """A station's chain in a plant's database."""

    station: str
    rows: int
    last_at: str
    """Time of the last row."""
    keys: tuple[str, ...]
    """Fingerprints of the keys that signed it, oldest first."""


@dataclass(frozen=True)
class PlantExamination:
    """Result of an examination of a plant's database."""

    problems: tuple[Problem, ...]
    remarks: tuple[str, ...]
    stations: tuple[ExaminedStation, ...]
    runs: int
    """Number of runs that were compared with their audit rows."""
    traces: int
    """Number of PASS that were compared with their traces."""
    archives: tuple[str, ...]
    """Files of retired months that were examined."""
    unexamined: tuple[str, ...]
    """Files of retired months that were not."""


class PlantExaminer(AssembledExaminer):
    """Examines a plant's database once."""

    def __init__(
        self,
        store: PlantStore,
        progress: Callable[[int, int], None],
        archives: Path | None = None,
    ) -> None:
        """`archives`: folder of the files of retired months."""
        super().__init__(store.database, store.files, store.signer.key_locations, progress)
        self._folder = archives

    def examine_plant(self) -> PlantExamination:
        """Examine everything. Raises RecordError."""
        problems: list[Problem] = []
        stations = []
        with self._database.reading() as connection:
            rows = select(func.count()).select_from(chain_row)
            self._total = connection.execute(rows).scalar_one()
            self._total += connection.execute(
                select(func.count()).select_from(schema.run)
            ).scalar_one()
            for station in connection.execute(select(chain_row.c.station).distinct()).scalars():
                trail, records_id = _begun(connection, station)
                if _station_of(records_id, trail.station) != station:
                    problems.append(
                        Problem(f"chain {station}", "it is stored as that of another station")
                    )
                found = self._station(connection, station, trail, records_id)
                shown = printable(trail.station)
                problems += (
                    replace(each, where=each.where if shown in each.where
                            else f"{shown}, {each.where}", runs=())
                    for each in found
                )  # fmt: skip
                last = select(chain_row.c.at).where(
                    chain_row.c.station == station, chain_row.c.number == trail.end
                )
                stations.append(
                    ExaminedStation(
                        trail.station,
                        trail.end,
                        connection.execute(last).scalar_one_or_none() or "",
                        tuple(map(_fingerprint, trail.keys)),
                    )
                )
            problems += (
                Problem(f"run {run_id}", "no station's audit trail has it: it was added", (run_id,))
                for run_id in connection.execute(_UNSENT).scalars()
            )
            problems += same_traces(connection)
            files = recorded_chains(connection)
            problems += _gaps(files)
        examined = [] if self._folder is None else [*files]
        for name in examined:
            problems += self._archive(name, files[name])
        unexamined = () if self._folder is not None else tuple(files)
        if unexamined:
            self._remarks.append(
                f"{len(unexamined)} files of retired months were not examined, nor the runs that"
                " stayed of them: name their folder with --archive"
            )
        self._remark_nameless()
        stations.sort(key=lambda each: each.station)
        return PlantExamination(
            tuple(problems), tuple(self._remarks), tuple(stations), self._runs, self._traces,
            tuple(examined), unexamined,
        )  # fmt: skip

    def _archive(self, name: str, chains: Sequence[ArchivedChain]) -> Iterator[Problem]:
        """Examine a file of a retired month."""
        assert self._folder is not None  # noqa: S101  or none is examined
        with self._database.reading() as connection:
            file = archive_file.c
            query = select(file.sha256, file.month).where(file.name == name)
            stated = connection.execute(query).one_or_none()
        examiner = ArchiveExaminer(self._database, self._folder / name, chains, self._progress)
        try:
            found = examiner.examine_file()
        except RecordError as error:
            yield Problem(printable(name), error.what)
            return
        yield from found.problems
        if stated is None or found.sha256 != stated.sha256:
            yield Problem(printable(name), "it is not the file that was written: its hash differs")
        elif found.manifest.month != stated.month:
            yield Problem(printable(name), "the database states another month of it")
        self._runs += found.runs
        self._traces += found.traces

    def _station(
        self, connection: Connection, station: UUID, trail: ExaminedTrail, records_id: str
    ) -> Iterator[Problem]:
        """Examine a chain, then its runs."""
        query = (
            select(chain_row, chain_row.c.run_number)
            .where(chain_row.c.station == station)
            .order_by(chain_row.c.number)
            .execution_options(yield_per=_AT_ONCE)
        )
        with connection.execute(query) as rows:
            # The run's id at the station is what was signed.
            signed = (dict(row) | {"run_id": row["run_number"]} for row in rows.mappings())
            yield from self._chain(trail, signed, records_id)
        ended = select(chain_row.c.run_number).where(
            chain_row.c.station == station, chain_row.c.content.is_not(None)
        )
        numbers = connection.execute(ended.order_by(chain_row.c.number)).scalars().all()
        for some in batches(numbers):
            yield from self._some_runs(connection, station, some)

    def _some_runs(
        self, connection: Connection, station: UUID, numbers: Sequence[int]
    ) -> Iterator[Problem]:
        """Compare runs with their digests and traces, and with the tables that are read."""
        query = select(chain_row).where(
            chain_row.c.station == station, chain_row.c.run_number.in_(numbers)
        )
        rows = connection.execute(query.order_by(chain_row.c.number)).mappings().all()
        digests = [chain.data_of(row["data"]).get("digests", {}) for row in rows]
        found = assembled(rows, shared_parts(connection, station, digests))
        central = {row["run_number"]: row["run_id"] for row in rows if row["content"] is not None}
        yield from self._assembled(found)
        whole = {number: central[number] for number in found.contents}
        missing = "reports and pages do not have it as a whole"
        yield from differing(connection, whole, found.contents, missing)


def _gaps(files: Mapping[str, Sequence[ArchivedChain]]) -> Iterator[Problem]:
    """Files of a chain that do not continue one another."""
    chains = sorted((each for some in files.values() for each in some), key=lambda each: each.last)
    ends: dict[UUID, ArchivedChain] = {}
    for each in chains:
        before = ends.get(each.station)
        last, last_hash = (0, chain.GENESIS) if before is None else (before.last, before.hash)
        if (each.first - 1, each.previous_hash) != (last, last_hash):
            what = f"the files of retired months do not continue at row {each.first}"
            yield Problem(f"audit trail of {printable(each.name)}", what)
        ends[each.station] = each


def _begun(connection: Connection, station: UUID) -> tuple[ExaminedTrail, str]:
    """The chain's station and records, as its first row states them, or its part in files."""
    retired = last_archived(connection, station)
    if retired.last:
        trail = ExaminedTrail(
            retired.last, retired.hash, keys=list(retired.keys), station=retired.name
        )
        return trail, retired.records_id
    query = select(chain_row.c.data).where(chain_row.c.station == station, chain_row.c.number == 1)
    data = chain.data_of(connection.execute(query).scalar_one_or_none() or "")
    trail = ExaminedTrail(station=str(data.get("station", station)))
    return trail, str(data.get("records", ""))


def _station_of(records_id: str, name: str) -> UUID:
    """As the function `plant_enter` computes it."""
    return UUID(hashlib.sha256(f"{records_id} {name}".encode()).hexdigest()[:32])


def _fingerprint(key: str) -> str:
    try:
        return fingerprint(key)
    except ValueError:
        return "none"
