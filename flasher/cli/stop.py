"""Ctrl-C and SIGTERM: the first one asks for a clean end, a second one ends at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signal(
    on_first: Callable[[], None] | None = None, on_second: Callable[[], None] | None = None
) -> Iterator[Callable[[], bool]]:
    """Gives a function that tells whether the user wants to stop; the first time that it says so,
    it calls `on_first`. With `on_second` the second signal calls it, in the handler, and only a
    third one ends at once.
    """
    asked = told = False
    second = on_second

    def handle(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked, second
        if not asked:
            asked = True
        elif second is not None:
            call, second = second, None
            call()
        else:
            raise KeyboardInterrupt

    def stopped() -> bool:
        # Not in the handler, which may have come in the middle of a print: printing there fails.
        nonlocal told
        if asked and not told:
            told = True
            if on_first is not None:
                on_first()
        return asked

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            # None: it was not set from Python, which cannot set it again.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
