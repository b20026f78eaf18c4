"""Reads the recent activity of each station of a plant: yield of shift and day, and last runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, time
from typing import Final

from sqlalchemy import Connection, text

from flasher.station.records.model import Moment, RunKind, RunState, Units, utc_moment, utc_text
from flasher.station.shift_counts import shift_began
from flasher.validation import json_keys

_YIELDS: Final = text(f"""
SELECT station, count(last), coalesce(sum(last % 2), 0), coalesce(sum(first % 2), 0),
    count(shift_last), coalesce(sum(shift_last % 2), 0), coalesce(sum(shift_first % 2), 0)
FROM (
    SELECT n.name AS station, r.unit_id,
        min(r.ranked) FILTER (WHERE r.begun_at >= :day) AS first,
        max(r.ranked) FILTER (WHERE r.begun_at >= :day) AS last,
        min(r.ranked) FILTER (WHERE r.begun_at >= :shift) AS shift_first,
        max(r.ranked) FILTER (WHERE r.begun_at >= :shift) AS shift_last
    FROM (
        -- Two for each run, and one for PASS: the least is that of the first run.
        SELECT socket_id, unit_id, begun_at, id * 2 + (state = 'PASS')::int AS ranked FROM run
        WHERE begun_at >= :since AND state IN ('PASS', 'FAIL') AND kind <> '{RunKind.GOLDEN}'
    ) r JOIN socket s ON s.id = r.socket_id JOIN station n ON n.id = s.station_id
    GROUP BY n.name, r.unit_id
) of_unit GROUP BY station
""")  # noqa: S608  a constant
_LAST: Final = text(f"""
SELECT n.name AS station, s.name AS socket, r.id, u.serial, r.state, r.code, r.begun_at
FROM socket s JOIN station n ON n.id = s.station_id CROSS JOIN LATERAL (
    SELECT id, unit_id, state, code, begun_at FROM run
    WHERE socket_id = s.id AND kind <> '{RunKind.GOLDEN}' ORDER BY id DESC LIMIT :runs
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
    and shift are those of the time zone of `now`.
    """
    day = datetime.combine(now.date(), time(), now.tzinfo)
    shift = shift_began(shifts, now) or day
    moments = {"day": day, "shift": shift, "since": min(day, shift)}
    values = {name: utc_text(moment) for name, moment in moments.items()}
    yields: dict[str, tuple[Units, Units]] = {}
    for station, *sums in connection.execute(_YIELDS, values):
        counts = [int(each) for each in sums]
        yields[station] = Units(*counts[3:]), Units(*counts[:3])
    sockets: dict[str, dict[str, list[RecentRun]]] = defaultdict(lambda: defaultdict(list))
    for row in connection.execute(_LAST, {"runs": runs}):
        made = RecentRun(
            row.id, row.serial, RunState(row.state), row.code, utc_moment(row.begun_at)
        )
        sockets[row.station][row.socket].append(made)
    return {
        station: Activity(
            *yields.get(station, (Units(), Units())),
            tuple(SocketRuns(name, tuple(some)) for name, some in of_station.items()),
        )
        for station, of_station in sockets.items()
    }
