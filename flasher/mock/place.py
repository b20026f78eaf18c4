"""Place of a device on a bus: an engine, with or without a device in it."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from flasher.mock.faults import FaultInjector
from flasher.protocol.frame import Frame


class Place:
    """A place from which a device can be taken, and into which another one can be put."""

    def __init__(self) -> None:
        self.device: FaultInjector | None = None
        self.due_at = inf
        """Time at which the place itself wants a tick, to exchange its device."""

    @property
    def done(self) -> bool:
        return self.device is None or self.device.done

    def receive(self, frame: Frame, now: float) -> None:
        if self.device is not None:
            self.device.receive(frame, now)

    def tick(self, now: float) -> None:
        if self.device is not None:
            self.device.tick(now)

    def deadline(self) -> float | None:
        wanted = None if self.device is None else self.device.deadline()
        due_at = min(self.due_at, inf if wanted is None else wanted)
        return None if due_at == inf else due_at

    def next_frame(self, now: float) -> Frame | None:
        return None if self.device is None else self.device.next_frame(now)

    def frame_sent(self, now: float) -> None:
        if self.device is not None:
            self.device.frame_sent(now)

    def cancel(self, now: float) -> None:
        if self.device is not None:
            self.device.cancel(now)

    def take_events(self) -> Sequence[object]:
        return () if self.device is None else self.device.take_events()
