"""`flasher bundle`: one file that explains a failure to whoever helps."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from tests.end_to_end.stage import Stage

from .conftest import SAMPLES, Flasher


@pytest.fixture
def failure(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, bundle_folder: Path
) -> Path:
    """The bundle of an upgrade that got no answer, run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    stage = Stage()
    stage.cut_power()
    monkeypatch.setattr("flasher.api.connect", stage.connect)
    run = flasher("flash", SAMPLES / "bms.hex", "-t", "bms", "-i", "virtual")
    assert run.code == ExitCode.NO_ANSWER, run.err
    assert "flasher bundle --last" not in run.err  # the folder was chosen
    (found,) = bundle_folder.iterdir()
    return found


def files_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.slow
def test_the_latest_failure_is_packed_with_its_story_history_and_adapters(
    flasher: Flasher, failure: Path, tmp_path: Path
) -> None:
    run = flasher("bundle", "--last")
    assert run.code == ExitCode.OK, run.err
    path = tmp_path / f"{failure.name}.zip"
    assert f"{path.name}, " in run.out
    assert "what an upgrade sent of its image" in run.out
    files = files_of(path)
    assert set(files) == {
        "README.txt", "story.html", "trace.blf", "transcript.txt", "report.json", "history.json",
        "computer.json",
    }  # fmt: skip
    assert files["trace.blf"] == (failure / "trace.blf").read_bytes()
    assert b"no boot version" in files["story.html"]
    (flash,) = json.loads(files["history.json"])
    assert flash["ended"]["exit_code"] == ExitCode.NO_ANSWER
    assert json.loads(files["computer.json"])["adapters"] == []
    for name in files.keys() - {"README.txt"}:
        assert f"{name}: " in files["README.txt"].decode()
    assert path.stat().st_mode & 0o077 == 0


def test_the_file_can_be_explained_where_it_is_extracted(
    flasher: Flasher, failure: Path, tmp_path: Path
) -> None:
    flasher("bundle", failure, "-o", "help.zip")
    with zipfile.ZipFile("help.zip") as archive:
        archive.extractall(tmp_path / "extracted")
    here, there = flasher("explain", failure), flasher("explain", tmp_path / "extracted")
    assert there.out.splitlines()[1:] == here.out.splitlines()[1:]


def test_the_home_folder_is_not_in_it_but_added_bytes_stay_as_they_are(
    flasher: Flasher, failure: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathlib.Path.home", lambda: SAMPLES)
    log, data = tmp_path / "a.log", tmp_path / "a.bin"
    log.write_text(f"opened {SAMPLES}/bms.hex\n")
    data.write_bytes(b"\0" + str(SAMPLES).encode())
    assert flasher("bundle", failure, "--add", log, "--add", data, "-o", "b.zip").code == 0
    files = files_of(tmp_path / "b.zip")
    assert files["added/a.log"] == b"opened ~/bms.hex\n"
    assert files["added/a.bin"] == data.read_bytes()
    for name in ("report.json", "history.json", "story.html"):
        assert str(SAMPLES).encode() not in files[name], name
    assert b"~/bms.hex" in files["report.json"]


@pytest.mark.slow
def test_nothing_is_overwritten_or_added_twice(
    flasher: Flasher, failure: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    for folder in (tmp_path, tmp_path / "other"):
        (folder / "a.log").write_text("x")
    run = flasher("bundle", failure, "--add", "a.log", "--add", "other/a.log")
    assert run.code == ExitCode.USAGE
    assert "Two files named a.log" in run.err
    assert flasher("bundle", failure, "--add", "a.log", "-o", "a.log", "--force").code == (
        ExitCode.USAGE
    )
    assert flasher("bundle", failure).code == ExitCode.OK
    assert flasher("bundle", failure).code == ExitCode.USAGE
    assert flasher("bundle", failure, "--force").code == ExitCode.OK


def test_what_is_no_bundle_is_refused(flasher: Flasher, tmp_path: Path) -> None:
    for words in ([], [tmp_path], [tmp_path / "none"], ["--last"], [tmp_path, "--last"]):
        run = flasher("bundle", *words)
        assert run.code == ExitCode.USAGE, words
        assert "what to do:" in run.err
    assert not list(tmp_path.iterdir())
