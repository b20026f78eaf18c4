"""The station's key, the kept heads, the clock, and what a person lets the station go on with."""

from __future__ import annotations

import errno
import os
import shutil
from datetime import timedelta
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.station.records.errors import (
    ClaimRefusedError,
    DiskFullError,
    KeyMissingError,
    RecordsCutError,
    Refusal,
)
from flasher.station.records.heads import HeadsFault, HeadsFile
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import TORN_TRACE, TRACE, RunId
from flasher.station.records.signatures import SigningKey
from flasher.station.records.store import Store
from tests.station.factory import SERIAL, Bench

OTHER = "W2605003"


def reopened(bench: Bench) -> Store:
    """The station is started again."""
    bench.store.close()
    bench.store = bench.opened()
    return bench.store


def only(folder: Path, pattern: str) -> Path:
    (found,) = folder.glob(pattern)
    return found


# -- the key --------------------------------------------------------------------------------------


def test_a_key_that_is_gone_stops_the_station_until_a_person_replaces_it(bench: Bench) -> None:
    bench.make()
    only(bench.keys, "*.key").unlink()
    store = reopened(bench)
    with pytest.raises(KeyMissingError, match="is not there") as caught:
        store.recover()
    assert "flasher station key --lost --reason TEXT" in caught.value.remedy
    store.replace_lost_key("jo", "the disk of the PC died")
    store.recover()
    bench.make(serial=OTHER)
    found = store.examine()
    assert not found.problems
    assert "the key was declared lost on 2026-05-17 by jo" in found.remarks[0]
    with pytest.raises(UsageError, match="The key is not lost"):
        store.replace_lost_key("jo", "again")


def test_a_key_of_something_else_or_for_everybody_is_refused(bench: Bench) -> None:
    key = only(bench.keys, "*.key")
    key.chmod(0o644)
    with pytest.raises(KeyMissingError, match="Others may read") as caught:
        reopened(bench).recover()
    assert caught.value.remedy.startswith("chmod 600")
    key.chmod(0o600)
    key.write_text("no key")
    with pytest.raises(KeyMissingError, match="holds no Ed25519 key"):
        reopened(bench).recover()
    key.unlink()
    SigningKey.make(key)
    with pytest.raises(KeyMissingError, match="is not there"):
        reopened(bench).recover()


@pytest.mark.slow
def test_after_a_rotation_another_key_signs_and_the_chain_holds(bench: Bench) -> None:
    bench.make()
    before = bench.store.signer.public
    bench.store.rotate_key("jo")
    bench.make(serial=OTHER)
    assert bench.store.signer.public != before
    reopened(bench).recover()
    assert not bench.store.examine().problems
    assert bench.store.read.head_of(RunId(1)).key == before  # type: ignore[union-attr]


def test_a_rotation_that_a_crash_cut_short_is_ended_at_the_next_start(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(5, "died")))
        with pytest.raises(OSError, match="died"):
            bench.store.rotate_key("jo")
    reopened(bench).recover()
    bench.make()
    assert not bench.store.examine().problems
    assert not list(bench.keys.glob("*.new"))


# -- the heads ------------------------------------------------------------------------------------


def test_a_head_that_cannot_be_kept_shows_no_pass_and_is_kept_later(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    ending = bench.ending()

    def full(_handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DiskFullError, match="RECORD NOT SAVED"):
            bench.store.finish(run_id, ending)
    bench.store.finish(run_id, ending)
    found = bench.store.examine()
    assert not found.problems
    assert found.kept[0].last == bench.store.read.head_of(run_id).number  # type: ignore[union-attr]


def test_half_a_line_that_a_crash_left_spoils_nothing(bench: Bench) -> None:
    kept = only(bench.keys, "*.heads")
    with kept.open("a") as file:
        file.write('{"at": "2026')
    bench.make()
    (problem,) = bench.store.examine().problems
    assert "is not a head" in problem.what
    kept.write_text("".join(line for line in kept.read_text().splitlines(keepends=True)[:-1]))


def test_heads_that_begin_late_leave_the_rows_before_unchecked(bench: Bench) -> None:
    bench.make()
    only(bench.keys, "*.heads").unlink()
    bench.make(serial=OTHER)
    found = bench.store.examine()
    assert not found.problems
    assert found.kept[0].first > 1
    assert not found.kept[0].is_whole


@pytest.mark.slow
def test_an_older_copy_does_not_become_the_station_before_a_person_confirms_it(
    bench: Bench,
) -> None:
    bench.make()
    older = bench.folder / "older.sqlite"
    bench.store.backup(older)
    bench.make(serial=OTHER)
    bench.store.close()
    shutil.move(older, bench.path)
    bench.store = store = bench.opened()
    with pytest.raises(RecordsCutError) as caught:
        store.recover()
    assert "flasher station accept restored --reason TEXT" in caught.value.remedy
    assert store.accept_restored("jo", "the disk died, this is the backup of the night") == 2
    with pytest.raises(UsageError, match="Nothing is missing"):
        store.accept_restored("jo", "once more")
    store.recover()
    bench.make(serial="W2605004")
    found = store.examine()
    assert not found.problems
    assert "rows 5 to 6 of an earlier chain were given up" in found.remarks[0]


def test_the_chains_of_two_stations_stand_for_themselves(bench: Bench) -> None:
    bench.make()
    other = bench.opened("line-3")
    other.recover()
    mine, bench.store = bench.store, other
    bench.make(serial=OTHER)
    bench.store = mine
    other.close()
    found = bench.store.examine()
    assert not found.problems
    assert [(each.station, each.first) for each in found.kept] == [("line-2", 1), ("line-3", 1)]
    assert len(list(bench.keys.glob("*.key"))) == 2


# -- the clock ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_clock_earlier_than_the_last_record_begins_no_unit_until_a_person_releases_it(
    bench: Bench,
) -> None:
    bench.clock.now += timedelta(days=365)
    bench.make()
    bench.clock.now -= timedelta(days=365)
    with pytest.raises(ClaimRefusedError) as caught:
        bench.claim(OTHER)
    assert caught.value.refusal is Refusal.CLOCK
    assert "accept clock --reason TEXT" in caught.value.remedy
    bench.store.release_clock("jo", "the battery of the clock was empty")
    bench.make(serial=OTHER)
    bench.clock.now -= timedelta(minutes=4)
    bench.claim("W2605004")
    assert not bench.store.examine().problems


# -- the traces of a dead station -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "kind"),
    [([".log"], TORN_TRACE), ([".log.gz"], TRACE), ([".log", ".log.gz"], TORN_TRACE)],
)
def test_the_trace_of_an_interrupted_run_is_attached(
    bench: Bench, names: list[str], kind: str
) -> None:
    run_id = bench.claim().run_id
    bench.store.files.spool.mkdir(parents=True)
    for name in names:
        (bench.store.files.spool / f"run-{run_id}{name}").write_bytes(b"frames" + name.encode())
    reopened(bench).recover()
    (file,) = bench.store.read.run(run_id).attachments
    assert file.kind == kind
    assert bench.store.files.read(file.sha256) == b"frames" + names[0].encode()
    assert not list(bench.store.files.spool.iterdir())
    assert not bench.store.examine().problems


# -- reading changes nothing ----------------------------------------------------------------------


def test_reading_changes_no_byte_and_a_report_of_a_backup_leaves_nothing_beside_it(
    bench: Bench,
) -> None:
    bench.make()
    copy = bench.folder / "copy" / "records.sqlite"
    copy.parent.mkdir()
    bench.store.backup(copy)
    before = {path: path.read_bytes() for path in copy.parent.rglob("*") if path.is_file()}
    key_locations = KeyLocations(bench.keys)
    with Store.open(str(copy), station="x", read_only=True, key_locations=key_locations) as store:
        assert not store.examine().problems
        assert store.read.unit(SERIAL).last
        with pytest.raises(Exception, match="read-only"), store.database.writing() as connection:
            connection.exec_driver_sql("DELETE FROM audit")
    assert before == {path: path.read_bytes() for path in copy.parent.rglob("*") if path.is_file()}


def test_records_on_media_that_no_one_can_write_are_read(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.make()
    bench.store.close()
    assert not bench.path.with_name(bench.path.name + "-wal").exists()
    monkeypatch.setattr(os, "access", lambda *_: False)
    with Store.open(
        str(bench.path), station="x", read_only=True, key_locations=KeyLocations(bench.keys)
    ) as store:
        assert not store.examine().problems
    assert not bench.path.with_name(bench.path.name + "-wal").exists()


def test_what_is_no_file_in_place_of_key_or_heads_is_never_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(UsageError, match="not a regular file"):
        HeadsFile(tmp_path / "pipe").last()
    with pytest.raises(UsageError, match="not a regular file"):
        SigningKey.load(tmp_path / "pipe")


def test_a_line_without_end_in_the_heads_is_reported_by_its_number(tmp_path: Path) -> None:
    (tmp_path / "heads").write_bytes(b"[" * 100_000 + b"\n{}\n")
    found = HeadsFile(tmp_path / "heads").entries()
    assert [each.what for each in found if isinstance(each, HeadsFault)] == [
        "line 1 is not a head",
        "line 2 is not a head",
    ]
