"""Power cuts of a device at a given moment.

One that matters comes in the middle of a flash operation, at a moment that nobody on the bus can
know. So it is set beforehand (`FaultInjector.set`), and the injector, an engine around the device,
lets it happen at that very moment.
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
    """When `share` (0 to 1) of a flash operation is done, and of `operation` of them that begin
    from now on, counted from 0: 0.0 is just before anything changed, 1.0 when it is over.
    """

    operation: int
    share: float = 0.5


@dataclass(frozen=True)
class AtTime:
    """At a time, in seconds on the clock of all calls."""

    at_s: float


Moment = InOperation | AtTime


@dataclass(frozen=True)
class PowerCut:
    """The power goes, and comes back after `off_s` seconds; never with None."""

    off_s: float | None = POWER_OFF_S


class FaultInjector:
    """An engine (`flasher.protocol.engine`): `device`, and one power cut at a time."""

    def __init__(self, device: MockDevice) -> None:
        self.device = device
        self.happened = 0
        """How many cuts happened so far."""
        self._cut: PowerCut | None = None
        self._moment: Moment | None = None
        self._operations_before = 0
        self._due_at = self._power_due_at = inf
        self.next_frame, self.frame_sent = device.next_frame, device.frame_sent
        self.cancel, self.take_events = device.cancel, device.take_events

    def set(self, cut: PowerCut, moment: Moment) -> None:
        """Cut the power at `moment`, in place of a cut that is still to come."""
        self._cut, self._moment = cut, moment
        self._operations_before = self.device.operations_done
        self._due_at = moment.at_s if isinstance(moment, AtTime) else inf
        self._look_at_flash()

    def clear(self) -> None:
        """Let none happen; power that is off still comes back."""
        self._cut = self._moment = None
        self._due_at = inf

    @property
    def is_set(self) -> bool:
        """True while a cut is still to come."""
        return self._cut is not None

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        return self.device.done

    def receive(self, frame: Frame, now: float) -> None:
        self._happen(now)
        self.device.receive(frame, now)
        self._look_at_flash()
        self._happen(now)

    def tick(self, now: float) -> None:
        self._happen(now)
        self.device.tick(now)
        self._look_at_flash()
        self._happen(now)

    def deadline(self) -> float | None:
        wanted = self.device.deadline()
        due_at = min(self._due_at, self._power_due_at, inf if wanted is None else wanted)
        return None if due_at == inf else due_at

    # -- how it happens ---------------------------------------------------------------------------

    def _look_at_flash(self) -> None:
        """The moment of an operation is known once it is under way."""
        moment = self._moment
        if isinstance(moment, InOperation):
            begun = self.device.operations_done - self._operations_before
            reached_at = self.device.operation_reaches(moment.share)
            is_under_way = begun == moment.operation
            self._due_at = inf if reached_at is None or not is_under_way else reached_at

    def _happen(self, now: float) -> None:
        if self._power_due_at <= now:
            at_s, self._power_due_at = self._power_due_at, inf
            self.device.power_on(at_s)
        if self._cut is None or self._due_at > now:
            return
        # At its own time, not when it was noticed: so much of the operation is done, and no more.
        cut, at_s = self._cut, self._due_at
        self.clear()
        self.happened += 1
        self.device.power_cut(at_s)
        self._power_due_at = inf if cut.off_s is None else at_s + cut.off_s
