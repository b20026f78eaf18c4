"""Records changed by somebody with a database tool, time and knowledge, who puts every rule back
afterwards: `verify` names each change.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine

from flasher.station.records.chain import canonical, row_hash
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import Problem, RunId, RunState
from flasher.station.records.signatures import SigningKey
from flasher.station.records.store import Store
from tests.station.factory import BMS_VERSION, IMAGES, SERIAL, Bench
from tests.station.traces import run_messages, write_trace

OTHER = "W2605003"
FAILED = "W2605004"


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Records of two good units, a bad one and one that runs, with nothing wrong in them."""
    made = Bench(tmp_path_factory.mktemp("plant"))
    fill(made)
    found = made.store.examine()
    assert not found.problems
    assert not found.is_checked_elsewhere  # its heads are beside the key
    assert [(each.station, each.first, each.last) for each in found.kept] == [("line-2", 1, 9)]
    assert found.traces == 2
    made.store.backup(made.folder / "copy.sqlite")
    yield made
    made.store.close()


def fill(made: Bench) -> None:
    made.make(lot="L1")
    made.make(serial=OTHER)
    made.make(RunState.FAIL, FAILED)
    made.work(made.claim("W2605005").run_id)


class Forger:
    """A copy of the records without its rules, until `put_back`."""

    def __init__(self, path: Path) -> None:
        self.db = sqlite3.connect(path, isolation_level=None)
        self.db.execute("PRAGMA synchronous = OFF")
        self.db.execute("PRAGMA ignore_check_constraints = ON")
        self.db.row_factory = sqlite3.Row
        rules = self.db.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'")
        self.rules: dict[str, str] = {row["name"]: row["sql"] for row in rules.fetchall()}
        for name in self.rules:
            self.db.execute(f"DROP TRIGGER {name}")

    def __call__(self, statement: str, *values: Any) -> None:
        self.db.execute(statement, values)

    def put_back(self) -> None:
        for statement in self.rules.values():
            self.db.execute(statement)
        self.db.close()

    def recompute(self, key: SigningKey | None = None) -> None:
        """Make the chain fit again from its first row on; signed where there is a key."""
        before = "0" * 64
        for row in self.db.execute("SELECT * FROM audit ORDER BY number").fetchall():
            found = dict(row) | {"previous_hash": before}
            before = row_hash(found)
            signature = row["signature"] if key is None else key.sign(before)
            self(
                "UPDATE audit SET previous_hash = ?, hash = ?, signature = ? WHERE id = ?",
                found["previous_hash"], before, signature, row["id"],
            )  # fmt: skip

    def restate(self, run_id: int, folder: Path, **change: Any) -> None:
        """Let the audit row of a finished run state what the run is now."""

        from flasher.station.records.chain import digests_of  # noqa: PLC0415

        self.db.commit()
        engine = create_engine(f"sqlite:///{folder / 'records.sqlite'}")
        with engine.connect() as connection:
            digests = digests_of(connection, [run_id])[run_id]
        engine.dispose()
        query = "SELECT id, data FROM audit WHERE run_id = ? AND event = 'finished'"
        row = self.db.execute(query, (run_id,)).fetchone()
        data = json.loads(row["data"]) | {"digests": digests} | change
        self("UPDATE audit SET data = ? WHERE id = ?", canonical(data), row["id"])


def examined(
    plant: Bench, folder: Path, forge: Callable[[Forger, Path], object]
) -> tuple[Problem, ...]:
    """What is found after a forgery."""
    copy = folder / "records.sqlite"
    shutil.copy(plant.folder / "copy.sqlite", copy)
    shutil.copytree(plant.keys, folder / "keys")
    forger = Forger(copy)
    forge(forger, folder)
    forger.put_back()
    key_locations = KeyLocations(folder / "keys")
    files = plant.store.files.folder
    with Store.open(
        str(copy), station="x", folder=files, read_only=True, key_locations=key_locations
    ) as store:
        return store.examine().problems


def noted(problems: tuple[Problem, ...], where: str, what: str) -> bool:
    return any(where in each.where and what in each.what for each in problems)


PLAIN = [
    ("UPDATE run SET text = 'all was well' WHERE id = 3", "run 3", "the run itself"),
    ("UPDATE run SET kind = 'golden' WHERE id = 3", "run 3", "its claim"),
    ("UPDATE run_target SET reached = 2 WHERE run_id = 1", "run 1", "verification of its targets"),
    ("UPDATE step SET duration_s = 0.1 WHERE run_id = 1", "run 1", "its steps"),
    ("DELETE FROM step WHERE run_id = 3", "run 3", "its steps"),
    ("UPDATE device_write SET read_back = 'V9' WHERE run_id = 1", "run 1", "its writes"),
    ("DELETE FROM attachment WHERE run_id = 3", "run 3", "its attachments"),
    ("UPDATE unit SET serial = 'W9999999' WHERE id = 3", "unit of run 3", "serial number or part"),
    ("UPDATE operator SET name = 'someone'", "operator of run 1, 2, 3, 4", "operator's name"),
    ("UPDATE lot SET name = 'L2'", "lot of run 1", "the lot's name"),
    ("UPDATE socket SET name = 'Z'", "socket of run", "the socket's name"),
    ("UPDATE recipe SET content = '# nothing'", "recipe of run", "revision or content"),
    ("UPDATE artifact SET name = 'good.bin'", "artifacts of run", "an image's name"),
    ("UPDATE artifact SET size_bytes = 1", "artifacts of run", "size"),
    ("UPDATE station SET name = 'line-9'", "station of run", "the station's name"),
    ("UPDATE station SET name = 'line-9'", "audit row 1 of line-9", "that of the station line-2"),
    ("DELETE FROM audit WHERE id = 4", "audit row 5", "the previous row is missing"),
    ("UPDATE audit SET at = '2026-01-01' WHERE id = 4", "audit row 4", "changed after it was"),
    ("UPDATE audit SET signature = 'x' WHERE id = 4", "audit row 4", "not signed with the key"),
    ("DELETE FROM audit WHERE id > 7", "audit trail of line-2", "row 9"),
    ("DELETE FROM audit", "audit trail of line-2", "ends at row 0"),
    ("DELETE FROM run WHERE id = 4", "run 4", "is missing"),
    ("UPDATE schema_info SET records_id = 'x'", "audit row 1", "that of other records"),
    ("UPDATE run SET state = 'GOOD' WHERE id = 3", "run 3", "it cannot be read: 'GOOD'"),
    ("UPDATE run SET begun_at = 'now' WHERE id = 3", "run 3", "it cannot be read"),
    ("UPDATE run SET text = X'00FF' WHERE id = 3", "run 3", "the run itself"),
    ("DELETE FROM unit WHERE id = 3", "unit of run 3", "serial number or part"),
    ("UPDATE audit SET event = 'restored' WHERE id = 4", "audit row 4", "changed after it was"),
    ("UPDATE audit SET number = 'x' WHERE id = 4", "audit row", "the previous row is missing"),
    ("INSERT INTO unit (part, serial) VALUES ('BAT-36', 'W1')", "unit W1", "no run refers to it"),
    ("INSERT INTO lot (part, name) VALUES ('BAT-36', 'L9')", "lot L9", "no run refers to it"),
    ("UPDATE step SET run_id = 77 WHERE run_id = 1", "table step", "a missing row of run"),
]  # fmt: skip


@pytest.mark.parametrize(("statement", "where", "what"), PLAIN, ids=[row[0] for row in PLAIN])
def test_a_changed_row_is_found(
    plant: Bench, tmp_path: Path, statement: str, where: str, what: str
) -> None:
    problems = examined(plant, tmp_path, lambda forger, _: forger(statement))
    assert noted(problems, where, what), problems


def to_pass(forger: Forger, folder: Path) -> None:
    """The bad unit becomes a good one, with the trace of a good one, and its audit row agrees."""
    forger("UPDATE step SET state = 'PASS', code = '' WHERE run_id = 3")
    forger("UPDATE run_target SET reached = 2 WHERE run_id = 3")
    forger("UPDATE run SET state = 'PASS', code = 'OK', verification_reached = 2 WHERE id = 3")
    forger("UPDATE run SET log_sha256 = (SELECT log_sha256 FROM run WHERE id = 2) WHERE id = 3")
    forger(
        "UPDATE attachment SET sha256 = (SELECT log_sha256 FROM run WHERE id = 2) WHERE run_id = 3"
    )
    forger.restate(3, folder, state="PASS")


@pytest.mark.slow
def test_a_fail_that_became_a_pass_in_a_recomputed_chain_is_reported(
    plant: Bench, tmp_path: Path
) -> None:
    def forge(forger: Forger, folder: Path) -> None:
        to_pass(forger, folder)
        forger.recompute()

    problems = examined(plant, tmp_path, forge)
    assert noted(problems, "audit row 8 of line-2", "not signed with the key of the station")
    assert noted(problems, "audit trail of line-2", "the chain was replaced")
    assert noted(problems, f"run 3, PASS of {FAILED}", f"it is the trace of {OTHER}")
    assert noted(problems, "runs 2, 3", "the same trace")


def test_a_chain_signed_anew_with_another_key_is_found_by_the_kept_heads(
    plant: Bench, tmp_path: Path
) -> None:
    def forge(forger: Forger, folder: Path) -> None:
        key = SigningKey.make(folder / "own.key")
        row = forger.db.execute("SELECT data FROM audit WHERE number = 1").fetchone()
        data = json.loads(row["data"]) | {"key": key.public}
        forger("UPDATE audit SET data = ? WHERE number = 1", canonical(data))
        forger("UPDATE run SET text = 'all was well' WHERE id = 3")
        forger.restate(3, folder)
        forger.recompute(key)

    (problem,) = examined(plant, tmp_path, forge)
    assert problem.where == "audit trail of line-2"
    assert "row 1 of 2026-05-17" in problem.what
    assert "replaced" in problem.what


def test_rules_taken_away_or_made_weaker_are_reported(plant: Bench, tmp_path: Path) -> None:
    def forge(forger: Forger, _folder: Path) -> None:
        del forger.rules["run_delete"]
        forger.rules["pass_log"] = forger.rules["pass_log"].replace("NOT EXISTS", "EXISTS")
        forger.rules["own"] = forger.rules["run_update"].replace("run_update", "own")

    assert [(each.where, each.what) for each in examined(plant, tmp_path, forge)] == [
        ("schema, trigger own", "it was added"),
        ("schema, trigger pass_log", "it was changed"),
        ("schema, trigger run_delete", "it was removed"),
    ]


def test_an_older_copy_is_reported(bench: Bench) -> None:
    bench.make()
    older = bench.folder / "older.sqlite"
    bench.store.backup(older)
    bench.make(serial=OTHER)
    bench.store.close()
    older.replace(bench.path)
    with bench.opened() as store:
        (problem,) = store.examine().problems
    assert "ends at row 4, but row 6" in problem.what
    assert "an older copy" in problem.what


@pytest.mark.slow
def test_a_pass_with_the_trace_of_something_else_is_reported(bench: Bench) -> None:
    """Written through the station's own operations, with its key: only the trace tells."""
    folder = bench.folder
    other_image = IMAGES[next(target for target in IMAGES if target.name == "wmc")]
    traces = {
        SERIAL: (run_messages(OTHER, BMS_VERSION, IMAGES_BMS), f"it is the trace of {OTHER}"),
        "W2605011": (run_messages("W2605011", BMS_VERSION, other_image), "another image"),
        "W2605012": (run_messages("W2605012", BMS_VERSION, None), "no complete transfer"),
        "W2605013": (run_messages("W2605013", "V9r9r9_20200101", IMAGES_BMS), "answers version"),
        "W2605014": (iter(()), "no complete transfer"),
    }
    for serial, (messages, what) in traces.items():
        run_id = passed(bench, serial, write_trace(folder / f"{serial}.log.gz", messages))
        assert noted(bench.store.examine().problems, f"run {run_id}, PASS of {serial}", what)
    run_id = bench.claim("W2605015").run_id
    write = bench.store.intent(run_id, "bms", "serial-number", "W2605015")
    bench.store.verified(write, "W2605015")
    bench.work(run_id)
    bench.store.finish(run_id, bench.ending(trace=bench.traced("W2605015")))
    assert noted(
        bench.store.examine().problems, f"run {run_id}", "W2605015 is not written in the trace"
    )
    broken = folder / "broken.log.gz"
    broken.write_bytes(b"no trace")
    run_id = passed(bench, "W2605016", broken)
    assert noted(bench.store.examine().problems, f"run {run_id}", "its trace cannot be read")


IMAGES_BMS = IMAGES[next(target for target in IMAGES if target.name == "bms")]


def passed(bench: Bench, serial: str, trace: Path) -> RunId:
    run_id = bench.claim(serial).run_id
    bench.work(run_id)
    bench.store.finish(run_id, bench.ending(trace=trace))
    return run_id


def test_wholly_new_records_are_found_where_the_heads_have_to_be(
    plant: Bench, tmp_path: Path
) -> None:
    new = str(tmp_path / "new.sqlite")
    with Store.open(new, station="line-2", key_locations=KeyLocations(tmp_path / "own")) as made:
        made.recover()
    key_locations = KeyLocations(tmp_path / "none")
    with Store.open(new, station="x", read_only=True, key_locations=key_locations) as store:
        found = store.examine()
        assert not found.problems
        assert found.unkept == ("line-2",)
        assert not found.is_checked_elsewhere
    key_locations = KeyLocations(tmp_path / "none", (str(plant.keys),))
    with Store.open(new, station="x", read_only=True, key_locations=key_locations) as store:
        assert noted(store.examine().problems, "heads of line-2", "no head of these records")


def test_kept_heads_that_were_changed_are_reported(plant: Bench, tmp_path: Path) -> None:
    def forge(_forger: Forger, folder: Path) -> None:
        (kept,) = (folder / "keys").glob("*.heads")
        lines = kept.read_text().splitlines(keepends=True)
        kept.write_text("".join([lines[0], "nothing\n", *lines[2:]]))

    (problem,) = examined(plant, tmp_path, forge)
    assert problem.where.startswith("heads of line-2, ")
    assert problem.what == "line 2 is not a head"


def test_the_key_is_for_this_user_alone_and_a_head_is_kept_of_every_row(plant: Bench) -> None:
    (key,) = plant.keys.glob("*.key")
    assert key.stat().st_mode & 0o777 == 0o600
    (kept,) = plant.keys.glob("*.heads")
    numbers = [json.loads(line)["number"] for line in kept.read_text().splitlines()]
    with closing(sqlite3.connect(plant.path)) as db:
        rows = [number for (number,) in db.execute("SELECT number FROM audit ORDER BY number")]
    assert numbers == rows
