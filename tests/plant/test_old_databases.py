"""A database of an older version becomes what a new one is, with what it holds."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from flasher.plant.setup import setup
from tests.plant.factory import STATIONS, Plant
from tests.plant.old_databases import REVISIONS, described, make_old

NOW = datetime(2026, 5, 17, tzinfo=UTC)


@pytest.mark.parametrize("revision", REVISIONS)
def test_it_is_brought_up_to_date(plant: Plant, revision: int) -> None:
    setup(plant.url(), STATIONS, NOW)
    expected = described(plant)
    make_old(plant, revision)
    assert described(plant) != expected
    assert setup(plant.url(), STATIONS, NOW).before == str(revision)
    assert described(plant) == expected


def test_units_that_passed_twice_are_found_in_what_is_there(plant: Plant) -> None:
    make_old(plant, 1)
    with plant.connect() as owner:
        insert = "INSERT INTO plant_station (role, name) VALUES ('flasher_{0}', '{1}')"
        for name in STATIONS:
            owner.execute(insert.format(name.replace("-", "_"), name).encode())
        grant = f"GRANT CONNECT ON DATABASE {plant.database} TO flasher_stations"
        owner.execute(grant.encode())
    for name in STATIONS:
        sender = plant.sender(name)
        sender.bench.make()
        if name == "line-3":
            sender.bench.make(serial="W2605003")
        sender.send()
        sender.close()
    setup(plant.url(), STATIONS, NOW)
    assert plant.rows("SELECT count(*) FROM plant_pass") == [(2,)]
    query = (
        "SELECT name FROM plant_duplicate d JOIN chain_row c ON c.run_id = d.run_id"
        " JOIN plant_station s ON s.station = c.station WHERE c.content IS NOT NULL"
    )
    assert plant.rows(query) == [("line-3",)]
