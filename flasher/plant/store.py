"""Opens a plant's database with the code of a station's records, for reports and pages."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final, NoReturn

from platformdirs import user_cache_path
from sqlalchemy import select

from flasher.errors import UsageError
from flasher.plant.central import plant_location
from flasher.plant.schema import trace
from flasher.station.records.database import Database, locate
from flasher.station.records.errors import RecordsDamagedError
from flasher.station.records.files import FileStore
from flasher.station.records.heads import ChainHead
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import RunExamination, RunId, StationClock
from flasher.station.records.queries import Records
from flasher.station.records.store import Store

_USUAL: Final = KeyLocations()


def cache_folder(url: str) -> Path:
    """Folder of this user for the daily sums of a plant's database. Raises UsageError."""
    shown = plant_location(url).shown
    mark = hashlib.sha256(shown.encode()).hexdigest()[:12]
    return user_cache_path("flasher", appauthor=False) / f"plant-{mark}"


class PlantFiles(FileStore):
    """Attachments in a plant's database."""

    def __init__(self, database: Database) -> None:
        super().__init__(database.location.folder)
        self._database = database

    def read(self, sha256: str) -> bytes:
        """Read an attachment and check its hash. Raises RecordError."""
        query = select(trace.c.data).where(trace.c.sha256 == sha256)
        with self._database.reading() as connection:
            data = connection.execute(query).scalar_one_or_none()
        if data is None:
            raise RecordsDamagedError(
                "An attachment is missing.",
                where=sha256,
                cause="its station could not read it when the run was sent",
                remedy="Fetch it from the station or its backup.",
            )
        if hashlib.sha256(data).hexdigest() != sha256:
            raise RecordsDamagedError(
                "An attachment was changed after it was stored: its hash differs.", where=sha256
            )
        return bytes(data)


class PlantRecords(Records):
    """Queries of a plant's database. Certificates are a matter of the stations."""

    def head_of(self, run_id: RunId) -> ChainHead | None:
        _refuse_certificate()


class PlantStore(Store):
    """The records of all stations, for reading."""

    located = staticmethod(locate)

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

    def examine_run(self, run_id: RunId) -> RunExamination:
        _refuse_certificate()


def _refuse_certificate() -> NoReturn:
    """A certificate states row numbers of the station that made the run."""
    raise UsageError(
        "Certificates are made and checked with the records of the station that made the run.",
        remedy="Use flasher station unit SERIAL --certificate FILE, or flasher station verify"
        " --certificate FILE, there.",
    )
