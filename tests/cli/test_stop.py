"""Ctrl-C and SIGTERM: a clean end at the first, an end at once at the second."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import pty
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
from tests.loops import each
from tests.station.factory import USUAL, write_recipe

pytestmark = pytest.mark.slow

SIGNALS = (signal.SIGINT, signal.SIGTERM)
signals_reach_processes = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows sends no Ctrl-C to a single process"
)


@pytest.fixture(autouse=True)
def hangups_arrive() -> Iterator[None]:
    """Also where the tests were started by nohup, which lets its children ignore a hangup."""
    if not hasattr(signal, "SIGHUP"):
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


# -- handlers -------------------------------------------------------------------------------------


@each("number", SIGNALS)
def test_the_first_signal_asks_and_the_second_interrupts(number: signal.Signals) -> None:
    with stop_on_signal() as stopped:
        assert not stopped()
        signal.raise_signal(number)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


def test_the_user_is_informed_once_and_not_from_within_the_handler() -> None:
    """A handler may interrupt a print; another print in it would fail."""
    printed: list[str] = []
    with stop_on_signal(lambda: printed.append("stopping")) as stopped:
        stopped()
        assert printed == []
        signal.raise_signal(signal.SIGINT)
        assert printed == []
        assert stopped()
        assert stopped()
        assert printed == ["stopping"]


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
    numbers = [*SIGNALS, signal.SIGHUP]
    assert calls[len(numbers) :] == [(number, signal.SIG_DFL) for number in numbers]


@signals_reach_processes
def test_a_hangup_is_distinguished_and_interrupts_nothing_however_often_it_comes() -> None:
    with stop_on_signal() as stop:
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        assert stop.has_hung_up
        assert stop()
        assert not stop.asked()


@signals_reach_processes
def test_nohup_is_respected() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signal() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_ctrl_break_asks_as_ctrl_c_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flasher.cli.stop._BREAK", signal.SIGUSR1)  # for the one of Windows
    before = signal.getsignal(signal.SIGUSR1)
    with stop_on_signal() as stopped:
        signal.raise_signal(signal.SIGUSR1)
        assert stopped.asked()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGUSR1)
    assert signal.getsignal(signal.SIGUSR1) is before


class Console:
    """kernel32 of Windows, as far as it is asked."""

    def __init__(self, _name: str) -> None:
        self.handlers: list[Callable[[int], int]] = []
        consoles.append(self)

    def SetConsoleCtrlHandler(  # noqa: N802  Windows' own name
        self, handler: Callable[[int], int], add: bool
    ) -> None:
        if add:
            self.handlers.append(handler)
        else:
            self.handlers.remove(handler)


consoles: list[Console] = []


@pytest.mark.parametrize("event", [2, 5, 6])
def test_a_console_that_is_closed_asks_and_its_handler_waits_for_the_end(
    monkeypatch: pytest.MonkeyPatch, event: int
) -> None:
    """Windows ends a process whose handler returns."""
    monkeypatch.setattr("flasher.cli.stop._IS_WINDOWS", True)
    monkeypatch.setattr("flasher.cli.stop._CLOSING_LIMIT_S", 0.05)
    monkeypatch.setattr(ctypes, "WinDLL", Console, raising=False)
    monkeypatch.setattr(ctypes, "WINFUNCTYPE", ctypes.CFUNCTYPE, raising=False)
    with stop_on_signal() as stopped:
        (handler,) = consoles[-1].handlers
        assert not handler(0), "Ctrl-C is another handler's"
        assert not stopped()
        began = time.perf_counter()
        assert handler(event)
        assert time.perf_counter() - began >= 0.05
        assert stopped.asked()
    assert consoles[-1].handlers == []


# -- in this process ------------------------------------------------------------------------------


def interrupt(*_arguments: object, **_options: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("where", ["flasher.jobs.load", "flasher.api.Device.upgrade"])
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
def flashing(
    folder: Path, *options: str, command: str = "flash"
) -> Iterator[subprocess.Popen[str]]:
    """A flash to the paced mock: five and a half seconds, unless something ends it."""
    with subprocess.Popen(
        [*FLASHER, command, str(SAMPLES / "bms.hex"), "-t", "bms", "--mock", *options],
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
    began = time.perf_counter()
    _, reported = process.communicate()
    return time.perf_counter() - began, reported


def printed(process: subprocess.Popen[str]) -> Callable[[str], list[str]]:
    def wait_for(wanted: str) -> list[str]:
        assert process.stderr is not None
        return lines_until(process.stderr, wanted)

    return wait_for


@signals_reach_processes
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_in_the_transfer_ends_it_cleanly_and_states_what_to_do(
    tmp_path: Path, number: signal.Signals
) -> None:
    with flashing(tmp_path) as process:
        printed(process)("transferring ...")
        process.send_signal(number)
        took_s, reported = seconds_until_the_end(process)
    assert process.returncode == ExitCode.INTERRUPTED
    assert took_s < 2.0
    assert "stopping at the end of the message ..." in reported
    assert "cancelled by the user" in reported
    assert "Run the same command again" in reported
    assert (
        "State of the device: its application is erased, half written or not accepted" in reported
    )
    assert "Traceback" not in reported


@signals_reach_processes
@pytest.mark.parametrize(
    "options", [("--frame-gap", "0.08"), ("--packet-gap", "10"), ("--mock-speed", "0.1")]
)
def test_ctrl_c_ends_in_no_time_at_any_setting(tmp_path: Path, options: tuple[str, ...]) -> None:
    """The end of a message is 1.4 s away at the slowest gap. A rescue transfers soonest. It takes
    0.3 s; where other tests take the processor meanwhile, it is tried again.
    """
    for _ in range(3):
        with flashing(tmp_path, *options, command="rescue") as process:
            printed(process)("transferring ...")
            process.send_signal(signal.SIGINT)
            began = time.perf_counter()
            printed(process)("cancelled by the user")
            took_s = time.perf_counter() - began
        if took_s < 1.0:
            return
    pytest.fail(f"it took {took_s:.1f} s at the third try, too")


@signals_reach_processes
@pytest.mark.parametrize(
    ("phase", "ending", "code"),
    [
        ("waiting for the boot version ...", "cancelled", ExitCode.INTERRUPTED),
        ("transferring ...", "completed", ExitCode.OK),
    ],
)
def test_a_closed_terminal_ends_before_the_update_command_and_finishes_after_it(
    tmp_path: Path, phase: str, ending: str, code: ExitCode
) -> None:
    """Its terminal is closed: SIGHUP comes, and nothing can be written to it any more."""
    log, bundles = tmp_path / "log.txt", tmp_path / "bundles"
    image = str(SAMPLES / "wmc.hex")
    words = ("-t", "wmc", "--mock", "--log-file", str(log), "--bundle-dir", str(bundles))
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(FLASHER[0], [*FLASHER, "flash", image, *words], clean_environment())  # noqa: S606
    reported = b""
    while phase.encode() not in reported:
        reported += os.read(terminal, 4096)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == code
    [bundle] = bundles.iterdir()
    report = json.loads((bundle / "report.json").read_text())
    assert report["outcome"]["ending"] == ending
    assert f"exit code {int(code)}" in log.read_text()


@signals_reach_processes
def test_sigterm_to_all_processes_of_a_station_finishes_the_runs_that_go_on(tmp_path: Path) -> None:
    """Service managers and `timeout` send it to the processes of the sockets too."""
    recipe = write_recipe(tmp_path, USUAL)
    sockets = (
        "--mock-sockets",
        "2",
        "--units",
        "6",
        "--mock-bad",
        "0",
        "--mock-dead",
        "0",
        "--mock-slow",
        "0",
    )
    with subprocess.Popen(
        [*FLASHER, "station", "run", "--recipe", str(recipe), *sockets, "--mock-speed", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=clean_environment(),
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        lines_until(process.stdout, "StepStarted")
        os.killpg(process.pid, signal.SIGTERM)
        out, err = process.communicate()
    assert process.returncode == ExitCode.INTERRUPTED
    units = json.loads(out.splitlines()[-1])["units"]
    assert units
    assert {unit["state"] for unit in units} == {"pass"}
    assert "Ctrl-C again" in err


@signals_reach_processes
def test_ctrl_c_while_the_program_loads_is_one_line_without_a_traceback(tmp_path: Path) -> None:
    interrupted = """\
import builtins, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
real = builtins.__import__
def load(name, *others):
    if name == "flasher.cli.main":
        os.kill(os.getpid(), signal.SIGINT)
    return real(name, *others)
builtins.__import__ = load
import flasher_start
sys.exit(flasher_start.main())
"""
    environment = {**clean_environment(), "PYTHONPATH": str(SAMPLES.parent)}
    ran = subprocess.run(
        [sys.executable, "-c", interrupted],
        capture_output=True, text=True, check=False, cwd=tmp_path, env=environment,
    )  # fmt: skip
    assert (ran.returncode, ran.stdout) == (ExitCode.INTERRUPTED, "")
    assert ran.stderr == "error: Interrupted at once. [E130]\n"


@pytest.mark.parametrize("command", ["flash", "rescue"])
def test_an_end_before_an_adapter_is_opened_leaves_no_doubt_about_the_device(
    flasher: Flasher, short_bms: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr("flasher.cli.upgrade.flash.load_profile", interrupt)
    run = flasher(command, short_bms, "-t", "bms", "--mock")
    assert run.code == ExitCode.INTERRUPTED
    assert "nothing was sent" in run.err
    assert "not known" not in run.err
