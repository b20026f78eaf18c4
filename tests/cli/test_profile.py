"""`flasher profile`: every value with its source, and checking a file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.settings.profile import reader
from tests.cli.conftest import Flasher


@pytest.fixture(autouse=True)
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory, and no configuration of the user."""
    for name in ("HOME", "XDG_CONFIG_HOME", "APPDATA", "USERPROFILE"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    return here


def rows(text: str) -> dict[str, tuple[str, str]]:
    """Value and source by name, as printed."""
    split = (re.split(r"\s{2,}", line.strip()) for line in text.splitlines())
    return {name: (value, source) for name, value, source in split}


def test_every_value_is_shown_with_its_source(flasher: Flasher) -> None:
    run = flasher("profile", "show", "-t", "bms")
    assert run.code == ExitCode.OK
    shown = rows(run.out)
    assert set(shown) | {"application_area.start", "application_area.size_bytes"} == set(
        reader().keys
    ) | {"application_area"}
    assert shown["timings.command_timeout_s"] == ("1.0", "document")
    assert shown["timings.ack_timeout_s"] == ("0.5", "default")
    assert shown["reset_command"] == ("0x4205", "document")
    assert shown["reset_data"] == ('"RESET"', "document")
    assert shown["version_query.answer_id"] == ("0x0720", "document")
    assert shown["application_area"] == ("not set", "default")


def test_the_file_of_the_working_directory_holds(flasher: Flasher, nowhere: Path) -> None:
    (nowhere / "flasher.toml").write_text("attempts = 8\nreset_data = [1, 2, 3, 4, 255]\n")
    shown = rows(flasher("profile", "show", "-t", "mc").out)
    assert shown["attempts"] == ("8", str(nowhere / "flasher.toml"))
    assert shown["reset_data"][0] == "[1, 2, 3, 4, 255]"


def test_the_file_that_is_named_holds_instead(flasher: Flasher, nowhere: Path) -> None:
    (nowhere / "flasher.toml").write_text("attempts = 8\n")
    other = nowhere / "other.toml"
    other.write_text("frame_gap_s = 0.001\n")
    shown = rows(flasher("profile", "show", "-t", "mc", "--profile", other).out)
    assert shown["attempts"] == ("3", "default")
    assert shown["frame_gap_s"] == ("0.001", str(other))


def test_the_dialect_decides_whether_there_is_an_upgrade(flasher: Flasher) -> None:
    run = flasher("profile", "show", "-t", "bms", "--dialect", "motinova")
    assert rows(run.out)["has_upgrade"] == ("false", "document")


def test_json_holds_typed_values_and_sources(flasher: Flasher, nowhere: Path) -> None:
    (nowhere / "flasher.toml").write_text("attempts = 8\n")
    for words in (("--json", "show"), ("show", "--json")):
        document = flasher("profile", *words, "-t", "bms").document
        assert document["exit_code"] == 0
        assert document["target"] == "bms"
        assert document["values"]["attempts"]["value"] == 8
        assert document["values"]["attempts"]["source"].endswith("flasher.toml")
        assert document["values"]["version_query.offset"] == {"value": 48, "source": "document"}


def test_a_right_file_is_reported_to_be_right(flasher: Flasher, nowhere: Path) -> None:
    path = nowhere / "bench.toml"
    path.write_text("[wmc]\nattempts = 8\n")
    run = flasher("profile", "check", path)
    assert run.code == ExitCode.OK
    assert run.out == f"{path}: right, with values of their own for wmc\n"


def test_a_wrong_file_is_wrong_usage_with_a_suggestion(flasher: Flasher, nowhere: Path) -> None:
    path = nowhere / "bench.toml"
    path.write_text("[wmc]\natempts = 8\n")
    for words in (("check", path), ("show", "-t", "bms", "--profile", path)):
        run = flasher("profile", *words)
        assert run.code == ExitCode.USAGE
        assert run.out == ""
        assert "unknown key 'atempts' in [wmc]" in run.err
        assert "Did you mean attempts?" in run.err


def test_it_wants_an_action(flasher: Flasher) -> None:
    assert flasher("profile").code == ExitCode.USAGE
    assert flasher("profile", "remove").code == ExitCode.USAGE
