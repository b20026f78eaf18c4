"""The entry point: help, version, and output without a reader."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TextIO

import pytest

from flasher.cli.main import COMMANDS, main
from flasher.cli.output import counted, duration
from flasher.errors import ExitCode
from tests.cli.conftest import SAMPLES, Flasher
from tests.end_to_end.processes import FLASHER, clean_environment, lines_until
from tests.loops import each

OBC_BIN = str(SAMPLES / "obc.bin")
MOCK = ("flash", OBC_BIN, "-t", "obc", "--mock", "--mock-speed", "0")
DEV_FULL = Path("/dev/full")
posix_pipes = pytest.mark.skipif(
    sys.platform == "win32", reason="a broken pipe is another error on Windows"
)
needs_dev_full = pytest.mark.skipif(not DEV_FULL.exists(), reason="there is no /dev/full")


# -- help and version -----------------------------------------------------------------------------


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help_is_on_stdout_with_examples(flasher: Flasher, command: str | None) -> None:
    run = flasher(*([command] if command else []), "--help")
    assert run.code == ExitCode.OK
    assert "Usage: flasher" in run.out
    assert "examples:" in run.out
    assert run.err == ""


def test_the_commands_are_listed_where_none_is_named(flasher: Flasher) -> None:
    run = flasher()
    assert run.code == ExitCode.USAGE
    assert all(name in run.out for name in COMMANDS)


def test_the_version_is_the_distributions(flasher: Flasher) -> None:
    assert flasher("--version").out == f"flasher {version('welling-flasher')}\n"


@pytest.mark.slow
def test_python_m_flasher_is_the_same_and_exits_with_the_code() -> None:
    words, environment = (*FLASHER, "image-info", OBC_BIN), clean_environment()
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == ExitCode.OK
    assert "4,000 bytes to send" in done.stdout


@each("seconds, text", [(0.0, "0.00 s"), (119.994, "119.99 s"), (3725.0, "62 min 05 s")])
def test_long_times_are_reported_in_minutes(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_one_is_singular() -> None:
    assert counted(1, "packet") == "1 packet"
    assert counted(1200, "packet") == "1,200 packets"


# -- output without a reader ----------------------------------------------------------------------


@contextlib.contextmanager
def broken_pipe() -> Iterator[TextIO]:
    """A stream whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    stream = os.fdopen(writer, "w")
    try:
        yield stream
    finally:
        with contextlib.suppress(OSError):
            stream.close()


@contextlib.contextmanager
def full_disk() -> Iterator[TextIO]:
    """A stream to a disk without room."""
    stream = DEV_FULL.open("w")
    try:
        yield stream
    finally:
        with contextlib.suppress(OSError):
            stream.close()


Stream = Callable[[], contextlib.AbstractContextManager[TextIO]]


@posix_pipes
@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("--help",), ExitCode.OK),
        (("image-info", OBC_BIN), ExitCode.OK),
        (("monitor", "--mock", "--mock-speed", "0", "--count", "3", "--table"), ExitCode.OK),
        (MOCK, ExitCode.OK),
        ((*MOCK, "--json"), ExitCode.OK),
        (("flash", str(SAMPLES / "bad" / "no_end.hex"), "-t", "obc", "--json"), ExitCode.IMAGE),
    ],
)
def test_a_reader_that_goes_away_does_not_change_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: ExitCode
) -> None:
    with broken_pipe() as stream:
        monkeypatch.setattr("sys.stdout", stream)
        assert main(words) == code


@posix_pipes
@pytest.mark.parametrize("more", [(), ("--json",)])
def test_a_monitor_whose_reader_goes_away_ends(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...]
) -> None:
    words = ("monitor", "--mock", "--mock-speed", "0", "--count", "9", *more)
    with broken_pipe() as stream:
        monkeypatch.setattr("sys.stdout", stream)
        assert main(words) == ExitCode.OK
    shown = capsys.readouterr().err.splitlines()[-1]
    assert int(shown.split()[0]) <= 2


@pytest.mark.parametrize(
    "stream",
    [
        pytest.param(broken_pipe, marks=posix_pipes),
        pytest.param(full_disk, marks=needs_dev_full),
    ],
)
def test_progress_that_cannot_be_written_does_not_end_an_upgrade(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, stream: Stream
) -> None:
    with stream() as opened:
        monkeypatch.setattr("sys.stderr", opened)
        assert main(MOCK) == ExitCode.OK
    assert "completed:" in capsys.readouterr().out


@needs_dev_full
@pytest.mark.parametrize("more", [(), ("--json",)])
def test_a_result_that_cannot_be_written_is_an_error_of_its_own(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, more: tuple[str, ...]
) -> None:
    with full_disk() as opened:
        monkeypatch.setattr("sys.stdout", opened)
        assert main(["image-info", str(OBC_BIN), *more]) == ExitCode.USAGE
    printed = capsys.readouterr().err
    assert printed.count("error:") == 1
    assert "Standard output cannot be written: No space left" in printed


@needs_dev_full
@pytest.mark.parametrize(
    ("more", "last"), [((), "OK  OBC confirmed"), (("--json",), "the document is lost.")]
)
def test_the_device_decides_the_exit_code_of_an_upgrade_whose_result_cannot_be_written(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    more: tuple[str, ...],
    last: str,
) -> None:
    with full_disk() as opened:
        monkeypatch.setattr("sys.stdout", opened)
        assert main((*MOCK, *more)) == ExitCode.OK
    printed = capsys.readouterr().err
    assert printed.count("warning: Standard output cannot be written: No space left") == 1
    assert last in printed.splitlines()[-1]


@pytest.mark.slow
@posix_pipes
def test_a_pipe_that_breaks_in_the_transfer_leaves_upgrade_and_exit_code_alone(
    tmp_path: Path,
) -> None:
    with subprocess.Popen(
        [*FLASHER, *MOCK[:-1], "10"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=clean_environment(),
    ) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        lines_until(process.stderr, "transferring ...")
        process.stderr.close()
        assert "completed:" in process.stdout.read()
    assert process.returncode == ExitCode.OK


def test_an_error_without_a_place_or_remedy_is_one_line(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr", stream := io.StringIO())
    run = flasher("flash", OBC_BIN, "-t", "obc", "--mock", "--base", "0x100000000")
    assert run.code == ExitCode.USAGE
    what = "the base 0x100000000 is not a 32-bit address"
    assert stream.getvalue().splitlines()[-2:] == [f"error: {what} [E200]", f"FAILED  {what}"]


def test_a_process_without_streams_works_and_exits_with_its_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Services and `pythonw` have neither stdout nor stderr."""
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("sys.stderr", None)
    assert main(MOCK) == ExitCode.OK
    assert main(["flash", str(SAMPLES / "bad" / "no_end.hex"), "-t", "obc"]) == ExitCode.IMAGE
    for stream in (sys.stdout, sys.stderr):
        assert stream is not None
        stream.close()


def test_a_process_without_stdin_cannot_be_asked(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", None)
    run = flasher("write", "user-string-1", "rack", "--mock", "--mock-speed", "0")
    assert run.code == ExitCode.USAGE
    assert "there is no terminal to ask" in run.err
    sys.stdin.close()


@pytest.mark.parametrize("words", [("--json", "flash"), ("flash", "--json", "--no-such-option")])
def test_wrong_usage_is_a_json_document_too(flasher: Flasher, words: tuple[str, ...]) -> None:
    run = flasher(*words)
    assert run.code == run.document["exit_code"] == ExitCode.USAGE
    assert run.document["error"]["kind"] == "UsageError"
    assert "Try `flasher flash --help`" in run.err


@pytest.mark.parametrize(
    ("words", "reported", "remedy"),
    [
        (("flas",), "flasher: No such command 'flas'.", "Did you mean flash?"),
        (("flash", "--verfy", "none"), "flasher flash: No such option '--verfy'.", "--verify"),
        (("flash", "x.hex"), "flasher flash: Missing option -t/--target.", "Try `flasher flash"),
        (("profile", "shw"), "flasher profile: No such action 'shw'.", "Did you mean show?"),
        (("profile",), "flasher profile: Missing action.", "Actions are check, show."),
        (("conformance", "--repeat", "0"), "Invalid value for --repeat", "Try `flasher conf"),
    ],
)
def test_wrong_usage_states_what_is_wrong_and_what_was_meant(
    flasher: Flasher, words: tuple[str, ...], reported: str, remedy: str
) -> None:
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert reported in run.err
    assert remedy in run.err.partition("what to do: ")[2]
    assert run.out == ""
