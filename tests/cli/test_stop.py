"""Ctrl-C and SIGTERM: a clean end at the first, an end at once at the second."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode
from tests.cli.conftest import SAMPLES, Flasher
from tests.end_to_end.processes import FLASHER, clean_environment, lines_until

SIGNALS = (signal.SIGINT, signal.SIGTERM)
signals_reach_processes = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows sends no Ctrl-C to a single process"
)


# -- handlers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_interrupts(number: signal.Signals) -> None:
    with stop_on_signal() as stopped:
        assert not stopped()
        signal.raise_signal(number)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


def test_the_user_is_told_once_and_not_from_within_the_handler() -> None:
    """A handler may interrupt a print; another print in it would fail."""
    told: list[str] = []
    with stop_on_signal(lambda: told.append("stopping")) as stopped:
        stopped()
        assert told == []
        signal.raise_signal(signal.SIGINT)
        assert told == []
        assert stopped()
        assert stopped()
        assert told == ["stopping"]


def test_the_handlers_from_before_are_back_afterwards_whatever_happened() -> None:
    def mine(*_: object) -> None:
        """Do nothing."""

    outer = {number: signal.signal(number, mine) for number in SIGNALS}
    try:
        for failure in (None, ZeroDivisionError, KeyboardInterrupt):
            expected: contextlib.AbstractContextManager[object] = (
                pytest.raises(failure) if failure else contextlib.nullcontext()
            )
            with expected, stop_on_signal():
                assert all(signal.getsignal(number) is not mine for number in SIGNALS)
                if failure:
                    raise failure
            assert all(signal.getsignal(number) is mine for number in SIGNALS)
    finally:
        for number, handler in outer.items():
            signal.signal(number, handler)


def test_a_handler_that_python_did_not_set_is_replaced_by_the_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[tuple[int, object]] = []
    monkeypatch.setattr(signal, "signal", lambda number, handler: calls.append((number, handler)))
    with stop_on_signal():
        pass
    assert calls[2:] == [(number, signal.SIG_DFL) for number in SIGNALS]


# -- in this process ------------------------------------------------------------------------------


def interrupt(*_arguments: object, **_options: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["flasher.cli.arguments.load", "flasher.api.upgrade"])
def test_an_interruption_anywhere_is_exit_code_130_without_a_traceback(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    monkeypatch.setattr(where, interrupt)
    run = flasher("flash", SAMPLES / "obc.bin", "-t", "obc", "--mock", "--json")
    assert run.code == run.document["exit_code"] == ExitCode.INTERRUPTED
    assert "Interrupted at once" in run.err
    assert "Traceback" not in run.err


# -- as a process ---------------------------------------------------------------------------------


@contextmanager
def flashing(folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """A flash to the paced mock: five and a half seconds, unless something ends it."""
    with subprocess.Popen(
        [*FLASHER, "flash", str(SAMPLES / "bms.hex"), "-t", "bms", "--mock", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=clean_environment(),
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def seconds_until_the_end(process: subprocess.Popen[str]) -> tuple[float, str]:
    began = time.monotonic()
    _, said = process.communicate()
    return time.monotonic() - began, said


def told(process: subprocess.Popen[str]) -> Callable[[str], list[str]]:
    def wait_for(wanted: str) -> list[str]:
        assert process.stderr is not None
        return lines_until(process.stderr, wanted)

    return wait_for


@signals_reach_processes
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_in_the_transfer_ends_it_cleanly_and_says_what_to_do(
    tmp_path: Path, number: signal.Signals
) -> None:
    with flashing(tmp_path) as process:
        told(process)("transferring ...")
        process.send_signal(number)
        took_s, said = seconds_until_the_end(process)
    assert process.returncode == ExitCode.INTERRUPTED
    assert took_s < 2.0
    assert "stopping at the end of the message ..." in said
    assert "cancelled by the user" in said
    assert "Run the same command again" in said
    assert "State of the device: its application is erased or half written" in said
    assert "Traceback" not in said


@signals_reach_processes
def test_a_second_ctrl_c_ends_at_once(tmp_path: Path) -> None:
    """With half a minute between two frames the end of the message is far away."""
    with flashing(tmp_path, "--frame-gap", "30") as process:
        told(process)("resetting the application ...")
        process.send_signal(signal.SIGINT)
        told(process)("stopping at the end of the message ...")
        process.send_signal(signal.SIGINT)
        took_s, said = seconds_until_the_end(process)
    assert process.returncode == ExitCode.INTERRUPTED
    assert took_s < 2.0
    assert "Interrupted at once" in said
    assert "Run the same command again" in said
    assert "Traceback" not in said
