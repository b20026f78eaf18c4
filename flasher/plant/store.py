"""Opens a plant's database with the code of a station's records, for reports and pages."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Final, NoReturn
from uuid import UUID

from platformdirs import user_cache_path
from sqlalchemy import Connection, func, select

from flasher.errors import UsageError
from flasher.plant.archive import month_after
from flasher.plant.central import open_central, plant_location
from flasher.plant.claim_list import released_runs
from flasher.plant.schema import SHARED_PARTS, archive_file, plant_duplicate, shared_part, trace
from flasher.station.records.database import Database, Location, locate, open_database
from flasher.station.records.files import FileStore
from flasher.station.records.heads import ChainHead
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    PassedTwice,
    RunExamination,
    RunFilter,
    RunId,
    RunRecord,
    StationClock,
    utc_moment,
)
from flasher.station.records.queries import RUN_QUERY, Records, runs_of
from flasher.station.records.rows import batches
from flasher.station.records.schema import run
from flasher.station.records.store import Store

_USUAL: Final = KeyLocations()
_EVERYTHING: Final = RunFilter()


def cache_folder(url: str) -> Path:
    """Folder of this user for the daily sums of a plant's database. Raises UsageError."""
    shown = plant_location(url).shown
    mark = hashlib.sha256(shown.encode()).hexdigest()[:12]
    return user_cache_path("flasher", appauthor=False) / f"plant-{mark}"


def shared_parts(
    connection: Connection, station: UUID, digests: Iterable[Mapping[str, str]]
) -> Mapping[str, Any]:
    """Parts that runs of a station share, by their digest."""
    wanted = {each[name] for each in digests for name in SHARED_PARTS if name in each}
    found: dict[str, Any] = {}
    for some in batches(wanted):
        query = select(shared_part.c.sha256, shared_part.c.content).where(
            shared_part.c.station == station, shared_part.c.sha256.in_(some)
        )
        for sha256, content in connection.execute(query):
            found[sha256] = json.loads(content)
    return found


def passed_twice(connection: Connection, limit: int) -> list[PassedTwice]:
    """The newest units that passed at two stations."""
    both = (plant_duplicate.c.first_run_id, plant_duplicate.c.run_id)
    query = select(*both).order_by(plant_duplicate.c.run_id.desc()).limit(limit)
    pairs = connection.execute(query).all()
    wanted = {run_id for pair in pairs for run_id in pair}
    found = runs_of(connection, RUN_QUERY.where(run.c.id.in_(wanted)), released_runs(connection))
    runs: dict[int, RunRecord] = {each.run_id: each for each in found}
    # `verify` reports runs that are missing, or refer to missing rows.
    return [
        PassedTwice(runs[first], runs[second])
        for first, second in pairs
        if {first, second} <= runs.keys()
    ]


class PlantFiles(FileStore):
    """Attachments in a plant's database."""

    cause_missing = "its station could not read it when the run was sent"
    remedy = "Fetch it from the station or its backup."

    def __init__(self, database: Database) -> None:
        super().__init__(database.location.folder)
        self._database = database

    def _stored(self, sha256: str) -> bytes | None:
        query = select(trace.c.data).where(trace.c.sha256 == sha256)
        with self._database.reading() as connection:
            return connection.execute(query).scalar_one_or_none()

    def _place(self, sha256: str) -> str:
        return sha256


class PlantRecords(Records):
    """Queries of a plant's database. Certificates are a matter of the stations."""

    def released(self) -> set[int]:
        with self._database.reading() as connection:
            return released_runs(connection)

    def head_of(self, run_id: RunId) -> ChainHead | None:
        _refuse_certificate()


def _open_checked(location: Location, now: datetime, **settings: Any) -> Database:
    """`open_database`, after the check of the plant's own tables."""
    with open_central(location.url.render_as_string(hide_password=False)):
        return open_database(location, now, **settings)


class PlantStore(Store):
    """The records of all stations, for reading."""

    located = staticmethod(locate)
    opened = staticmethod(_open_checked)

    def __init__(
        self,
        database: Database,
        station: str,
        clock: StationClock,
        key_locations: KeyLocations = _USUAL,
    ) -> None:
        super().__init__(database, station, clock, key_locations)
        database.location.folder.mkdir(parents=True, exist_ok=True)
        self.files = PlantFiles(database)
        self.read = PlantRecords(database)

    def passed_twice(self, limit: int) -> Sequence[PassedTwice]:
        """The newest units that passed at two stations. Raises RecordError."""
        with self.database.reading() as connection:
            return passed_twice(connection, limit)

    def figures_begin(self) -> datetime | None:
        """What was retired has no figures: of its runs only the last ones of units stay."""
        query = select(func.max(archive_file.c.month))
        with self.database.reading() as connection:
            month = connection.execute(query).scalar_one()
        return None if month is None else utc_moment(f"{month_after(month)}-01T00:00:00Z")

    def examine_run(self, run_id: RunId) -> RunExamination:
        _refuse_certificate()


def _refuse_certificate() -> NoReturn:
    """A certificate states row numbers of the station that made the run."""
    raise UsageError(
        "Certificates are made and checked with the records of the station that made the run.",
        remedy="Use flasher station unit SERIAL --certificate FILE, or flasher station verify"
        " --certificate FILE, there.",
    )
