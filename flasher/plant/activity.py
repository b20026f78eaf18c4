"""Reads the recent activity of each station of a plant: yield of shift and day, and last runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, time
from typing import Any, Final

from sqlalchemy import Connection, text

from flasher.station.records.model import (
    CLOCK_TOLERANCE,
    Moment,
    RunFilter,
    RunKind,
    RunState,
    Units,
    local_moment,
    utc_moment,
    utc_text,
)
from flasher.station.records.yields import Span, units_in
from flasher.station.shift_counts import shift_began
from flasher.validation import json_keys

_LAST: Final = text(f"""
SELECT n.id AS station_id, n.name AS station, s.name AS socket, r.id, u.serial, r.state, r.code,
    r.begun_at
FROM socket s JOIN station n ON n.id = s.station_id CROSS JOIN LATERAL (
    SELECT id, unit_id, state, code, begun_at FROM run
    WHERE socket_id = s.id AND kind <> '{RunKind.GOLDEN}' AND begun_at < :until
    ORDER BY id DESC LIMIT :runs
) r JOIN unit u ON u.id = r.unit_id ORDER BY n.name, s.name, r.id DESC
""")  # noqa: S608  a constant


@dataclass(frozen=True)
class RecentRun:
    """One of the last runs of a socket."""

    run_id: int
    serial: str
    state: RunState
    code: str
    begun_at: Moment


@dataclass(frozen=True)
class SocketRuns:
    """The last runs of a socket, newest first."""

    name: str
    runs: tuple[RecentRun, ...]


@json_keys("shift day sockets last_run")
@dataclass(frozen=True)
class Activity:
    """What a station has done lately, without golden units."""

    shift: Units = field(default_factory=Units)
    day: Units = field(default_factory=Units)
    sockets: tuple[SocketRuns, ...] = ()

    @property
    def last_run(self) -> RecentRun | None:
        runs = (socket.runs[0] for socket in self.sockets if socket.runs)
        return max(runs, key=lambda run: run.run_id, default=None)


def activities(
    connection: Connection, shifts: Sequence[time], now: datetime, runs: int
) -> Mapping[str, Activity]:
    """Activity of each station that has runs, by its name, with the last `runs` of each socket. Day
    and shift are those of the time zone of this computer.
    """
    day = local_moment(datetime.combine(now.astimezone(), time()))
    shift = shift_began(shifts, now) or day
    # A later run is one of a clock that was ahead.
    until = now + CLOCK_TOLERANCE
    spans = [Span(begin, until) for begin in (shift, day)]
    chosen = RunFilter(since=min(day, shift), until=until)
    yields = dict(units_in(connection, chosen, spans, by_station=True))
    sockets: dict[Any, dict[str, list[RecentRun]]] = defaultdict(lambda: defaultdict(list))
    for row in connection.execute(_LAST, {"runs": runs, "until": utc_text(until)}):
        made = RecentRun(
            row.id, row.serial, RunState(row.state), row.code, utc_moment(row.begun_at)
        )
        sockets[row.station_id, row.station][row.socket].append(made)
    return {
        station: Activity(
            yields.get((station_id, 0), Units()),
            yields.get((station_id, 1), Units()),
            tuple(SocketRuns(name, tuple(some)) for name, some in of_station.items()),
        )
        for (station_id, station), of_station in sockets.items()
    }
