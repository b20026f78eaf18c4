"""Heads in several places: what a forger cannot reach is compared with what he left; a place that
cannot be reached stops no line.
"""

from __future__ import annotations

import json
import pickle
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from sqlalchemy import Connection, create_engine, select, text

from flasher.station.board import Board
from flasher.station.health import HealthWatch
from flasher.station.records import keys, places, schema
from flasher.station.records.chain import canonical, data_of, digests_of, row_hash
from flasher.station.records.errors import RecordsCutError
from flasher.station.records.heads import ChainHead, HeadsFile
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import Examination, Problem
from flasher.station.records.places import call_all, place_of
from flasher.station.records.schema import audit, run
from flasher.station.records.signatures import SigningKey
from flasher.station.records.store import Store
from tests.station.factory import Bench
from tests.station.postgres import Server

OTHER = "W2605003"


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Bench]:
    """A line with three units, whose heads are kept beside the key and on a share."""
    made = Bench(tmp_path, heads=(tmp_path / "share",))
    for serial in ("W2605002", OTHER, "W2605004"):
        made.make(serial=serial)
    yield made
    made.store.close()


@contextmanager
def forging(bench: Bench) -> Iterator[Connection]:
    """The records without their rules, by somebody who owns the database."""
    engine = create_engine(f"sqlite:///{bench.path}")
    with engine.begin() as connection:
        query = "SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"
        rules: dict[str, str] = dict(connection.execute(text(query)).all())
        for name in rules:
            connection.exec_driver_sql(f"DROP TRIGGER {name}")
        yield connection
        for statement in rules.values():
            connection.exec_driver_sql(statement)
    engine.dispose()


def verified(bench: Bench, key_locations: KeyLocations | None = None) -> Examination:
    bench.store.close()
    files = bench.store.files.folder
    with Store.open(
        str(bench.path), station="x", folder=files, read_only=True,
        key_locations=key_locations or bench.key_locations,
    ) as store:  # fmt: skip
        return store.examine()


def noted(problems: tuple[Problem, ...], where: str, what: str) -> bool:
    return any(where in each.where and what in each.what for each in problems)


def beside(bench: Bench) -> Path:
    (found,) = bench.keys.glob("*.heads")
    return found


def cut_tail(bench: Bench) -> None:
    """The last unit was never made: neither in the database nor in the heads beside the key."""
    bench.store.close()
    with forging(bench) as connection:
        last = connection.execute(select(run.c.id).order_by(run.c.id.desc()).limit(1)).scalar_one()
        for table in (
            schema.step,
            schema.device_write,
            schema.attachment,
            schema.run_target,
            audit,
        ):
            connection.execute(table.delete().where(table.c.run_id == last))
        connection.execute(run.delete().where(run.c.id == last))
        connection.exec_driver_sql("DELETE FROM unit WHERE serial = 'W2605004'")
    kept = beside(bench)
    kept.write_text("".join(kept.read_text().splitlines(keepends=True)[:-2]))


def make_anew(bench: Bench) -> None:
    """A unit has another history, in a chain that was signed anew, with new heads beside it."""
    bench.store.close()
    (path,) = bench.keys.glob("*.key")
    path.unlink()
    key, heads = SigningKey.make(path), []
    with forging(bench) as connection:
        connection.exec_driver_sql("UPDATE run SET text = 'all was well' WHERE state = 'PASS'")
        before = "0" * 64
        for row in connection.execute(select(audit).order_by(audit.c.number)).mappings().all():
            data: dict[str, Any] = data_of(row["data"])
            if row["number"] == 1:
                data["key"] = key.public
            if "digests" in data and row["event"] == "finished":
                data["digests"] = digests_of(connection, [row["run_id"]])[row["run_id"]]
            new = dict(row) | {"previous_hash": before, "data": canonical(data)}
            before = row_hash(new)
            changes = {name: new[name] for name in ("previous_hash", "data")}
            signature = key.sign(before)
            connection.execute(
                audit.update()
                .where(audit.c.id == row["id"])
                .values(**changes, hash=before, signature=signature)
            )
            heads.append(
                ChainHead("line-2", row["number"], row["at"], before, signature, key.public)
            )
    kept = beside(bench)
    kept.unlink()
    HeadsFile(kept).append(heads, key)


FORGERIES: dict[Callable[[Bench], None], str] = {
    cut_tail: "its end was cut off",
    make_anew: "the chain was replaced",
}


@pytest.mark.slow
@pytest.mark.parametrize("forge", FORGERIES)
def test_what_was_forged_with_the_heads_beside_the_key_is_reported_by_another_place(
    line: Bench, tmp_path: Path, forge: Callable[[Bench], None]
) -> None:
    honest = verified(line)
    assert not honest.problems
    assert honest.is_checked_elsewhere
    assert {(each.place, each.first, each.last) for each in honest.kept} == {
        (str(line.keys), 1, 8), (str(tmp_path / "share"), 1, 8),
    }  # fmt: skip
    forge(line)
    found = verified(line)
    assert noted(found.problems, "audit trail of line-2", FORGERIES[forge])
    assert all(str(tmp_path / "share") in each.what for each in found.problems)
    alone = verified(line, KeyLocations(line.keys))
    assert not alone.problems  # nothing tells it there, and it does not claim to
    assert not alone.is_checked_elsewhere
    assert alone.unkept == ("line-2",)


@pytest.mark.slow
@pytest.mark.parametrize("forge", FORGERIES)
def test_no_station_goes_on_with_what_another_place_contradicts(
    line: Bench, forge: Callable[[Bench], None]
) -> None:
    forge(line)
    line.store = line.opened()
    with pytest.raises(RecordsCutError) as caught:
        line.store.recover()
    assert "share" in caught.value.cause


@pytest.mark.slow
def test_rows_that_are_given_up_are_so_in_every_place(line: Bench) -> None:
    cut_tail(line)
    line.store = line.opened()
    assert line.store.accept_restored("jo", "the disk died") == 2
    line.store.recover()
    line.make(serial="W2605005")
    found = verified(line)
    assert not found.problems
    assert found.is_checked_elsewhere


def test_heads_on_a_server_report_a_forgery_and_only_grow(postgres: Server, tmp_path: Path) -> None:
    url = postgres.url(postgres.database())
    bench = Bench(tmp_path, heads=(url,))
    for serial in ("W2605002", OTHER, "W2605004"):
        bench.make(serial=serial)
    assert verified(bench).is_checked_elsewhere
    place = place_of(url)
    assert list(place.stations(bench.store.signer.records_id)) == ["line-2"]
    kept = place.of("line-2", bench.store.signer.records_id)
    assert kept.of_row(3) == HeadsFile(beside(bench)).of_row(3)
    cut_tail(bench)
    assert noted(verified(bench).problems, "audit trail of line-2", "row 8")
    engine = create_engine(url)
    for statement in (
        "DELETE FROM kept_head",
        "UPDATE kept_head SET number = 1",
        "TRUNCATE kept_head",
    ):
        with pytest.raises(Exception, match="neither changed nor deleted"), engine.begin() as other:
            other.exec_driver_sql(statement)
    engine.dispose()


@pytest.mark.slow
def test_a_place_that_is_gone_stops_no_line_and_is_caught_up(tmp_path: Path) -> None:
    share, gone = tmp_path / "share", tmp_path / "gone"
    bench = Bench(tmp_path, heads=(share,))
    bench.make()
    bench.store.signer.wait_for_copies()
    share.rename(gone)
    share.write_text("no folder")
    bench.make(serial=OTHER)
    (copying,) = bench.store.signer.copies
    assert copying.wait()
    assert copying.fault
    watch = HealthWatch(
        tmp_path, bench.clock.utc, bench.clock.monotonic_s, bench.store.signer.unkept
    )
    (check,) = (each for each in watch.look(Board()) if each.name == "heads")
    assert str(share) in check.text
    found = verified(bench)
    assert not found.problems
    assert found.unreached == (f"{share}: there is no such folder",)
    assert found.unkept == ("line-2",)
    assert not found.is_checked_elsewhere
    share.unlink()
    gone.rename(share)
    bench.store = bench.opened()
    bench.store.recover()
    bench.store.signer.wait_for_copies()
    assert verified(bench).is_checked_elsewhere


def test_a_share_that_is_not_mounted_is_not_begun_anew(tmp_path: Path) -> None:
    share = tmp_path / "share"
    bench = Bench(tmp_path, heads=(share,))
    bench.make()
    bench.store.close()
    shutil.move(share, tmp_path / "away")
    share.mkdir()
    bench.store = bench.opened()
    bench.store.recover()
    bench.make(serial=OTHER)
    (copying,) = bench.store.signer.copies
    assert copying.wait()
    assert "another share may be mounted" in copying.fault
    assert not list(share.iterdir())
    bench.store.close()


def test_a_share_that_is_unmounted_meanwhile_is_not_begun_anew(tmp_path: Path) -> None:
    mounted, away = tmp_path / "mounted", tmp_path / "away"
    bench = Bench(tmp_path, heads=(mounted / "heads",))
    bench.make()
    (copying,) = bench.store.signer.copies
    assert copying.wait()
    shutil.move(mounted, away)
    mounted.mkdir()
    bench.make(serial=OTHER)
    assert copying.wait()
    assert "another share may be mounted" in copying.fault
    assert not list(mounted.iterdir())
    mounted.rmdir()
    shutil.move(away, mounted)
    bench.make(serial="W2605004")
    assert copying.wait()
    assert not copying.fault
    (kept,) = (mounted / "heads").glob("*.heads")
    numbers = [json.loads(line)["number"] for line in kept.read_text("ascii").splitlines()]
    assert numbers == list(range(1, 9))
    bench.store.close()


def test_a_place_that_was_never_reached_is_begun_when_it_can_be(tmp_path: Path) -> None:
    share = tmp_path / "share"
    share.write_text("no folder yet")
    bench = Bench(tmp_path, heads=(share,))
    bench.make()
    (copying,) = bench.store.signer.copies
    assert copying.wait()
    assert copying.fault
    share.unlink()
    bench.make(serial=OTHER)
    assert copying.wait()
    assert not copying.fault
    assert verified(bench).is_checked_elsewhere


def test_a_new_place_gets_the_heads_from_the_first_on(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.make()
    bench.store.close()
    bench.heads = (tmp_path / "new",)
    bench.store = bench.opened()
    bench.store.recover()
    bench.store.signer.wait_for_copies()
    assert verified(bench).is_checked_elsewhere


@pytest.mark.slow
def test_a_folder_in_which_an_older_flasher_kept_all_heads_goes_on(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.make()
    bench.store.close()
    (tmp_path / "old").mkdir()
    shutil.move(beside(bench), tmp_path / "old")
    bench.heads = (tmp_path / "old",)
    bench.store = bench.opened()
    bench.store.recover()
    bench.make(serial=OTHER)
    bench.store.signer.wait_for_copies()
    found = verified(bench)
    assert found.is_checked_elsewhere
    assert not found.problems


def test_a_place_that_does_not_answer_is_not_waited_for() -> None:
    ended = Event()
    silent, good = call_all([ended.wait, lambda: True], 0.01)
    ended.set()
    assert "did not answer" in str(silent)
    assert good is True


def test_a_share_that_hangs_stops_no_station_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    share, mounted_again = tmp_path / "share", Event()

    def hanging(call: Callable[[Path], Any]) -> Callable[[Path], Any]:
        def run(path: Path, *more: Any, **named: Any) -> Any:
            if path.is_relative_to(share):
                mounted_again.wait(20.0)
            return call(path, *more, **named)

        return run

    for module in (keys, places):
        monkeypatch.setattr(module, "PATIENCE_S", 0.01)
    monkeypatch.setattr(places.call_all, "__defaults__", (0.01,))
    for name in ("resolve", "exists", "is_dir", "stat", "open"):
        monkeypatch.setattr(Path, name, hanging(getattr(Path, name)))
    began_s = time.perf_counter()
    bench = Bench(tmp_path, heads=(str(share),))
    bench.make()
    assert time.perf_counter() - began_s < 15.0
    signer = bench.store.signer
    while not signer.unkept():
        assert time.perf_counter() - began_s < 15.0
    assert signer.unkept() == [str(share)]
    mounted_again.set()
    assert signer.copies[0].wait(15.0)
    assert signer.unkept() == []
    assert verified(bench).is_checked_elsewhere


def test_a_keeping_is_sent_to_another_process_without_its_connections(postgres: Server) -> None:
    key_locations = KeyLocations(heads=(postgres.url("postgres"),))
    assert key_locations.elsewhere
    assert pickle.loads(pickle.dumps(key_locations)) == key_locations  # noqa: S301
