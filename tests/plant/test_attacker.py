# ruff: noqa: S608, ISC004  all of this SQL is written here
"""Somebody who has a station's password changes, deletes and reads nothing, and writes only what
continues that station's own chain.
"""

from __future__ import annotations

from typing import Any

import psycopg
import pytest

from flasher.plant.functions import REFUSED
from tests.plant.factory import Plant

_ROW = "INSERT INTO chain_row (station, number, at, event, data, previous_hash, hash, signature)"
_MINE = "plant_my_station()"
_THEIRS = "'{theirs}'::uuid"
_HASH = "repeat('a', 64)"
DENIED, POLICY = "42501", "42501"
ATTEMPTS = {
    "read the records": ("SELECT * FROM run", DENIED),
    "read the chains": ("SELECT * FROM chain_row", DENIED),
    "read the audit trail": ("SELECT * FROM audit", DENIED),
    "read traces": ("SELECT * FROM trace", DENIED),
    "read other stations": ("SELECT * FROM plant_station", DENIED),
    "change a run": ("UPDATE run SET state = 'PASS'", DENIED),
    "change a row of the chain": ("UPDATE chain_row SET data = ''", DENIED),
    "delete a run": ("DELETE FROM run", DENIED),
    "delete rows of the chain": ("DELETE FROM chain_row", DENIED),
    "empty the chains": ("TRUNCATE chain_row", DENIED),
    "empty the runs": ("TRUNCATE run CASCADE", DENIED),
    "delete traces": ("DELETE FROM trace", DENIED),
    "retire the records of others": ("DELETE FROM kept_run", DENIED),
    "state that its chain is in a file": (
        "INSERT INTO archive_chain VALUES ('{theirs}', 1, 1, '', '', '', '', '[]', '')", DENIED,
    ),
    "add a run beside the chain": (
        "INSERT INTO unit (part, serial) VALUES ('BAT-36', 'W2605099')", DENIED,
    ),
    "become another station": (f"UPDATE plant_station SET station = {_MINE}", DENIED),
    "enter as another station": ("SELECT plant_enter('{records}', 'line-3')", REFUSED),
    "send from other records": ("SELECT plant_enter('other', 'line-2')", REFUSED),
    "write the chain of another station": (
        f"{_ROW} VALUES ({_THEIRS}, 99, '', 'sign-in', '', {_HASH}, {_HASH}, '')", REFUSED,
    ),
    "send its images as those of others": (
        "INSERT INTO shared_part (station, sha256, content, ids) VALUES"
        f" ({_THEIRS}, encode(sha256('x'), 'hex'), 'x', 'null')", DENIED,
    ),
    "write parts for another station": (
        f"INSERT INTO shared_part VALUES ({_THEIRS}, encode(sha256('x'), 'hex'), 'x')", POLICY,
    ),
    "fork the own chain": (
        f"{_ROW} VALUES ({_MINE}, 2, '', 'sign-in', '', {_HASH}, {_HASH}, '')", REFUSED,
    ),
    "leave rows out": (
        f"{_ROW} VALUES ({_MINE}, 99, '', 'sign-in', '', {_HASH}, {_HASH}, '')", REFUSED,
    ),
    "add a row with a false hash": (
        f"{_ROW} VALUES ({_MINE}, 5, '', 'sign-in', '', '{{head}}', {_HASH}, '')", REFUSED,
    ),
    "read active runs": ("SELECT * FROM open_run", DENIED),
    "end the active run of another station": ("DELETE FROM open_run", DENIED),
    "add an active run to another station": (
        f"INSERT INTO open_run VALUES ({_THEIRS}, 9, '{{{{}}}}')", POLICY,
    ),
    "take another station over": (
        f"{_ROW} VALUES ({_THEIRS}, 5, '', 'taken over', '', {_HASH}, {_HASH}, '')", REFUSED,
    ),
    "take the own station over with a false hash": (
        f"{_ROW} VALUES ({_MINE}, 5, '', 'taken over', '', '{{head}}', {_HASH}, '')", REFUSED,
    ),
    "end an active run by the inner function": ("SELECT plant_close()", DENIED),
    "overwrite a row": (
        f"{_ROW} VALUES ({_MINE}, 4, '', 'sign-in', '', {_HASH}, {_HASH}, '')"
        " ON CONFLICT (station, number) DO UPDATE SET data = 'x'", DENIED,
    ),
    "store another trace under a hash": (
        f"INSERT INTO trace VALUES ({_HASH}, 'x')", "23514",
    ),
    "read released claims": ("SELECT * FROM released_claim", DENIED),
    "undo the release of a claim": ("DELETE FROM released_claim", DENIED),
    "release the claim of another station": (
        "INSERT INTO released_claim (token, station, part, serial, socket, claimed_at, reason)"
        f" VALUES ('x', {_THEIRS}, '', '', '', now(), '')", DENIED,
    ),
    "publish a recipe": ("INSERT INTO released_recipe VALUES ('x', 'x', '', '', '')", DENIED),
    "store an image": (f"INSERT INTO released_file VALUES ({_HASH}, 'x')", DENIED),
    "give a recipe to all stations": (
        f"INSERT INTO recipe_event (what, digest) VALUES ('published', {_HASH})", DENIED,
    ),
    "withdraw a recipe": (
        f"INSERT INTO recipe_event (what, digest) VALUES ('withdrawn', {_HASH})", DENIED,
    ),
    "alter an image": ("UPDATE released_file SET data = 'x'", DENIED),
    "read images past the functions": ("SELECT * FROM released_file", DENIED),
    "read who published": ("SELECT * FROM recipe_event", DENIED),
    "ask as another station": ("SELECT plant_gives_me('x')", DENIED),
    "become a publisher": ("SET ROLE flasher_publishers", DENIED),
    "take the checks away": ("ALTER TABLE chain_row DISABLE TRIGGER ALL", DENIED),
    "take row level security away": ("ALTER TABLE chain_row DISABLE ROW LEVEL SECURITY", DENIED),
    "replace a function": (
        "CREATE OR REPLACE FUNCTION plant_my_station() RETURNS uuid LANGUAGE sql AS"
        " 'SELECT gen_random_uuid()'", DENIED,
    ),
    "hide a table": ("CREATE TEMPORARY TABLE plant_station (role text)", DENIED),
    "add a run by the inner function": ("SELECT plant_add_run('{{}}', '{{}}')", DENIED),
    "read claims": ("SELECT * FROM plant_claim", DENIED),
    "take a claim away": ("DELETE FROM plant_claim", DENIED),
    "claim for another station": (
        f"INSERT INTO plant_claim VALUES ('x', {_THEIRS}, 'BAT-36', 'W1', 'A', now(), now())",
        DENIED,
    ),
    "hide a duplicate": ("DELETE FROM plant_duplicate", DENIED),
    "claim one's own token twice": (
        "SELECT plant_claim('{token}', 'BAT-36', 'W2605077', false, 'A', 60, '{records}', '')",
        "23505",
    ),
    "claim everything": (
        "SELECT plant_claim(md5(n::text), 'BAT-36', 'X' || n, false, 'A', 60, '{records}', '')"
        " FROM generate_series(1, 1001) n", REFUSED,
    ),
    "hand a run over again": (f"SELECT plant_enqueue('mes', {_THEIRS}, 4)", DENIED),
    "confirm a delivery": ("UPDATE plant_delivery SET state = 'confirmed'", DENIED),
    "read deliveries": ("SELECT * FROM plant_delivery", DENIED),
    "stop a receiver": ("UPDATE plant_receiver SET stopped_at = now()", DENIED),
    "become the owner": ("SET ROLE postgres", DENIED),
    "make roles": ("CREATE ROLE another SUPERUSER", DENIED),
}  # fmt: skip


def test_each_attempt_is_refused_and_changes_nothing(plant: Plant) -> None:
    sender, other = plant.sender("line-2"), plant.sender("line-3")
    for each in (sender, other):
        each.bench.make()
        each.send()
        each.close()
    ((theirs,),) = plant.rows("SELECT station FROM plant_station WHERE name = 'line-3'")
    query = "SELECT records_id FROM plant_station ORDER BY name"
    (records,), (their_records,) = plant.rows(query)
    query = "SELECT hash FROM chain_row c JOIN plant_station p USING (station)"
    ((head,),) = plant.rows(query + " WHERE name = 'line-2' ORDER BY number DESC LIMIT 1")
    token = "0" * 32
    with plant.connect("flasher_line_3") as victim:
        claim = "SELECT plant_claim(%s, 'BAT-36', 'W2605078', false, 'A', 60, %s, '')"
        victim.execute(claim, [token, their_records])
    before = _everything(plant)
    found = {}
    with plant.connect("flasher_line_2") as attacker:
        attacker.autocommit = True
        for name, (statement, _) in ATTEMPTS.items():
            known = {"theirs": theirs, "records": records, "head": head, "token": token}
            with pytest.raises(psycopg.Error) as caught:
                attacker.execute(statement.format(**known).encode())
            found[name] = caught.value.sqlstate
        # Without an error, but also without an effect on another station.
        attacker.execute(f"SELECT plant_release(ARRAY['{token}'])".encode())
        attacker.execute(f"SELECT plant_renew(ARRAY['{token}'], 600)".encode())
        assert attacker.execute("SELECT * FROM plant_claims()").fetchall() == []
    assert found == {name: state for name, (_, state) in ATTEMPTS.items()}
    assert _everything(plant) == before


def _everything(plant: Plant) -> dict[str, list[tuple[Any, ...]]]:
    tables = ("chain_row", "shared_part", "trace", "plant_station", "run", "unit", "station",
              "plant_claim", "plant_pass", "plant_duplicate", "open_run",
              "plant_delivery", "plant_receiver")  # fmt: skip
    return {table: plant.rows(f"SELECT * FROM {table} ORDER BY 1, 2") for table in tables}
