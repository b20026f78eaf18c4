# ruff: noqa: S608  all of this SQL is written here
"""Lists the claims of units in a plant's database, and releases those of a lost station.

A claim that expired stays until its station sends the end of the run: until then the unit may have
passed there, and other stations mark it or refuse it. A released claim holds nothing up. If its
station sends the run after all, that run counts as one whose duplicates were not checked
(`claim_functions`), so that at most one PASS of the unit is without a mark.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, text

from flasher.errors import UsageError
from flasher.plant.central import Central
from flasher.station.records.model import RunState

RELEASES_MAX: Final = 100
"""Releases that are listed."""
_CONDITIONS: Final = {
    "station": "p.name = :station",
    "part": "c.part = :part",
    "serial": "c.serial = :serial",
}
_OF: Final = "FROM {table} c LEFT JOIN plant_station p ON p.station = c.station"
_CLAIMS: Final = f"""
SELECT coalesce(p.name, '') AS station, c.socket, c.part, c.serial, c.claimed_at, c.expires_at,
    c.expires_at <= clock_timestamp() AS is_expired
{_OF.format(table="plant_claim")} WHERE {{where}} ORDER BY c.claimed_at, c.token
"""
_RELEASES: Final = f"""
SELECT coalesce(p.name, '') AS station, c.socket, c.part, c.serial, c.claimed_at, c.released_at,
    c.released_by, c.reason, c.run_id, run.state AS outcome
{_OF.format(table="released_claim")} LEFT JOIN run ON run.id = c.run_id WHERE {{where}}
ORDER BY c.released_at DESC, c.token LIMIT :limit
"""
# The time is compared again when the row is locked: its station may renew it at the same moment.
_RELEASE: Final = f"""
WITH gone AS (
    DELETE FROM plant_claim WHERE expires_at <= clock_timestamp() AND token IN (
        SELECT c.token {_OF.format(table="plant_claim")} WHERE {{where}})
    RETURNING token, station, part, serial, socket, claimed_at
)
INSERT INTO released_claim (token, station, part, serial, socket, claimed_at, reason)
    SELECT *, :reason FROM gone
"""


@dataclass(frozen=True)
class ClaimFilter:
    """Claims to list or to release; None means any."""

    station: str | None = None
    part: str | None = None
    serial: str | None = None


@dataclass(frozen=True)
class UnitClaim:
    """A unit that a station claims. Times are by the database's clock."""

    station: str
    """Empty: a station whose records were replaced."""
    socket: str
    part: str
    serial: str
    claimed_at: datetime
    expires_at: datetime
    is_expired: bool
    """True if its station has not renewed it."""


@dataclass(frozen=True)
class ReleasedClaim:
    """A claim that the owner of the database released."""

    station: str
    """Empty: a station whose records were replaced."""
    socket: str
    part: str
    serial: str
    claimed_at: datetime
    released_at: datetime
    released_by: str
    """User of the database."""
    reason: str
    run_id: int | None
    """The run with this claim, if its station has sent it after all."""
    outcome: RunState | None
    """Null also where the run was retired."""


def claims_of(connection: Connection, chosen: ClaimFilter) -> list[UnitClaim]:
    """Claims whose run has not arrived, oldest first."""
    where, values = _conditions(chosen)
    rows = connection.execute(text(_CLAIMS.format(where=where)), values)
    return [UnitClaim(**row) for row in rows.mappings()]


def releases_of(connection: Connection, chosen: ClaimFilter) -> list[ReleasedClaim]:
    """The newest released claims."""
    where, values = _conditions(chosen)
    query = text(_RELEASES.format(where=where))
    rows = connection.execute(query, {**values, "limit": RELEASES_MAX})
    return [
        ReleasedClaim(**{**row, "outcome": row["outcome"] and RunState(row["outcome"])})
        for row in rows.mappings()
    ]


def release(central: Central, chosen: ClaimFilter, reason: str) -> int:
    """Release the claims of a filter that have expired; returns how many. Raises UsageError if
    there is none, or this user is not the owner of the database.
    """
    central.check_owner("release claims")
    where, values = _conditions(chosen)
    query = text(_RELEASE.format(where=where))
    with central.writing() as connection:
        count = connection.execute(query, {**values, "reason": reason}).rowcount
    if not count:
        raise UsageError(
            "No such claim has expired: nothing was released.",
            where=central.shown,
            remedy="flasher plant claims --database URL lists them. A claim that has not expired"
            " belongs to a unit in a run; wait for its end.",
        )
    return count


def released_runs(connection: Connection) -> set[int]:
    """Runs that arrived after their claim was released."""
    query = text("SELECT run_id FROM released_claim WHERE run_id IS NOT NULL")
    return set(connection.execute(query).scalars())


def _conditions(chosen: ClaimFilter) -> tuple[str, dict[str, Any]]:
    values = {name: value for name, value in vars(chosen).items() if value is not None}
    return " AND ".join(_CONDITIONS[name] for name in values) or "true", values
