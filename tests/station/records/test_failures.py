"""Full disks, locked, damaged and foreign databases: a typed error, nothing half saved."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.plant.central import plant_location
from flasher.station.records.database import locate
from flasher.station.records.errors import (
    DiskFullError,
    RecordError,
    RecordsDamagedError,
    RecordsLockedError,
    RecordsMovedError,
    RecordsReadOnlyError,
    SchemaVersionError,
)
from flasher.station.records.model import RunState
from flasher.station.records.schema import SCHEMA_VERSION
from flasher.station.records.store import Store
from tests.loops import each
from tests.station.factory import Bench, FakeClock


def test_a_full_disk_saves_no_pass_and_the_run_can_be_finished_later(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    long = replace(ending, text="x" * 100_000)
    with bench.store.database.reading() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 2}")
    with pytest.raises(DiskFullError):
        bench.store.finish(run_id, long)
    assert bench.store.read.run(run_id).run.state is RunState.RUNNING
    with bench.store.database.reading() as connection:
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 1000}")
    bench.store.finish(run_id, long)
    assert bench.store.read.run(run_id).run.state is RunState.PASS
    assert not bench.store.examine().problems


def test_a_locked_database_is_waited_for_and_then_an_error(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    with contextlib.closing(sqlite3.connect(bench.path, isolation_level=None)) as holder:
        holder.execute("BEGIN IMMEDIATE")
        began = time.perf_counter()
        with pytest.raises(RecordsLockedError):
            bench.store.finish(run_id, ending)
        assert time.perf_counter() - began < 1.0
        assert bench.store.read.run(run_id).run.state is RunState.RUNNING  # reading goes on
    bench.store.finish(run_id, ending)
    assert bench.store.read.run(run_id).run.state is RunState.PASS


@pytest.mark.parametrize("is_deleted", [False, True])
def test_a_database_that_is_moved_away_saves_nothing(bench: Bench, *, is_deleted: bool) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    away = bench.path.with_name("away.sqlite")
    bench.path.rename(away)
    if is_deleted:
        bench.path.write_bytes(b"")
    with pytest.raises(RecordsMovedError):
        bench.store.finish(run_id, ending)
    away.replace(bench.path)
    bench.store.finish(run_id, ending)
    assert bench.store.read.run(run_id).run.state is RunState.PASS


def test_a_database_that_is_moved_while_it_is_written_is_no_record(bench: Bench) -> None:
    away = bench.path.with_name("away.sqlite")
    with pytest.raises(RecordsMovedError), bench.store.database.writing():
        bench.path.rename(away)


def test_a_read_only_database_is_an_error_at_the_claim(bench: Bench) -> None:
    with bench.store.database.reading() as connection:
        connection.exec_driver_sql("PRAGMA query_only = ON")
    with pytest.raises(RecordsReadOnlyError):
        bench.claim()


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "records.sqlite"
    path.write_bytes(b"this is a text, and long enough to be looked at" * 100)
    with pytest.raises(RecordsDamagedError):
        Store.open(str(path), station="x")
    assert path.read_bytes().startswith(b"this is")


@pytest.mark.slow
def test_a_damaged_page_is_found(bench: Bench) -> None:
    for number in range(2, 8):
        bench.make(serial=f"W260500{number}")
    bench.store.backup(bench.folder / "copy.sqlite")
    data = bytearray((bench.folder / "copy.sqlite").read_bytes())
    data[4096 * 3 : 4096 * 12] = os.urandom(4096 * 9)
    (bench.folder / "copy.sqlite").write_bytes(data)
    try:
        with Store.open(str(bench.folder / "copy.sqlite"), station="x", create=False) as store:
            assert store.examine().problems
    except RecordsDamagedError as error:
        assert "damaged" in str(error)  # noqa: PT017  either is right


@pytest.mark.parametrize(("version", "cause"), [(SCHEMA_VERSION + 1, "newer"), (0, "older")])
def test_records_of_another_version_are_refused_with_what_to_do(
    bench: Bench, version: int, cause: str
) -> None:
    bench.store.close()
    with contextlib.closing(sqlite3.connect(bench.path)) as other:
        other.execute("UPDATE alembic_version SET version_num = ?", (str(version),))
        other.commit()
    with pytest.raises(SchemaVersionError, match=f"schema {version}") as caught:
        bench.opened()
    assert cause in caught.value.cause
    assert "flasher" in caught.value.remedy


def test_a_database_of_something_else_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "other.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE holiday (photo BLOB)")
        other.commit()
    with pytest.raises(SchemaVersionError, match="other data"):
        Store.open(str(path), station="x")
    with contextlib.closing(sqlite3.connect(path)) as other:
        assert other.execute("SELECT name FROM sqlite_master").fetchall() == [("holiday",)]


def test_a_report_makes_no_database(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no records"):
        Store.open(str(tmp_path / "none.sqlite"), station="x", create=False)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordError):
        Store.open(str(tmp_path / "none" / "r.sqlite"), station="x")


@each(
    "url",
    [
        "nonsense://x",
        "sqlite://",
        "sqlite:///:memory:",
        "sqlite:///x?mode=ro",
        "postgresql+none://x",
    ],
)
def test_a_place_that_cannot_be_is_a_wrong_setting(url: str) -> None:
    with pytest.raises(UsageError):
        locate(url)


def test_a_password_is_not_shown(tmp_path: Path) -> None:
    assert "secret" not in locate("postgresql://me:secret@host/db", tmp_path).shown


@each("url", ["me:secret@host/db", "postgresql://me:sec@ret@host/db", "mysql://me:secret@host/db"])
def test_a_password_is_not_shown_of_a_url_that_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match="neither a file nor the URL") as caught:
        locate(url)
    assert "sec" not in str(caught.value)
    with pytest.raises(UsageError, match="neither a file nor the URL") as caught:
        plant_location(url)
    assert "SQLite" not in caught.value.remedy


def test_every_connection_has_the_settings_that_make_a_commit_last(tmp_path: Path) -> None:
    with (
        Store.open(str(tmp_path / "r.sqlite"), station="x", lock_timeout_s=0.02) as store,
        store.database.reading() as one,
        store.database.reading() as two,
    ):
        for connection in (one, two):
            found = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
                for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
            }
            assert found == {
                "journal_mode": "wal",
                "synchronous": 2,
                "foreign_keys": 1,
                "busy_timeout": 20,
            }


def test_records_in_memory_are_refused_since_no_pass_would_be_on_disk(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        Store.open("sqlite://", station="x", folder=tmp_path / "files", clock=FakeClock())


def test_a_trace_that_cannot_be_stored_is_an_error_and_leaves_no_part(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DiskFullError):
            bench.store.files.add("trace", bench.trace)
    assert not [path for path in bench.store.files.folder.rglob("*") if "part" in path.name]
    bench.make()


def test_what_a_crash_left_half_written_is_swept_away_a_day_later(bench: Bench) -> None:
    old, young = (bench.store.files.folder / name for name in (".part-old", ".part-young"))
    for path, age_s in ((old, 90_000.0), (young, 100.0)):
        path.write_bytes(b"half")
        then = bench.clock.now.timestamp() - age_s
        os.utime(path, (then, then))
    bench.store.recover()
    assert not old.exists()
    assert young.exists()


def test_a_trace_that_is_not_there_is_an_error(bench: Bench) -> None:
    with pytest.raises(RecordError, match="RECORD NOT SAVED"):
        bench.store.files.add("trace", bench.folder / "none.asc")


def test_a_pass_whose_trace_vanished_is_not_saved(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()
    bench.store.files.path(ending.attachments[0].sha256).unlink()
    with pytest.raises(RecordError):
        bench.store.finish(run_id, ending)
    assert bench.store.read.run(run_id).run.state is RunState.RUNNING
