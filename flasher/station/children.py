"""Starts processes that ignore Ctrl-C and SIGTERM, so that the station can end them in order."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block signals while the block runs: processes that this thread starts in it never receive
    Ctrl-C, a hangup, or SIGTERM, which service managers send to all processes of a service, even
    while they start. This process receives pending signals afterwards. Does nothing on Windows.
    """
    if os.name == "nt":
        yield
        return
    resource_tracker.ensure_running()  # else `multiprocessing` starts it, and unblocks the signals
    signals = {signal.SIGINT, signal.SIGHUP, signal.SIGTERM}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
