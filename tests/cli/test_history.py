"""`flasher history`: what flash and rescue keep, and that keeping it never disturbs them."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from flasher import history
from flasher.errors import ExitCode
from flasher.history import Began, Ended, FlashHistory
from tests.cli.conftest import SAMPLES, Flasher

BMS = str(SAMPLES / "bms.hex")
WMC = str(SAMPLES / "wmc.hex")
MOCK = ("--mock", "--mock-speed", "0")
BEGAN = Began(
    "2026-05-17T10:31:02+02:00", "flash", "bms", False, "socketcan can0", "a.hex", "ab", 3, None
)
ENDED = Ended(
    "2026-05-17T10:31:09+02:00", 0, "", "W2605001", None, True, True, "V1r0r4", False, None
)


@pytest.fixture
def file(data_folder: Path) -> Path:
    """The file of a user who has flashed nothing yet."""
    return data_folder / "flasher" / "history.jsonl"


def latest(flasher: Flasher, *words: str) -> dict[str, Any]:
    document = flasher("history", "--json", *words).document
    found = document["flashes"][0]
    assert isinstance(found, dict)
    return found


# -- what is kept ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_good_flash_is_kept_with_its_three_claims(flasher: Flasher, file: Path) -> None:
    assert flasher("flash", BMS, "-t", "bms", *MOCK).code == ExitCode.OK
    kept = latest(flasher)
    began, ended = kept["began"], kept["ended"]
    assert (began["command"], began["target"], began["is_virtual"]) == ("flash", "bms", True)
    assert (began["image"], began["image_size_bytes"]) == (BMS, 78_351)
    assert began["image_sha256"].startswith("3524689d")
    assert ended["serial_number"] == "W2605001"
    assert (ended["previous_version"], ended["running_version"]) == (
        "V1r0r0_20220512", "V1r0r4_20220512"
    )  # fmt: skip
    assert (ended["transferred"], ended["completed"]) == (True, True)
    assert (ended["exit_code"], ended["what"], ended["bundle"]) == (0, "", None)
    assert ended["needs_rescue"] is False
    if os.name == "posix":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700


@pytest.mark.slow
def test_what_runs_is_not_claimed_where_it_was_not_asked(flasher: Flasher) -> None:
    assert flasher("rescue", WMC, "-t", "wmc", *MOCK).code == ExitCode.OK
    kept = latest(flasher)
    assert kept["began"]["command"] == "rescue"
    assert kept["ended"]["completed"] is True
    assert kept["ended"]["running_version"] is None
    assert "running not known" in flasher("history").out


@pytest.mark.slow
def test_a_flash_that_fails_is_kept_with_its_bundle_and_what_is_left(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms", "--timeout", "2", *MOCK)
    ended = latest(flasher)["ended"]
    assert ended["exit_code"] == run.code == ExitCode.TRANSFER
    assert "the overall deadline passed" in ended["what"]
    assert (ended["transferred"], ended["completed"]) == (False, False)
    assert ended["needs_rescue"] is True
    assert (Path(ended["bundle"]) / "report.json").is_file()
    shown = flasher("history").out
    assert "not transferred, not completed, running not known" in shown
    assert "flasher rescue" in shown


def test_an_adapter_that_fails_in_the_middle_leaves_the_claims_open(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("flasher.api.Device.upgrade", fails)
    assert flasher("flash", BMS, "-t", "bms", *MOCK).code == ExitCode.INTERRUPTED
    ended = latest(flasher)["ended"]
    assert ended["exit_code"] == ExitCode.INTERRUPTED
    assert (ended["transferred"], ended["completed"]) == (None, None)
    assert ended["needs_rescue"] is True


@pytest.mark.parametrize(
    "words", [("--dry-run",), ("-i", "socketcan", "-c", "nocan7"), ("--verify", "nonsense")]
)
def test_what_never_began_is_not_kept(flasher: Flasher, file: Path, words: tuple[str, ...]) -> None:
    flasher("flash", BMS, "-t", "bms", *words)
    assert not file.exists()


@pytest.mark.slow
def test_one_that_was_killed_shows_without_an_end(flasher: Flasher) -> None:
    words = [sys.executable, "-m", "flasher", "flash", WMC, "-t", "wmc", "--mock"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert any("transferring" in line for line in process.stderr)
        process.kill()
    run = flasher("history")
    assert "end      began, no end recorded" in run.out
    assert latest(flasher)["ended"] is None
    assert flasher("flash", WMC, "-t", "wmc", *MOCK).code == ExitCode.OK, "it holds no lock"
    assert latest(flasher)["ended"]["completed"] is True


# -- it never disturbs -----------------------------------------------------------------------------


def full(*_: object) -> int:
    raise OSError(28, "No space left on device")


def broken_folder(file: Path, _patch: pytest.MonkeyPatch) -> None:
    file.parent.parent.mkdir(exist_ok=True)
    file.parent.write_text("a file in the place of the folder")


def full_disk(_file: Path, patch: pytest.MonkeyPatch) -> None:
    patch.setattr(os, "fsync", full)


@pytest.mark.slow
@pytest.mark.parametrize("breaks", [broken_folder, full_disk])
def test_what_cannot_be_written_is_a_warning_and_the_flash_goes_on(
    flasher: Flasher,
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    breaks: Callable[[Path, pytest.MonkeyPatch], None],
) -> None:
    breaks(file, monkeypatch)
    run = flasher("flash", WMC, "-t", "wmc", *MOCK)
    assert run.code == ExitCode.OK
    assert "warning: no history in" in run.err


def test_a_lock_that_another_program_holds_is_waited_for_a_moment_only(
    flasher: Flasher, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history, "_LOCK_LIMIT_S", 0.01)
    file.parent.mkdir(parents=True)
    with FileLock(f"{file}.lock"):
        run = flasher("flash", WMC, "-t", "wmc", *MOCK)
    assert run.code == ExitCode.OK
    assert "warning: no history in" in run.err
    assert not file.exists()


# -- reading ---------------------------------------------------------------------------------------


def test_nothing_flashed_is_reported(flasher: Flasher) -> None:
    assert flasher("history").out == "nothing flashed yet\n"
    FlashHistory().begin(BEGAN)
    assert flasher("history", "-t", "wmc").out == "nothing flashed that fits\n"


def test_the_latest_come_first_and_are_limited(flasher: Flasher) -> None:
    kept = FlashHistory()
    for number in range(5):
        name = kept.begin(Began(**{**vars(BEGAN), "image": f"{number}.hex"}))
        kept.end(name, Ended(**{**vars(ENDED), "serial_number": f"W{number % 2}"}))
    document = flasher("history", "--limit", "2", "--json").document
    assert [each["began"]["image"] for each in document["flashes"]] == ["4.hex", "3.hex"]
    assert document["total"] == 5
    run = flasher("history", "--serial", "w1", "--json")
    assert [each["began"]["image"] for each in run.document["flashes"]] == ["3.hex", "1.hex"]
    assert "the latest 1 of 5" in flasher("history", "--limit", "1").err
    assert flasher("history", "--limit", "0").code == ExitCode.USAGE


def test_damaged_lines_are_left_out_and_counted(flasher: Flasher, file: Path) -> None:
    kept = FlashHistory()
    kept.end(kept.begin(BEGAN), ENDED)
    damages = ['{"flash": "x", "event": "began"}', "[1, 2]", "\xff\xfe", "{" * 10_000, "null"]
    with file.open("a", encoding="latin-1") as appended:
        appended.write("\n".join([*damages, '{"flash": "torn', ""])[:-1])
    kept.begin(BEGAN)
    run = flasher("history", "--json")
    assert run.code == ExitCode.OK
    assert run.document["damaged_lines"] == len(damages) + 1
    assert [each["ended"] is None for each in run.document["flashes"]] == [True, False]
    assert "6 lines" in run.err


def test_what_it_contains_is_shown_escaped(flasher: Flasher) -> None:
    FlashHistory().begin(Began(**{**vars(BEGAN), "image": "\x1b[2J.hex"}))
    out = flasher("history").out
    assert "\x1b" not in out
    assert "\\x1b[2J.hex" in out


def line_of(**changes: object) -> bytes:
    """A flash that began, with these values in place of good ones."""
    values = {"flash": "x", "event": "began", **vars(BEGAN), **changes}
    return json.dumps(values).encode() + b"\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "shown", "damaged"),
    [
        pytest.param(b"", 0, 0, id="empty"),
        pytest.param(bytes(range(256)) * 4_000, 0, 4_000 * 2 + 1, id="binary"),
        pytest.param(b"\0" * 10_000_000, 0, 0, id="zeros, larger than what is read"),
        pytest.param((b"x" * 99 + b"\n") * 60_000 + line_of(), 1, None, id="huge, good at its end"),
        pytest.param(b"[" * 3_000_000, 0, 1, id="nested"),
        pytest.param(b"\r\n\n" + line_of() + b"\r\n", 1, None, id="blank lines"),
        pytest.param(b"1" * 5_000 + b"\n\xef\xbb\xbf{}", 0, 2, id="long number, byte order mark"),
        pytest.param(line_of(at=1), 0, 1, id="a number for a text"),
        pytest.param(line_of(image_size_bytes="3"), 0, 1, id="a text for a number"),
        pytest.param(line_of(image_size_bytes=True), 0, 1, id="true for a number"),
        pytest.param(line_of(target=None), 0, 1, id="null for a text"),
        pytest.param(line_of(waived=["size"]), 0, 1, id="a list for a text"),
        pytest.param(line_of(flash=["x"]), 0, 1, id="a list for its name"),
        pytest.param(line_of(event=None), 0, 0, id="null for its event"),
        pytest.param(line_of(event="paused"), 0, 0, id="an event of a newer flasher"),
        pytest.param(line_of(image="\ud800\x1b[2J\n"), 1, 0, id="half a character"),
        pytest.param(
            line_of() + line_of(event="ended", exit_code="0"), 1, 1, id="a text for an exit code"
        ),
    ],
)  # fmt: skip
def test_whatever_is_in_the_file_is_survived(
    flasher: Flasher, file: Path, content: bytes, shown: int, damaged: int | None
) -> None:
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    assert flasher("history").code == ExitCode.OK
    document = flasher("history", "--json").document
    assert document["total"] == shown
    assert damaged is None or document["damaged_lines"] == damaged
    kept = FlashHistory()
    kept.end(kept.begin(BEGAN), ENDED)
    assert flasher("history", "--json").document["flashes"][0]["ended"]["exit_code"] == 0
    assert file.stat().st_size <= history.SIZE_MAX + 10_000


def a_directory(file: Path) -> None:
    file.mkdir(parents=True)


def a_link_to_itself(file: Path) -> None:
    file.parent.mkdir(parents=True)
    file.symlink_to(file)


@pytest.mark.parametrize("make", [a_directory, a_link_to_itself])
def test_what_is_no_file_is_refused_in_one_sentence(
    flasher: Flasher, file: Path, make: Callable[[Path], None]
) -> None:
    make(file)
    run = flasher("history")
    assert run.code == ExitCode.USAGE
    assert "Move it away" in run.err
    run = flasher("flash", WMC, "-t", "wmc", *MOCK)
    assert run.code == ExitCode.OK
    assert "warning: no history in" in run.err


def test_a_link_that_leads_nowhere_is_an_empty_history(flasher: Flasher, file: Path) -> None:
    file.parent.mkdir(parents=True)
    file.symlink_to("nowhere.jsonl")
    assert flasher("history").out == "nothing flashed yet\n"


def test_a_pipe_in_its_place_is_not_waited_for(flasher: Flasher, file: Path) -> None:
    file.parent.mkdir(parents=True)
    os.mkfifo(file)
    assert flasher("history").code == ExitCode.USAGE


@pytest.mark.slow
def test_it_stays_bounded_and_keeps_the_latest(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "SIZE_MAX", 4_000)
    file.parent.mkdir(parents=True)
    file.with_name(f".{file.name}-0a.part").write_text("of a killed process")
    kept = FlashHistory()
    for number in range(60):
        kept.end(kept.begin(Began(**{**vars(BEGAN), "image": f"{number}.hex"})), ENDED)
    assert file.stat().st_size < 5_000
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    flashes, damaged = kept.flashes()
    assert damaged == 0
    assert flashes[-1].began.image == "59.hex"
    assert flashes[-1].ended == ENDED
    assert [path.name for path in file.parent.iterdir() if path.suffix == ".part"] == []


def test_keys_of_a_newer_flasher_are_no_damage(file: Path) -> None:
    kept = FlashHistory()
    kept.begin(BEGAN)
    line = json.loads(file.read_text())
    file.write_text(json.dumps({**line, "mood": ["good"]}) + "\n")
    assert kept.flashes() == ([history.Flash(BEGAN, None, is_running=True)], 0)
