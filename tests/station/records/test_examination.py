"""An examination goes on from the last one; a certificate examines its own run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, event

from flasher.station.records import chain, examination, heads
from flasher.station.records.model import Examination, RunId, RunState
from flasher.station.records.store import Store
from tests.station.factory import Bench
from tests.station.records.test_places import forging, make_anew, noted

OTHER = "W2605003"


def examine_two(bench: Bench) -> None:
    bench.make()
    bench.make(serial=OTHER)
    found = bench.store.examine()
    assert not found.problems
    assert found.since is None


@pytest.fixture
def examined(tmp_path: Path) -> Iterator[Bench]:
    """Records of two units that were examined, and found good."""
    made = Bench(tmp_path, grow=examine_two)
    yield made
    made.store.close()


def go_on(bench: Bench) -> Examination:
    return bench.store.examine(incremental=True)


def changed(bench: Bench, statement: str) -> None:
    with forging(bench) as connection:
        connection.exec_driver_sql(statement)


@pytest.mark.slow
def test_only_what_came_after_the_last_examination_is_examined(examined: Bench) -> None:
    examined.make(RunState.FAIL, "W2605004")
    running = examined.claim("W2605005").run_id
    examined.work(running)
    seen: list[tuple[int, int]] = []
    found = examined.store.examine(
        incremental=True, progress=lambda done, total: seen.append((done, total))
    )
    assert not found.problems
    assert found.since is not None
    assert [(each.first, each.last, each.rows) for each in found.kept] == [(1, 9, 9)]
    assert seen[0] == (0, 5)  # the bar is there before the first row
    assert seen[-1] == (5, 5)  # three audit rows and two runs
    examined.store.finish(running, examined.ending(trace=examined.traced("W2605005")))
    again = go_on(examined)
    assert not again.problems
    assert again.traces == 1  # of the run that went on then
    assert examined.store.examine().traces == 3


@pytest.mark.slow
def test_more_runs_are_no_more_statements(bench: Bench) -> None:
    """All rows of many runs are read together: an examination of a million runs asks for each page
    of the database about once.
    """
    asked: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        asked.append(statement)

    event.listen(bench.store.database.engine, "before_cursor_execute", note)
    counts = []
    for serial in ("W2605002", "W2605003", "W2605004"):
        bench.make(serial=serial)
        asked.clear()
        assert not bench.store.examine().problems
        counts.append(len(asked))
    assert counts == counts[:1] * 3
    reads = [statement for statement in asked if " step" in statement]
    assert len(reads) == 2, reads  # steps, and the measurements of steps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statement", "where", "what"),
    [
        ("UPDATE run SET text = 'all was well' WHERE id = 3", "run 3", "the run itself"),
        ("DELETE FROM audit WHERE number = 8", "audit trail of line-2", "its end was cut off"),
        ("UPDATE audit SET signature = 'x' WHERE number = 7", "audit row 7", "not signed"),
        ("DELETE FROM attachment WHERE run_id = 3", "run 3", "its attachments"),
        ("INSERT INTO unit (part, serial) VALUES ('BAT-36', 'W1')", "unit W1", "no run refers"),
    ],
)
def test_what_was_changed_since_is_reported(
    examined: Bench, statement: str, where: str, what: str
) -> None:
    examined.make(serial="W2605004")
    changed(examined, statement)
    found = go_on(examined)
    assert found.since is not None
    assert noted(found.problems, where, what), found.problems
    assert noted(go_on(examined).problems, where, what)  # and is not forgotten


def test_what_was_changed_before_is_reported_by_a_whole_examination(examined: Bench) -> None:
    changed(examined, "UPDATE run SET text = 'all was well' WHERE id = 1")
    assert not go_on(examined).problems
    assert noted(examined.store.examine().problems, "run 1", "the run itself")


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM audit WHERE number = 4",
        "DELETE FROM audit WHERE number >= 5",
        "DELETE FROM run WHERE id = 1",
    ],
)
def test_what_is_not_as_it_was_examined_is_examined_as_a_whole(
    examined: Bench, statement: str
) -> None:
    changed(examined, statement)
    found = go_on(examined)
    assert found.since is None
    assert "everything is examined again" in found.remarks[0]
    assert found.problems


def test_a_note_that_was_changed_is_not_believed(examined: Bench) -> None:
    (note,) = examined.keys.glob("*.examined")
    note.write_text(note.read_text().replace('"runs": 2', '"runs": 3'))
    found = go_on(examined)
    assert found.since is None
    assert found.remarks[0] == (
        "The file of the last examination was changed. Everything is examined."
    )
    assert go_on(examined).since is not None


def test_a_folder_that_cannot_be_written_is_examined_all_the_same(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_words: object) -> None:
        raise OSError(28, "No space left on device")

    bench.make()
    monkeypatch.setattr(Path, "replace", full)
    found = bench.store.examine()
    assert not found.problems
    assert "the next examination starts from the beginning" in found.remarks[0]


# -- one run ---------------------------------------------------------------------------------------


def test_a_run_is_examined_without_going_through_the_records(
    examined: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    examined.make(serial="W2605004")
    calls: list[int] = []
    real = chain.contents_of

    def counted(connection: Connection, runs: list[int]) -> dict[int, dict[str, Any]]:
        calls.extend(runs)
        return real(connection, runs)

    monkeypatch.setattr(examination, "contents_of", counted)
    monkeypatch.setattr(heads.HeadsFile, "entries", None)
    first, last = (examined.store.examine_run(RunId(run_id)) for run_id in (1, 3))
    assert calls == [1, 3]
    assert not first.problems
    assert not last.problems
    assert first.is_beside
    assert first.elsewhere == ()
    assert first.examined_at
    assert last.examined_at is None


RUN_FORGERIES: list[tuple[str, str]] = [
    ("UPDATE run SET text = 'all was well' WHERE id = 1", "the run itself"),
    ("UPDATE unit SET serial = 'W2605009' WHERE id = 1", "serial number or part"),
    ("UPDATE audit SET signature = 'x' WHERE run_id = 1", "not signed with the key"),
    ("UPDATE audit SET at = '2026-01-01' WHERE run_id = 1", "it was changed"),
    ("DELETE FROM audit WHERE run_id = 1", "does not have it"),
    ("DELETE FROM audit WHERE number = 6", "but missing here"),
    ("DELETE FROM attachment WHERE run_id = 1", "its attachments"),
]


@pytest.mark.parametrize(("statement", "what"), RUN_FORGERIES)
def test_a_changed_run_is_reported_by_its_own_examination(
    examined: Bench, statement: str, what: str
) -> None:
    changed(examined, statement)
    found = examined.store.examine_run(RunId(1))
    assert any(what in each.what for each in found.problems), found.problems


@pytest.mark.slow
def test_a_run_of_a_chain_made_anew_is_reported_by_another_place(tmp_path: Path) -> None:

    bench = Bench(tmp_path, heads=(tmp_path / "share",))
    bench.make()
    bench.store.signer.wait_for_copies()
    assert bench.store.examine_run(RunId(1)).elsewhere == (str(tmp_path / "share"),)
    make_anew(bench)
    with Store.open(
        str(bench.path), station="x", read_only=True, key_locations=bench.key_locations
    ) as store:
        found = store.examine_run(RunId(1))
    assert any("is not the one that is stored" in each.what for each in found.problems)
