"""Faults of a device at a given moment: its power is cut, or its controller goes bus-off.

A power cut that matters comes in the middle of a flash operation, at a moment that nobody on the
bus can know. So a fault is set beforehand (`FaultInjector.set`), and the injector, an engine around
the device, lets it happen at that very moment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from flasher.mock.machine import BUS_OFF_S
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame

POWER_OFF_S: Final = 0.5


# -- moments --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class InOperation:
    """When `share` (0 to 1) of a flash operation is done, and of `operation` of them that begin
    from now on, counted from 0: 0.0 is just before anything changed, 1.0 when it is over.
    """

    operation: int
    share: float = 0.5


@dataclass(frozen=True)
class AfterFrame:
    """`delay_s` after the device received its frame number `frames` from now on, counted from 1."""

    frames: int
    delay_s: float = 0.0


@dataclass(frozen=True)
class AtTime:
    """At a time, in seconds on the clock of all calls."""

    at_s: float


Moment = InOperation | AfterFrame | AtTime


# -- faults ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PowerCut:
    """The power goes, and comes back after `off_s` seconds; never with None."""

    off_s: float | None = POWER_OFF_S


@dataclass(frozen=True)
class BusOff:
    """The controller leaves the bus for `off_s` seconds; see `Machine.bus_off`."""

    off_s: float = BUS_OFF_S


Fault = PowerCut | BusOff


class FaultInjector:
    """An engine (`flasher.protocol.engine`): `device`, and one fault at a time."""

    def __init__(self, device: MockDevice) -> None:
        self.device = device
        self.happened = 0
        """How many faults happened so far."""
        self._fault: Fault | None = None
        self._moment: Moment | None = None
        self._operations_before = 0
        self._frames_left = 0
        self._due_at = self._power_due_at = inf

    def set(self, fault: Fault, moment: Moment) -> None:
        """Let `fault` happen at `moment`, in place of one that is still to come."""
        self._fault, self._moment = fault, moment
        self._operations_before = self.device.operations_done
        self._frames_left = moment.frames if isinstance(moment, AfterFrame) else 0
        self._due_at = moment.at_s if isinstance(moment, AtTime) else inf
        self._look_at_flash()

    def clear(self) -> None:
        """Let no fault happen; power that is off still comes back."""
        self._fault = self._moment = None
        self._due_at = inf

    @property
    def is_set(self) -> bool:
        """True while a fault is still to come."""
        return self._fault is not None

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        return self.device.done

    def receive(self, frame: Frame, now: float) -> None:
        self._happen(now)
        self.device.receive(frame, now)
        if self._frames_left and frame.can_id == self.device.target.request_id:
            self._frames_left -= 1
            if not self._frames_left and isinstance(self._moment, AfterFrame):
                self._due_at = now + self._moment.delay_s
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

    def next_frame(self, now: float) -> Frame | None:
        return self.device.next_frame(now)

    def frame_sent(self, now: float) -> None:
        self.device.frame_sent(now)

    def cancel(self, now: float) -> None:
        self.device.cancel(now)

    def take_events(self) -> Sequence[object]:
        return self.device.take_events()

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
        if self._fault is None or self._due_at > now:
            return
        # At its own time, not when it was noticed: so much of the operation is done, and no more.
        fault, at_s = self._fault, self._due_at
        self.clear()
        self.happened += 1
        if isinstance(fault, BusOff):
            self.device.bus_off(at_s, fault.off_s)
            return
        self.device.power_cut(at_s)
        self._power_due_at = inf if fault.off_s is None else at_s + fault.off_s
