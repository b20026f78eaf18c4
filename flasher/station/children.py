"""Processes of a station that Ctrl-C does not reach: it is for the station, which ends them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def deaf_from_birth(*, to_sigterm: bool = False) -> Iterator[None]:
    """What this thread starts meanwhile never hears Ctrl-C or a hangup (nor SIGTERM: service
    managers send it to the whole group), not even before its first line; this process hears what
    came meanwhile afterwards. On Windows nothing is done.
    """
    if os.name == "nt":
        yield
        return
    resource_tracker.ensure_running()  # else `multiprocessing` starts it, and hears again
    deaf_to = {signal.SIGINT, signal.SIGHUP}
    if to_sigterm:
        deaf_to.add(signal.SIGTERM)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, deaf_to)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
