"""Reads the state of the stations from the plant's database."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from sqlalchemy import Connection, text

from flasher.plant.central import Refusal

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


_RECIPES: Final = text("""
WITH used AS (
    SELECT DISTINCT ON (c.station, data::jsonb->>'socket') p.name AS station, c.at, data::jsonb AS d
    FROM chain_row c JOIN plant_station p USING (station) WHERE c.event = 'recipe in use'
    ORDER BY c.station, data::jsonb->>'socket', c.number DESC
), newest AS (
    SELECT DISTINCT ON (digest) digest, what FROM recipe_event ORDER BY digest, id DESC
)
SELECT station, d->>'socket' AS socket, d->>'name' AS name, d->>'revision' AS revision,
    d->>'sha256' AS sha256, d->>'digest' AS digest, at AS since,
    coalesce(n.what = 'withdrawn', false) AS is_withdrawn,
    (SELECT CASE WHEN e.digest = d->>'digest' THEN '' ELSE e.digest END FROM recipe_event e
        WHERE e.what = 'published' AND coalesce(e.station, used.station) = used.station
        AND coalesce(e.socket, d->>'socket') = d->>'socket' ORDER BY e.id DESC LIMIT 1) AS published
FROM used LEFT JOIN newest n ON n.digest = d->>'digest' ORDER BY 1, 2
""")


@dataclass(frozen=True)
class SocketRecipe:
    """The recipe that a socket uses, as its station recorded it."""

    socket: str
    name: str
    revision: str
    sha256: str
    """SHA-256 of the recipe file."""
    digest: str
    """Digest of the recipe with its files; empty: a local recipe."""
    since: str
    """By the station's clock."""
    is_withdrawn: bool
    published: str | None
    """Digest of the newest recipe that was published for the socket, if it is not in use yet; empty
    if it is; null without one."""


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
    """Why it refuses another PC that runs, or ran before a takeover, as this station."""
    other_reported_at: datetime | None
    """When that PC reported last."""
    recipes: tuple[SocketRecipe, ...] = ()
    """Recipes in use by socket, of a station that gets them from the plant."""

    def is_forked(self, within_s: float) -> bool:
        """True if another PC has reported as this station within this time, and was not taken
        over.
        """
        if self.other_reported_at is None or self.other_refusal.startswith(Refusal.TAKEN_OVER):
            return False
        return (self.now - self.other_reported_at).total_seconds() <= within_s


def statuses(connection: Connection) -> list[StationStatus]:
    """All stations, by name."""
    recipes = defaultdict(list)
    for each in connection.execute(_RECIPES).mappings():
        facts = dict(each)
        recipes[facts.pop("station")].append(SocketRecipe(**facts))
    found = []
    for row in connection.execute(_QUERY).mappings():
        reported_at = row["reported_at"]
        silent_s = None if reported_at is None else (row["now"] - reported_at).total_seconds()
        used = tuple(recipes[row["station"]])
        found.append(StationStatus(**row, silent_s=silent_s, recipes=used))
    return found
