"""Starts processes of a station that ignore Ctrl-C; the station ends them itself."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def deaf_from_birth(*, to_sigterm: bool = False) -> Iterator[None]:
    """Block signals while the block runs: processes that this thread starts in it never get Ctrl-C
    or a hangup (`to_sigterm`: nor SIGTERM, which service managers send to the whole group), not
    even while they start. This process gets pending signals afterwards. Does nothing on Windows.
    """
    if os.name == "nt":
        yield
        return
    resource_tracker.ensure_running()  # else `multiprocessing` starts it, and unblocks the signals
    deaf_to = {signal.SIGINT, signal.SIGHUP}
    if to_sigterm:
        deaf_to.add(signal.SIGTERM)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, deaf_to)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
