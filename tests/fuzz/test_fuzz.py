"""Each harness takes its corpus, and fails where flasher fails; atheris drives some of them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NoReturn

import pytest

from tests.fuzz import __main__ as command
from tests.fuzz.harness import CORPUS, MODULES, Harness, find

_SLOW: Final = frozenset({"recipe", "story", "station-pages", "certificate", "bench-pages"})
"""Harnesses that take their corpus in more than 0.3 s."""
_CORPUS_MAX: Final = 200_000
NAMES: Final = [
    pytest.param(name, marks=pytest.mark.slow if name in _SLOW else ()) for name in MODULES
]
DRIVEN: Final = ("reassembler", "image", "plan")
"""Harnesses whose modules are instrumented in few seconds; `python -m tests.fuzz` drives all."""


def take_all(harness: Harness, inputs: Iterable[bytes]) -> None:
    for data in inputs:
        harness.take(data)


# -- harnesses -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_harness_takes_its_corpus(name: str) -> None:
    harness = find(name)
    take_all(harness, harness.corpus(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_harness_has_a_seed_that_is_not_refused(name: str) -> None:
    harness = find(name)
    for seed in harness.seeds():
        try:
            harness.run(seed)
        except harness.allowed:
            continue
        return
    pytest.fail("every seed is refused")


@pytest.mark.parametrize("name", NAMES)
def test_a_harness_reports_a_fault_of_flasher(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> NoReturn:
        raise ValueError("planted")

    harness = find(name)
    seeds = list(harness.seeds())
    harness.take(seeds[0])  # what is made once is made before
    monkeypatch.setattr(harness.below, fail)
    with pytest.raises(ValueError, match="planted"):
        take_all(harness, seeds)


@pytest.mark.parametrize(
    ("name", "function", "wrong"),
    [
        ("reassembler", "flasher.protocol.wire.Reassembler.buffered_bytes", 1000),
        ("reassembler", "flasher.protocol.wire.Reassembler._flush_junk", lambda *_: None),
        ("messages", "flasher.protocol.messages.Ack.data", lambda _self: b"\1\1"),
        ("messages", "flasher.protocol.fields.TextField.show", lambda *_: "\x1b[2J"),
        ("image-hex", "flasher.image.records._digest", id),
        ("image-srec", "flasher.image.plan._packet_wire", lambda *_: b""),
        ("manifest", "flasher.settings.manifest.STATEMENTS", ("target", "sha256")),
        (
            "conformance-profile",
            "flasher.conformance.profile.ConformanceProfile.to_toml",
            lambda _self: "",
        ),
        ("recipe", "flasher.station.recipe_file.LoadedRecipe.is_unchanged", lambda _self: False),
        ("trace-log", "flasher.trace.recorder.CandumpWriter.__call__", lambda *_: None),
        ("trace-pcapng", "flasher.trace.pcapng.PcapngWriter.__call__", lambda *_: None),
    ],
)
def test_a_harness_reports_what_does_not_hold(
    name: str, function: str, wrong: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness = find(name)
    seeds = list(harness.seeds())
    monkeypatch.setattr(function, wrong)
    with pytest.raises(AssertionError):
        take_all(harness, seeds)


@pytest.mark.parametrize(
    ("clock", "readings", "reason"),
    [
        ("time.process_time", [0.0, 2.5], "2.5 s of the processor"),
        ("_peak_mb", [100.0, 400.0], "300 MB of memory"),
    ],
)
def test_time_and_memory_of_an_input_are_limited(
    clock: str, readings: list[float], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"tests.fuzz.harness.{clock}", iter(readings).__next__)
    harness = Harness(lambda _data: None, list, "")
    with pytest.raises(AssertionError, match=reason):
        harness.take(b"")


# -- corpus ----------------------------------------------------------------------------------------


def test_the_corpus_is_small_and_of_harnesses() -> None:
    folders = [path for path in CORPUS.iterdir() if path.is_dir()]
    assert {path.name for path in folders} <= set(MODULES)
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < _CORPUS_MAX


# -- command ---------------------------------------------------------------------------------------


def run(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tests.fuzz", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        cwd=command.ROOT,
    )


@pytest.mark.slow
def test_an_input_is_run_again_without_atheris(tmp_path: Path) -> None:
    path = tmp_path / "input"
    path.write_bytes(b"\0")
    assert run("reassembler", path).returncode == 0
    done = run("reassembler", tmp_path / "nothing")
    assert done.returncode == 2
    assert "no harness" in done.stderr


def test_without_atheris_the_command_names_where_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda _name: None)
    monkeypatch.setattr(sys, "argv", ["fuzz", "reassembler"])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 2
    assert "atheris is not installed: it is in the extra `dev`" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVEN)
def test_atheris_drives_a_harness(name: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="needs atheris")
    done = command.fuzz(name, tmp_path, runs=100)
    assert not done.failure, done.failure
    assert done.findings == ()
    assert done.executions >= 100
    assert done.edges > 30


_BROKEN: Final = """
import sys
import tests.fuzz.wire
from tests.fuzz.harness import Harness
def run(data):
    if len(data) > 3:
        raise ValueError("planted")
tests.fuzz.wire.HARNESSES["reassembler"] = Harness(run, lambda: [b"x"], "")
import tests.fuzz.instrumented
"""


@pytest.mark.slow
def test_a_finding_is_kept_in_a_file(tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="needs atheris")
    done = command.fuzz("reassembler", tmp_path, runs=10_000, child=("-c", _BROKEN))
    assert "ValueError: planted" in done.failure
    (path,) = done.findings
    assert path.parent == tmp_path / "reassembler"
    assert len(path.read_bytes()) > 3
