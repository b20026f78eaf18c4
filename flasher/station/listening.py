"""Only listening to a device: whether it is there, and whether its bootloader announced itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion, decode
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Message, Reassembler
from flasher.settings.profile import sent_ids

_LOOK_EVERY_S: Final = 0.05


class BootWatcher:
    """A driver's tap that counts the announcements of a device's bootloader."""

    def __init__(self, target: Target, timings: Timings = DEFAULT_TIMINGS) -> None:
        self._answers = Reassembler(target.answer_id, timings.inter_frame_timeout_s)
        self._own_ids = frozenset(sent_ids(target))
        self.announcements = 0
        self.version = ""
        """As announced last, escaped."""
        self.heard_at: float | None = None
        """When the device last said anything."""
        self.announced_at: float | None = None

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Take one frame."""
        if sent or not frame.is_payload or frame.can_id not in self._own_ids:
            return
        self.heard_at = now
        if frame.can_id != self._answers.can_id:
            return
        for found in self._answers.feed(frame.data, now):
            row = decode(found) if isinstance(found, Message) else None
            if isinstance(row, BootVersion):
                self.announcements += 1
                self.announced_at = now
                self.version = printable(row.version)


class Listen:
    """An engine that listens until `enough(now)` says so, or for `limit_s`."""

    def __init__(self, limit_s: float, enough: Callable[[float], bool]) -> None:
        self._limit_s = limit_s
        self._enough = enough
        self._ends_at: float | None = None
        self._look_at = float("-inf")
        self.done = False

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived. Taps have looked at it: perhaps it was enough."""
        self.done = self.done or self._enough(now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._ends_at is None:
            self._ends_at = now + self._limit_s
        self._look_at = min(now + _LOOK_EVERY_S, self._ends_at)
        self.done = self.done or now >= self._ends_at or self._enough(now)

    def deadline(self) -> float | None:
        """When it next wants `tick`: soon, as what is enough may be a silence."""
        return None if self.done else self._look_at

    def next_frame(self, now: float) -> Frame | None:
        """It says nothing."""
        return None

    def frame_sent(self, now: float) -> None:
        """It sends nothing."""

    def cancel(self, now: float) -> None:
        """Stop at once."""
        self.done = True

    def take_events(self) -> Sequence[object]:
        """It reports nothing."""
        return ()
