"""Processes that Ctrl-C does not reach."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from flasher.processes import signals_blocked

HEARS = """
import signal, sys
blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
sys.exit(not {signal.SIGINT, signal.SIGHUP, signal.SIGTERM} <= blocked)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no Ctrl-C to a single process")
def test_a_process_gets_no_ctrl_c_from_its_first_line_on_and_its_parent_gets_it_again() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: heard.append(number))
    try:
        with signals_blocked():
            signal.raise_signal(signal.SIGINT)
            assert subprocess.run([sys.executable, "-c", HEARS], check=False).returncode == 0
            assert not heard
        assert heard == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)
