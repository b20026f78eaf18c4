"""Frames that come back: some adapters deliver what they were given to send, when it has left.

A link marks them once, as `Frame.is_echo`; nobody else has to know them again. An adapter that
gives none, not all, or some of them twice (a network with two ways, a driver's own) is fine.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from flasher.protocol.frame import Frame

ECHO_LIMIT_S: Final = 0.5
"""An echo comes when the frame has left: within the time that an adapter's queue takes to drain."""
ECHO_FRAMES: Final = 1024
"""Frames that may be on their way at once: more than a full bus carries in that time."""
DOUBLE_LIMIT_S: Final = 0.1
"""A second copy of an echo comes right behind it."""


class Echoes:
    """Remembers what was sent through a link, and marks it when it comes back."""

    def __init__(self) -> None:
        self.ids: set[int] = set()
        """CAN ids that were sent on."""
        self._sent: deque[tuple[float, Frame]] = deque(maxlen=ECHO_FRAMES)
        self._echoed: deque[tuple[float, Frame]] = deque(maxlen=ECHO_FRAMES)

    def sent(self, frame: Frame, now: float) -> None:
        """A frame was handed to the adapter, at `now` in seconds."""
        self._sent.append((now, frame))
        self.ids.add(frame[0])

    def held_up(self, now: float) -> None:
        """The adapter was off the bus: what waited in its queue leaves only from `now` on."""
        self._sent = deque(((now, frame) for _, frame in self._sent), maxlen=ECHO_FRAMES)

    def mark(self, frame: Frame, now: float) -> Frame:
        """A received frame, marked when it is the echo of a sent one, which is forgotten then, or a
        second copy of such an echo.
        """
        if frame[0] not in self.ids:
            return frame
        sent = self._sent
        while sent and now - sent[0][0] > ECHO_LIMIT_S:
            sent.popleft()
        for index, (_, own) in enumerate(sent):
            if own == frame:
                del sent[index]
                self._echoed.append((now, frame))
                return frame._replace(is_echo=True)
        if any(own == frame and now - at <= DOUBLE_LIMIT_S for at, own in self._echoed):
            return frame._replace(is_echo=True)
        return frame
