"""Records of an older flasher: what a plant has goes on with this one."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.station.records.keys import Keeping
from flasher.station.records.model import RunKind, RunState
from flasher.station.records.store import Store
from tests.station.records import old_records


@pytest.fixture(params=["sqlite", "postgresql"])
def old(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of records of schema 2."""
    old_records.unpack(request.param, tmp_path)
    if request.param == "sqlite":
        return str(tmp_path / "records.sqlite")
    return old_records.restore(request.getfixturevalue("postgres"), tmp_path / old_records.DUMP)


def opened(old: str, folder: Path, station: str = "line-2", *, read_only: bool = False) -> Store:
    files = folder / ("files" if "://" in old else "records.sqlite.files")
    keeping = Keeping(folder / "keys")
    return Store.open(
        old, station=station, folder=files, keeping=keeping, create=False, read_only=read_only
    )


def test_old_records_are_examined_and_continued(old: str, tmp_path: Path) -> None:
    with opened(old, tmp_path) as store:
        assert not store.examine().problems
        assert len(store.recover()) == 1  # the run that its station left
        rows = store.read.table()
        assert len(rows) == 50
        assert {row["kind"] for row in rows} == {kind.value for kind in RunKind}
        assert {row["state"] for row in rows} == {state.value for state in RunState} - {"RUNNING"}
        assert not store.examine().problems
