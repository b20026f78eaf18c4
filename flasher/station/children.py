"""Processes of a station that Ctrl-C does not reach: it is for the station, which ends them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def deaf_from_birth() -> Iterator[None]:
    """What this thread starts meanwhile never hears Ctrl-C or a hangup, not even before its first
    line; this process hears what came meanwhile afterwards. On Windows nothing is done.
    """
    if os.name == "nt":
        yield
        return
    resource_tracker.ensure_running()  # else `multiprocessing` starts it, and hears again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
