"""Backup and verification of the records."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import select

from flasher.errors import UsageError
from flasher.station.records.errors import RecordsDamagedError
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import AuditEvent, RunState, UnitState
from flasher.station.records.schema import audit
from flasher.station.records.store import Store
from tests.station.factory import SERIAL, Bench


@pytest.mark.slow
def test_a_backup_made_while_a_unit_runs_is_whole_and_opens_by_itself(bench: Bench) -> None:
    bench.make()
    bench.claim("W2605003")
    path = bench.folder / "backup.sqlite"
    path.write_text("the backup of yesterday")
    made = bench.store.backup(path)
    assert made.size_bytes == path.stat().st_size
    assert not list(bench.folder.glob(".*part*"))
    bench.make(RunState.PASS, "W2605004", "B")
    key_locations = KeyLocations(
        bench.folder / "of no one"
    )  # the kept heads know the later run as well
    with Store.open(str(path), station="line-2", create=False, key_locations=key_locations) as copy:
        assert not copy.examine().problems
        assert copy.read.unit(SERIAL).state is UnitState.PASS
        assert copy.read.units("W2605004") == ()


def test_a_backup_that_fails_leaves_the_old_one(bench: Bench) -> None:
    bench.make()
    (file,) = bench.store.read.unit(SERIAL).runs[0].attachments
    bench.store.files.path(file.sha256).unlink()
    path = bench.folder / "backup.sqlite"
    path.write_text("the backup of yesterday")
    with pytest.raises(Exception, match="NOT SAVED"):
        bench.store.backup(path)
    assert path.read_text() == "the backup of yesterday"


def test_a_backup_does_not_overwrite_the_records(bench: Bench) -> None:
    with pytest.raises(UsageError, match="cannot replace"):
        bench.store.backup(bench.path)


@pytest.mark.parametrize("spoil", [lambda path: path.unlink(), lambda path: path.write_bytes(b"x")])
def test_an_attachment_that_is_gone_or_changed_is_found(
    bench: Bench, spoil: Callable[[Path], object]
) -> None:
    bench.make()
    (file,) = bench.store.read.unit(SERIAL).runs[0].attachments
    spoil(bench.store.files.path(file.sha256))
    (problem,) = bench.store.examine().problems
    assert file.sha256 in problem.where
    with pytest.raises(RecordsDamagedError):
        bench.store.files.read(file.sha256)


def test_what_a_person_did_at_the_station_is_part_of_the_chain(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.store.note(AuditEvent.OPERATOR, {"before": "jo", "now": "al"})
    bench.store.note(AuditEvent.ABORT, {"socket": "A", "by": "al"}, run_id)
    with bench.store.database.reading() as connection:
        rows = connection.execute(select(audit).order_by(audit.c.id.desc()).limit(2)).all()
    assert [(row.event, row.run_id) for row in rows] == [("abort", run_id), ("operator", None)]
    assert json.loads(rows[1].data) == {"before": "jo", "now": "al"}
    assert not bench.store.examine().problems
