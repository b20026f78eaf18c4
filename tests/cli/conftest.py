"""How the tests run the command line."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flasher.bus.detect import DetectionResult
from flasher.cli.main import main
from tests import schema_document
from tests.firmware import shorten

SAMPLES = Path(__file__).parents[2] / "firmware_samples"


@dataclass(frozen=True)
class Run:
    """What a command printed and its exit code."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> dict[str, Any]:
        """The one JSON document on stdout."""
        loaded = json.loads(self.out)
        assert isinstance(loaded, dict)
        return loaded


Flasher = Callable[..., Run]


@pytest.fixture(scope="session")
def short_bms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of the BMS sample, for tests of something else than its size."""
    path = tmp_path_factory.mktemp("samples") / "bms"
    shorten(SAMPLES / "bms", path)
    return path.with_suffix(".hex")


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where each test gets folders of its own, with less work than by `tmp_path_factory`."""
    return tmp_path_factory.mktemp("folders")


@pytest.fixture(autouse=True)
def bundle_folder(folders: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where failures leave their bundles: not in the folder that the tests are run in."""
    folder = Path(tempfile.mkdtemp(dir=folders))
    monkeypatch.setenv("FLASHER_BUNDLE_DIR", str(folder))
    return folder


@pytest.fixture(autouse=True)
def data_folder(folders: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the history lies: what one test has left unfinished is not known to the next."""
    folder = Path(tempfile.mkdtemp(dir=folders))
    monkeypatch.setenv("XDG_DATA_HOME", str(folder))
    return folder


@pytest.fixture(scope="session")
def schema() -> dict[str, Any]:
    """What `--json` prints, as it is published."""
    loaded = json.loads(schema_document.SCHEMA.read_text(encoding="utf-8"))
    assert isinstance(loaded, dict)
    return loaded


@pytest.fixture
def flasher(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Flasher:
    """Runs `flasher ...` on a computer without adapters and without python-can's configuration."""
    monkeypatch.setattr("can.util.load_file_config", lambda *_args: {})
    monkeypatch.setattr("can.util.load_environment_config", lambda *_args: {})
    monkeypatch.setattr("flasher.cli.adapters.detect_adapters", lambda **_: DetectionResult())

    def run(*arguments: str | Path) -> Run:
        words: Sequence[str] = [str(argument) for argument in arguments]
        code = main(words)
        captured = capsys.readouterr()
        return Run(code, captured.out, captured.err)

    return run
