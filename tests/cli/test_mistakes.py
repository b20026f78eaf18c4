"""The table of mistakes (mistakes.toml): exit code, message, and the advised command, run."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest

from flasher.errors import ExitCode
from tests.cli.conftest import SAMPLES, Flasher
from tests.rights import permissions_hold

pytestmark = pytest.mark.slow
_TABLE: Final = Path(__file__).with_name("mistakes.toml")
_PRINTED_COMMAND: Final = re.compile(r"`(flasher [^`]+)`|^ {4}(flasher .+)$", re.MULTILINE)
_ERRORS_WITHOUT_ONE: Final = (ExitCode.OK, ExitCode.PARTIAL)


@dataclass(frozen=True)
class Mistake:
    """Row of the table."""

    typed: str
    """Command line, run in the folder of `workplace`."""
    exit_code: int
    holds: list[str]
    """Words of the message."""
    then: str = ""
    """Command line that follows the advice; it has the words of `advised`."""
    advised: str = ""
    """Words of the message; by default `then`."""
    then_exit_code: int = 0
    not_run: list[str] = field(default_factory=list)
    """Printed commands that do not run here, such as for an adapter."""


MISTAKES: Final = [Mistake(**row) for row in tomllib.loads(_TABLE.read_text("utf-8"))["mistake"]]


def fill(folder: Path, short_bms: Path) -> None:
    """Lay the files of the table into a folder."""
    for name in ("bms.bin", "obc.bin", "obc.elf", "wmc.hex", "wmc.s19"):
        shutil.copy(SAMPLES / name, folder)
    shutil.copy(short_bms, folder / "bms.hex")
    shutil.copytree(SAMPLES / "bad", folder / "bad")
    (folder / "empty.bin").touch()
    (folder / "tiny.bin").write_bytes(bytes(range(16)))
    (folder / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8)
    (folder / "page.bin").write_bytes(b"<!doctype html><title>404</title>\n" * 9)
    (folder / "notes.txt").write_text("Release notes of the month.\n" * 9)
    (folder / "noise.bin").write_bytes(bytes(range(7, 256, 3)) * 40)
    with zipfile.ZipFile(folder / "release.zip", "w") as archive:
        archive.write(folder / "wmc.hex", "wmc.hex")
    (folder / "folder").mkdir()
    (folder / "kept.asc").write_text("date Mon Jan 5 10:00:00 2026\n")
    (folder / "broken.toml").write_text("attempts = \n")
    (folder / "wrong.toml").write_text("attemps = 5\n")
    (folder / "locked").mkdir()
    shutil.copy(folder / "bms.hex", folder / "locked")
    (folder / "locked").chmod(0)


@pytest.fixture(scope="module")
def laid_out(tmp_path_factory: pytest.TempPathFactory, short_bms: Path) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("workplace")
    fill(folder, short_bms)
    yield folder
    (folder / "locked").chmod(0o700)


@pytest.fixture
def workplace(laid_out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of its own for each row, in which it is run."""
    for path in laid_out.iterdir():
        if path.name != "locked":
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / "locked").mkdir(mode=0)
    monkeypatch.chdir(tmp_path)


def run_typed(flasher: Flasher, typed: str) -> tuple[int, str]:
    program, *words = shlex.split(typed)
    assert program == "flasher"
    run = flasher(*words)
    return run.code, run.out + run.err


@pytest.mark.parametrize("row", MISTAKES, ids=lambda row: row.typed)
@pytest.mark.usefixtures("workplace")
def test_a_mistake_has_its_exit_code_and_its_advice_works(flasher: Flasher, row: Mistake) -> None:
    with permissions_hold():
        code, printed = run_typed(flasher, row.typed)
        assert code == row.exit_code, printed
        for words in row.holds:
            assert words in printed, printed
        assert "Traceback" not in printed
        assert (printed.count("error: ") == 1) is (code not in _ERRORS_WITHOUT_ONE), printed
        commands = {found[1] or found[2] for found in _PRINTED_COMMAND.finditer(printed)}
        assert commands <= {row.then, row.advised, *row.not_run}, commands
        if not row.then:
            return
        advised = row.advised or row.then
        assert advised in printed, printed
        assert advised in row.then
        code, printed = run_typed(flasher, row.then)
        assert code == row.then_exit_code, printed


def test_the_table_has_a_hundred_mistakes_and_no_row_twice() -> None:
    typed = [row.typed for row in MISTAKES]
    assert len(set(typed)) == len(typed) >= 100
