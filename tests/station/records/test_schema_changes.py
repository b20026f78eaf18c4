# ruff: noqa: S608  names of tables of our own
"""Records of an older flasher: what a plant has goes on with this one, or stays as it is."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, inspect, text

from flasher.errors import ExitCode, FlasherError, UsageError
from flasher.station.records import database, schema, upgrade
from flasher.station.records.errors import (
    DiskFullError,
    OldSchemaError,
    RecordsLockedError,
    RuleBrokenError,
    SchemaVersionError,
    StationBusyError,
)
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import RunKind, RunState
from flasher.station.records.store import Store
from flasher.station.records.triggers import fingerprint_of
from flasher.station.records.upgrade import NEWEST, Upgraded
from tests.station.factory import FakeClock
from tests.station.records import old_records

pytestmark = pytest.mark.slow


class Old:
    """Records of schema 2."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder, url
        self.files = folder / "records.sqlite.files"
        self.engine = create_engine(f"sqlite:///{url}")

    @property
    def place(self) -> dict[str, Any]:
        return {"folder": self.files, "key_locations": KeyLocations(self.folder / "keys")}

    def open(self, station: str = "line-2", *, read_only: bool = False, **more: Any) -> Store:
        return Store.open(
            self.url, station=station, create=False, read_only=read_only, lock_timeout_s=0.5,
            **self.place, **more,
        )  # fmt: skip

    def upgrade(self, station: str = "line-2") -> Upgraded:
        return upgrade.upgrade(
            database.locate(self.url, self.files),
            choose=lambda _: station,
            key_locations=KeyLocations(self.folder / "keys"),
            now=FakeClock().utc,
            lock_timeout_s=0.5,
        )

    def catalogue(self) -> dict[str, str]:
        with self.engine.connect() as connection:
            return fingerprint_of(connection)

    def rows(self) -> dict[str, list[Any]]:
        """All rows of the tables that schema 2 has."""
        with self.engine.connect() as connection:
            return {
                name: [tuple(row) for row in connection.execute(text(f"SELECT * FROM {name}"))]
                for name in sorted(set(inspect(connection).get_table_names()))
                if name not in ("alembic_version", "schema_info")
            }


@pytest.fixture
def old(tmp_path: Path) -> Iterator[Old]:
    old_records.unpack(tmp_path)
    made = Old(tmp_path, str(tmp_path / "records.sqlite"))
    yield made
    made.engine.dispose()


def test_old_records_are_taken_over_whole(old: Old) -> None:
    before = old.rows()
    done = old.upgrade()
    assert (done.before, done.after, done.problems) == ("2", NEWEST, ())
    after = old.rows()
    added = after.pop("audit")[-1]  # the change itself
    assert added[4] == "migrated"
    assert before.pop("audit")
    assert after == before
    fresh = Old(old.folder, str(old.folder / "fresh.sqlite"))
    Store.open(fresh.url, station="x").close()
    assert old.catalogue() == fresh.catalogue()
    fresh.engine.dispose()
    with old.open() as store:
        assert not store.examine().problems
        assert len(store.recover()) == 1  # the run that its station left
        rows = store.read.table()
        assert len(rows) == 50
        assert {row.kind for row in rows} == set(RunKind)
        assert {row.state.value for row in rows} == {state.value for state in RunState} - {
            "RUNNING"
        }
        assert not store.examine().problems
    with old.open("line-3") as other:
        other.recover()
        assert not other.examine().problems


def test_a_station_upgrades_its_file_at_its_start_and_keeps_a_copy(old: Old) -> None:
    before = old.rows()
    reported: list[str] = []
    with old.open(report=reported.append) as store:
        assert "minutes" in reported[0]
        assert not store.examine().problems
        assert store.recover() != ()
    (copy,) = old.folder.glob("*.schema-2")
    kept = Old(old.folder, str(copy))
    assert kept.rows() == before
    kept.engine.dispose()
    with old.open():
        assert [copy] == list(old.folder.glob("*.schema-2*"))


def test_who_reads_changes_no_schema(old: Old) -> None:
    before = old.catalogue()
    with pytest.raises(OldSchemaError) as caught:
        old.open(read_only=True)
    assert "flasher station upgrade" in caught.value.remedy
    assert old.catalogue() == before


def test_a_station_that_the_records_do_not_know_changes_nothing(old: Old) -> None:
    with pytest.raises(FlasherError, match="line-9 is none") as caught:
        old.open("line-9")
    assert "line-2, line-3" in caught.value.remedy
    assert not list(old.folder.glob("*.schema-2*"))


def test_nothing_is_changed_while_another_station_of_the_records_runs(old: Old) -> None:
    lock = database.StationLock("line-3", old.files)
    lock.acquire()
    with pytest.raises(StationBusyError):
        old.upgrade()
    lock.release()
    assert old.upgrade().after == NEWEST


def test_a_rule_that_was_taken_away_before_is_reported_and_stays_reported(old: Old) -> None:
    with old.engine.begin() as connection:
        connection.execute(text("DROP TRIGGER run_update"))
        connection.execute(text("CREATE INDEX foreign_one ON unit (part)"))
    done = old.upgrade()
    assert "schema, trigger run_update: it was removed" in done.problems
    assert "schema, index foreign_one: it was added" in done.problems
    with old.open(read_only=True) as store:
        noted = [each.what for each in store.examine().problems]
    assert noted == [f"found at the upgrade: {problem}" for problem in done.problems]


# -- what goes wrong ------------------------------------------------------------------------------

_BROKEN = '''
"""A change that does not work out."""

from alembic import op

revision = "{revision}"
down_revision = "{before}"


def upgrade() -> None:
    op.create_index("half_done", "run", ["reason"])
    op.execute("{statement}")
'''


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes this flasher one of a further schema, with a change of these lines."""

    def plant(text: str) -> None:
        folder = tmp_path / "planted"
        versions = folder / "versions"
        versions.mkdir(parents=True)
        real = Path(upgrade.__file__).parent / "migrations"
        for path in (real / "env.py", *(real / "versions").glob("v*.py")):
            copy = folder / path.relative_to(real)
            copy.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
        (versions / "v99.py").write_text(text, encoding="utf-8")
        monkeypatch.setattr(upgrade, "CHANGES", str(folder))
        monkeypatch.setattr(upgrade, "NEWEST", "99")

    return plant


@pytest.mark.parametrize(
    ("statement", "kind"),
    [
        ("UPDATE nowhere SET x = 1", FlasherError),
        ("UPDATE run SET state = 'GOOD' WHERE id = 1", RuleBrokenError),
    ],
)
def test_a_change_that_fails_leaves_everything(
    old: Old, planted: Any, statement: str, kind: type[FlasherError]
) -> None:
    planted(_BROKEN.format(revision="99", before=NEWEST, statement=statement))
    rows, catalogue = old.rows(), old.catalogue()
    with pytest.raises(kind, match="not brought to schema 99, they keep schema 2") as caught:
        old.upgrade()
    assert caught.value.exit_code is ExitCode.USAGE
    assert old.rows() == rows
    assert old.catalogue() == catalogue
    assert not list(old.folder.glob("*.schema-2*"))


def test_a_table_that_is_made_anew_keeps_rules_and_rows(old: Old, planted: Any) -> None:
    planted(
        '"""A change that SQLite does by copying the table."""\n\n'
        "import sqlalchemy as sa\nfrom alembic import op\n\n"
        f'revision = "99"\ndown_revision = "{NEWEST}"\n\n\n'
        "def upgrade() -> None:\n"
        '    with op.batch_alter_table("run", recreate="auto") as table:\n'
        '        table.alter_column("code", type_=sa.String(80))\n'
    )
    before = old.catalogue()
    runs = old.rows()["run"]
    assert old.upgrade().after == "99"
    after = old.catalogue()
    rules = {name: sql for name, sql in before.items() if name.startswith("trigger ")}
    assert rules == {name: after.get(name) for name in rules}
    assert before.keys() - after.keys() == {"index ix_run_lot_id"}  # schema 3 has a better one
    assert old.rows()["run"] == runs


def test_a_backup_is_read_with_a_copy_of_the_key_alone(old: Old) -> None:
    folder = old.folder / "copy"
    (folder / "keys").mkdir(parents=True)
    shutil.copy(old.url, folder / "copy.sqlite")
    shutil.copytree(old.files, folder / "records.sqlite.files")
    for key in old.folder.glob("keys/*.key"):
        shutil.copy(key, folder / "keys")
    copy = Old(folder, str(folder / "copy.sqlite"))
    old.open().close()  # the station goes on, and stores later heads
    copy.upgrade()
    with closing(copy.open(read_only=True)) as store:
        assert not store.examine().problems
    with closing(old.open()) as station:
        station.recover()
        assert not station.examine().problems
    copy.engine.dispose()


def test_a_full_disk_leaves_everything(old: Old, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = old.rows()
    prepare = database.Database._prepare_sqlite

    def small(self: database.Database, connection: Any, record: Any) -> None:
        prepare(self, connection, record)
        (pages,) = connection.execute("PRAGMA page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count = {pages}")

    monkeypatch.setattr(database.Database, "_prepare_sqlite", small)
    with pytest.raises(DiskFullError):
        old.open()
    monkeypatch.undo()
    assert old.rows() == rows
    assert not list(old.folder.glob("*.schema-2*"))


def test_a_copy_for_which_there_is_no_room_stops_the_change(
    old: Old, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(upgrade, "copy_checked", full)
    before = old.catalogue()
    with pytest.raises(DiskFullError, match="No space left"):
        old.open()
    assert old.catalogue() == before


def test_without_its_package_nothing_is_changed(old: Old, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(UsageError, match="alembic") as caught:
        old.open()
    assert ".[station]" in caught.value.remedy
    assert not list(old.folder.glob("*.schema-2*"))


def test_records_that_another_program_holds_are_not_changed(old: Old) -> None:
    with closing(sqlite3.connect(old.url, isolation_level=None)) as holder:
        holder.execute("BEGIN IMMEDIATE")
        with pytest.raises(RecordsLockedError, match="keep schema 2"):
            old.open()
    assert not list(old.folder.glob("*.schema-2*"))
    old.open().close()


@pytest.mark.parametrize("revision", [str(schema.SCHEMA_VERSION + 1), "1a2b3c"])
def test_a_revision_that_is_not_known_is_refused(old: Old, revision: str) -> None:
    old.upgrade()
    with old.engine.begin() as connection:
        connection.execute(schema.alembic_version.update().values(version_num=revision))
    with pytest.raises(SchemaVersionError, match=revision):
        old.upgrade()
    with pytest.raises(SchemaVersionError, match=revision) as caught:
        old.open()
    assert caught.value.exit_code is ExitCode.USAGE
    assert "newer" in caught.value.remedy


def test_a_flasher_from_before_refuses_upgraded_records(old: Old) -> None:
    """It asks for the version that it wrote itself."""
    old.upgrade()
    with old.engine.connect() as connection:
        found = connection.execute(text("SELECT version FROM schema_info")).scalar_one()
    assert found == schema.SCHEMA_VERSION > 2


def test_the_newest_change_is_the_schema_of_this_flasher() -> None:
    folder = Path(upgrade.__file__).parent / "migrations" / "versions"
    numbers = sorted(int(path.name[1:].partition("_")[0]) for path in folder.glob("v*.py"))
    assert numbers == list(range(2, schema.SCHEMA_VERSION + 1))


def test_what_holds_no_records_is_not_upgraded(tmp_path: Path) -> None:
    other = Old(tmp_path, str(tmp_path / "other.sqlite"))
    with other.engine.begin() as connection:
        connection.execute(text("CREATE TABLE holiday (photo BLOB)"))
    with pytest.raises(SchemaVersionError, match="other data"):
        other.upgrade()
    other.engine.dispose()
