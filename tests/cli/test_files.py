"""Writing a file whole: what lies in its folder already is no way to another file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flasher.cli.files import write_whole
from flasher.errors import ExitCode, UsageError
from tests.loops import each

from .conftest import SAMPLES, Flasher


def test_a_link_that_was_laid_beforehand_is_never_written_through(
    flasher: Flasher, tmp_path: Path
) -> None:
    """Whoever may write into the folder knows the names that a command writes."""
    treasure = tmp_path / "treasure"
    treasure.write_bytes(b"mine")
    out = tmp_path / "app.toml"
    for name in (".app.toml.part", f".app.toml.{os.getpid()}.part"):
        (tmp_path / name).symlink_to(treasure)
    run = flasher("manifest", "create", SAMPLES / "bms.bin", "-t", "bms", "-o", out)
    assert run.code == 0
    assert treasure.read_bytes() == b"mine"
    assert out.is_file()
    assert not out.is_symlink()


def test_ones_own_link_is_followed_and_stays(tmp_path: Path) -> None:
    real = tmp_path / "real"
    (tmp_path / "link").symlink_to("other")
    (tmp_path / "other").symlink_to(real)
    write_whole(tmp_path / "link", b"new", "--html")
    assert real.read_bytes() == b"new"
    assert (tmp_path / "link").is_symlink()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owner here")
def test_a_link_of_another_user_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = tmp_path / "real"
    real.write_bytes(b"mine")
    (tmp_path / "own").symlink_to("foreign")
    (tmp_path / "foreign").symlink_to(real)
    if os.geteuid() == 0:
        os.lchown(tmp_path / "foreign", 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
    for name in ("own", "foreign"):
        with pytest.raises(UsageError, match="a link of another user"):
            write_whole(tmp_path / name, b"new", "--html")
    assert real.read_bytes() == b"mine"


@each(
    "words",
    [
        ("backup", "-t", "bms", "--mock", "-o", "-"),
        ("release", "payload", "bike.wfw", "-o", "-"),
        ("bundle", "--last", "-o", "-"),
    ],
)
def test_standard_output_is_not_taken_for_a_file_named_by_a_dash(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bundles" / "flasher-bms-20260105-101500").mkdir(parents=True, exist_ok=True)
    monkeypatch.setenv("FLASHER_BUNDLE_DIR", str(tmp_path / "bundles"))
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "writes a file, not standard output" in run.err
    assert not (tmp_path / "-").exists()
