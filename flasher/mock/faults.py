"""Power cuts of a device at a chosen moment, also during a flash operation.

Such a moment is not visible on the bus. So the cut is scheduled in advance (`FaultInjector.set`),
and the injector, an engine around the device, executes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Final

from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame

POWER_OFF_S: Final = 0.5


@dataclass(frozen=True)
class InOperation:
    """Moment at which `share` (0 to 1) of a flash operation is done; `operation` counts the
    operations that begin from now on, from 0. Share 0.0 is just before any change, 1.0 at the end.
    """

    operation: int
    share: float = 0.5


@dataclass(frozen=True)
class AtTime:
    """Moment in seconds on the clock of all calls."""

    at_s: float


Moment = InOperation | AtTime


@dataclass(frozen=True)
class PowerCut:
    """Power loss of `off_s` seconds; None is permanent."""

    off_s: float | None = POWER_OFF_S


class FaultInjector:
    """Engine (`flasher.protocol.engine`) around `device` that executes one power cut at a time."""

    def __init__(self, device: MockDevice) -> None:
        self.device = device
        self.cuts_done = 0
        """Number of power cuts so far."""
        self._cut: PowerCut | None = None
        self._moment: Moment | None = None
        self._operations_before = 0
        self._due_at = self._power_due_at = inf
        self.next_frame, self.frame_sent = device.next_frame, device.frame_sent
        self.cancel, self.take_events = device.cancel, device.take_events

    def set(self, cut: PowerCut, moment: Moment) -> None:
        """Schedule a power cut at `moment`, replacing a pending one."""
        self._cut, self._moment = cut, moment
        self._operations_before = self.device.operations_done
        self._due_at = moment.at_s if isinstance(moment, AtTime) else inf
        self._watch_operation()

    def clear(self) -> None:
        """Cancel a pending power cut; power that is off still comes back."""
        self._cut = self._moment = None
        self._due_at = inf

    @property
    def is_set(self) -> bool:
        """True while a power cut is pending."""
        return self._cut is not None

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        return self.device.done

    def receive(self, frame: Frame, now: float) -> None:
        if self._cut is None and self._power_due_at == inf:  # as for most frames
            self.device.receive(frame, now)
            return
        self._cut_when_due(now)
        self.device.receive(frame, now)
        self._watch_operation()
        self._cut_when_due(now)

    def tick(self, now: float) -> None:
        self._cut_when_due(now)
        self.device.tick(now)
        self._watch_operation()
        self._cut_when_due(now)

    def deadline(self) -> float | None:
        wanted = self.device.deadline()
        if self._cut is None and self._power_due_at == inf:
            return wanted
        due_at = min(self._due_at, self._power_due_at, inf if wanted is None else wanted)
        return None if due_at == inf else due_at

    # -- execution --------------------------------------------------------------------------------

    def _watch_operation(self) -> None:
        """Determine the time of a cut during an operation, once that has begun."""
        moment = self._moment
        if isinstance(moment, InOperation):
            begun = self.device.operations_done - self._operations_before
            reached_at = self.device.operation_reaches(moment.share)
            is_under_way = begun == moment.operation
            self._due_at = inf if reached_at is None or not is_under_way else reached_at

    def _cut_when_due(self, now: float) -> None:
        if self._power_due_at <= now:
            at_s, self._power_due_at = self._power_due_at, inf
            self.device.power_on(at_s)
        if self._cut is None or self._due_at > now:
            return
        # Cut at the scheduled time, so that exactly that share of the operation is done.
        cut, at_s = self._cut, self._due_at
        self.clear()
        self.cuts_done += 1
        self.device.power_cut(at_s)
        self._power_due_at = inf if cut.off_s is None else at_s + cut.off_s
