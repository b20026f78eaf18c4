"""`flasher plant retire`: months go to files that prove what they hold, and nothing is lost."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from sqlalchemy import text

from flasher.errors import FlasherError, UsageError
from flasher.plant import archive, retire
from flasher.plant.archive import month_after
from flasher.plant.archive_check import ArchiveExaminer
from flasher.plant.central import Central
from flasher.plant.deliveries import Answer, Deliveries, DeliveryState, parse_key
from flasher.plant.delivery_list import DeliveryFilter, deliveries_of
from flasher.plant.retire import ArchiveRefusedError, RetiredMonth, Retirement, month_before
from flasher.plant.store import PlantStore
from flasher.plant.verify import PlantExamination, PlantExaminer
from flasher.station.records.errors import RecordError
from flasher.station.records.model import Admission, Order, RunFilter, RunState
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from tests.plant.factory import READER, Plant, Sender
from tests.station.postgres import OWNER, Server

MONTH_S = 31 * 86_400.0


def make_three_months(plant: Plant, sender: Sender) -> None:
    """A unit that fails in May and passes in June, another one in each month, two stations."""
    other = plant.sender("line-3")
    other.bench.make(serial="W2605009")
    sender.bench.make(RunState.FAIL, "W2605002")
    sender.bench.make(serial="W2605003")
    sender.bench.clock.go_on(MONTH_S)
    sender.bench.make(serial="W2605002")
    sender.bench.make(serial="W2605004")
    sender.bench.clock.go_on(MONTH_S)
    sender.bench.make(serial="W2605005")
    other.bench.clock.go_on(2 * MONTH_S)
    other.bench.make(serial="W2605008")
    for each in (sender, other):
        each.send()
    other.close()


@pytest.fixture(scope="module")
def sent_months(postgres: Server, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The database of `three_months`, made once: sending takes ten times as long as a copy."""
    plant = Plant(postgres, tmp_path_factory.mktemp("plant"))
    with closing(plant.sender("line-2")) as sender:
        make_three_months(plant, sender)
    return plant.database


@pytest.fixture(scope="module")
def without_may(
    postgres: Server, tmp_path_factory: pytest.TempPathFactory, sent_months: str
) -> Plant:
    """The first month is retired; no test changes this one."""
    plant = Plant(postgres, tmp_path_factory.mktemp("plant"), sent_months)
    retired(plant, "2026-06")
    return plant


@pytest.fixture
def three_months(postgres: Server, tmp_path: Path, sent_months: str) -> Iterator[Plant]:
    made = Plant(postgres, tmp_path, sent_months)
    yield made
    made.drop()


@contextmanager
def retirement(plant: Plant, role: str = OWNER) -> Iterator[Retirement]:
    url = plant.url(role)
    with closing(Central(url)) as central:
        yield Retirement(central, plant.folder / "archive")


def retired(plant: Plant, before: str, *, with_problems: bool = False) -> list[RetiredMonth]:
    with retirement(plant) as made:
        return list(made.retire(before, with_problems=with_problems))


def opened(plant: Plant) -> PlantStore:
    url = plant.url(READER)
    return PlantStore.open(url, station="desk", folder=plant.folder / "desk", read_only=True)


def examined(plant: Plant, archives: Path | None) -> PlantExamination:
    with closing(opened(plant)) as store:
        return PlantExaminer(store, lambda _done, _total: None, archives).examine_plant()


def holders(plant: Plant) -> list[tuple[str, bool]]:
    with closing(opened(plant)) as store:
        overview = Overview(store.database)
        (image,) = overview.images("V1r0r4_20220512")
        found = overview.holders(image.sha256, PageCursor()).rows
        return sorted((unit.serial, unit.is_confirmed) for unit in found)


def counts(plant: Plant) -> dict[str, int]:
    tables = ("chain_row", "run", "step", "attachment", "trace", "kept_run", "archive_file")
    return {table: len(plant.rows(f"TABLE {table}")) for table in tables}


def test_a_month_goes_to_a_file_and_verifies_with_the_rest(three_months: Plant) -> None:
    plant = three_months
    before = holders(plant)
    whole = examined(plant, None)
    (may,) = retired(plant, "2026-06")
    assert (may.month, may.runs, may.traces, may.stations) == ("2026-05", 3, 3, 2)
    left = counts(plant)
    # W2605002 was flashed again in June; the others of May stay as the last runs of their units.
    assert (left["run"], left["step"], left["kept_run"]) == (6, 4, 2)
    assert left["attachment"] == left["trace"] == 4
    assert holders(plant) == before
    without = examined(plant, None)
    assert without.problems == ()
    assert without.unexamined == (may.file,)
    assert any("not examined" in each for each in without.remarks)
    both = examined(plant, plant.folder / "archive")
    assert both.problems == ()
    assert (both.archives, both.unexamined) == ((may.file,), ())
    assert (both.runs, both.traces) == (whole.runs, whole.traces)
    assert [(each.station, each.rows) for each in both.stations] == [
        (each.station, each.rows) for each in whole.stations
    ]


def test_a_month_that_is_not_handed_over_stays(plant: Plant, sender: Sender) -> None:
    with closing(Central(plant.url())) as central:
        deliveries = Deliveries(central)
        deliveries.register(["mes"])
        sender.bench.make()
        sender.bench.clock.go_on(MONTH_S)
        sender.bench.make(serial="W2605003")
        sender.send()
        before = counts(plant)
        with pytest.raises(RecordError, match=r"1 run of 2026-05 .* to mes yet: nothing was"):
            retired(plant, "2026-06")
        assert counts(plant) == before
        assert not (plant.folder / "archive").exists()
        with central.reading() as connection:
            (oldest,) = deliveries_of(connection, DeliveryFilter("mes", serial="W2605002")).rows
        attempt = deliveries.begin("mes", *parse_key(oldest.key))
        assert attempt is not None
        deliveries.end(attempt, Answer(DeliveryState.CONFIRMED, "200"))
        assert [each.month for each in retired(plant, "2026-06")] == ["2026-05"]
        assert deliveries.send_again("mes", [oldest.key]) == [oldest.key]
        # Its key stays, so that it is not unknown when a receiver lists it.
        assert deliveries.keys("mes")[oldest.key] is DeliveryState.CONFIRMED


def test_a_receiver_that_was_stopped_holds_no_month_back(plant: Plant, sender: Sender) -> None:
    with closing(Central(plant.url())) as central:
        deliveries = Deliveries(central)
        deliveries.register(["mes"])
        sender.bench.make()
        sender.bench.clock.go_on(MONTH_S)
        sender.bench.make(serial="W2605003")
        sender.send()
        deliveries.stop("mes")
    assert [each.month for each in retired(plant, "2026-06")] == ["2026-05"]


def test_months_follow_each_other_and_stations_go_on(plant: Plant, sender: Sender) -> None:
    make_three_months(plant, sender)
    before = holders(plant)
    assert [each.month for each in retired(plant, "2026-07")] == ["2026-05", "2026-06"]
    assert retired(plant, "2026-07") == []
    sender.bench.make(serial="W2605006")
    sender.send()
    assert holders(plant) == sorted([*before, ("W2605006", True)])
    # All but the newest row of each station.
    assert [each.month for each in retired(plant, "2027-01")] == ["2026-07"]
    assert counts(plant)["chain_row"] == 2
    sender.bench.make(serial="W2605007")
    sender.send()
    found = examined(plant, plant.folder / "archive")
    assert found.problems == ()
    assert len(found.archives) == 3


def test_a_unit_that_comes_back_needs_its_old_run_no_more(plant: Plant, sender: Sender) -> None:
    sender.bench.make(RunState.FAIL, "W2605002")
    sender.bench.clock.go_on(MONTH_S)
    sender.bench.make(serial="W2605003")
    sender.send()
    retired(plant, "2026-06")
    query = (
        "SELECT serial, state FROM kept_run JOIN run ON run.id = run_id"
        " JOIN unit ON unit.id = unit_id ORDER BY 1"
    )
    assert plant.rows(query) == [("W2605002", "FAIL")]
    sender.bench.make(serial="W2605002")
    sender.bench.clock.go_on(MONTH_S)
    sender.bench.make(serial="W2605004")
    sender.send()
    retired(plant, "2026-07")
    assert plant.rows(query) == [("W2605002", "PASS"), ("W2605003", "PASS")]
    assert examined(plant, plant.folder / "archive").problems == ()


def test_what_arrives_late_goes_to_another_file_of_the_month(plant: Plant, sender: Sender) -> None:
    late = plant.sender("line-3")
    late.bench.make(serial="W2605009")
    late.bench.make(serial="W2605008")
    sender.bench.make()
    sender.bench.make(serial="W2605003")
    sender.send()
    (first,) = retired(plant, "2026-06")
    late.send()
    late.close()
    (second,) = retired(plant, "2026-06")
    assert second.file == first.file.replace(".tar.gz", "-2.tar.gz")
    assert examined(plant, plant.folder / "archive").problems == ()


def test_what_follows_a_later_month_is_not_due_before_that_is(plant: Plant, sender: Sender) -> None:
    bench = sender.bench
    bench.make()
    right = bench.clock.now
    bench.clock.now += timedelta(days=365)
    bench.make(serial="W2605003")
    bench.clock.now = right
    bench.store.release_clock("jo", "it was a year ahead")
    bench.make(serial="W2605004")
    bench.clock.go_on(MONTH_S)
    bench.make(serial="W2605005")
    sender.send()
    with retirement(plant) as made:
        due = made.months("2026-06")
    assert [(each.month, each.rows, each.runs) for each in due] == [("2026-05", 4, 1)]
    assert [(each.rows, each.runs) for each in retired(plant, "2026-06")] == [(4, 1)]
    with retirement(plant) as made:
        assert made.months("2026-06") == []
    assert retired(plant, "2026-06") == []


def test_a_month_that_begins_the_figures_earlier_is_found(three_months: Plant) -> None:
    plant = three_months
    (may,) = retired(plant, "2026-06")
    with plant.connect() as owner:
        owner.execute("UPDATE archive_file SET month = '2026-04'")
    (problem,) = examined(plant, plant.folder / "archive").problems
    assert (problem.where, problem.what) == (may.file, "the database states another month of it")


class KilledError(BaseException):
    """The process is gone."""


PLACES = ("write", "rename", "examine", "delete", "commit")


@pytest.mark.parametrize("place", PLACES)
def test_a_call_that_is_killed_loses_nothing_and_the_next_one_goes_on(
    three_months: Plant, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = three_months
    before, held = counts(plant), holders(plant)

    def die(*_args: object, **_named: object) -> None:
        raise KilledError

    with monkeypatch.context() as patch:
        match place:
            case "write":
                patch.setattr(archive._Writer, "_add_traces", die)
            case "rename":
                patch.setattr(Path, "replace", die)
            case "examine":
                patch.setattr(ArchiveExaminer, "examine_file", die)
            case "delete":
                patch.setattr(Retirement, "_delete", die)
            case "commit":
                patch.setattr(retire, "_DELETIONS", (*retire._DELETIONS, "SELECT 1 / 0"))
        with pytest.raises((KilledError, FlasherError)):
            retired(plant, "2026-06")
    assert counts(plant) == before
    (month,) = retired(plant, "2026-06")
    assert holders(plant) == held
    found = examined(plant, plant.folder / "archive")
    assert found.problems == ()
    assert found.archives == (month.file,)
    assert [each.name for each in (plant.folder / "archive").glob("*.tar.gz")] == [month.file]


def test_a_file_of_another_database_stays(three_months: Plant) -> None:
    (folder := three_months.folder / "archive").mkdir()
    with retirement(three_months) as made:
        name = f"flasher-{made._plant[:8]}-2026-05.tar.gz"
    (folder / name).write_bytes(b"something else")
    (month,) = retired(three_months, "2026-06")
    assert month.file == name.replace(".tar.gz", "-2.tar.gz")
    assert (folder / name).read_bytes() == b"something else"


def test_a_full_disk_deletes_nothing(three_months: Plant) -> None:
    (three_months.folder / "archive").touch()  # no folder: as a full disk, it takes no file
    before = counts(three_months)
    with pytest.raises(UsageError, match="Nothing was deleted"):
        retired(three_months, "2026-06")
    assert counts(three_months) == before


def test_a_disk_that_gets_full_while_it_is_written_keeps_no_part_of_it(
    three_months: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = pytest.importorskip("resource", reason="a system with limits of file sizes")
    before = counts(three_months)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    usual = archive.write_archive

    def limited(*values: Any) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
        try:
            usual(*values)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    monkeypatch.setattr(retire, "write_archive", limited)
    before_signal = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with pytest.raises(UsageError, match="cannot be written"):
            retired(three_months, "2026-06")
    finally:
        signal.signal(signal.SIGXFSZ, before_signal)
    assert counts(three_months) == before
    assert list((three_months.folder / "archive").iterdir()) == []


def test_changed_records_are_not_retired_unless_asked_for(three_months: Plant) -> None:
    plant = three_months
    with plant.connect() as owner:
        owner.execute("SET session_replication_role = replica")
        owner.execute("DELETE FROM trace WHERE sha256 IN (SELECT log_sha256 FROM run LIMIT 1)")
    before = counts(plant)
    with pytest.raises(ArchiveRefusedError, match="An attachment is missing"):
        retired(plant, "2026-06")
    assert counts(plant) == before
    (month,) = retired(plant, "2026-06", with_problems=True)
    assert len(month.problems) == 1
    found = examined(plant, plant.folder / "archive")
    assert [each.what for each in found.problems] == ["An attachment is missing."]


DAMAGES = {
    "UPDATE run SET state = 'FAIL', code = 'NO' WHERE id IN (SELECT run_id FROM kept_run)":
        "what reports and pages show differs",
    "DELETE FROM device_write WHERE run_id IN (SELECT run_id FROM kept_run)":
        "what reports and pages show differs",
    "DELETE FROM kept_run": "it was added",
    "UPDATE archive_chain SET hash = repeat('a', 64)": "",
    "DELETE FROM archive_chain WHERE name = 'line-2'": "",
    "UPDATE archive_file SET sha256 = 'x'": "its hash differs",
}  # fmt: skip


@pytest.mark.parametrize("statement", DAMAGES)
def test_what_the_owner_changes_after_it_was_retired_is_found(
    postgres: Server, tmp_path: Path, without_may: Plant, statement: str
) -> None:
    plant = Plant(postgres, tmp_path, without_may.database)
    with plant.connect() as owner:
        owner.execute("SET session_replication_role = replica")
        owner.execute(statement.encode())
    found = examined(plant, without_may.folder / "archive")
    assert any(DAMAGES[statement] in each.what for each in found.problems)


def test_a_damaged_file_is_found(three_months: Plant) -> None:
    (month,) = retired(three_months, "2026-06")
    path = three_months.folder / "archive" / month.file
    whole = path.read_bytes()
    for at in (0.1, 0.5, 0.9, 0.999):
        data = bytearray(whole)
        data[int(len(data) * at)] ^= 1
        path.write_bytes(data)
        assert examined(three_months, path.parent).problems, at
    path.unlink()
    (problem,) = examined(three_months, path.parent).problems
    assert "cannot be read" in problem.what


def test_only_the_owner_retires(three_months: Plant) -> None:
    with pytest.raises(UsageError, match="Only the owner"), retirement(three_months, READER):
        pass
    with pytest.raises(RecordError), retirement(three_months, "flasher_line_2"):
        pass


def test_two_calls_at_once_do_it_once(three_months: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = three_months
    usual = Retirement._delete

    def late(self: Retirement, *words: object) -> None:
        monkeypatch.undo()
        retired(plant, "2026-06")  # the other one, between this one's file and its deletion
        usual(self, *words)  # type: ignore[arg-type]

    monkeypatch.setattr(Retirement, "_delete", late)
    with pytest.raises(RecordError, match="Another call"):
        retired(plant, "2026-06")
    assert examined(plant, plant.folder / "archive").problems == ()


def test_figures_begin_after_what_was_retired(three_months: Plant) -> None:
    plant = three_months
    retired(plant, "2026-06")
    with closing(opened(plant)) as store:
        begin = store.figures_begin()
        assert begin == datetime(2026, 6, 1, tzinfo=UTC)
        assert store.read.figures(RunFilter(since=begin)).units == 4


@pytest.mark.parametrize("doubt", ["", "no answer"])
def test_the_mark_of_duplicates_stays_with_the_last_run_of_a_unit(
    plant: Plant, sender: Sender, doubt: str
) -> None:
    bench = sender.bench
    order = Order("W2605002", "A", "jo", admission=Admission(uuid4().hex, doubt))
    run_id = bench.store.claim(order, bench.recipe).run_id
    bench.work(run_id)
    bench.store.finish(run_id, bench.ending(RunState.PASS, "OK", bench.traced("W2605002")))
    bench.clock.go_on(MONTH_S)
    bench.make(serial="W2605003")
    sender.send()
    retired(plant, "2026-06")
    assert examined(plant, plant.folder / "archive").problems == ()
    marks = plant.rows("SELECT text FROM measurement WHERE name = 'duplicates'")
    assert [tuple(each) for each in marks] == [(f"not checked: {doubt}" if doubt else "checked",)]


@pytest.mark.parametrize(("schema", "what"), [("99", "has schema 99"), ("5", "has schema 5")])
def test_tables_of_another_version_are_not_retired(plant: Plant, schema: str, what: str) -> None:
    with closing(Central(plant.url())) as central, central.writing() as connection:
        connection.execute(text("UPDATE plant_version SET version_num = :to"), {"to": schema})
    with pytest.raises(UsageError, match=what), retirement(plant):
        pass


def test_months() -> None:
    assert [month_after(each) for each in ("2025-11", "2025-12")] == ["2025-12", "2026-01"]
    now = datetime(2026, 3, 17, tzinfo=UTC)
    assert [month_before(now, each) for each in (0, 2, 3)] == ["2026-03", "2026-01", "2025-12"]
    with pytest.raises(UsageError, match="is not a month"):
        month_after("2026-13")
