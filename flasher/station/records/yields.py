"""Counts units by the first and the last of their runs with a verdict, in spans of time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, and_, case, func, literal, select, union_all

from flasher.station.records import schema
from flasher.station.records.filters import JUDGED, counting
from flasher.station.records.model import RunFilter, RunState, Units, utc_text
from flasher.station.records.rows import beside_index

_SPANS_AT_ONCE: Final = 400
"""Number of time spans in one query; SQLite takes 500."""


@dataclass(frozen=True)
class Span:
    """A period of time, without its end."""

    begin: datetime
    end: datetime


def units_in(
    connection: Connection, chosen: RunFilter, spans: Sequence[Span], *, by_station: bool = False
) -> Iterator[tuple[tuple[int, int], Units]]:
    """Units of each span that has any, by the id of the station (0: of all) and the index of the
    span.
    """
    run = schema.run.c
    station_id = schema.socket.c.station_id if by_station else literal(0)
    # Run id times two, plus one for PASS: the least value is that of the first run.
    ranked = run.id * 2 + case((run.state == RunState.PASS.value, 1), else_=0)
    for begin in range(0, len(spans), _SPANS_AT_ONCE):
        span = union_all(
            *(
                select(
                    literal(number).label("number"),
                    literal(utc_text(each.begin)).label("begin"),
                    literal(utc_text(each.end)).label("end"),
                )
                for number, each in enumerate(spans[begin : begin + _SPANS_AT_ONCE], begin)
            )
        ).cte()
        of_unit = (
            counting(chosen, station_id.label("station"), span.c.number, run.unit_id)
            .add_columns(func.min(ranked).label("first"), func.max(ranked).label("last"))
            .join(span, and_(run.begun_at >= span.c.begin, run.begun_at < span.c.end))
        )
        keys: list[Any] = [span.c.number, run.unit_id]
        if by_station:
            of_unit = of_unit.join(schema.socket, run.socket_id == schema.socket.c.id)
            keys.append(station_id)
        found = of_unit.where(beside_index(run.state).in_(JUDGED)).group_by(*keys).subquery().c
        query = select(
            found.station, found.number, func.count(), func.sum(found.last % 2),
            func.sum(found.first % 2),
        ).group_by(found.station, found.number)  # fmt: skip
        for station, number, *counts in connection.execute(query):
            yield (station, number), Units(*map(int, counts))
