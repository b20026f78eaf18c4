"""Frames that come back: some adapters deliver what they were given to send, when it has left."""

from __future__ import annotations

from collections import deque
from typing import Final

from flasher.protocol.frame import Frame

ECHO_LIMIT_S: Final = 0.5
"""An echo comes when the frame has left: within the time that an adapter's queue takes to drain."""
ECHO_FRAMES: Final = 1024
"""Frames that may be on their way at once: more than a full bus carries in that time."""


class Echoes:
    """Remembers what was sent, and knows it again once."""

    def __init__(self) -> None:
        self._sent: deque[tuple[float, Frame]] = deque(maxlen=ECHO_FRAMES)
        self._ids: set[int] = set()

    def sent(self, frame: Frame, now: float) -> None:
        """A frame was handed to the adapter, at `now` in seconds."""
        self._sent.append((now, frame))
        self._ids.add(frame[0])

    def held_up(self, now: float) -> None:
        """The adapter was off the bus: what waited in its queue leaves only from `now` on."""
        self._sent = deque(((now, frame) for _, frame in self._sent), maxlen=ECHO_FRAMES)

    def take(self, frame: Frame, now: float) -> bool:
        """True when a received frame is the echo of a sent one, which is forgotten then."""
        if frame[0] not in self._ids:
            return False
        sent = self._sent
        while sent and now - sent[0][0] > ECHO_LIMIT_S:
            sent.popleft()
        for index, (_, own) in enumerate(sent):
            if own == frame:
                del sent[index]
                return True
        return False
