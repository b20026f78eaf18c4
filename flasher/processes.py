"""Child processes: blocked signals, and an end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
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


def end_with_parent() -> None:
    """End this process as soon as its parent has ended: one that was killed cannot do it."""
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
