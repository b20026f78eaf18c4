"""A tap in front of others that keeps an adapter's echoes from them: a frame that was sent stands
in a trace once, and is counted once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from flasher.protocol.frame import Frame


class _Tap(Protocol):
    """As `flasher.driver.Tap`."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None: ...


class Unechoed:
    """A driver's tap. `taps` is asked at each frame: more of them may come later."""

    def __init__(self, taps: Callable[[], Sequence[_Tap]]) -> None:
        self._taps = taps

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Hand on one frame, unless it is an echo."""
        if frame.is_echo:
            return
        for tap in self._taps():
            tap(frame, sent=sent, now=now)
