"""Reports and pages of a station read the runs of a whole plant."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html import unescape
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import pytest

from flasher.cli.station.records import passed_twice_lines
from flasher.plant.central import Central
from flasher.plant.retire import Retirement
from flasher.plant.store import PlantStore
from flasher.station.records import rollup
from flasher.station.records.capability import Capability
from flasher.station.records.model import Admission, Order, RunFilter, RunState, Units
from flasher.station.records.overview import By, Overview
from flasher.station.records.rollup import Rollup
from flasher.station.records.yields import Span
from flasher.web.plant import PLANT_PAGES
from flasher.web.query_processes import Question
from flasher.web.supervisor import SupervisorPages
from tests.plant.factory import READER, Plant, Sender
from tests.station.factory import SERIAL
from tests.station.records.test_capability import VALUES, measure
from tests.station.records.test_rollup import summed

LATER = datetime(2026, 6, 1, tzinfo=UTC)


def opened(plant: Plant) -> PlantStore:
    url = plant.url(READER)
    return PlantStore.open(url, station="desk", folder=plant.folder / "desk", read_only=True)


def page(pages: SupervisorPages, path: str, **fields: str) -> str:
    return pages.answer(Question(path, fields)).body.decode()


def units_of(store: PlantStore) -> Units:
    """Those of all runs, as a page counts them."""
    span = Span(LATER - timedelta(days=365), LATER + timedelta(days=365))
    return Overview(store.database).yields(RunFilter(), [span])[1]


def add_up(sums: Rollup, now: datetime) -> None:
    while sums.add(now):
        pass


def test_daily_sums_take_in_the_runs_of_a_station_that_was_off_line(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = plant.sender("line-3")
    late.bench.make(serial="W2605003")
    late.bench.clock.go_on(1)
    sender.bench.clock.go_on(100)
    sender.bench.make()
    sender.send()
    with closing(opened(plant)) as store:
        sums = Rollup(store.database)
        add_up(sums, LATER)
        add_up(sums, LATER + rollup._ARRIVAL)
        assert units_of(store).units == 1
        late.send()
        late.close()
        monkeypatch.setattr(rollup, "_recreate", None)  # only what they touch is added
        assert units_of(store).units == 2
        add_up(sums, LATER + 2 * rollup._ARRIVAL)
        assert units_of(store).units == 2
        add_up(sums, LATER + 3 * rollup._ARRIVAL)
        assert summed(store) == 2
        assert units_of(store) == Units(2, 2, 2)


def test_daily_sums_miss_no_run_that_was_committed_after_newer_audit_rows(
    plant: Plant, sender: Sender
) -> None:
    late = plant.sender("line-3")
    for each, serial in (late, "W2605003"), (sender, SERIAL):
        each.bench.make(serial=serial)
        each.send()
    late.bench.clock.go_on(50)
    late.bench.make(serial="W2605004")
    sender.bench.clock.go_on(100)
    sender.bench.make(serial="W2605005")
    with closing(opened(plant)) as store, ThreadPoolExecutor(1) as threads:

        def add(minutes: int) -> None:
            add_up(sums, LATER + timedelta(minutes=minutes))
            assert units_of(store).units == len(plant.rows("SELECT FROM run"))

        sums = Rollup(store.database)
        add(0)
        add(10)
        with plant.connect() as other:
            other.execute("INSERT INTO unit (part, serial) VALUES ('BAT-36', 'W2605004')")
            sending = threads.submit(late.send)  # its audit rows have their ids, and wait
            while not plant.rows("SELECT FROM pg_locks WHERE NOT granted"):
                pass
            sender.send()
            add(20)
        sending.result()
        late.close()
        add(21)
        add(30)
        add(40)
        assert summed(store) == 4
        assert units_of(store) == Units(4, 4, 4)


def test_daily_sums_lose_the_runs_of_each_retired_month_beside_a_station_that_is_silent(
    plant: Plant, sender: Sender
) -> None:
    silent = plant.sender("line-3")
    silent.bench.make(serial="W2605009")
    silent.send()
    silent.close()
    for serial in ("W2605003", "W2605004", "W2605005"):
        sender.bench.make(RunState.FAIL)
        sender.bench.make(serial=serial)
        sender.bench.clock.go_on(31 * 86_400.0)
    sender.bench.make()
    sender.send()
    now = datetime(2026, 12, 1, tzinfo=UTC)
    with closing(opened(plant)) as store, closing(Central(plant.url())) as central:
        sums = Rollup(store.database)

        def check() -> None:
            """Compare the sums with the records."""
            span = Span(store.figures_begin() or now, now)
            chosen, found = RunFilter(since=span.begin, until=span.end), []
            for file in (sums._file, Path("nowhere")):
                overview = Overview(store.database)
                overview._rollup._file = file
                found.append(
                    [overview.yields(chosen, [span]), overview.causes(chosen, By.STATION),
                     overview.step_times(chosen)]
                )  # fmt: skip
            assert found[0] == found[1]

        for month in ("2026-06", "2026-07"):
            list(Retirement(central, plant.folder / "archive").retire(month))
            check()
            add_up(sums, now)
            now += rollup._ARRIVAL
            add_up(sums, now)
            check()
            assert summed(store)


def test_units_that_passed_at_two_stations_are_shown_with_their_marks(
    plant: Plant, sender: Sender
) -> None:
    other = plant.sender("line-3")
    sender.bench.make()
    admission = Admission("0" * 32, "the server was away")
    claim = other.bench.store.claim(
        Order(SERIAL, "A", "jo", admission=admission), other.bench.recipe
    )
    other.bench.work(claim.run_id)
    other.bench.store.finish(claim.run_id, other.bench.ending())
    for each in (sender, other):
        each.send()
    other.close()
    with closing(opened(plant)) as store:
        (found,) = store.passed_twice(100)
        assert (found.serial, found.first.station, found.second.station) == (
            SERIAL, "line-2", "line-3",
        )  # fmt: skip
        assert found.first.duplicates is None
        lines = list(passed_twice_lines([found]))
        assert lines[0] == "passed at two stations: 1 unit"
        assert lines[1].endswith("duplicates NOT CHECKED")
    with plant.pages() as pages:
        runs = page(pages, "/runs")
        assert "passed at two stations" in runs
        assert runs.count("<small>duplicates not checked</small>") == 2  # table and list
        unit = page(pages, "/units", serial=SERIAL, part="BAT-36")
        assert "not checked: the server was away" in unit
    with plant.connect() as owner:
        owner.execute("SET session_replication_role = replica")
        owner.execute("DELETE FROM run WHERE id = %s", [found.first.run_id])
    with closing(opened(plant)) as store:
        assert store.passed_twice(100) == [], "verify reports that a run is missing"


def test_each_page_shows_the_units_of_all_stations(plant: Plant, sender: Sender) -> None:
    other = plant.sender("line-3")
    sender.bench.make()
    other.bench.make(serial="W2605003")
    for each in (sender, other):
        each.send()
    other.close()
    with plant.pages() as pages:
        runs = page(pages, "/runs")
        assert "W2605002" in runs
        assert "W2605003" in runs
        assert "<th>station, socket</th>" in runs
        assert "line-3, A" in runs
        for path in ("/yield", "/times", "/images", "/audit"):
            assert pages.answer(Question(path)).status == 200
        unit = page(pages, "/units", serial="W2605003", part="BAT-36")
        assert "line-3" in unit
        leads = [urlsplit(unescape(link)) for link in re.findall('href="(/[^"]*)"', unit)]
        asked = [Question(each.path, dict(parse_qsl(each.query))) for each in leads]
        here = [each for each in asked if each.path in PLANT_PAGES]
        assert len(here) > 9
        assert [each.path for each in here if pages.answer(each).status >= 400] == []
        refused = page(pages, "/units/certificate", serial="W2605003", part="BAT-36")
        assert "records of the station that made the run" in refused


def test_the_page_of_stations_leads_to_the_runs_of_one(plant: Plant, sender: Sender) -> None:
    other = plant.sender("line-3")
    sender.bench.make()
    other.bench.make(serial="W2605003")
    for each in (sender, other):
        each.send()
    other.close()
    with plant.pages() as pages:
        shown = page(pages, "/stations")
        assert '<a href="/runs?station=line-3">line-3</a>' in shown
        assert "There is no alert." in shown
        assert 'aria-current="page">Stations' in shown
        of_one = page(pages, "/runs", station="line-3")
        assert "W2605003" in of_one
        assert "W2605002" not in of_one
        assert '<option value="line-3" selected>' in page(pages, "/yield", station="line-3")
        for language in ("de", "zh"):
            assert pages.answer(Question("/stations", {}, language=language)).status == 200
        with plant.connect() as owner:
            owner.execute("UPDATE plant_station SET reported_at = now() - interval '6 min'")
        assert "silent for 6 min" in page(pages, "/stations")


def _rounded(each: Capability) -> dict[str, object]:
    return {
        name: round(value, 12) if isinstance(value, float) else value
        for name, value in vars(each).items()
    }


def test_capability_is_computed_as_at_the_station(plant: Plant, sender: Sender) -> None:
    measure(sender.bench, VALUES)
    measure(sender.bench, [8.0], high=None, serial="W2605003", socket="B")
    sender.send()
    own = sender.bench.store.read.capabilities()
    with closing(opened(plant)) as store:
        assert [*map(_rounded, store.read.capabilities())] == [*map(_rounded, own)]
    with plant.pages() as pages:
        shown = page(pages, "/measurements")
        assert f"{own[0].ppk:.2f}" in shown
        assert "from 7 to 14 V" in shown
        assert "fewer than 30 values" in shown


def test_figures_are_not_those_of_a_clock_that_was_a_year_ahead(
    plant: Plant, sender: Sender
) -> None:
    bench = sender.bench
    right = bench.clock.now
    bench.clock.now += timedelta(days=365)
    bench.make(serial="W2605003")
    bench.clock.now = right
    bench.store.release_clock("jo", "it was a year ahead")
    bench.make()
    bench.make(serial="W2605004")
    sender.send()
    with plant.pages() as made:
        at = replace(made, now=lambda: LATER)
        assert at._figured(Question("/yield", {}))[1].end < LATER
        all_ahead = replace(made, now=lambda: LATER - timedelta(days=365))
        assert all_ahead._figured(Question("/yield", {}))[1].end > LATER
