"""Signals: the first Ctrl-C, Ctrl-Break or SIGTERM requests a clean end, a second one ends at once.

SIGHUP, from a terminal that was closed or a connection that was lost, is a separate request: work
that must not be interrupted continues without a terminal. Under `nohup` it stays ignored. Windows
ends the programs of a console that is closed within 5 s: there it requests a clean end.
"""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Any, Final

_HANGUP: signal.Signals | None = getattr(signal, "SIGHUP", None)  # not on Windows
_BREAK: signal.Signals | None = getattr(signal, "SIGBREAK", None)  # on Windows only
_IS_WINDOWS: Final = os.name == "nt"
_CLOSING: Final = frozenset({2, 5, 6})
"""Windows: CTRL_CLOSE_EVENT, CTRL_LOGOFF_EVENT, CTRL_SHUTDOWN_EVENT."""
_CLOSING_LIMIT_S: Final = 10.0
"""Longer than Windows waits after closing a console."""


class Stop:
    """True after a request to stop by the user (Ctrl-C, SIGTERM) or a lost terminal (SIGHUP)."""

    def __init__(self, on_first: Callable[[], None] | None) -> None:
        self._on_first = on_first
        self._was_reported = False
        self.is_asked = False
        """Ctrl-C or SIGTERM was received."""
        self.has_hung_up = False
        """SIGHUP was received."""

    def __call__(self) -> bool:
        return self.asked() or self.has_hung_up

    def asked(self) -> bool:
        """True after Ctrl-C or SIGTERM; the first call that returns True calls `on_first`."""
        # Not in the handler, which may interrupt a print: printing there fails.
        if self.is_asked and not self._was_reported:
            self._was_reported = True
            if self._on_first is not None:
                self._on_first()
        return self.is_asked


@contextmanager
def stop_on_signal(
    on_first: Callable[[], None] | None = None, on_second: Callable[[], None] | None = None
) -> Iterator[Stop]:
    """Yield the stop request. `on_first` is called when it is first read. With `on_second` the
    second signal calls it, in the handler, and only a third one ends at once.
    """
    stop = Stop(on_first)
    second = on_second

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal second
        if number == _HANGUP:
            stop.has_hung_up = True
        elif not stop.is_asked:
            stop.is_asked = True
        elif second is not None:
            call, second = second, None
            call()
        else:
            raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM]
    if _HANGUP is not None and signal.getsignal(_HANGUP) is not signal.SIG_IGN:
        numbers.append(_HANGUP)
    if _BREAK is not None:
        numbers.append(_BREAK)
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        with _asked_by_console(stop) if _IS_WINDOWS else nullcontext():
            yield stop
    finally:
        for number, handler in before.items():
            # None: it was not set from Python, which cannot set it again.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def _asked_by_console(stop: Stop) -> Iterator[None]:
    """Windows: closing the console, log-off and shutdown request a stop.

    The system calls the handler in a separate thread, and ends the process as soon as it returns:
    so it waits. A process that ends meanwhile ends its threads.
    """

    def handle(event: int) -> bool:
        if event in _CLOSING:
            stop.is_asked = True
            threading.Event().wait(_CLOSING_LIMIT_S)
        return event in _CLOSING

    windows: Any = ctypes
    kernel32 = windows.WinDLL("kernel32")
    handler = windows.WINFUNCTYPE(ctypes.c_int, ctypes.c_uint)(handle)
    kernel32.SetConsoleCtrlHandler(handler, True)  # noqa: FBT003
    try:
        yield
    finally:
        kernel32.SetConsoleCtrlHandler(handler, False)  # noqa: FBT003
