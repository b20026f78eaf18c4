# ruff: noqa: S608  all of this SQL is written here
"""Lists the deliveries in a plant's database, the newest first, and counts them by receiver."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import Connection, text

from flasher.plant.deliveries import DeliveryState, key_of, parse_key
from flasher.station.records.model import RunState
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Page, page_of

_OLDEST: Final = ", ".join(
    f"(SELECT min(row_id) FROM plant_delivery WHERE receiver = r.name AND state = '{each}')"
    for each in DeliveryState
    if not each.is_settled
)
"""A query for each state: each takes the first row of an index."""
_RECEIVERS: Final = text(f"""
SELECT r.name, r.since, r.stopped_at, coalesce(d.state, '') AS state, d.amount, c.station, c.number,
    c.arrived_at
FROM plant_receiver r
    LEFT JOIN (SELECT receiver, state, count(*) AS amount FROM plant_delivery GROUP BY 1, 2) d
        ON d.receiver = r.name
    LEFT JOIN chain_row c ON c.id = least({_OLDEST})
ORDER BY r.name, d.state
""")
_LIST: Final = """
SELECT * FROM (
SELECT d.row_id, d.receiver, d.station AS station_id, d.number, d.state, d.attempts, d.sent_at,
    d.answered_at, d.answer, c.run_id, c.arrived_at, n.name AS station, u.serial, u.part,
    run.state AS outcome, run.is_virtual,
    CASE WHEN j.status = 'todo' THEN j.scheduled_at END AS next_at
FROM plant_delivery d JOIN chain_row c ON c.id = d.row_id
    JOIN run ON run.id = c.run_id JOIN unit u ON u.id = run.unit_id
    JOIN socket s ON s.id = run.socket_id JOIN station n ON n.id = s.station_id
    LEFT JOIN procrastinate_jobs j ON j.id = d.job
WHERE {where} ORDER BY d.row_id {order} {limit}
) found ORDER BY row_id {order}, receiver {within}
"""
_LAST: Final = text("SELECT max(id) FROM chain_row")
_ARRIVED: Final = text("SELECT arrived_at FROM chain_row WHERE id >= :id ORDER BY id LIMIT 1")
_SKEW: Final = timedelta(minutes=10)
"""Rows of transactions that began as long after each other have ids in the order of their times."""


@dataclass(frozen=True)
class DeliveryFilter:
    """Deliveries to list; None means any. Raises UsageError for a key that is none."""

    receiver: str | None = None
    state: DeliveryState | None = None
    station: str | None = None
    serial: str | None = None
    key: str | None = None
    run_id: int | None = None
    since: datetime | None = None
    """Runs that arrived in the plant's database at this time or later."""
    until: datetime | None = None

    def __post_init__(self) -> None:
        if self.key is not None:
            parse_key(self.key)


_ALL: Final = DeliveryFilter()
_NEWEST: Final = PageCursor()
_CONDITIONS: Final = {
    "receiver": "d.receiver = :receiver",
    "state": "d.state = :state",
    "station": "n.name = :station",
    "serial": "u.serial = :serial",
    "key": "d.station = :station_id AND d.number = :number",
    "run_id": "c.run_id = :run_id",
    "since": "c.arrived_at >= :since AND d.row_id >= :since_row",
    "until": "c.arrived_at < :until AND d.row_id < :until_row",
}


@dataclass(frozen=True)
class Delivery:
    """A run that is handed over to a receiver."""

    key: str
    receiver: str
    state: DeliveryState
    attempts: int
    sent_at: datetime | None
    """Time of the last attempt; times are by the database's clock."""
    answered_at: datetime | None
    answer: str
    """What the receiver answered then, or what failed."""
    next_at: datetime | None
    """Time of the next attempt; null: at once, or none."""
    arrived_at: datetime
    """Time at which the run arrived in the plant's database."""
    run_id: int
    station: str
    serial: str
    part: str
    outcome: RunState
    is_virtual: bool


@dataclass(frozen=True)
class ReceiverStatus:
    """A receiver with its number of deliveries by state."""

    name: str
    since: datetime
    """Runs that arrived from this time on are handed over."""
    stopped_at: datetime | None
    """From this time on, runs that arrive are not handed over; null: they are."""
    counts: dict[DeliveryState, int]
    oldest_open_at: datetime | None
    """Arrival of the oldest run that is neither confirmed nor refused."""
    oldest_open_key: str | None
    """Its key."""


def receivers_of(connection: Connection) -> list[ReceiverStatus]:
    """All receivers, by name."""
    found: dict[str, ReceiverStatus] = {}
    for row in connection.execute(_RECEIVERS):
        oldest = None if row.station is None else key_of(row.station, row.number)
        status = found.setdefault(
            row.name,
            ReceiverStatus(row.name, row.since, row.stopped_at, {}, row.arrived_at, oldest),
        )
        if row.state:
            status.counts[DeliveryState(row.state)] = row.amount
    return list(found.values())


def deliveries_of(
    connection: Connection,
    chosen: DeliveryFilter = _ALL,
    cursor: PageCursor = _NEWEST,
    size: int | None = None,
) -> Page[Delivery]:
    """A page of `size` deliveries, or all. Those of a run are on one page."""
    values: dict[str, Any] = {k: v for k, v in vars(chosen).items() if v is not None}
    where = [_CONDITIONS[name] for name in values]
    if chosen.since is not None:
        values["since_row"] = _row_at(connection, chosen.since, _SKEW)
    if chosen.until is not None:
        values["until_row"] = _row_at(connection, chosen.until, -_SKEW)
    if chosen.key is not None:
        values["station_id"], values["number"] = parse_key(chosen.key)
    for name, sign in (("before", "<"), ("after", ">")):
        if getattr(cursor, name) is not None:
            where.append(f"d.row_id {sign} :{name}")
            values[name] = getattr(cursor, name)
    order, within = ("DESC", "ASC") if cursor.after is None else ("ASC", "DESC")
    query = _LIST.format(
        where=" AND ".join(where) or "true",
        order=order,
        within=within,
        limit="" if size is None else "FETCH FIRST :more ROWS WITH TIES",
    )
    more = None if size is None else size + 1
    rows = [
        dict(row) for row in connection.execute(text(query), {**values, "more": more}).mappings()
    ]
    has_more = size is not None and len(rows) > size
    if has_more:  # the last run, with all its deliveries, begins the next page
        last = rows[-1]["row_id"]
        rows = [row for row in rows if row["row_id"] != last] or rows
    ids = [row.pop("row_id") for row in rows]
    return page_of([_delivery(row) for row in rows], ids, cursor, has_more=has_more)


def _row_at(connection: Connection, moment: datetime, later: timedelta) -> int:
    """Id of the first row that would have arrived at a moment or after it, had all arrived so much
    later. Looks up a few rows: the times have no index, and without a range of ids the database
    would read all deliveries since a past day.
    """

    def arrived(row_id: int) -> datetime:
        at: datetime = connection.execute(_ARRIVED, {"id": row_id}).scalar_one()
        return at + later

    last: int | None = connection.execute(_LAST).scalar_one()
    return bisect_left(range(0 if last is None else last + 1), moment, key=arrived)


def _delivery(row: dict[str, Any]) -> Delivery:
    key = key_of(row.pop("station_id"), row.pop("number"))
    words = {"state": DeliveryState(row["state"]), "outcome": RunState(row["outcome"])}
    return Delivery(**{**row, "key": key, **words})
