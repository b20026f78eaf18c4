# ruff: noqa: S608  all of this SQL is written here
"""A station's records arrive in the plant's database whole, in order, once; or they are refused."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from flasher import __version__
from flasher.plant import forwarder as forwarder_module
from flasher.plant.central import Central, ChainRefusedError, Refusal
from flasher.plant.forwarder import ForwarderState, load_state, state_file
from flasher.plant.health import checks
from flasher.plant.process import keep_sending
from flasher.plant.setup import setup
from flasher.station.health import HealthCheck
from flasher.station.records.errors import RecordError
from flasher.station.records.files import FileStore
from flasher.station.records.model import AuditEvent, RunDetails, RunId, RunState
from tests.plant.factory import Plant, Sender

OTHER = "W2605003"


def without_ids(details: RunDetails) -> RunDetails:
    """A run without the numbers of its rows, which differ between station and plant."""
    writes = tuple(replace(each, write_id=0) for each in details.writes)  # type: ignore[arg-type]
    return replace(details, run=replace(details.run, run_id=RunId(0)), writes=writes)


def hashes(plant: Plant) -> list[str]:
    return [row for (row,) in plant.rows("SELECT hash FROM chain_row ORDER BY station, number")]


def own_hashes(sender: Sender) -> list[str]:
    with closing(sqlite3.connect(sender.bench.path)) as records:
        return [row for (row,) in records.execute("SELECT hash FROM audit ORDER BY number")]


def test_a_run_arrives_with_all_its_parts_and_its_trace(plant: Plant, sender: Sender) -> None:
    run_id = sender.bench.make()
    sender.send()
    own = sender.bench.store.read.run(run_id)
    with closing(plant.store()) as store:
        (listed,) = store.read.table()
        found = store.read.run(RunId(listed.run_id))
        assert without_ids(found) == without_ids(own)
    assert hashes(plant) == own_hashes(sender)
    sha256 = own.run.log_sha256
    ((data,),) = plant.rows(f"SELECT data FROM trace WHERE sha256 = '{sha256}'")
    assert data == sender.bench.store.files.read(str(sha256))


def test_rows_of_persons_and_of_later_reprints_arrive_too(plant: Plant, sender: Sender) -> None:
    run_id = sender.bench.make()
    sender.bench.store.note(AuditEvent.OPERATOR, {"name": "jo"})
    sender.send()
    sender.bench.store.note(AuditEvent.REPRINT, {"by": "jo"}, run_id)
    sender.send()
    found = plant.rows("SELECT event, run_id IS NOT NULL FROM audit ORDER BY id")
    assert found[-4:] == [
        ("claimed", True), ("finished", True), ("operator", False), ("reprint", True),
    ]  # fmt: skip


def test_a_run_that_is_active_arrives_with_its_end(plant: Plant, sender: Sender) -> None:
    claim = sender.bench.claim()
    sender.send()
    assert plant.rows("SELECT count(*) FROM run") == [(0,)]
    sender.bench.work(claim.run_id)
    sender.bench.store.finish(claim.run_id, sender.bench.ending())
    sender.send()
    assert plant.rows("SELECT state FROM run") == [("PASS",)]
    assert hashes(plant) == own_hashes(sender)


def test_an_interrupted_run_arrives(plant: Plant, sender: Sender) -> None:
    sender.bench.claim()
    sender.bench.store.recover()
    sender.send()
    assert plant.rows("SELECT state FROM run") == [("INTERRUPTED",)]


def test_what_was_sent_before_is_not_sent_again(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forwarder_module, "BATCH_ROWS", 3)
    for number in range(4):
        sender.bench.make(serial=f"W260501{number}")
    sender.forwarder.forward()
    sender.start()
    sender.send()
    sender.start()
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert plant.rows("SELECT count(*) FROM run") == [(4,)]


def test_a_batch_is_bounded_by_the_size_of_its_traces(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forwarder_module, "BATCH_BYTES", 1)
    for number in range(3):
        sender.bench.make(serial=f"W260501{number}")
    assert sender.forwarder.forward()
    assert plant.rows("SELECT count(*) FROM run") == [(1,)]
    sender.send()
    assert hashes(plant) == own_hashes(sender)


@pytest.mark.parametrize("point", ["enter", "part", "trace", "row", "commit", "acknowledge"])
def test_a_forwarder_that_dies_loses_and_doubles_nothing(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch, point: str
) -> None:
    """Between send, commit and acknowledgement: the connection is gone at each of the points."""
    sender.bench.make()
    sender.bench.make(RunState.FAIL, serial=OTHER)
    reached: list[str] = []
    usual = Central.writing
    points = {"enter": "ENTER", "part": "_ADD_PART", "trace": "_ADD_TRACE", "row": "ADD_ROW"}

    class Dying:
        def __init__(self, connection: Any) -> None:
            self._connection = connection

        def execute(self, statement: Any, values: Any) -> Any:
            found = self._connection.execute(statement, values)
            of_point = points.get(point)
            if of_point and statement is getattr(forwarder_module, of_point):
                self.die()
            return found

        def die(self) -> None:
            if not reached:
                reached.append(point)
                raise SystemExit(137)

    from contextlib import contextmanager  # noqa: PLC0415

    transactions: list[int] = []

    @contextmanager
    def writing(central: Central) -> Any:
        transactions.append(1)
        with usual(central) as connection:
            dying = Dying(connection)
            yield dying
            if point == "commit" and len(transactions) == 2:
                dying.die()
        if point == "acknowledge" and len(transactions) == 2:
            dying.die()

    monkeypatch.setattr(Central, "writing", writing)
    with pytest.raises(SystemExit):
        sender.send()
    assert reached == [point]
    sender.start()
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert plant.rows("SELECT count(*), count(DISTINCT unit_id) FROM run") == [(2, 2)]


def test_a_server_that_is_away_is_waited_for(plant: Plant, sender: Sender) -> None:
    run_id = sender.bench.make()
    sender.lose_the_server()
    assert not sender.forwarder.forward()
    state = sender.forwarder.state
    assert state.fault
    assert state.unsent == len(own_hashes(sender))
    assert load_state(sender.bench.store.files.folder, sender.station) == state
    shown = check_of(sender)
    assert not shown.is_good
    begin = f"{state.unsent} rows wait: sending to the plant failed: "
    assert shown.text.removesuffix("...") in begin + state.fault
    assert len(shown.text) > len(begin)
    assert sender.bench.store.read.run(run_id).run.state is RunState.PASS
    sender.start()
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert check_of(sender).is_good


def test_a_station_that_is_older_than_the_database_goes_on(plant: Plant, sender: Sender) -> None:
    # A newer schema keeps the functions that stations call; they may not even read its number.
    with plant.connect() as owner:
        owner.execute("UPDATE plant_version SET version_num = '99'")
        owner.execute("ALTER TABLE plant_station ADD COLUMN new_in_99 text NOT NULL DEFAULT ''")
        owner.execute("ALTER TABLE chain_row ADD COLUMN new_in_99 text NOT NULL DEFAULT ''")
    sender.bench.make()
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert not sender.forwarder.state.fault
    ((reported,),) = plant.rows("SELECT version FROM plant_station WHERE name = 'line-2'")
    assert reported == __version__


def test_it_sends_until_the_station_ends_and_then_the_rest(plant: Plant, sender: Sender) -> None:
    sender.bench.make()
    waits: list[float] = []

    def wait(limit_s: float) -> bool:
        waits.append(limit_s)
        if len(waits) == 3:
            sender.bench.make(serial=OTHER)
            return True
        return False

    keep_sending(sender.forwarder, wait)
    assert hashes(plant) == own_hashes(sender)


def test_it_waits_longer_for_a_server_that_stays_away(sender: Sender) -> None:
    sender.lose_the_server()
    waits: list[float] = []

    def wait(limit_s: float) -> bool:
        waits.append(limit_s)
        return len(waits) == 7

    keep_sending(sender.forwarder, wait)
    assert waits == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


def test_a_lost_trace_holds_no_run_up(plant: Plant, sender: Sender) -> None:
    run_id = sender.bench.make()
    files = sender.bench.store.files
    files.path(str(sender.bench.store.read.run(run_id).run.log_sha256)).unlink()
    sender.bench.make(serial=OTHER)
    sender.send()
    assert plant.rows("SELECT count(*) FROM run") == [(2,)]
    assert plant.rows("SELECT count(*) FROM trace") == [(1,)]


def test_runs_of_a_unit_are_in_the_order_of_time_however_late_they_arrive(
    plant: Plant, sender: Sender
) -> None:
    """Line-2 passed the unit first; line-3, which was on-line, found it bad afterwards."""
    sender.bench.make()
    other = plant.sender("line-3")
    other.bench.clock.go_on(3600)
    other.bench.make(RunState.FAIL)
    other.send()
    sender.send()
    other.close()
    with closing(plant.store()) as store:
        life = store.read.unit("W2605002")
    assert [details.run.station for details in life.runs] == ["line-2", "line-3"]
    assert life.state.value == "FAIL"


def test_runs_that_began_in_the_same_microsecond_both_arrive(plant: Plant, sender: Sender) -> None:
    other = plant.sender("line-3")
    for each in (sender, other):
        each.bench.make()
        each.send()
    other.close()
    ids = [found for (found,) in plant.rows("SELECT id FROM run ORDER BY id")]
    assert ids[1] == ids[0] + 1


def check_of(sender: Sender) -> HealthCheck:
    """What the operator page shows."""
    folder, now = sender.bench.store.files.folder, sender.forwarder._clock.utc()
    return checks(folder, sender.station, now, 5.0)[0]


# -- refused by name -------------------------------------------------------------------------------


def refused(sender: Sender) -> Refusal:
    with pytest.raises(ChainRefusedError) as caught:
        sender.send()
    reported = sender.plant.status(sender.station)
    assert reported.refusal == caught.value.text
    state = load_state(sender.bench.store.files.folder, sender.station)
    assert state.refusal == caught.value.text
    shown = check_of(sender)
    assert not shown.is_good
    assert caught.value.text in shown.text
    return caught.value.refusal


def copied(sender: Sender, to: Path) -> Path:
    sender.bench.store.database.close()
    return Path(shutil.copy(sender.bench.path, to))


def changed(sender: Sender, *statements: str) -> None:
    """What somebody does to the file who can write it, against the rules of the records."""
    with closing(sqlite3.connect(sender.bench.path)) as records:
        triggers = records.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
        for (name,) in triggers.fetchall():
            records.execute(f"DROP TRIGGER {name}")
        for statement in statements:
            records.execute(statement)
        records.commit()


def test_two_copies_of_the_records_that_both_go_on_are_a_fork(
    sender: Sender, tmp_path: Path
) -> None:
    sender.bench.make()
    copy = copied(sender, tmp_path / "copy.sqlite")
    sender.bench.make(serial=OTHER)
    sender.send()
    sender.close()
    shutil.copy(copy, sender.bench.path)
    for heads in sender.bench.keys.glob("*.heads"):
        heads.unlink()  # the station itself would refuse the older copy
    sender.bench.store = sender.bench.opened()
    sender.bench.store.recover()
    sender.start()
    assert refused(sender) is Refusal.REPLAYED
    for serial in ("W2605009", "W2605010"):
        sender.bench.make(serial=serial)
    assert refused(sender) is Refusal.FORKED


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE run SET code = 'OK', state = 'FAIL'",
        "UPDATE step SET duration_s = 1.5",
        "UPDATE unit SET serial = 'W2605099'",
        "UPDATE operator SET name = 'somebody else'",
        "UPDATE recipe SET content = 'other'",
        "DELETE FROM step",
        "UPDATE audit SET data = replace(data, 'PASS', 'FAIL') WHERE event = 'finished'",
        "UPDATE audit SET at = '2026-01-01T00:00:00.000000Z' WHERE event = 'finished'",
    ],
)
def test_edited_records_are_refused(sender: Sender, plant: Plant, statement: str) -> None:
    sender.bench.make()
    changed(sender, statement)
    assert refused(sender) is Refusal.EDITED
    assert plant.rows("SELECT count(*) FROM run") == [(0,)]


def test_records_are_sent_again_after_the_right_ones_are_back(
    plant: Plant, sender: Sender, tmp_path: Path
) -> None:
    sender.bench.make()
    copy = copied(sender, tmp_path / "copy.sqlite")
    changed(sender, "UPDATE operator SET name = 'somebody else'")
    assert refused(sender) is Refusal.EDITED
    sender.end()
    shutil.copy(copy, sender.bench.path)
    sender.start()
    sender.send()
    assert plant.status().refusal == ""
    assert hashes(plant) == own_hashes(sender)


def test_a_row_that_is_missing_in_between_is_refused(sender: Sender) -> None:
    sender.bench.make()
    changed(sender, "DELETE FROM audit WHERE number = 2")
    assert refused(sender) is Refusal.INCOMPLETE


def test_a_station_with_the_user_of_another_is_foreign(plant: Plant, sender: Sender) -> None:
    sender.role = "flasher_line_3"
    sender.start()
    with pytest.raises(ChainRefusedError) as caught:
        sender.send()
    assert caught.value.refusal is Refusal.FOREIGN
    assert plant.rows("SELECT count(*) FROM chain_row") == [(0,)]


def test_new_records_under_the_same_name_are_foreign_until_renewed(
    plant: Plant, sender: Sender
) -> None:
    sender.bench.make()
    sender.send()
    sender.close()
    for path in (*sender.bench.keys.iterdir(), *sender.folder.glob("records.sqlite*")):
        if path.is_file():
            path.unlink()
    sender.bench.store = sender.bench.opened()
    sender.bench.store.recover()
    sender.bench.make()
    sender.start()
    assert refused(sender) is Refusal.FOREIGN
    assert "flasher plant init --renew" in str(sender.forwarder.error)
    setup(plant.url(), (), datetime.now(UTC), renewed=["line-2"])
    sender.send()
    assert plant.rows("SELECT count(DISTINCT station), count(*) FROM chain_row") == [(2, 8)]


def test_an_unreadable_state_file_is_reported(tmp_path: Path) -> None:
    state_file(tmp_path, "line-2").write_text("{", encoding="ascii")
    with pytest.raises(RecordError, match="cannot be read"):
        load_state(tmp_path, "line-2")
    assert load_state(tmp_path / "nowhere", "line-2") == ForwarderState()


def test_a_disk_that_takes_no_state_file_stops_neither_rows_nor_report(
    plant: Plant, sender: Sender
) -> None:
    """As a full disk does; a folder in the way refuses root too."""
    sender.bench.make()
    folder = sender.bench.store.files.folder
    state_file(folder, "line-2").mkdir()
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert plant.status().unsent == 0
    assert not list(folder.glob("*.part"))
    shown = check_of(sender)
    assert not shown.is_good


def test_a_folder_of_files_that_cannot_be_made_stops_neither(plant: Plant, sender: Sender) -> None:
    (sender.folder / "in the way").touch()
    sender.forwarder._files = FileStore(sender.folder / "in the way" / "files")
    sender.send()
    assert hashes(plant) == own_hashes(sender)
    assert plant.status().disk_free_bytes is None


def test_two_senders_of_a_station_at_once_do_not_disturb_each_other(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`flasher plant send` while the station runs: both write the state file."""
    sender.bench.make()
    running = sender.forwarder
    sender._forwarders.clear()
    sender.start()
    usual = Path.replace

    def replace_late(part: Path, to: Path) -> Path:
        monkeypatch.undo()
        assert not running.forward()  # between writing the file and its new name
        return usual(part, to)

    monkeypatch.setattr(Path, "replace", replace_late)
    sender.send()
    running.close()
    assert hashes(plant) == own_hashes(sender)
    assert load_state(sender.bench.store.files.folder, sender.station) == sender.forwarder.state


def test_stations_that_share_a_folder_have_states_of_their_own(
    plant: Plant, sender: Sender
) -> None:
    other = plant.sender("line-3")
    other.forwarder._files = sender.forwarder._files
    other.lose_the_server()
    sender.send()
    other.forwarder.forward()
    other.close()
    assert check_of(sender).is_good
    assert load_state(sender.bench.store.files.folder, "line-3").fault
