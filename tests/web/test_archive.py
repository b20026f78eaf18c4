"""Files on this computer, without a page around it."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.history import MOCK, FlashHistory, Reached
from flasher.trace.bundle import write_bundle
from flasher.trace.taps import FlightRecorder
from flasher.web.archive import Archive
from flasher.web.query_processes import Answer, Question
from tests.cli.test_history import BEGAN


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Archive:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    facts = {"target": "bms", "error": {"what": "The <b>bus</b> broke.", "exit_code": 4}}
    write_bundle(tmp_path / "bundles", FlightRecorder(), facts)
    for folder, name in (("backups", "bms-1.zip"), ("backups", "else.txt"), ("traces", "a.log")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_bytes(b"(1.0) can0 725#00\n")
    return Archive(tmp_path / "bundles", tmp_path / "backups", tmp_path / "traces")


def _asked(kept: Archive, path: str, **fields: str) -> Answer:
    return kept.answer(Question(path, fields))


def test_it_lists_bundles_with_their_reason_and_backups(kept: Archive) -> None:
    page = _asked(kept, "/kept").body.decode()
    assert "The &lt;b&gt;bus&lt;/b&gt; broke." in page
    assert "bms-1.zip" in page
    assert "else.txt" not in page


def test_a_bundle_whose_report_is_damaged_is_listed_with_that(kept: Archive) -> None:
    (bundle,) = kept.bundles.iterdir()
    (bundle / "report.json").write_text("[")
    assert "is not the report of a bundle" in _asked(kept, "/kept").body.decode()


def test_nothing_kept_yet_is_reported(tmp_path: Path) -> None:
    missing = tmp_path / "missing"
    assert _asked(Archive(missing, missing, missing), "/kept").status == 200


def test_a_bundle_is_one_file(kept: Archive) -> None:
    (bundle,) = kept.bundles.iterdir()
    answer = _asked(kept, "/kept/bundle", name=bundle.name)
    assert answer.file_name == f"{bundle.name}.zip"
    with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
        assert f"{bundle.name}/report.json" in archive.namelist()


@pytest.mark.parametrize(
    ("path", "field"),
    [
        ("/kept/backup", "name"),
        ("/kept/bundle", "name"),
        ("/kept/story", "bundle"),
        ("/kept/story", "trace"),
    ],
)
@pytest.mark.parametrize("name", ["../backups/bms-1.zip", "/etc/passwd", "..", "", "no.zip"])
def test_nothing_but_what_is_listed_is_given_out(
    kept: Archive, path: str, field: str, name: str
) -> None:
    answer = _asked(kept, path, **{field: name})
    assert answer.status == 400
    assert "no longer exists" in answer.body.decode()


@pytest.mark.slow
def test_a_story_names_the_file_and_not_where_it_was_put(kept: Archive, tmp_path: Path) -> None:
    page = _asked(kept, "/kept/story", trace="a.log").body.decode()
    assert "What a.log tells" in page
    (kept.traces / "a.log").write_bytes(b"no trace")
    answer = _asked(kept, "/kept/story", trace="a.log")
    assert answer.status == 400
    assert "a.log is not a trace" in answer.body.decode()
    assert str(tmp_path) not in answer.body.decode()


def test_an_upgrade_without_an_end_names_what_it_left(kept: Archive) -> None:
    history = FlashHistory()
    name = history.begin(BEGAN)
    assert "it is still running" in _asked(kept, "/kept").body.decode()
    history.reached(name, Reached("transfer", 12))
    del history
    page = _asked(kept, "/kept").body.decode()
    assert "the program was killed" in page
    assert "its application is erased" in page


@pytest.mark.slow
def test_the_built_in_mock_is_named_in_the_language_of_the_page(kept: Archive) -> None:
    history = FlashHistory()
    history.begin(replace(BEGAN, adapter=MOCK))
    (flash,) = history.flashes()[0]
    assert flash.began.adapter == MOCK
    page = kept.answer(Question("/kept", language="de")).body.decode()
    assert "<dd>das eingebaute Gerätemodell</dd>" in page
