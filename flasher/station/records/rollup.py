"""Stores daily sums of runs, so that pages with figures need not read the runs of all years.

The sums are in a file beside the attachments and cover runs up to `Rolled.run`, without those whose
end arrived since then. These, later runs, and days that a period covers partly, are read from the
records. The file is rebuilt if it does not fit the records; nothing that is signed or verified
depends on it, and it may be deleted.
"""

from __future__ import annotations

import json
import logging
import sqlite3
import zlib
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, time, timedelta
from functools import partial
from itertools import groupby
from typing import Any, Final, NamedTuple

from sqlalchemy import Connection, and_, case, func, not_, or_, select
from sqlalchemy.sql.expression import ColumnElement

from flasher.protocol.text import printable
from flasher.station.records import schema
from flasher.station.records.chain import ENDINGS
from flasher.station.records.database import Database, records_id_of
from flasher.station.records.errors import RecordError
from flasher.station.records.filters import JUDGED, begun_in, counting, named_in
from flasher.station.records.model import (
    RunFilter,
    RunKind,
    RunState,
    StepState,
    Units,
    utc_moment,
    utc_text,
)
from flasher.station.records.rows import batches, beside_index

_LOG: Final = logging.getLogger(__name__)
_LAYOUT: Final = 4
_RUNS_AT_ONCE: Final = 5000
_PAUSE_S: Final = 0.2
"""Pause between batches, for other programs."""
_UNTIL_NEXT_S: Final = 600.0
_SETTLED: Final = timedelta(hours=1)
"""Younger runs are not added: on a server, a run with a lower id may not be committed yet."""
_ARRIVAL: Final = timedelta(minutes=10)
"""A transaction lasts less: until then a server may commit an audit row with a lower id."""
WITHOUT_CAUSE: Final = (RunState.PASS.value, RunState.RUNNING.value)
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
CREATE TABLE history (
    day INTEGER, recipe INTEGER, socket INTEGER, passed INTEGER, later TEXT, units INTEGER,
    PRIMARY KEY (day, recipe, socket, passed, later)
) WITHOUT ROWID;
CREATE TABLE bad (
    begun_at TEXT, run INTEGER, recipe_id INTEGER, socket_id INTEGER, lot_id INTEGER, state TEXT,
    code TEXT, is_virtual INTEGER, PRIMARY KEY (begun_at, run)
) WITHOUT ROWID;
CREATE TABLE passed (
    period TEXT, recipe INTEGER, socket INTEGER, is_virtual INTEGER, durations_s BLOB,
    PRIMARY KEY (period, recipe, socket, is_virtual)
) WITHOUT ROWID;
CREATE TABLE times (
    period TEXT, recipe INTEGER, socket INTEGER, content BLOB,
    PRIMARY KEY (period, recipe, socket)
) WITHOUT ROWID;
"""
"""`history`: number of units with the same runs with a verdict: the first run, and the others as
text. `bad`: runs that ended without PASS. `passed`: durations of runs with PASS, in order. `times`:
number of each duration of a step, by day (its number) or month."""


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
_Chosen = Callable[[ColumnElement[int]], ColumnElement[bool]]
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


@dataclass
class EndCounts:
    """Counts of runs by how they ended."""

    by_state: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    """Number of runs by code."""
    virtual_runs: int = 0
    durations_s: list[float] = field(default_factory=list)
    """Durations of runs with PASS."""

    def add(
        self, state: str, code: str, is_virtual: int, duration_s: float | None, runs: int = 1
    ) -> None:
        """Add `runs` runs without PASS, or one run with PASS."""
        self.by_state[state] += runs
        self.virtual_runs += bool(is_virtual) * runs
        if state == RunState.PASS.value:
            self.durations_s.append(duration_s or 0.0)
        elif state != RunState.RUNNING.value:
            self.failures[code] += runs


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
                    added = _NOTHING
                marks = added.marks.moved(connection, now)
                due = [each.audit for each in added.late if each.audit <= marks.settled]
                last, has_more = added.run, bool(due)
                if due:
                    chosen = partial(_ended_in, added.marks.settled, due[-1], last)
                    marks = replace(added.marks, settled=due[-1])
                    _Addition(sums, connection, added, chosen).add()
                elif marks.settled:
                    last, has_more = _last_to_add(connection, added.run, now)
                    if last > added.run:
                        chosen = partial(_begun_in, added.run, last, marks.settled)
                        _Addition(sums, connection, added, chosen).add()
                _save_state(sums, connection, last, marks)
            sums.execute("COMMIT")
        return has_more

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
    if added is None or not added.run or len(added.late) >= _RUNS_AT_ONCE:
        return None
    allowed: dict[str, set[int]] = {}
    for column, query in named_in(chosen):
        found = set(connection.execute(query).scalars())
        allowed[column.name] = allowed.get(column.name, found) & found
    return Rolled(
        sums, connection, chosen, added, days, allowed.get("recipe_id"), allowed.get("socket_id")
    )


class _Late(NamedTuple):
    """A run of which the end arrived after later runs were added, as from a station that was off
    line, and the audit row with that end.
    """

    audit: int
    run: int


@dataclass(frozen=True)
class _Marks:
    """Audit rows up to which the ends of runs are in the sums."""

    settled: int = 0
    """Id of an audit row: none with a lower id can still be committed. The sums hold no run whose
    end is in a later one. 0: not known yet."""
    newest: int = 0
    """Id of the newest audit row at the time `at`; it is settled after `_ARRIVAL`."""
    at: str = ""

    def moved(self, connection: Connection, now: datetime) -> _Marks:
        """As of now."""
        newest = connection.execute(select(func.max(schema.audit.c.id))).scalar_one() or 0
        if connection.dialect.name == "sqlite":  # one program writes at a time
            return _Marks(newest)
        if self.at > utc_text(now):  # the clock was set back
            return _Marks(self.settled, newest, utc_text(now))
        if self.at > utc_text(now - _ARRIVAL):
            return self
        return _Marks(self.newest, newest, utc_text(now))


class _Added(NamedTuple):
    """What the sums hold: the runs up to `run`, without those in `late`."""

    run: int
    marks: _Marks
    late: tuple[_Late, ...]
    """In the order in which they arrived, the first `_RUNS_AT_ONCE`."""

    def is_late(self, run_id: ColumnElement[int]) -> ColumnElement[bool]:
        """Condition of the late runs."""
        return _ended_in(self.marks.settled, None, self.run, run_id)

    def holds(self, run_id: ColumnElement[int]) -> ColumnElement[bool]:
        """Condition of runs that are in the sums."""
        is_before = run_id <= self.run
        return and_(is_before, not_(self.is_late(run_id))) if self.late else is_before


_NOTHING: Final = _Added(0, _Marks(), ())


def _ended_in(
    after: int, until: int | None, last: int, run_id: ColumnElement[int]
) -> ColumnElement[bool]:
    """Condition of runs up to `last` whose end is in these audit rows."""
    audit = schema.audit.c
    ends = select(audit.run_id).where(
        audit.id > after, audit.event.in_(ENDINGS), audit.run_id <= last
    )
    return run_id.in_(ends if until is None else ends.where(audit.id <= until))


def _begun_in(
    after: int, last: int, settled: int, run_id: ColumnElement[int]
) -> ColumnElement[bool]:
    """Condition of runs after one and up to `last`, that did not end after `settled`."""
    return and_(run_id > after, run_id <= last, not_(_ended_in(settled, None, last, run_id)))


def _save_state(sums: sqlite3.Connection, connection: Connection, run: int, marks: _Marks) -> None:
    """Identify the records, the last added run, and the newest audit row. The row differs in a
    restored copy of the records that continued from there.
    """
    audit = schema.audit.c
    newest = select(audit.id, audit.hash).order_by(audit.id.desc()).limit(1)
    row = connection.execute(newest).one()
    state = {
        "layout": _LAYOUT, "records": records_id_of(connection), "run": run, "audit": row.id,
        "hash": row.hash, "first": _first(connection), "marks": asdict(marks),
    }  # fmt: skip
    sums.execute("DELETE FROM state")
    sums.execute("INSERT INTO state VALUES (?)", (json.dumps(state),))


def _first(connection: Connection) -> dict[str, str]:
    return {str(station): at for station, at in connection.execute(_FIRST) if at}


def _added(sums: sqlite3.Connection, connection: Connection) -> _Added | None:
    """What the sums hold; None if they belong to other records."""
    if not sums.execute("SELECT 1 FROM sqlite_master WHERE name = 'state'").fetchone():
        return None
    row = sums.execute("SELECT content FROM state").fetchone()
    if row is None:
        return _NOTHING
    found = json.loads(row[0])
    if found["layout"] != _LAYOUT or found["first"].items() - _first(connection).items():
        return None
    audit = schema.audit.c
    is_same = select(audit.id).where(audit.id == found["audit"], audit.hash == found["hash"])
    if connection.execute(is_same).first() is None or found["records"] != records_id_of(connection):
        return None
    marks = _Marks(**found["marks"])
    late = select(audit.id, audit.run_id).where(
        audit.id > marks.settled, audit.event.in_(ENDINGS), audit.run_id <= found["run"]
    )
    rows = connection.execute(late.order_by(audit.id).limit(_RUNS_AT_ONCE)).all()
    return _Added(int(found["run"]), marks, tuple(_Late(*row) for row in rows))


def _recreate(sums: sqlite3.Connection) -> None:
    for (name,) in sums.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
        sums.execute(f"DROP TABLE {name}")
    for statement in _TABLES.split(";"):
        sums.execute(statement)


def _last_to_add(connection: Connection, begun: int, now: datetime) -> tuple[int, bool]:
    """Id of the last run of a batch that may be added: its day is over and every earlier run has
    ended. True if more runs follow the batch.
    """
    run = schema.run.c
    today = datetime.combine(now.astimezone(), time()).astimezone()
    over = utc_text(min(today, now - _SETTLED))
    newest = (
        select(run.id)
        .where(run.id > begun, beside_index(run.begun_at) < over)
        .order_by(run.id.desc())
        .limit(1)
    )
    last = connection.execute(newest).scalar_one_or_none() or begun
    running = select(func.min(beside_index(run.id))).where(
        run.state == RunState.RUNNING.value, run.id > begun
    )
    first_running = connection.execute(running).scalar_one_or_none()
    if first_running is not None:
        last = min(last, first_running - 1)
    # A plant's database leaves gaps between ids.
    batch = select(run.id).where(run.id > begun).order_by(run.id).offset(_RUNS_AT_ONCE - 1)
    end = connection.execute(batch.limit(1)).scalar_one_or_none()
    return (last, False) if end is None or last < end else (end, True)


class _Addition:
    """Adds runs to the sums; `chosen` makes the condition of their ids."""

    def __init__(
        self, sums: sqlite3.Connection, connection: Connection, added: _Added, chosen: _Chosen
    ) -> None:
        self._sums, self._connection = sums, connection
        self._added, self._chosen = added, chosen
        self._days = _Days(Day(*row) for row in sums.execute("SELECT * FROM day"))

    def add(self) -> None:
        run = schema.run.c
        query = (
            select(
                run.id, run.unit_id, run.recipe_id, run.socket_id, run.lot_id, run.state, run.code,
                run.begun_at, run.is_virtual,
                (run.ended_monotonic_s - run.begun_monotonic_s).label("duration_s"),
            )
            .where(self._chosen(run.id))
            .where(beside_index(run.kind) != RunKind.GOLDEN.value)
            .order_by(run.id)
        )  # fmt: skip
        runs = self._connection.execute(query).all()
        for row in runs:
            if self._days.find(row.begun_at) is None:
                day = self._days.make(row.begun_at)
                self._sums.execute("INSERT INTO day VALUES (?, ?, ?, ?)", day)
        self._sums.executemany(
            "INSERT INTO bad VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            [
                (
                    row.begun_at, row.id, row.recipe_id, row.socket_id, row.lot_id, row.state,
                    row.code, row.is_virtual,
                )
                for row in runs
                if row.state not in WITHOUT_CAUSE
            ],
        )  # fmt: skip
        self._add_histories(runs)
        self._add_passed(runs)
        self._add_times({row.id: row for row in runs})

    def _add_histories(self, runs: Iterable[Any]) -> None:
        added: dict[int, dict[int, Judged]] = defaultdict(dict)
        for row in runs:
            if row.state in JUDGED:
                added[row.unit_id][row.id] = self._days.judged(row)
        before: dict[int, dict[int, Judged]] = defaultdict(dict)
        for row in _judged_runs(self._connection, added, self._added.holds(schema.run.c.id)):
            before[row.unit_id][row.id] = self._days.judged(row)
        change: Counter[History] = Counter()
        for unit_id, more in added.items():
            if unit_id in before:
                change[tuple(before[unit_id].values())] -= 1
            every = before[unit_id] | more
            change[tuple(every[run_id] for run_id in sorted(every))] += 1
        self._sums.executemany(
            "INSERT INTO history VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE"
            " SET units = units + excluded.units",
            [(*first, _text_of(later), units) for (first, *later), units in change.items()],
        )
        self._sums.executemany(
            "DELETE FROM history WHERE units = 0"
            " AND (day, recipe, socket, passed, later) = (?, ?, ?, ?, ?)",
            [(*first, _text_of(later)) for (first, *later), units in change.items() if units < 0],
        )

    def _add_passed(self, runs: Iterable[Any]) -> None:
        added: dict[tuple[str, int, int, bool], list[float]] = defaultdict(list)
        for row in runs:
            if row.state == RunState.PASS.value:
                day = self._days.of(row.begun_at)
                for period in (str(day.number), day.month):
                    key = (period, row.recipe_id, row.socket_id, bool(row.is_virtual))
                    added[key].append(row.duration_s)
        for key, durations_s in added.items():
            known = self._sums.execute(
                "SELECT durations_s FROM passed"
                " WHERE (period, recipe, socket, is_virtual) = (?, ?, ?, ?)",
                key,
            ).fetchone()
            every = sorted(durations_s if known is None else [*_seconds(known[0]), *durations_s])
            packed = array("d", every).tobytes()
            self._sums.execute("REPLACE INTO passed VALUES (?, ?, ?, ?, ?)", (*key, packed))

    def _add_times(self, runs: Mapping[int, Any]) -> None:
        step = schema.step.c
        query = select(step.run_id, step.name, rounded_s()).where(
            self._chosen(step.run_id),
            step.state == StepState.PASS.value,
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
            utc_text(datetime.combine(each, time()).astimezone())
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


def _judged_runs(
    connection: Connection, units: Iterable[int], *conditions: ColumnElement[bool]
) -> Iterator[Any]:
    """Runs with a verdict of some units, in order for each unit."""
    run = schema.run.c
    query = (
        select(run.id, run.unit_id, run.recipe_id, run.socket_id, run.state, run.begun_at)
        .where(beside_index(run.state).in_(JUDGED), *conditions)
        .where(beside_index(run.kind) != RunKind.GOLDEN.value)
        .order_by(run.unit_id, run.id)
    )
    for some in batches(units):
        yield from connection.execute(query.where(run.unit_id.in_(some)))


def _text_of(later: Iterable[Judged]) -> str:
    return ";".join(",".join(map(str, each)) for each in later)


def _later(text: str) -> Iterator[Judged]:
    for each in text.split(";") if text else ():
        day, recipe, socket, passed = map(int, each.split(","))
        yield Judged(day, recipe, socket, passed)


def _seconds(packed: bytes) -> array[float]:
    found = array("d")
    found.frombytes(packed)
    return found


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
    _since: str = field(init=False)
    _until: str = field(init=False)

    def __post_init__(self) -> None:
        since, until = self.chosen.since, self.chosen.until
        object.__setattr__(self, "_since", "" if since is None else utc_text(since))
        object.__setattr__(self, "_until", "~" if until is None else utc_text(until))

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
    def run(self) -> int:
        """Id of the last run in the sums."""
        return self._added.run

    @property
    def tail(self) -> Rest:
        """Runs that were added to the records later."""
        run_id = schema.run.c.id
        later = run_id > self.run
        if self._added.late:
            later = or_(later, self._added.is_late(run_id))
        within = begun_in(self.chosen, beside_index(schema.run.c.begun_at))
        chosen = replace(self.chosen, since=None, until=None)
        return Rest(chosen, [later, *within])

    def _cut(self, whole: Collection[Day]) -> Iterator[Rest]:
        """Runs of days that lie only partly in the period or in a span."""
        kept = {day.number for day in whole}
        condition = self._added.holds(beside_index(schema.run.c.id))
        for day in self._days:
            if day.number in kept or day.end <= self._since or day.begin >= self._until:
                continue
            since = utc_moment(max(day.begin, self._since))
            until = utc_moment(min(day.end, self._until))
            yield Rest(replace(self.chosen, since=since, until=until), [condition])

    def bad(self, *columns: str) -> Iterator[Any]:
        """Numbers of runs without PASS, by columns of the table `bad`, without the `tail`."""
        allowed = (
            None if ids is None else json.dumps(sorted(ids))
            for ids in (self._recipes, self._sockets)
        )
        names = ", ".join(columns)
        return self._sums.execute(
            f"SELECT {names}, count(*) FROM bad"  # noqa: S608
            " WHERE begun_at >= ?1 AND begun_at < ?2"
            " AND (?3 IS NULL OR recipe_id IN (SELECT value FROM json_each(?3)))"
            " AND (?4 IS NULL OR socket_id IN (SELECT value FROM json_each(?4)))"
            f" GROUP BY {names}",
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

    def add_ends(self, counts: EndCounts) -> list[Rest]:
        """Add counts of how runs ended; returns the runs that are not included."""
        whole = self._whole()
        for state, code, is_virtual, runs in self.bad("state", "code", "is_virtual"):
            counts.add(state, code, is_virtual, None, runs)
        for some in batches(self._periods(whole)):
            for *place, is_virtual, packed in self._sums.execute(
                "SELECT recipe, socket, is_virtual, durations_s FROM passed"
                " WHERE period IN (SELECT value FROM json_each(?))",
                [json.dumps(some)],
            ):
                if self._allows(*place):
                    durations_s = _seconds(packed)
                    counts.durations_s.extend(durations_s)
                    counts.by_state[RunState.PASS.value] += len(durations_s)
                    counts.virtual_runs += is_virtual * len(durations_s)
        only_passed = beside_index(schema.run.c.state) == RunState.PASS.value
        cut = [
            replace(rest, conditions=[*rest.conditions, only_passed]) for rest in self._cut(whole)
        ]
        return [self.tail, *cut]

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

    def all_units(self) -> Units | None:
        """Units of the whole period; None if the sums cover no whole day."""
        found = self.units([("", "~")])
        return None if found is None else found.get(ALL_SPANS, Units())

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
        late = {each.run for each in self._added.late}
        for _, runs in groupby(
            _judged_runs(self._connection, sorted(apart)), key=lambda row: row.unit_id
        ):
            history: list[Judged] = []
            placed: list[Judged] = []
            for row in runs:
                if row.id <= self.run and row.id not in late:
                    history.append(self._days.judged(row))
                passed = int(row.state == RunState.PASS.value)
                placed.append(Judged(place_of(row.begun_at), row.recipe_id, row.socket_id, passed))
            counted_apart[tuple(history)] += 1
            self._count(found, placed, 1)
        places = {day.number: place_of(day.begin) for day in whole}
        for *first, text, all_units in self._sums.execute("SELECT * FROM history"):
            history = [Judged(*first), *_later(text)]
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
