"""`flasher plant verify` finds what the owner of the database changes, and what no key signed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.plant.store import PlantStore
from flasher.plant.verify import PlantExamination, PlantExaminer
from flasher.station.records.chain import row_hash
from flasher.station.records.model import RunId, RunState
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from tests.plant.factory import READER, Plant, Sender
from tests.station.postgres import Server


def opened(plant: Plant) -> PlantStore:
    url = plant.url(READER)
    return PlantStore.open(url, station="desk", folder=plant.folder / "desk", read_only=True)


def examined(plant: Plant) -> PlantExamination:
    with closing(opened(plant)) as store:
        return PlantExaminer(store, lambda _done, _total: None).examine_plant()


@pytest.fixture(scope="module")
def sent(postgres: Server, tmp_path_factory: pytest.TempPathFactory) -> Plant:
    """A plant in which two stations have sent a run each; no test changes it."""
    plant = Plant(postgres, tmp_path_factory.mktemp("plant"))
    for station, state, serial in (
        ("line-2", RunState.PASS, "W2605002"), ("line-3", RunState.FAIL, "W2605003")
    ):  # fmt: skip
        with closing(plant.sender(station)) as sender:
            sender.bench.make(state, serial)
            sender.send()
    return plant


@pytest.fixture
def two(sent: Plant, postgres: Server, tmp_path: Path) -> Iterator[Plant]:
    """A copy of it."""
    made = Plant(postgres, tmp_path, sent.database)
    yield made
    made.drop()


def test_what_the_stations_sent_is_as_they_signed_it(two: Plant) -> None:
    found = examined(two)
    assert found.problems == ()
    assert (found.runs, found.traces) == (2, 1)
    assert [(each.station, each.rows) for each in found.stations] == [("line-2", 4), ("line-3", 4)]
    assert all(len(each.keys) == 1 for each in found.stations)


CHANGES = {
    "UPDATE run SET state = 'PASS', code = 'OK' WHERE state = 'FAIL'": None,
    "UPDATE unit SET serial = 'W2605077' WHERE serial = 'W2605002'": "what reports and pages show",
    "UPDATE run SET ended_at = 'yesterday' WHERE state = 'FAIL'": None,
    "UPDATE recipe SET part = 'BAT-37'": None,
    "UPDATE recipe SET content = '# none'": None,
    "UPDATE artifact SET target = 'wmc'": None,
    "DELETE FROM artifact": None,
    "UPDATE trace SET data = 'x', sha256 = encode(sha256('x'), 'hex')"
    " WHERE ctid = (SELECT ctid FROM trace LIMIT 1)": "missing",
    "DELETE FROM trace": "An attachment is missing.",
    "UPDATE chain_row SET data = replace(data, 'FAIL', 'PASS')": "changed after it was written",
    "UPDATE chain_row SET signature = reverse(signature) WHERE number = 3": "not signed with",
    "DELETE FROM chain_row WHERE number = 3": "the chain is broken",
    'UPDATE chain_row SET content = replace(content::text, \'"state":"PASS"\','
    ' \'"state":"FAIL"\')::json WHERE content IS NOT NULL': "changed after it was recorded",
    "DELETE FROM shared_part": "a part of it is missing",
    "INSERT INTO run SELECT (r).* FROM (SELECT jsonb_populate_record(run, '{\"id\": 7}') AS r"
    " FROM run LIMIT 1) AS x": "no station's audit trail has it",
}


@pytest.mark.parametrize("statement", CHANGES)
def test_what_the_owner_of_the_database_changes_is_found(two: Plant, statement: str) -> None:
    with two.connect() as owner:
        owner.execute("SET session_replication_role = replica")
        if "state = 'PASS'" in statement:  # a FAIL has no level that a PASS needs
            owner.execute("UPDATE run SET verification_reached = 1")
        owner.execute(statement.encode())
    found = examined(two)
    wanted = CHANGES[statement] or "what reports and pages show differs"
    assert any(wanted in each.what for each in found.problems), found.problems


def test_a_row_that_a_thief_of_the_password_adds_is_found(two: Plant) -> None:
    """The database cannot check signatures: the row is stored, and found here."""
    query = "SELECT station, number, hash FROM chain_row JOIN plant_station USING (station)"
    ((station, number, head),) = two.rows(
        f"{query} WHERE name = 'line-2' ORDER BY number DESC LIMIT 1"
    )
    row = {
        "number": number + 1, "at": "2026-05-17T10:00:00.000000Z", "event": "sign-in",
        "run_id": None, "data": "{}", "previous_hash": head,
    }  # fmt: skip
    with two.connect("flasher_line_2") as thief:
        thief.execute(
            "INSERT INTO chain_row (station, number, at, event, data, previous_hash, hash,"
            " signature) VALUES (%s, %s, %s, %s, %s, %s, %s, 'AAAA')",
            [station, row["number"], row["at"], row["event"], row["data"], head, row_hash(row)],
        )
    (problem,) = examined(two).problems
    assert problem.what == "it is not signed with the key of the station"


def test_units_of_an_image_are_found_over_all_stations(two: Plant) -> None:
    with closing(opened(two)) as store:
        overview = Overview(store.database)
        (image,) = overview.images("V1r0r4_20220512")
        held = [unit.serial for unit in overview.holders(image.sha256, PageCursor()).rows]
    assert held == ["W2605003", "W2605002"]


def test_certificates_are_left_to_the_stations(two: Plant) -> None:
    with closing(opened(two)) as store, pytest.raises(UsageError, match="station that made"):
        store.examine_run(RunId(1))


def test_traces_are_read_from_the_database(plant: Plant, sender: Sender) -> None:
    sender.bench.make()
    sender.send()
    own = sender.bench.store.read.run(RunId(1))
    with closing(opened(plant)) as store:
        sha256 = str(own.run.log_sha256)
        assert store.files.read(sha256) == sender.bench.store.files.read(sha256)
        assert store.files.check("0" * 64) == "An attachment is missing."
