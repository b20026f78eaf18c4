"""Starts processes of a station that get no Ctrl-C and no SIGTERM: the station ends them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def deaf_from_birth() -> Iterator[None]:
    """Block signals while the block runs: processes that this thread starts in it never get Ctrl-C,
    a hangup, or SIGTERM, which service managers send to all processes of a service, not even while
    they start. This process gets pending signals afterwards. Does nothing on Windows.
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
