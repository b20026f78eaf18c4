"""Reports and pages of a station read the runs of a whole plant."""

from __future__ import annotations

from contextlib import closing
from datetime import UTC, datetime

from flasher.plant.store import PlantStore
from flasher.station.records.model import RunFilter
from flasher.station.records.rollup import Rollup
from flasher.web.query_processes import Question
from flasher.web.supervisor import SupervisorPages, open_supervisor
from tests.plant.factory import READER, Plant, Sender

LATER = datetime(2026, 6, 1, tzinfo=UTC)


def opened(plant: Plant) -> PlantStore:
    url = plant.url(READER)
    return PlantStore.open(url, station="desk", folder=plant.folder / "desk", read_only=True)


def page(pages: SupervisorPages, path: str, **fields: str) -> str:
    return pages.answer(Question(path, fields)).body.decode()


def test_daily_sums_take_in_the_runs_of_a_station_that_was_off_line(
    plant: Plant, sender: Sender
) -> None:
    late = plant.sender("line-3")
    late.bench.make(serial="W2605003")
    late.bench.clock.go_on(1)
    sender.bench.clock.go_on(100)
    sender.bench.make()
    sender.send()
    with closing(opened(plant)) as store:
        sums = Rollup(store.database)
        while sums.add(LATER):
            pass
        with sums.rolled(RunFilter()) as found:
            assert found is not None
        assert store.read.figures().units == 1
        late.send()
        late.close()
        assert store.read.figures().units == 2
        while sums.add(LATER):
            pass
        assert store.read.figures().units == 2


def test_each_page_shows_the_units_of_all_stations(plant: Plant, sender: Sender) -> None:
    other = plant.sender("line-3")
    sender.bench.make()
    other.bench.make(serial="W2605003")
    for each in (sender, other):
        each.send()
    other.close()
    pages = open_supervisor(
        plant.url(READER), plant.folder / "desk", sender.bench.key_locations, (), PlantStore
    )
    with closing(pages.store):
        runs = page(pages, "/runs")
        assert "W2605002" in runs
        assert "W2605003" in runs
        assert "<th>station, socket</th>" in runs
        assert "line-3, A" in runs
        for path in ("/yield", "/times", "/images", "/audit"):
            assert pages.answer(Question(path)).status == 200
        assert "line-3" in page(pages, "/units", serial="W2605003", part="BAT-36")
        refused = page(pages, "/units/certificate", serial="W2605003", part="BAT-36")
        assert "records of the station that made the run" in refused
