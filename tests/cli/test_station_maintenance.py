"""`flasher station verify`, `key`, `accept` and `upgrade`, as a person meets them."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ExitCode
from flasher.station.records.model import RELEASED_MARK, AuditEvent, RunId, RunState
from flasher.station.records.schema import SCHEMA_VERSION
from tests.cli.conftest import Flasher
from tests.cli.test_schema import hold_output
from tests.station.factory import SERIAL, Bench
from tests.station.records import old_records

BESIDE = (
    "NOT CHECKED as a whole against heads stored elsewhere: whoever can write beside the key could"
    " have forged records and heads"
)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.store.close()


@pytest.fixture
def place(bench: Bench) -> tuple[str, ...]:
    """Options that name the records of a good and a bad unit."""
    bench.make()
    bench.make(RunState.FAIL, "W2605003")
    bench.store.close()
    return ("--database", str(bench.path), "--keys", str(bench.keys))


@pytest.mark.slow
def test_verify_states_what_the_records_were_compared_with(
    flasher: Flasher, bench: Bench, place: tuple[str, ...], schema: dict[str, Any]
) -> None:
    run = flasher("station", "verify", *place)
    assert run.code == ExitCode.OK
    assert run.out.splitlines() == [
        f"no difference in the records; {BESIDE}",
        f"  line-2: rows 1 to 6 match the heads beside the key, in {bench.keys}",
        "  line-2: heads are stored only beside the key",
        "  1 trace of runs that passed agree with the records",
    ]
    printed = flasher("station", "verify", *place, "--json")
    hold_output(schema, printed.out, 0)
    assert not printed.document["is_checked_elsewhere"]
    shutil.copytree(bench.keys, bench.folder / "share", ignore=shutil.ignore_patterns("*.key"))
    again = flasher("station", "verify", *place)
    assert again.out.startswith("no difference in the records since the examination of ")
    assert "--all examines everything again" in again.out
    two = flasher("station", "verify", *place, "--all", "--heads", bench.folder / "share")
    assert two.out.splitlines()[:3] == [
        "records, traces and audit trails are as they were written",
        f"  line-2: rows 1 to 6 match the heads beside the key, in {bench.keys}",
        f"  line-2: rows 1 to 6 match the heads in {bench.folder / 'share'}",
    ]
    gone = flasher("station", "verify", *place, "--heads", bench.folder / "gone")
    assert gone.code == ExitCode.OK
    assert f"heads NOT REACHED: {bench.folder / 'gone'}: there is no such folder" in gone.out
    without = flasher("station", "verify", "--database", bench.path, "--keys", bench.folder)
    assert without.code == ExitCode.OK
    assert "NOT CHECKED against heads stored elsewhere" in without.out
    assert "as they were written" not in without.out
    assert "line-2: no heads were found" in without.out
    for wrong in ("sqlite:///x.db", "mysql://x/y"):
        refused = flasher("station", "verify", *place, "--heads", wrong)
        assert refused.code == ExitCode.USAGE
    named = flasher("station", "verify", *place, "--heads", bench.folder)
    assert named.code == ExitCode.VERIFICATION
    assert "no head of these records is stored" in named.out


@pytest.mark.slow
def test_a_unit_whose_records_were_changed_gets_no_page(
    flasher: Flasher, bench: Bench, place: tuple[str, ...], tmp_path: Path
) -> None:
    good = flasher("station", "unit", SERIAL, *place, "--certificate", tmp_path / "good.html")
    assert good.code == ExitCode.OK
    page = (tmp_path / "good.html").read_text("utf-8")
    assert "Signed audit row" in page
    assert "Compared only with heads beside the key of the station" in page
    with closing(sqlite3.connect(bench.path)) as db:
        rule = db.execute("SELECT sql FROM sqlite_master WHERE name = 'run_update'").fetchone()[0]
        db.execute("DROP TRIGGER run_update")
        db.execute("UPDATE run SET text = 'all was well' WHERE id = 2")
        db.execute(rule)
        db.commit()
    bad = flasher("station", "unit", "W2605003", *place, "--certificate", tmp_path / "bad.html")
    assert bad.code == ExitCode.VERIFICATION
    assert "its records were changed" in bad.err
    assert not (tmp_path / "bad.html").exists()
    both = flasher("station", "report", *place, "--certificates", tmp_path / "pages")
    assert both.code == ExitCode.VERIFICATION
    assert (
        "no certificate for W2605003: run 2: changed after it was recorded: the run itself"
        in both.out
    )
    assert [path.name for path in (tmp_path / "pages").iterdir()] == [f"{SERIAL}.html"]


@pytest.mark.slow
def test_a_run_whose_claim_the_plant_released_has_its_mark(
    flasher: Flasher, bench: Bench, place: tuple[str, ...], tmp_path: Path, schema: dict[str, Any]
) -> None:
    with closing(bench.opened()) as store:
        store.become_station()
        store.note(AuditEvent.CLAIM_RELEASED, {}, RunId(1))
    page = tmp_path / "page.html"
    shown = flasher("station", "unit", SERIAL, *place, "--certificate", page)
    assert f"  duplicates {RELEASED_MARK}" in shown.out.splitlines()
    assert "not checked whether it has passed at another station" in page.read_text("utf-8")
    run = flasher("station", "unit", SERIAL, *place, "--json")
    hold_output(schema, run.out, 0)
    assert run.document["unit"]["runs"][0]["run"]["duplicates"] == RELEASED_MARK
    report = flasher("station", "report", *place, "--json")
    assert [each["duplicates"] for each in report.document["runs"]] == [RELEASED_MARK, None]
    assert flasher("station", "verify", *place, "--certificate", page).code == ExitCode.OK
    assert flasher("station", "verify", *place).code == ExitCode.OK


@pytest.mark.slow
def test_a_certificate_is_checked(
    flasher: Flasher,
    bench: Bench,
    place: tuple[str, ...],
    tmp_path: Path,
    schema: dict[str, Any],
) -> None:
    page = tmp_path / "good.html"
    flasher("station", "unit", SERIAL, *place, "--certificate", page)
    good = flasher("station", "verify", *place, "--certificate", page)
    assert good.code == ExitCode.OK
    assert good.out.splitlines()[0] == f"{SERIAL}, part BAT-36: run 1, PASS"
    assert "  signed by line-2, key " in good.out
    assert "  unchanged, and the run is in these records" in good.out
    text = page.read_text("utf-8")
    page.write_text(text.replace("bms.bin", "bmw.bin", 1), encoding="utf-8")
    bad = flasher("station", "verify", *place, "--certificate", page, "--json")
    hold_output(schema, bad.out, ExitCode.VERIFICATION)
    assert bad.document["problems"][0].startswith("its page was changed: it shows ")
    assert "unchanged" not in flasher("station", "verify", *place, "--certificate", page).out
    none = flasher("station", "verify", *place, "--certificate", bench.folder / "recipe.toml")
    assert none.code == ExitCode.USAGE
    assert "contains no signed certificate" in none.err


@pytest.mark.slow
def test_a_key_is_shown_rotated_and_replaced(
    flasher: Flasher, bench: Bench, place: tuple[str, ...], schema: dict[str, Any]
) -> None:
    shown = flasher("station", "key", *place, "--json")
    hold_output(schema, shown.out, 0)
    rotated = flasher("station", "key", *place, "--rotate", "--json").document
    assert rotated["public"] != shown.document["public"]
    (key,) = bench.keys.glob("*.key")
    key.unlink()
    assert "MISSING" in flasher("station", "key", *place).out
    assert flasher("station", "key", *place, "--lost").code == ExitCode.USAGE
    lost = flasher("station", "key", *place, "--lost", "--reason", "the disk died")
    assert lost.code == ExitCode.OK
    verified = flasher("station", "verify", *place)
    assert verified.code == ExitCode.OK
    assert "the key was declared lost" in verified.err


@pytest.mark.slow
def test_a_clock_is_released_by_a_person_with_a_reason(
    flasher: Flasher, bench: Bench, place: tuple[str, ...], schema: dict[str, Any]
) -> None:
    words = ("station", "accept", "clock", *place)
    assert flasher(*words).code == ExitCode.USAGE
    run = flasher(*words, "--operator", "Jo", "--reason", "a wrong date was set", "--json")
    hold_output(schema, run.out, 0)
    assert "the clock was released" in flasher("station", "verify", *place).err
    bench.clock.now += timedelta(days=400)
    nothing = flasher("station", "accept", "restored", *place, "--reason", "x")
    assert nothing.code == ExitCode.USAGE
    assert "Nothing is missing" in nothing.err


@pytest.mark.slow
def test_which_station_is_meant_has_to_be_clear(
    flasher: Flasher, bench: Bench, place: tuple[str, ...]
) -> None:
    other = bench.opened("line-3")
    other.recover()
    other.close()
    run = flasher("station", "key", *place)
    assert run.code == ExitCode.USAGE
    assert "line-2, line-3" in run.err
    Path(bench.folder / "sockets.toml").write_text(
        'name = "line-3"\nrecords = "records.sqlite"\nkeys = "keys"\n'
        '[[socket]]\nname = "A"\nmock = {}\n',
        encoding="utf-8",
    )
    named = flasher("station", "key", "--sockets", bench.folder / "sockets.toml")
    assert named.out.startswith("line-3: key ")


@pytest.mark.slow
def test_records_of_an_older_schema_are_upgraded_once(
    flasher: Flasher, tmp_path: Path, schema: dict[str, Any]
) -> None:
    old_records.unpack(tmp_path)
    database, files = str(tmp_path / "records.sqlite"), tmp_path / "records.sqlite.files"
    place = ("--database", database, "--files", files, "--keys", tmp_path / "keys")
    refused = flasher("station", "unit", "W2605100", *place)
    assert refused.code == ExitCode.USAGE
    assert "flasher station upgrade" in refused.err
    unclear = flasher("station", "upgrade", *place)
    assert unclear.code == ExitCode.USAGE
    assert "line-2, line-3" in unclear.err
    sockets = tmp_path / "sockets.toml"
    sockets.write_text(
        f'name = "line-2"\nrecords = "{database}"\nfiles = "{files}"\n'
        f'keys = "{tmp_path / "keys"}"\n[[socket]]\nname = "A"\nmock = {{}}\n',
        encoding="utf-8",
    )
    done = flasher("station", "upgrade", "--sockets", sockets, "--json")
    hold_output(schema, done.out, 0)
    assert (done.document["before"], done.document["after"]) == ("2", str(SCHEMA_VERSION))
    assert done.document["backup"] is not None
    assert "PASS" in flasher("station", "unit", "W2605100", *place).out
    assert "nothing to do" in flasher("station", "upgrade", "--sockets", sockets).out
    assert flasher("station", "verify", *place).code == ExitCode.OK


@pytest.mark.slow
def test_rules_that_were_taken_away_hide_nothing_else(
    flasher: Flasher, bench: Bench, place: tuple[str, ...]
) -> None:
    with closing(sqlite3.connect(bench.path)) as db:
        rules = db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
        for (name,) in rules:
            db.execute(f"DROP TRIGGER {name}")
        db.execute("UPDATE operator SET name = 'somebody'")
        db.commit()
    run = flasher("station", "verify", *place)
    schema, operator, count = run.out.splitlines()
    assert schema.endswith(f"and {len(rules) - 2} more: it was removed")
    assert operator == "operator of run 1, 2: changed after it was recorded: the operator's name"
    assert count == f"{len(rules) + 1} problems"
