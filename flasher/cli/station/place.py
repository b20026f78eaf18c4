"""Opens the records that the options describe."""

from __future__ import annotations

import getpass
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from flasher.cli.station.commands import DEFAULT_RECORDS, RecordsOptions
from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.config import StationConfig, load_config
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.records.store import Store

_READER: Final = "report"
"""Station name for opening records that are only read."""


@dataclass(frozen=True)
class RecordsPlace:
    """The records' URL and settings, from the options."""

    url: str
    """A file, or an SQLAlchemy URL."""
    files: Path | None
    lock_timeout_s: float
    key_locations: KeyLocations
    station: str | None
    """Name of the station, if the options include a station file."""

    def open(self, station: str, *, kind: type[Store] = Store, **options: Any) -> Store:
        """Open the records as a station; `options` as in `Store.open`. Raises UsageError,
        RecordError.
        """
        return kind.open(
            self.url,
            station=station,
            folder=self.files,
            lock_timeout_s=self.lock_timeout_s,
            key_locations=self.key_locations,
            **options,
        )


def records_of(options: RecordsOptions) -> RecordsPlace:
    """Settings of the records from the options. Raises UsageError."""
    config = load_config(options.sockets) if options.sockets is not None else None
    database, files, keys, heads = options.database, options.files, options.keys, options.heads
    if config is None:
        return RecordsPlace(
            database or DEFAULT_RECORDS,
            files,
            DEFAULT_LOCK_TIMEOUT_S,
            KeyLocations(keys, heads),
            None,
        )
    if database is None:
        database, files = config.records, files or _path(config.files)
    key_locations = KeyLocations(keys or _path(config.keys), heads or config.heads)
    return RecordsPlace(database, files, config.lock_timeout_s, key_locations, config.name)


def _path(text: str) -> Path | None:
    return Path(text) if text else None


def open_to_read(options: RecordsOptions, kind: type[Store] = Store) -> Store:
    """Open the records for reading only. Raises UsageError, RecordError."""
    return records_of(options).open(_READER, read_only=True, kind=kind)


def station_of_plant(file: Path) -> StationConfig:
    """Read a station file that names a plant. Raises UsageError."""
    config = load_config(file)
    if not config.plant:
        raise UsageError(
            "The station file names no plant.",
            where=printable(str(file)),
            remedy='Add plant = "postgresql://USER@HOST/NAME"; flasher plant init prints the line.',
        )
    return config


def the_station(names: tuple[str, ...]) -> str:
    """The only station of the records. Raises UsageError for none or several."""
    if len(names) != 1:
        listed = ", ".join(map(printable, names)) or "none"
        raise UsageError(
            f"The records do not have exactly one station: {listed}.",
            remedy="Name the file of the station with --sockets.",
        )
    return names[0]


def operator_of(named: str | None) -> str:
    """The given name, or the login of the user."""
    try:
        return named or getpass.getuser()
    except (OSError, KeyError):
        return "operator"
