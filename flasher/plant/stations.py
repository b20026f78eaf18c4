"""Reads the state of the stations from the plant's database."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Final

from sqlalchemy import Connection, text

from flasher.plant.central import Central

_QUERY: Final = text("""
SELECT p.name AS station, p.role, p.reported_at, p.version, p.unsent, p.oldest_unsent_at,
    p.clock_offset_s, p.disk_free_bytes, p.refusal, p.other_refusal, p.other_reported_at,
    clock_timestamp() AS now,
    coalesce(c.number, 0) AS head_number, c.hash AS head_hash, c.at AS head_at
FROM plant_station p LEFT JOIN LATERAL (
    SELECT number, hash, at FROM chain_row WHERE chain_row.station = p.station
    ORDER BY number DESC LIMIT 1
) c ON true ORDER BY p.name
""")


@dataclass(frozen=True)
class StationStatus:
    """A station as the plant's database knows it."""

    station: str
    role: str
    reported_at: datetime | None
    """Time of its last report, by the database's clock; null: it never connected."""
    now: datetime
    """The time of this answer, by the database's clock."""
    silent_s: float | None
    """Seconds since the last report."""
    version: str
    """Version of flasher."""
    head_number: int
    """Number of its last audit row in the database; 0: none."""
    head_hash: str | None
    head_at: str | None
    """Time of that row by the station's clock."""
    unsent: int | None
    """Audit rows that waited at the last report."""
    oldest_unsent_at: str | None
    """Time of the first of these; empty without any."""
    clock_offset_s: float | None
    """The station's clock minus the database's."""
    disk_free_bytes: int | None
    refusal: str
    """Why the database refuses its chain; empty if it does not."""
    other_refusal: str
    """Why it refuses a PC that ran as this station before another one took it over."""
    other_reported_at: datetime | None
    """When that PC reported last."""


def stations_of(central: Central) -> list[StationStatus]:
    """All stations, by name. Raises RecordError."""
    with central.reading() as connection:
        return statuses(connection)


def statuses(connection: Connection) -> list[StationStatus]:
    """All stations, by name."""
    found = []
    for row in connection.execute(_QUERY).mappings():
        reported_at = row["reported_at"]
        silent_s = None if reported_at is None else (row["now"] - reported_at).total_seconds()
        found.append(StationStatus(**row, silent_s=silent_s))
    return found
