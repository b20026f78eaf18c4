"""Stores daily sums of runs, so that pages with figures need not read the runs of all years.

The sums are in a file beside the attachments. They hold the runs whose end is in audit rows up to
`_Added.audit`, in whatever order these began. Other runs, and days that a period covers partly, are
read from the records. The file is rebuilt if it does not fit the records; nothing that is signed or
verified depends on it, and it may be deleted.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import zlib
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime, time, timedelta
from functools import cached_property
from itertools import groupby
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, Select, case, func, select, union_all
from sqlalchemy.sql.expression import ColumnElement

from flasher.protocol.text import printable
from flasher.station.records import schema
from flasher.station.records.chain import ENDINGS
from flasher.station.records.database import Database, records_id_of
from flasher.station.records.errors import RecordError
from flasher.station.records.filters import JUDGED, WITHOUT_CAUSE, begun_in, counting, named_in
from flasher.station.records.model import (
    RunFilter,
    RunKind,
    RunState,
    StepState,
    Units,
    local_moment,
    utc_moment,
    utc_text,
)
from flasher.station.records.rows import batches, beside_index

_LOG: Final = logging.getLogger(__name__)
_LAYOUT: Final = 5
_RUNS_AT_ONCE: Final = 5000
_PAUSE_S: Final = 0.2
"""Pause between batches, for other programs."""
_UNTIL_NEXT_S: Final = 600.0
_ARRIVAL: Final = timedelta(minutes=10)
"""A transaction lasts less: until then a server may commit an audit row with a lower id."""
_FIRST: Final = select(
    schema.station.c.id,
    select(func.min(schema.audit.c.at))
    .where(schema.audit.c.station_id == schema.station.c.id)
    .scalar_subquery(),
)
"""The oldest audit row of each station. A plant retires the runs of old months with their audit
rows, except for the last one of each station."""
_TABLES: Final = """
CREATE TABLE state (content TEXT);
CREATE TABLE day (number INTEGER PRIMARY KEY, begin TEXT, end TEXT, month TEXT);
CREATE TABLE history (runs TEXT PRIMARY KEY, units INTEGER) WITHOUT ROWID;
CREATE TABLE bad (
    begun_at TEXT, run INTEGER, recipe_id INTEGER, socket_id INTEGER, lot_id INTEGER, code TEXT,
    PRIMARY KEY (begun_at, run)
) WITHOUT ROWID;
CREATE TABLE times (
    period TEXT, recipe INTEGER, socket INTEGER, content BLOB,
    PRIMARY KEY (period, recipe, socket)
) WITHOUT ROWID;
"""
"""`history`: number of units with the same runs with a verdict, as JSON. `bad`: runs that ended
without PASS. `times`: number of each duration of a step, by day (its number) or month."""

_NOWHERE: Final = -1
"""Index of a run outside every span."""
ALL_SPANS: Final = -2


class Judged(NamedTuple):
    """A run with a verdict, and the number of its day."""

    day: int
    recipe: int
    socket: int
    passed: int


History = tuple[Judged, ...]
"""Runs of a unit with a verdict, in order, without golden ones."""


class Day(NamedTuple):
    """A day in local time; begin and end in UTC."""

    number: int
    begin: str
    end: str
    month: str


StepTimes = dict[str, Counter[float]]
"""Number of each duration in seconds, by step name."""
_Times = dict[str, Counter[str]]
"""Number of each duration, as text for JSON, by step name."""
_ALL: Final = (0, 0)
"""Recipe and socket 0: the times of all."""


def rounded_s() -> ColumnElement[float]:
    """Duration of a step, rounded to three digits and at most to a millisecond."""
    duration_s = schema.step.c.duration_s
    return case(
        (duration_s < 1, func.round(duration_s * 1000) / 1000),
        (duration_s < 10, func.round(duration_s * 100) / 100),
        else_=func.round(duration_s * 10) / 10,
    )


@dataclass(frozen=True)
class Rest:
    """Runs that the sums do not include: those of a filter and further conditions."""

    chosen: RunFilter
    conditions: list[ColumnElement[bool]]


class Rollup:
    """File with the daily sums of a database of records."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._file = database.location.folder / "figures.sqlite"

    # -- adding up --------------------------------------------------------------------------------

    def add(self, now: datetime) -> bool:
        """Add a batch of missing runs; True if more are missing. Another process may do the same.

        Raises RecordError if the records cannot be read, sqlite3.Error, OSError.
        """
        self._file.touch(0o600)
        try:
            return self._add(now)
        except sqlite3.OperationalError:
            raise
        except (sqlite3.DatabaseError, zlib.error, ValueError):  # it is damaged, or none
            for left in self._file.parent.glob(f"{self._file.name}*"):
                left.unlink()
            self._file.touch(0o600)
            return self._add(now)

    def _add(self, now: datetime) -> bool:
        with closing(sqlite3.connect(self._file, timeout=0, isolation_level=None)) as sums:
            sums.execute("PRAGMA journal_mode = WAL")
            sums.execute("PRAGMA synchronous = NORMAL")
            sums.execute("BEGIN IMMEDIATE")
            with self._database.reading() as connection:
                added = _added(sums, connection)
                if added is None:
                    _recreate(sums)
                    added = _Added()
                added = added.settled_at(connection, now)
                ends = _ends(added.audit, added.settled).with_only_columns(schema.audit.c.id)
                batch = ends.order_by(schema.audit.c.id).offset(_RUNS_AT_ONCE - 1).limit(1)
                end = connection.execute(batch).scalar_one_or_none()
                last = end or added.settled
                if last > added.audit:
                    _Addition(sums, connection, added, last).add()
                    added = replace(added, audit=last)
                _save_state(sums, connection, added)
            sums.execute("COMMIT")
        return end is not None

    def keep_up(self, now: Callable[[], datetime], wait: Callable[[float], object]) -> None:
        """Add missing runs forever, at intervals."""
        while True:
            has_more = False
            try:
                has_more = self.add(now())
            except (RecordError, sqlite3.Error, OSError, ValueError) as error:
                # Another process adds runs, or the file is read-only: pages use the records.
                _LOG.info("no runs were added to %s: %s", self._file, error)
            wait(_PAUSE_S if has_more else _UNTIL_NEXT_S)

    # -- reading ----------------------------------------------------------------------------------

    @contextmanager
    def rolled(self, chosen: RunFilter) -> Iterator[Rolled | None]:
        """The sums for a filter; None if it selects more than they hold. Raises RecordError."""
        is_counted = (chosen.lot, chosen.serial, chosen.search, chosen.state, chosen.code)
        if any(each is not None for each in is_counted) or not self._file.exists():
            yield None
            return
        with self._database.reading() as connection:
            try:
                sums = sqlite3.connect(f"{self._file.resolve().as_uri()}?mode=rw", uri=True)
            except sqlite3.Error:
                yield None
                return
            with closing(sums):
                try:
                    yield _rolled(sums, connection, chosen)
                except (sqlite3.Error, zlib.error, ValueError) as error:
                    raise RecordError(
                        "The file with the daily sums is damaged.",
                        where=printable(str(self._file)),
                        cause=printable(str(error)),
                        remedy="Delete the file: it is made again from the records.",
                    ) from error


def _rolled(sums: sqlite3.Connection, connection: Connection, chosen: RunFilter) -> Rolled | None:
    try:
        sums.execute("BEGIN")
        added = _added(sums, connection)
        days = _Days(Day(*row) for row in sums.execute("SELECT * FROM day"))
    except sqlite3.Error:  # not whole, or not for this user: the records themselves are read
        return None
    if added is None or not added.audit:
        return None
    missing = connection.execute(_ends(added.audit).offset(_RUNS_AT_ONCE).limit(1))
    if missing.first() is not None:
        return None
    allowed: dict[str, set[int]] = {}
    for column, query in named_in(chosen):
        found = set(connection.execute(query).scalars())
        allowed[column.name] = allowed.get(column.name, found) & found
    return Rolled(
        sums, connection, chosen, added, days, allowed.get("recipe_id"), allowed.get("socket_id")
    )


@dataclass(frozen=True)
class _Added:
    """What the sums hold."""

    audit: int = 0
    """Id of an audit row: the sums hold the runs whose end is in it or in an earlier one. Runs of
    retired months, which have no audit rows, are in no sum: pages leave their time out.
    """
    settled: int = 0
    """Id of an audit row: none with a lower id can still be committed."""
    newest: int = 0
    """Id of the newest audit row at the time `at`; it is settled after `_ARRIVAL`."""
    at: str = ""

    def settled_at(self, connection: Connection, now: datetime) -> _Added:
        """As of now."""
        newest = connection.execute(select(func.max(schema.audit.c.id))).scalar_one() or 0
        if connection.dialect.name == "sqlite":  # one program writes at a time
            return replace(self, settled=newest)
        is_set_back = self.at > utc_text(now)
        if self.at > utc_text(now - _ARRIVAL) and not is_set_back:
            return self
        settled = self.settled if is_set_back else self.newest
        return _Added(self.audit, settled, newest, utc_text(now))

    def holds(self, run_id: ColumnElement[int]) -> ColumnElement[bool]:
        """Condition of a run that is in the sums."""
        audit = schema.audit.c
        # By the index of the run, and not through all ends.
        ends = (beside_index(audit.event).in_(ENDINGS), beside_index(audit.id) <= self.audit)
        return select(audit.id).where(audit.run_id == run_id, *ends).exists()


def _ends(after: int, until: int | None = None) -> Select[int]:
    """Ids of the runs whose end is in these audit rows."""
    audit = schema.audit.c
    query = select(audit.run_id).where(audit.id > after, audit.event.in_(ENDINGS))
    return query if until is None else query.where(audit.id <= until)


def ended_after(audit_id: int, chosen: RunFilter) -> Rest:
    """Runs of a filter whose end is in a later audit row, or that go on."""
    run = schema.run.c
    running = select(run.id).where(run.state == RunState.RUNNING.value)
    later = run.id.in_(union_all(_ends(audit_id), running))
    within = begun_in(chosen, beside_index(run.begun_at))
    return Rest(replace(chosen, since=None, until=None), [later, *within])


def _save_state(sums: sqlite3.Connection, connection: Connection, added: _Added) -> None:
    """Identify the records and what was added. In a restored copy of the records that continued
    from there, the last audit row differs.
    """
    state = {
        "layout": _LAYOUT, "records": records_id_of(connection), "added": asdict(added),
        "hash": _hash_of(connection, added), "first": _first(connection),
    }  # fmt: skip
    sums.execute("DELETE FROM state")
    sums.execute("INSERT INTO state VALUES (?)", (json.dumps(state),))


def _hash_of(connection: Connection, added: _Added) -> str | None:
    audit = schema.audit.c
    return connection.execute(select(audit.hash).where(audit.id == added.audit)).scalar()


def _first(connection: Connection) -> dict[str, str]:
    return {str(station): at for station, at in connection.execute(_FIRST) if at}


def _added(sums: sqlite3.Connection, connection: Connection) -> _Added | None:
    """What the sums hold; None if they belong to other records."""
    if not sums.execute("SELECT 1 FROM sqlite_master WHERE name = 'state'").fetchone():
        return None
    row = sums.execute("SELECT content FROM state").fetchone()
    if row is None:
        return _Added()
    found = json.loads(row[0])
    if found["layout"] != _LAYOUT or found["first"].items() - _first(connection).items():
        return None
    added = _Added(**found["added"])
    is_same = found["hash"] == _hash_of(connection, added)
    return added if is_same and found["records"] == records_id_of(connection) else None


def _recreate(sums: sqlite3.Connection) -> None:
    for (name,) in sums.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
        sums.execute(f"DROP TABLE {name}")
    for statement in _TABLES.split(";"):
        sums.execute(statement)


class _Addition:
    """Adds the runs whose end is in the next audit rows, up to `last`."""

    def __init__(
        self, sums: sqlite3.Connection, connection: Connection, added: _Added, last: int
    ) -> None:
        self._sums, self._connection, self._added = sums, connection, added
        self._ended = _ends(added.audit, last)
        self._days = _Days(Day(*row) for row in sums.execute("SELECT * FROM day"))

    def add(self) -> None:
        run = schema.run.c
        query = (
            select(
                run.id, run.unit_id, run.recipe_id, run.socket_id, run.lot_id, run.state, run.code,
                run.begun_at,
            )
            .where(run.id.in_(self._ended))
            .where(beside_index(run.kind) != RunKind.GOLDEN.value)
            .order_by(run.id)
        )  # fmt: skip
        runs = self._connection.execute(query).all()
        for row in runs:
            if self._days.find(row.begun_at) is None:
                day = self._days.make(row.begun_at)
                self._sums.execute("INSERT INTO day VALUES (?, ?, ?, ?)", day)
        self._sums.executemany(
            "INSERT INTO bad VALUES (?, ?, ?, ?, ?, ?)",
            [
                (row.begun_at, row.id, row.recipe_id, row.socket_id, row.lot_id, row.code)
                for row in runs
                if row.state not in WITHOUT_CAUSE
            ],
        )  # fmt: skip
        self._add_histories(runs)
        self._add_times({row.id: row for row in runs})

    def _add_histories(self, runs: Iterable[Any]) -> None:
        added: dict[int, dict[int, Judged]] = defaultdict(dict)
        for row in runs:
            if row.state in JUDGED:
                added[row.unit_id][row.id] = self._days.judged(row)
        before: dict[int, dict[int, Judged]] = defaultdict(dict)
        for row in _judged_runs(self._connection, added, self._added):
            if row.is_added:
                before[row.unit_id][row.id] = self._days.judged(row)
        change: Counter[History] = Counter()
        for unit_id, more in added.items():
            if unit_id in before:
                change[tuple(before[unit_id].values())] -= 1
            every = before[unit_id] | more
            change[tuple(every[run_id] for run_id in sorted(every))] += 1
        self._sums.executemany(
            "INSERT INTO history VALUES (?, ?)"
            " ON CONFLICT DO UPDATE SET units = units + excluded.units",
            [(json.dumps(runs), units) for runs, units in change.items()],
        )
        self._sums.execute("DELETE FROM history WHERE units = 0")

    def _add_times(self, runs: Mapping[int, Any]) -> None:
        step = schema.step.c
        query = select(step.run_id, step.name, rounded_s()).where(
            step.run_id.in_(self._ended), step.state == StepState.PASS.value
        )
        days = {run_id: self._days.of(row.begun_at) for run_id, row in runs.items()}
        added: dict[tuple[str, int, int], _Times] = defaultdict(lambda: defaultdict(Counter))
        for run_id, name, seconds in self._connection.execute(query):
            if run_id in runs:
                key = (str(days[run_id].number), runs[run_id].recipe_id, runs[run_id].socket_id)
                added[key][name][str(float(seconds))] += 1
        months = {str(day.number): day.month for day in days.values()}
        for (number, recipe, socket), times in list(added.items()):
            for place in ((recipe, socket), _ALL):
                _merge(added[months[number], *place], times)
            _merge(added[number, *_ALL], times)
        for key, times in added.items():
            known = self._sums.execute(
                "SELECT content FROM times WHERE (period, recipe, socket) = (?, ?, ?)", key
            ).fetchone()
            if known is not None:
                _merge(times, json.loads(zlib.decompress(known[0])))
            packed = zlib.compress(json.dumps(times).encode("utf-8"), 1)
            self._sums.execute("REPLACE INTO times VALUES (?, ?, ?, ?)", (*key, packed))


class _Days:
    """Days with runs, in order, without overlap."""

    def __init__(self, days: Iterable[Day]) -> None:
        self._days = sorted(days, key=lambda day: day.begin)
        self._begins = [day.begin for day in self._days]

    def __iter__(self) -> Iterator[Day]:
        return iter(self._days)

    def find(self, begun_at: str) -> Day | None:
        at = bisect_right(self._begins, begun_at) - 1
        return self._days[at] if at >= 0 and begun_at < self._days[at].end else None

    def of(self, begun_at: str) -> Day:
        day = self.find(begun_at)
        assert day is not None  # noqa: S101  a run that was added has its day
        return day

    def make(self, begun_at: str) -> Day:
        """Add the local day of a time; after a change of the time zone, what other days leave."""
        date = utc_moment(begun_at).astimezone().date()
        begin, end = (
            utc_text(local_moment(datetime.combine(each, time())))
            for each in (date, date + timedelta(days=1))
        )
        at = bisect_right(self._begins, begun_at)
        if at > 0:
            begin = max(begin, self._days[at - 1].end)
        if at < len(self._days):
            end = min(end, self._days[at].begin)
        day = Day(len(self._days) + 1, begin, end, f"{date:%Y-%m}")
        self._days.insert(at, day)
        self._begins.insert(at, begin)
        return day

    def judged(self, row: Any) -> Judged:
        is_passed = row.state == RunState.PASS.value
        return Judged(self.of(row.begun_at).number, row.recipe_id, row.socket_id, int(is_passed))


def _judged_runs(connection: Connection, units: Iterable[int], added: _Added) -> Iterator[Any]:
    """Runs with a verdict of some units, in order for each unit."""
    run = schema.run.c
    query = (
        select(
            run.id, run.unit_id, run.recipe_id, run.socket_id, run.state, run.begun_at,
            added.holds(run.id).label("is_added"),
        )
        .where(beside_index(run.state).in_(JUDGED))
        .where(beside_index(run.kind) != RunKind.GOLDEN.value)
        .order_by(run.unit_id, run.id)
    )  # fmt: skip
    for some in batches(units):
        yield from connection.execute(query.where(run.unit_id.in_(some)))


def _merge(into: _Times, times: Mapping[str, Mapping[str, int]]) -> None:
    for name, counts in times.items():
        into[name].update(counts)


@dataclass(frozen=True)
class Rolled:
    """The sums for a filter."""

    _sums: sqlite3.Connection
    _connection: Connection
    chosen: RunFilter
    _added: _Added
    _days: _Days
    _recipes: set[int] | None
    """Recipe ids that the filter allows; None: all."""
    _sockets: set[int] | None

    @cached_property
    def _since(self) -> str:
        return "" if self.chosen.since is None else utc_text(self.chosen.since)

    @cached_property
    def _until(self) -> str:
        return "~" if self.chosen.until is None else utc_text(self.chosen.until)

    def _allows(self, recipe: int, socket: int) -> bool:
        return (self._recipes is None or recipe in self._recipes) and (
            self._sockets is None or socket in self._sockets
        )

    def _whole(self, cuts: Sequence[str] = ()) -> list[Day]:
        """Days entirely inside the period, not cut by these times; in order."""
        return [
            day
            for day in self._days
            if self._since <= day.begin and day.end <= self._until
            if bisect_right(cuts, day.begin) == bisect_left(cuts, day.end)
        ]

    @property
    def tail(self) -> Rest:
        """Runs that are not in the sums."""
        return ended_after(self._added.audit, self.chosen)

    def _cut(self, whole: Collection[Day]) -> Iterator[Rest]:
        """Runs of days that lie only partly in the period or in a span."""
        kept = {day.number for day in whole}
        condition = self._added.holds(schema.run.c.id)
        for day in self._days:
            if day.number in kept or day.end <= self._since or day.begin >= self._until:
                continue
            since = utc_moment(max(day.begin, self._since))
            until = utc_moment(min(day.end, self._until))
            yield Rest(replace(self.chosen, since=since, until=until), [condition])

    def bad(self, column: str) -> Iterator[Any]:
        """Number of runs without PASS, by code and a column of `bad`, without the `tail`."""
        allowed = (
            None if ids is None else json.dumps(sorted(ids))
            for ids in (self._recipes, self._sockets)
        )
        return self._sums.execute(
            f"SELECT code, {column}, count(*) FROM bad"  # noqa: S608
            " WHERE begun_at >= ?1 AND begun_at < ?2"
            " AND (?3 IS NULL OR recipe_id IN (SELECT value FROM json_each(?3)))"
            " AND (?4 IS NULL OR socket_id IN (SELECT value FROM json_each(?4)))"
            f" GROUP BY code, {column}",
            (self._since, self._until, *allowed),
        )

    def _periods(self, whole: Sequence[Day]) -> Iterator[str]:
        """Keys of the sums that cover these days: whole months, and the other days."""
        in_all = Counter(day.month for day in self._days)
        months = {
            month for month, days in Counter(day.month for day in whole).items()
            if days == in_all[month]
        }  # fmt: skip
        yield from months
        yield from (str(day.number) for day in whole if day.month not in months)

    def step_times(self) -> tuple[StepTimes, list[Rest]]:
        """Number of each duration of passed steps, and the runs that are not included."""
        whole = self._whole()
        summed: _Times = defaultdict(Counter)
        is_all = self._recipes is None and self._sockets is None
        for some in batches(self._periods(whole)):
            for *place, content in self._sums.execute(
                "SELECT recipe, socket, content FROM times"
                " WHERE period IN (SELECT value FROM json_each(?)) AND (recipe = 0) = ?",
                [json.dumps(some), is_all],
            ):
                if is_all or self._allows(*place):
                    _merge(summed, json.loads(zlib.decompress(content)))
        found: StepTimes = defaultdict(Counter)
        for name, counts in summed.items():
            found[name] = Counter({float(seconds): count for seconds, count in counts.items()})
        return found, [self.tail, *self._cut(whole)]

    def units(self, spans: Sequence[tuple[str, str]]) -> dict[int, Units] | None:
        """Units of each span, by its index, and of `ALL_SPANS`; spans without units are left out.

        Spans are in order and do not overlap. None if the sums cover no whole day of them.
        """
        whole = self._whole(sorted({each for span in spans for each in span}))
        if not whole:
            return None
        begins = [begin for begin, _ in spans]

        def place_of(begun_at: str) -> int:
            at = bisect_right(begins, begun_at) - 1
            is_in = at >= 0 and self._since <= begun_at < self._until
            return at if is_in and begun_at < spans[at][1] else _NOWHERE

        found: dict[int, Units] = defaultdict(Units)
        # The history of units with further runs is read from the records.
        apart = {unit for rest in (self.tail, *self._cut(whole)) for unit in self._judged(rest)}
        counted_apart: Counter[History] = Counter()
        judged = _judged_runs(self._connection, sorted(apart), self._added)
        for _, runs in groupby(judged, key=lambda row: row.unit_id):
            history: list[Judged] = []
            placed: list[Judged] = []
            for row in runs:
                if row.is_added:
                    history.append(self._days.judged(row))
                passed = int(row.state == RunState.PASS.value)
                placed.append(Judged(place_of(row.begun_at), row.recipe_id, row.socket_id, passed))
            counted_apart[tuple(history)] += 1
            self._count(found, placed, 1)
        places = {day.number: place_of(day.begin) for day in whole}
        for text, all_units in self._sums.execute("SELECT * FROM history"):
            history = [Judged(*each) for each in json.loads(text)]
            units = all_units - counted_apart[tuple(history)]
            if units:
                placed = [run._replace(day=places.get(run.day, _NOWHERE)) for run in history]
                self._count(found, placed, units)
        return found

    def _judged(self, rest: Rest) -> Iterable[int]:
        """Ids of units with runs that the sums do not include."""
        run = schema.run.c
        query = counting(rest.chosen, run.unit_id).where(*rest.conditions)
        return self._connection.execute(query.where(beside_index(run.state).in_(JUDGED))).scalars()

    def _count(self, found: dict[int, Units], runs: Iterable[Judged], units: int) -> None:
        """Count units that all have these runs; the `day` of each run is the index of its span."""
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for at, recipe, socket, passed in runs:
            if at != _NOWHERE and self._allows(recipe, socket):
                for each in (at, ALL_SPANS):
                    first.setdefault(each, passed)
                    last[each] = passed
        for at, passed in last.items():
            found[at].units += units
            found[at].passed += units * passed
            found[at].first_passed += units * first[at]
