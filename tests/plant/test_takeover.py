"""A spare PC takes a station over, and the station is taken back: nothing is lost or doubled."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.plant.central import ChainRefusedError, Refusal
from flasher.plant.setup import role_of
from flasher.plant.takeover import TakenOver, Takeover
from flasher.station.records.branch import BroughtIn, bring_in
from flasher.station.records.database import locate_records, open_database
from flasher.station.records.errors import (
    ClaimRefusedError,
    KeyMissingError,
    NotFoundError,
    RecordError,
    RecordsDamagedError,
    StationBusyError,
    UnprovenError,
)
from flasher.station.records.errors import Refusal as RefusalReason
from flasher.station.records.files import FileStore
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import AuditEvent, RunId, RunState, UnitState
from flasher.station.records.server import ServerLock
from flasher.station.records.signatures import SigningKey
from flasher.station.records.store import Store
from tests.loops import sample
from tests.plant.factory import READER, Plant, Sender
from tests.plant.test_claims import Line, expire
from tests.plant.test_retire import MONTH_S, retired
from tests.plant.test_retire import examined as examined_with
from tests.plant.test_verify import examined
from tests.station.factory import USUAL, FakeClock

pytestmark = pytest.mark.slow
WHEN = datetime(2026, 5, 17, 12, tzinfo=UTC)


def takeover_of(plant: Plant, folder: Path, archives: Path | None = None) -> Takeover:
    return Takeover(
        "line-2", plant.url(READER), plant.url(role_of("line-2")),
        locate_records(str(folder / "records.sqlite")), KeyLocations(folder / "keys"),
        "sv", "the PC died", archives,
    )  # fmt: skip


@pytest.fixture
def key(sender: Sender) -> bytes:
    return sender.bench.store.signer.key_file.read_bytes()


def spare_of(plant: Plant, sender: Sender, name: str = "spare") -> Sender:
    """Another PC, with the records that a takeover has put there."""
    folder = plant.folder / name
    shutil.copytree(sender.bench.folder / "keys", folder / "unused", dirs_exist_ok=True)
    made = object.__new__(Sender)
    made.plant, made.station, made.folder, made.role = plant, "line-2", folder, ""
    made._forwarders = []
    made.bench = bench = object.__new__(type(sender.bench))
    bench.folder, bench.path, bench.recipe = folder, folder / "records.sqlite", sender.bench.recipe
    bench.clock, bench.lock_timeout_s, bench.heads, bench._traces = FakeClock(WHEN), 0.5, (), 500
    bench.trace = bench.traced("W2605002")
    bench.store = bench.opened()
    bench.store.recover()
    made.start()
    return made


def taken(
    plant: Plant, key: bytes | None, name: str = "spare", archives: Path | None = None
) -> TakenOver:
    return takeover_of(plant, plant.folder / name, archives).run(key, FakeClock(WHEN).utc)


def brought(spare: Sender, old: Path) -> BroughtIn:
    files = old.with_name("records.sqlite.files")
    with closing(
        open_database(
            locate_records(str(old), files), WHEN, lock_timeout_s=0.5, create=False, read_only=True
        )
    ) as branch:
        return bring_in(
            spare.bench.store, branch, FileStore(files), by="sv", reason="back", now=WHEN
        )


def states(sender: Sender) -> dict[str, UnitState]:
    store = sender.bench.store
    return {row.serial: store.read.unit(row.serial).state for row in store.read.table()}


@pytest.fixture
def spares() -> Iterator[list[Sender]]:
    made: list[Sender] = []
    yield made
    for each in made:
        each.close()


def test_a_spare_pc_goes_on_in_mid_shift_and_the_station_is_taken_back(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    old = sender.bench
    old.make(serial="W2605001")
    old.make(RunState.FAIL, serial="W2605003", lot="L1")
    active = old.claim("W2605004", "B")
    old.store.note(AuditEvent.OPERATOR, {"name": "jo"})
    sender.send()
    # Not sent: the end of the active run, a run, and one that has not ended.
    old.work(active.run_id)
    old.store.finish(active.run_id, old.ending(trace=old.traced("W2605004")))
    unsent = old.make(serial="W2605005")
    old.claim("W2605006", "A")

    found = taken(plant, key)
    assert (found.runs, found.active) == (2, ("W2605004",))
    with pytest.raises(ChainRefusedError) as caught:
        sender.send()
    assert caught.value.refusal is Refusal.TAKEN_OVER
    line_2 = plant.status()
    assert (line_2.refusal, line_2.other_refusal) == ("", caught.value.text)

    spare = spare_of(plant, sender)
    spares.append(spare)
    assert states(spare) == {
        "W2605001": UnitState.PASS, "W2605003": UnitState.FAIL, "W2605004": UnitState.RECHECK,
    }  # fmt: skip
    own = spare.bench.make(serial="W2605007")
    assert own > unsent + 99_000  # numbers are left to the other PC
    spare.bench.make(serial="W2605003")
    spare.send()
    assert not spare.bench.store.examine().problems

    _take_back(plant, sender, spare, unsent)


def _take_back(plant: Plant, sender: Sender, spare: Sender, unsent: int) -> None:
    """On the old PC, which has a branch; the spare PC has one too, then."""
    old = sender.bench
    old.store.close()
    sender.end()
    spare.bench.make(serial="W2605008")
    back = takeover_of(plant, old.folder).run(None, FakeClock(WHEN).utc)
    assert back.set_aside is not None
    with pytest.raises(ChainRefusedError, match="taken-over"):
        spare.send()  # W2605008 was not sent: it is a branch now
    old.store = old.opened()
    old.store.recover()
    sender.start()
    branch = brought(sender, back.set_aside)
    assert len(branch.runs) == 3
    assert unsent in branch.runs
    assert branch.conflicts == ()
    with pytest.raises(NotFoundError):
        brought(sender, back.set_aside)
    spare.bench.store.close()
    second = brought(sender, spare.bench.path)
    assert len(second.runs) == 1
    sender.send()

    assert states(sender) == {
        "W2605001": UnitState.PASS, "W2605003": UnitState.PASS, "W2605004": UnitState.PASS,
        "W2605005": UnitState.PASS, "W2605006": UnitState.RECHECK, "W2605007": UnitState.PASS,
        "W2605008": UnitState.PASS,
    }  # fmt: skip
    found_here = old.store.examine()
    assert not found_here.problems
    assert "took the station over" in " ".join(found_here.remarks)
    in_plant = examined(plant)
    assert not in_plant.problems
    assert in_plant.runs == len(old.store.read.table()) == 9
    assert plant.rows("SELECT count(*) FROM open_run") == [(0,)]
    assert not old.store.examine(incremental=True).problems


def test_a_run_that_ended_and_was_sent_without_its_end_is_interrupted(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch ended between the two, and the PC died before the next one."""
    sender.bench.make(serial="W2605001")
    sender.send()
    sender.bench.make(serial="W2605002")
    monkeypatch.setattr("flasher.plant.forwarder.BATCH_ROWS", 1)
    sender.forwarder.forward()
    monkeypatch.undo()
    assert taken(plant, key).active == ("W2605002",)
    spares.append(spare := spare_of(plant, sender))
    assert states(spare) == {"W2605001": UnitState.PASS, "W2605002": UnitState.RECHECK}
    assert not spare.bench.store.examine().problems
    sender.bench.store.close()
    brought(spare, sender.bench.path)
    assert states(spare)["W2605002"] is UnitState.PASS
    spare.send()
    assert not spare.bench.store.examine().problems
    assert not examined(plant).problems


def test_a_golden_unit_passes_at_both_pcs(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    recipe = USUAL + '\n[golden]\nserial_numbers = ["W2600001"]\nevery_h = 8\n'
    sender.bench.make()
    sender.send()
    taken(plant, key)
    spares.append(spare := spare_of(plant, sender))
    for each in (sender, spare):
        each.bench.use(recipe)
        each.bench.make(serial="W2600001")
    assert brought(spare, sender.bench.path).conflicts == ()


def test_a_unit_that_passes_at_both_pcs_is_named(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    earlier = sender.bench.make(serial="W2605001")
    sender.send()
    taken(plant, key)
    sender.bench.store.note(AuditEvent.LABELLED, {}, earlier)
    labelled = sender.bench.make(serial="W2605009", gets_label=True)
    sender.bench.store.note(AuditEvent.LABELLED, {}, labelled)
    sender.bench.make(serial="W2605008", gets_label=True)
    spares.append(spare := spare_of(plant, sender))
    spare.bench.make(serial="W2605009")
    assert brought(spare, sender.bench.path).conflicts == ("W2605009",)
    sender.bench.make(serial="W2605010")  # the old PC still runs
    sender.bench.store.note(AuditEvent.LABELLED, {}, labelled)
    assert len(brought(spare, sender.bench.path).runs) == 1
    assert [run.serial for run in spare.bench.store.read.unlabelled("line-2")] == ["W2605008"]
    assert not spare.bench.store.examine().problems
    spare.send()
    assert not examined(plant).problems


def test_the_claims_of_the_pc_that_was_taken_over_stay_until_its_records_come(
    plant: Plant, sender: Sender, key: bytes
) -> None:
    """It passed a unit, and did not send that."""
    old, third = Line(plant, "line-2", sender), Line(plant, "line-3")
    sender.bench.make(serial="W2605001")
    sender.send()
    old.end(old.claim("W2605009"))
    taken(plant, key)
    spare = Line(plant, "line-2", spare_of(plant, sender))
    with pytest.raises(ClaimRefusedError) as caught:
        spare.claim("W2605009")
    assert caught.value.refusal is RefusalReason.UNIT_RUNNING
    expire(plant)
    spare.claims.tend()
    for each in (spare, third):
        admission = each.asked("W2605009")
        assert admission.doubt.startswith("line-2 claimed it")
        each.gate.dropped(admission)
        each.claims.tend()

    sender.bench.store.close()
    assert len(brought(spare.sender, sender.bench.path).runs) == 1
    spare.start()
    spare.claims.tend()
    assert plant.rows("SELECT serial FROM plant_claim") == [("W2605009",)]  # it was not sent yet
    spare.sender.send()
    assert plant.rows("SELECT serial FROM plant_claim") == []
    with pytest.raises(ClaimRefusedError) as caught:
        third.claim("W2605009")
    assert caught.value.refusal is RefusalReason.DUPLICATE
    for line in (old, spare, third):
        line.close()


def test_a_pc_that_was_taken_over_claims_nothing(plant: Plant, sender: Sender, key: bytes) -> None:
    old = Line(plant, "line-2", sender)
    sender.bench.make(serial="W2605001")
    sender.send()
    assert not old.asked("W2605002").doubt
    taken(plant, key)
    assert "taken-over" in old.asked("W2605003").doubt
    old.claims.tend()
    assert "taken-over" in old.asked("W2605003").doubt
    old.close()


def test_a_takeover_that_was_retired_still_holds(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    old = Line(plant, "line-2", sender)
    sender.bench.make(serial="W2605001")
    sender.send()
    taken(plant, key)
    spares.append(spare := spare_of(plant, sender))
    spare.bench.clock.go_on(MONTH_S)
    spare.bench.make(serial="W2605002")
    spare.send()
    retired(plant, "2026-06")
    assert plant.rows("SELECT count(*) FROM chain_row WHERE event = 'taken over'") == [(0,)]
    assert "taken-over" in old.asked("W2605003").doubt
    with pytest.raises(ChainRefusedError, match="another PC runs the station") as caught:
        sender.send()
    assert caught.value.refusal is Refusal.TAKEN_OVER
    other = Line(plant, "line-2", spare)
    assert not other.asked("W2605003").doubt
    for each in (old, other):
        each.claims.close()


@pytest.fixture
def with_retired(plant: Plant, sender: Sender) -> Path:
    """Two retired months of two stations, one with a run that has not ended; their folder."""
    other = plant.sender("line-3")
    for each, serials in ((sender, ("W2605001", "W2605002")), (other, ("W2605011", "W2605012"))):
        for serial in serials:
            each.bench.make(serial=serial)
            each.bench.clock.go_on(MONTH_S)
    sender.bench.claim("W2605003", "B")
    sender.bench.store.note(AuditEvent.OPERATOR, {"name": "jo"})
    for each in (sender, other):
        each.send()
        each.close()
    assert [each.month for each in retired(plant, "2026-08")] == ["2026-05", "2026-06", "2026-07"]
    return plant.folder / "archive"


def test_retired_months_are_taken_from_their_files(
    plant: Plant, sender: Sender, key: bytes, with_retired: Path, spares: list[Sender],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr("tests.plant.test_takeover.WHEN", WHEN + timedelta(days=90))
    found = taken(plant, key, archives=with_retired)
    assert (found.runs, found.active) == (2, ("W2605003",))
    spares.append(spare := spare_of(plant, sender))
    assert states(spare) == {
        "W2605001": UnitState.PASS, "W2605002": UnitState.PASS, "W2605003": UnitState.RECHECK,
    }  # fmt: skip
    with pytest.raises(ClaimRefusedError) as caught:
        spare.bench.claim("W2605001")
    assert caught.value.refusal is RefusalReason.DUPLICATE
    spare.bench.make(serial="W2605003")
    spare.send()
    assert not spare.bench.store.examine().problems
    assert not examined_with(plant, with_retired).problems


def test_files_of_retired_months_that_are_missing_or_damaged_are_named(
    plant: Plant, key: bytes, with_retired: Path
) -> None:
    with pytest.raises(UsageError, match=r"line-2 are in \d file\(s\) of retired months") as caught:
        taken(plant, key)
    assert "--archive FOLDER" in caught.value.remedy
    june = next(with_retired.glob("*-2026-06.tar.gz"))
    data = june.read_bytes()
    june.unlink()
    with pytest.raises(UsageError, match=r"2026-06\.tar\.gz with retired rows of line-2 is not in"):
        taken(plant, key, archives=with_retired)
    june.write_bytes(data[: len(data) // 2])
    with pytest.raises(RecordsDamagedError):
        taken(plant, key, archives=with_retired)
    june.write_bytes(next(with_retired.glob("*-2026-07.tar.gz")).read_bytes())
    with pytest.raises(RecordsDamagedError, match="not as the station signed"):
        taken(plant, key, archives=with_retired)
    assert not (plant.folder / "spare" / "records.sqlite").exists()
    assert plant.rows("SELECT DISTINCT takeover FROM plant_station") == [("",)]


def test_a_pc_that_waits_for_the_unit_while_it_is_taken_over_does_not_claim_it(
    plant: Plant, sender: Sender
) -> None:
    old = Line(plant, "line-2", sender)
    old.claims.tend()
    lock = (
        "SELECT pg_advisory_xact_lock(hashtextextended('BAT-36' || E'\\x1f' || 'W2605002',"
        f" {ServerLock.UNIT:d}))"
    )
    waiting = "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND NOT granted"
    with ThreadPoolExecutor() as pool, plant.connect() as spare:
        spare.execute(lock.encode())
        asked = pool.submit(old.asked, "W2605002")
        while plant.rows(waiting) == [(0,)]:
            assert not asked.done()
        spare.execute("UPDATE plant_station SET takeover = 'x' WHERE name = 'line-2'")
        spare.commit()
        assert "taken-over" in asked.result().doubt
    old.claims.close()


def test_claims_of_a_pc_stay_until_its_own_records_come(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    """Two PCs were taken over; the records of the second one come twice."""
    first = Line(plant, "line-2", sender)
    sender.bench.make(serial="W2605001")
    sender.send()
    first.end(first.claim("W2605009"))
    taken(plant, key)
    spares.append(second := spare_of(plant, sender))
    second.send()
    taken(plant, key, "third")
    spares.append(third := spare_of(plant, sender, "third"))
    for serial in ("W2605003", "W2605004"):
        second.bench.make(serial=serial)
        assert len(brought(third, second.bench.path).runs) == 1
    line = Line(plant, "line-2", third)
    line.claims.tend()
    assert plant.rows("SELECT serial FROM plant_claim") == [("W2605009",)]
    sender.bench.store.close()
    brought(third, sender.bench.path)
    line.start()
    line.claims.tend()
    third.send()
    assert plant.rows("SELECT serial FROM plant_claim") == []
    for each in (first, line):
        each.claims.close()


@pytest.mark.parametrize("sent", sample([1, 4], [1, 2, 4, 6]))
def test_a_branch_that_was_sent_in_part_is_completed_after_the_next_takeover(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender], sent: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    old = Line(plant, "line-2", sender)
    sender.bench.make(serial="W2605001")
    sender.send()
    for serial in ("W2605002", "W2605003", "W2605004"):
        old.end(old.claim(serial))
    taken(plant, key)
    spares.append(second := spare_of(plant, sender))
    second.send()
    sender.bench.store.close()
    assert len(brought(second, sender.bench.path).runs) == 3
    monkeypatch.setattr("flasher.plant.forwarder.BATCH_ROWS", sent)
    second.forwarder.forward()
    monkeypatch.undo()
    taken(plant, key, "third")
    spares.append(third := spare_of(plant, sender, "third"))
    line = Line(plant, "line-2", third)
    line.claims.tend()
    assert plant.rows("SELECT count(*) FROM plant_claim") == [(3 - (sent - 1) // 2,)]
    brought(third, sender.bench.path)
    with pytest.raises(NotFoundError):
        brought(third, sender.bench.path)
    line.start()
    line.claims.tend()
    third.send()
    serials = [f"W260500{number}" for number in (1, 2, 3, 4)]
    assert states(third) == dict.fromkeys(serials, UnitState.PASS)
    passed = "SELECT serial FROM run JOIN unit u ON u.id = unit_id WHERE state = 'PASS' ORDER BY 1"
    assert plant.rows(passed) == [(each,) for each in serials]
    assert plant.rows("SELECT * FROM plant_claim") == []
    assert not third.bench.store.examine().problems
    assert not examined(plant).problems
    for each in (old, line):
        each.claims.close()


def test_a_branch_within_a_branch_is_not_brought_in_twice(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    """The second PC had brought in what the first one had not sent, and could not send that."""
    sender.bench.make(serial="W2605001")
    sender.send()
    sender.bench.make(serial="W2605002")
    sender.bench.store.close()
    taken(plant, key)
    spares.append(second := spare_of(plant, sender))
    second.send()
    brought(second, sender.bench.path)
    second.bench.make(serial="W2605003")
    second.bench.store.close()
    taken(plant, key, "third")
    spares.append(third := spare_of(plant, sender, "third"))
    assert len(brought(third, second.bench.path).runs) == 2
    with pytest.raises(NotFoundError):
        brought(third, sender.bench.path)
    assert len(third.bench.store.read.table()) == 3
    assert not third.bench.store.examine().problems


@pytest.mark.parametrize("name", ["line-2", "line-3"])
def test_other_records_are_not_brought_in(sender: Sender, tmp_path: Path, name: str) -> None:
    path, keys = tmp_path / "records.sqlite", KeyLocations(tmp_path / "other")
    with Store.open(str(path), station=name, clock=FakeClock(), key_locations=keys) as store:
        store.recover()
    with pytest.raises(RecordError, match="not records of the station line-2") as caught:
        brought(sender, path)
    assert str(path) in caught.value.where


def test_a_changed_branch_is_not_brought_in(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    sender.bench.make(serial="W2605001")
    sender.send()
    taken(plant, key)
    sender.bench.make(RunState.FAIL, serial="W2605009")
    with sender.bench.outsider() as other:
        other.execute("DROP TRIGGER step_final")
        other.execute("DROP TRIGGER step_update")
        other.execute("UPDATE step SET text = 'other' WHERE run_id = 2")
        other.commit()
    spares.append(spare := spare_of(plant, sender))
    with pytest.raises(UnprovenError, match="not as it was signed"):
        brought(spare, sender.bench.path)
    assert len(spare.bench.store.read.table()) == 1


def test_of_two_spare_pcs_at_once_one_takes_the_station_over(
    plant: Plant, sender: Sender, key: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender.bench.make(serial="W2605001")
    sender.send()
    usual = Takeover._data
    faster: list[TakenOver] = []

    def data(self: Takeover, *args: object) -> object:
        if not faster:
            faster.append(TakenOver("", 0, 0, (), None))
            faster[0] = taken(plant, key, "faster")
        return usual(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(Takeover, "_data", data)
    with pytest.raises(StationBusyError, match="Another PC"):
        taken(plant, key, "slower")
    assert not (plant.folder / "slower" / "records.sqlite").exists()
    assert faster[0].runs == 1
    assert plant.rows("SELECT count(*) FROM chain_row WHERE event = 'taken over'") == [(1,)]


def test_the_other_pc_may_send_while_it_is_taken_over(
    plant: Plant, sender: Sender, key: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender.bench.make(serial="W2605001")
    sender.send()
    usual = Takeover._data
    made: list[RunId] = []

    def data(self: Takeover, *args: object) -> object:
        if len(made) < 2:
            made.append(sender.bench.make(serial=f"W260500{len(made) + 2}"))
            sender.send()
        return usual(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(Takeover, "_data", data)
    assert taken(plant, key).runs == 3


def test_a_takeover_that_was_killed_is_run_again(
    plant: Plant, sender: Sender, key: bytes, monkeypatch: pytest.MonkeyPatch, spares: list[Sender]
) -> None:
    sender.bench.make(serial="W2605001")
    sender.send()
    monkeypatch.setattr("flasher.plant.takeover._set_aside", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):  # the plant has accepted it
        taken(plant, key)
    monkeypatch.undo()
    assert taken(plant, None).runs == 1  # the key is here
    spares.append(spare := spare_of(plant, sender))
    spare.bench.make(serial="W2605002")
    spare.send()
    assert not spare.bench.store.examine().problems
    assert not examined(plant).problems


def test_a_key_that_is_missing_or_older_is_named(plant: Plant, sender: Sender, key: bytes) -> None:
    sender.bench.make(serial="W2605001")
    sender.bench.store.rotate_key("jo")
    sender.send()
    for given in (None, key):
        with pytest.raises(KeyMissingError) as caught:
            taken(plant, given)
        assert "flasher station export" in caught.value.remedy
    newer = sender.bench.store.signer.key_file.read_bytes()
    assert SigningKey.parse(newer).public == sender.bench.store.signer.public
    assert taken(plant, newer).runs == 1


def test_a_restored_older_copy_of_either_pc_is_refused(
    plant: Plant, sender: Sender, key: bytes, spares: list[Sender]
) -> None:
    sender.bench.make(serial="W2605001")
    sender.send()
    taken(plant, key)
    spares.append(spare := spare_of(plant, sender))
    spare.send()
    copy = plant.folder / "copy.sqlite"
    spare.bench.store.backup(copy)
    spare.bench.make(serial="W2605002")
    spare.send()
    spare.end()
    spare.bench.store.close()
    shutil.copy(copy, spare.bench.path)
    for path in (spare.bench.folder / "keys").glob("*.heads*"):
        path.unlink()
    spare.start()
    with pytest.raises(ChainRefusedError) as caught:
        spare.send()
    assert caught.value.refusal is Refusal.REPLAYED
    with pytest.raises(ChainRefusedError) as caught:
        sender.send()
    assert caught.value.refusal is Refusal.TAKEN_OVER


def test_rows_that_were_changed_in_the_plant_are_not_taken(
    plant: Plant, sender: Sender, key: bytes
) -> None:
    sender.bench.make(serial="W2605001")
    sender.bench.claim("W2605002", "B")
    sender.send()
    with plant.server.connect(plant.database) as owner:
        owner.execute("UPDATE open_run SET content = jsonb_set(content::jsonb, '{unit,serial}',"
                      " '\"X\"')::json")  # fmt: skip
    with pytest.raises(RecordsDamagedError, match="had not ended"):
        taken(plant, key)
    with plant.server.connect(plant.database) as owner:
        owner.execute("UPDATE chain_row SET data = replace(data, 'W2605001', 'W2605009')")
    with pytest.raises(RecordsDamagedError, match="as the station signed"):
        taken(plant, key)
    assert not (plant.folder / "spare" / "records.sqlite").exists()
