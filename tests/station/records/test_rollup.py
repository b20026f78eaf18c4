# ruff: noqa: S608  all of this SQL is written here
"""Sums of days: what a page shows from them is what the records themselves say."""

from __future__ import annotations

import random
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, func, insert, select, text

from flasher.station.records import rollup, schema
from flasher.station.records.chain import FINISHED
from flasher.station.records.database import Database, locate
from flasher.station.records.errors import RecordError
from flasher.station.records.model import RunFilter, RunKind, RunState, utc_moment, utc_text
from flasher.station.records.overview import By, Overview
from flasher.station.records.rollup import Rollup, _Days
from flasher.station.records.store import Store
from flasher.station.records.yields import Span
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.supervisor import shifts_of, spans_of
from tests.loops import each, sample
from tests.plant.factory import Plant
from tests.station.factory import Bench
from tests.station.postgres import OWNER
from tests.zones import in_zone

BEGIN = datetime(2026, 3, 27, 20, tzinfo=UTC)
"""Before a night in which clocks are set forward in Europe, and a month ends."""
DAYS = 6
NOW = BEGIN + timedelta(days=DAYS + 3)
ENDED = ("PASS", "FAIL", "PASS", "PASS", "ERROR", "ABORTED", "INTERRUPTED")


@dataclass
class Lines:
    """Random runs of two sockets, two recipes, some lots; units come again, days later too."""

    database: Database
    chance: random.Random
    runs: int = 1

    def add(self, count: int) -> None:
        """Add runs of any order in time, past the rules of the database."""
        self.add_numbers(range(self.runs + 1, self.runs + 1 + count))

    def add_numbers(self, numbers: Sequence[int]) -> None:
        """The audit rows of their ends are in an order of their own."""
        with self.database.engine.connect() as connection:
            is_server = connection.dialect.name == "postgresql"
            if is_server:
                connection.exec_driver_sql("SET session_replication_role = replica")
            rules = self._rules(connection)
            if not is_server:
                for name, _ in rules:
                    connection.exec_driver_sql(f"DROP TRIGGER {name}")
            like = dict(
                connection.execute(select(schema.run).where(schema.run.c.id == 1)).mappings().one()
            )
            for number in numbers:
                self._add(connection, like, number)
            for number in self.chance.sample(numbers, len(numbers)):
                self._add_end(connection, number)
            for _, statement in rules if not is_server else ():
                connection.exec_driver_sql(statement)
            connection.commit()
        self.runs = max(self.runs, *numbers)

    @staticmethod
    def _add_end(connection: Connection, run_id: int) -> None:
        """Only what the sums read of it is right."""
        if connection.dialect.name == "postgresql":
            columns = "station, at, run_number, data, signature, station_id, previous_hash"
            connection.exec_driver_sql(
                f"INSERT INTO chain_row ({columns}, number, event, run_id, hash)"
                f" SELECT {columns}, number + 1, '{FINISHED}', {run_id}, '{run_id:064x}'"
                " FROM chain_row ORDER BY id DESC LIMIT 1"
            )
            return
        audit = schema.audit
        last = connection.execute(select(audit).order_by(audit.c.id.desc()).limit(1)).mappings()
        values = {name: value for name, value in last.one().items() if name != "id"}
        facts = {"event": FINISHED, "run_id": run_id, "number": values["number"] + 1}
        hashes = {"previous_hash": values["hash"], "hash": f"{run_id:064x}"}
        connection.execute(insert(audit).values(**values | facts | hashes))

    @staticmethod
    def _rules(connection: Any) -> list[tuple[str, str]]:
        if connection.dialect.name == "postgresql":
            return []
        query = text("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
        return [(name, sql) for name, sql in connection.execute(query)]

    def _add(self, connection: Any, like: dict[str, Any], number: int) -> None:
        chance = self.chance
        state = chance.choice(ENDED)
        at = (
            BEGIN
            + timedelta(days=DAYS * number / 400)
            + timedelta(hours=chance.choice((0, 0, 0, -30, 1)))
        )
        connection.execute(
            insert(schema.run).values(
                **{
                    **like, "id": number, "unit_id": chance.randint(1, 60),
                    "socket_id": chance.randint(1, 2), "recipe_id": chance.randint(1, 2),
                    "lot_id": chance.choice((None, 1, 2)), "state": state,
                    "code": "OK" if state == "PASS" else chance.choice(("NO_ANSWER", "REFUSED")),
                    "is_virtual": chance.random() < 0.5,
                    "begun_monotonic_s": 0.1,
                    "ended_monotonic_s": 0.1 + chance.lognormvariate(2, 1),
                    "kind": RunKind.GOLDEN.value if chance.random() < 0.1 else "production",
                    "begun_at": utc_text(at), "ended_at": utc_text(at + timedelta(hours=5)),
                }
            )
        )  # fmt: skip
        for position, name in enumerate(("flash", "verify"), 1):
            connection.execute(
                insert(schema.step).values(
                    run_id=number, position=position, name=name, try_number=1,
                    state=chance.choice(("PASS", "PASS", "FAIL")), code="", text="",
                    begun_at=utc_text(at), begun_monotonic_s=0.0,
                    duration_s=chance.lognormvariate(position, 1.0),
                )
            )  # fmt: skip


def name_things(database: Database) -> None:
    """A second socket and recipe, lots, units."""
    with database.engine.connect() as connection:
        recipe = dict(connection.execute(select(schema.recipe)).mappings().one())
        connection.execute(insert(schema.socket).values(id=2, station_id=1, name="B"))
        connection.execute(
            insert(schema.recipe).values(
                **{**recipe, "id": 2, "name": "Other", "part": "BAT-48", "sha256": "5" * 64}
            )
        )
        for number in (1, 2):
            connection.execute(
                insert(schema.lot).values(id=number, part="BAT-36", name=f"L{number}")
            )
        for number in range(2, 61):
            connection.execute(
                insert(schema.unit).values(id=number, part="BAT-36", serial=f"U{number}")
            )
        connection.commit()


def filters() -> Iterator[dict[str, Any]]:
    yield {}
    yield {"recipe": "Other", "socket": "B"}
    yield {"part": "BAT-36"}
    yield {"lot": "lot 1"}
    yield {"socket": "nowhere"}


def periods(chance: random.Random) -> Iterator[Span]:
    midnight = BEGIN.astimezone().replace(hour=0, minute=0)
    around = timedelta(days=sample(9, 40))
    yield Span(midnight - around, midnight + around)
    begin = BEGIN + timedelta(hours=chance.randint(-30, 40), minutes=chance.randint(0, 59))
    yield Span(begin, begin + timedelta(hours=chance.randint(60, 130)))
    yield Span(begin, begin + timedelta(hours=chance.randint(1, 40)))


def figures_of(overview: Overview, chance: random.Random) -> list[Any]:
    """Everything that pages of figures show, for filters and periods."""
    found: list[Any] = []
    for span in periods(chance):
        shifts = list(shifts_of(span, DEFAULT_SHIFTS))
        for words in chance.sample(list(filters()), sample(1, 2)):
            chosen = RunFilter(since=span.begin, until=span.end, **words)
            found.append(
                [overview.yields(chosen, spans) for spans in ([span], list(spans_of(span)))]
            )
            found.append([overview.causes(chosen, by, shifts) for by in By])
            found.append(overview.step_times(chosen))
    found += [overview.step_times(RunFilter()), overview.causes(RunFilter(), By.RECIPE)]
    return found


def check(lines: Lines) -> None:
    """Compare the sums, as they are, with the records."""
    database = lines.database
    seed = lines.chance.random()
    found = []
    for file in (Rollup(database)._file, Path("nowhere")):
        overview = Overview(database)
        overview._rollup._file = file
        found.append(figures_of(overview, random.Random(seed)))
    assert found[0] == found[1]


@pytest.fixture(
    params=[("Europe/Berlin", "sqlite"), ("Asia/Kathmandu", "postgresql")], ids=lambda pair: pair[1]
)
def lines(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Lines]:
    zone, backend = request.param
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    monkeypatch.setattr(rollup, "_RUNS_AT_ONCE", 90)
    made = of_a_plant(request, tmp_path) if backend == "postgresql" else of_a_station(tmp_path)
    with made as database:
        name_things(database)
        yield Lines(database, random.Random(zone))
    monkeypatch.undo()
    time.tzset()


@contextmanager
def of_a_station(folder: Path) -> Iterator[Database]:
    """Records with a run."""
    bench = Bench(folder)
    bench.make(RunState.PASS, "W2605001")
    with closing(bench.store):
        yield bench.store.database


@contextmanager
def of_a_plant(request: pytest.FixtureRequest, folder: Path) -> Iterator[Database]:
    """A plant's database with a run, for its owner."""
    plant = Plant(request.getfixturevalue("postgres"), folder)
    with closing(plant.sender("line-2")) as sender:
        sender.bench.make(RunState.PASS, "W2605001")
        sender.send()
    database = Database(locate(plant.url(OWNER), folder / "desk"), 5.0)
    database.location.folder.mkdir()
    with closing(database), database.engine.connect() as connection:
        connection.exec_driver_sql("SET session_replication_role = replica")
        connection.exec_driver_sql("UPDATE run SET id = 1")  # as that of a station
        connection.exec_driver_sql("UPDATE chain_row SET run_id = 1 WHERE run_id IS NOT NULL")
        for table in ("run_target", "step", "device_write", "attachment"):
            of_run = schema.metadata.tables[table]
            connection.execute(of_run.update().values(run_id=1))
        connection.commit()
        yield database


def add_up(lines: Lines, now: datetime = NOW) -> None:
    sums = Rollup(lines.database)
    for at in (now, now + rollup._ARRIVAL):  # at first a server's audit rows have to settle
        while sums.add(at):
            pass


def summed(records: Lines | Store) -> int | None:
    """Number of runs in the sums; None where the records do not use them."""
    with Rollup(records.database).rolled(RunFilter()) as rolled:
        if rolled is None:
            return None
        query = (
            select(func.count()).select_from(schema.run).where(rolled._added.holds(schema.run.c.id))
        )
        return rolled._connection.execute(query).scalar_one()


@pytest.mark.slow
def test_sums_and_records_give_the_same_figures(lines: Lines) -> None:
    lines.add(300)
    add_up(lines)
    check(lines)
    lines.add(80)
    check(lines)
    add_up(lines)
    assert summed(lines) == lines.runs
    check(lines)
    lines.add(20)
    check(lines)


@pytest.mark.slow
@pytest.mark.parametrize("lines", [("Europe/Berlin", "sqlite")], indirect=True)
def test_runs_that_arrive_late_are_added_to_the_days_that_they_touch(
    lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = lines.chance.sample(range(2, 301), 60)
    lines.add_numbers([number for number in range(2, 301) if number not in late])
    add_up(lines)
    lines.add_numbers(late[:50])
    check(lines)
    sums = Rollup(lines.database)
    with monkeypatch.context() as patched:
        patched.setattr(rollup, "_recreate", None)
        patched.setattr(rollup, "_RUNS_AT_ONCE", 20)
        for _ in range(2):
            assert sums.add(NOW)
            check(lines)
        lines.add_numbers(late[50:])
        add_up(lines)
        assert summed(lines) == lines.runs
        check(lines)


@each(
    "zone, begun_at",
    [
        ("America/Santiago", "2026-09-06T03:30:00.000000Z"),
        ("Europe/Berlin", "2026-03-29T00:59:59.999999Z"),
        ("Europe/Berlin", "2026-10-25T23:00:00.000000Z"),
        ("Australia/Lord_Howe", "2026-10-03T15:15:00.000000Z"),
    ],
)
def test_a_run_is_in_its_day_when_the_clock_is_changed(zone: str, begun_at: str) -> None:
    """In Santiago the day of the change has no midnight."""
    with in_zone(zone):
        days = _Days([])
        for moment in (begun_at, utc_text(utc_moment(begun_at) + timedelta(hours=25))):
            assert days.make(moment) == days.of(moment)


@pytest.mark.slow
@pytest.mark.parametrize("lines", [("Europe/Berlin", "sqlite")], indirect=True)
def test_days_of_a_clock_in_another_zone_are_cut(
    lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines.add(150)
    add_up(lines)
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    check(lines)
    lines.add(150)
    add_up(lines)
    check(lines)


# -- what is not in the sums, and sums of other records --------------------------------------------


def make_four(bench: Bench) -> None:
    for number in range(1, 5):
        bench.make(RunState.PASS, f"W260500{number}")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Four runs of a day."""
    made = Bench(tmp_path, grow=make_four)
    yield made
    made.store.close()


@pytest.fixture
def made(bench: Bench) -> Lines:
    return Lines(bench.store.database, random.Random(1), runs=4)


@pytest.mark.slow
def test_a_day_that_goes_on_is_read_from_the_records_after_its_last_sum(
    made: Lines, bench: Bench
) -> None:
    add_up(made, bench.clock.now)
    bench.make(RunState.FAIL, "W2605005")
    assert summed(made) == 4
    check(made)
    add_up(made, bench.clock.now)
    assert summed(made) == 5
    check(made)


@pytest.mark.slow
def test_a_run_that_goes_on_is_in_no_sum(made: Lines, bench: Bench) -> None:
    run_id = bench.claim("W2605005").run_id
    bench.make(RunState.PASS, "W2605006", "B")
    later = bench.clock.now + timedelta(days=2)
    add_up(made, later)
    assert summed(made) == 5
    check(made)
    bench.work(run_id)
    bench.store.finish(run_id, bench.ending(trace=bench.traced("W2605005")))
    check(made)
    add_up(made, later)
    assert summed(made) == 6
    check(made)


@pytest.mark.slow
def test_sums_of_records_that_were_restored_are_made_anew(made: Lines, bench: Bench) -> None:
    backup = bench.folder / "backup.sqlite"
    bench.store.backup(backup)
    bench.make(RunState.PASS, "W2605005")
    later = bench.clock.now + timedelta(days=2)
    add_up(made, later)
    assert summed(made) == 5
    bench.store.close()
    bench.path.with_name(bench.path.name + "-wal").unlink(missing_ok=True)
    bench.path.write_bytes(backup.read_bytes())
    bench.store = bench.opened()
    assert summed(made) is None
    add_up(made, later)
    assert summed(made) == 4


@pytest.mark.parametrize("content", [b"", b"no database" * 500])
def test_a_file_that_holds_no_sums_is_no_obstacle(
    made: Lines, bench: Bench, content: bytes
) -> None:
    file = bench.store.files.folder / "figures.sqlite"
    file.write_bytes(content)
    assert summed(made) is None
    add_up(made, bench.clock.now + timedelta(days=2))
    assert summed(made) == 4


def test_sums_that_are_damaged_are_named_with_what_to_do(made: Lines, bench: Bench) -> None:
    add_up(made, bench.clock.now + timedelta(days=2))
    file = bench.store.files.folder / "figures.sqlite"
    with closing(sqlite3.connect(file)) as damaged:
        damaged.execute("UPDATE times SET content = x'00'")
        damaged.commit()
    with pytest.raises(RecordError, match="Delete the file") as found:
        Overview(bench.store.database).step_times(RunFilter())
    assert found.value.where == str(file)


def test_sums_of_which_no_one_knows_the_end_are_made_anew(made: Lines, bench: Bench) -> None:
    later = bench.clock.now + timedelta(days=2)
    add_up(made, later)
    file = bench.store.files.folder / "figures.sqlite"
    with closing(sqlite3.connect(file)) as damaged:
        damaged.execute("UPDATE state SET content = '{'")
        damaged.commit()
    with pytest.raises(RecordError, match="damaged"):
        summed(made)
    add_up(made, later)
    assert summed(made) == 4


def test_a_folder_that_is_not_there_is_not_made(bench: Bench) -> None:
    sums = Rollup(bench.store.database)
    sums._file = bench.folder / "nowhere" / "figures.sqlite"
    with pytest.raises(OSError, match="nowhere"):
        sums.add(NOW)


def test_a_process_adds_until_nothing_is_missing_and_again_later(
    made: Lines, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollup, "_RUNS_AT_ONCE", 2)
    waited: list[float] = []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 5:
            raise TimeoutError

    later = bench.clock.now + timedelta(days=2)
    with pytest.raises(TimeoutError):
        Rollup(bench.store.database).keep_up(lambda: later, wait)
    assert [seconds < 1 for seconds in waited] == [True, True, False, False, False]
    assert summed(made) == 4


def test_a_process_goes_on_where_another_one_adds(made: Lines, bench: Bench) -> None:
    later = bench.clock.now + timedelta(days=2)
    add_up(made, later)
    file = bench.store.files.folder / "figures.sqlite"
    with closing(sqlite3.connect(file, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(TimeoutError):
            Rollup(bench.store.database).keep_up(lambda: later, _end)
        assert summed(made) == 4


def _end(_seconds: float) -> None:
    raise TimeoutError
