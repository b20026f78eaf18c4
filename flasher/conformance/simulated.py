"""A simulated bus as the suite's way to a device model: exact end times of all frames, on a virtual
clock, so that no time is spent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Final

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.conformance.results import DeviceCrashed
from flasher.conformance.subject import Arrival
from flasher.conformance.wire import RawFrame
from flasher.errors import BusError, FlasherError
from flasher.protocol.frame import Frame

_AT_ONCE: Final = float("-inf")


class SimulatedPort:
    """A way onto a simulated bus, with exact end times of all frames, the own ones included. Its
    methods raise DeviceCrashed too.
    """

    echoes = True
    timestamp_source = "simulated bus"
    uncertainty_s = 0.0
    sends_error_frames = True

    def __init__(self, bitrate_bps: int) -> None:
        self.bitrate_bps = bitrate_bps
        self.bus = SimulatedBus(bitrate_bps, VirtualClock(), self._record)
        self._link = self.bus.link()
        self._arrived: deque[tuple[Frame, float]] = deque()
        self._pending: deque[tuple[Frame, RawFrame]] = deque()
        """What was sent and has not left."""
        self.now = self.bus.clock.now

    def send(self, frame: RawFrame) -> None:
        made = Frame(*frame)
        self._pending.append((made, frame))
        with CRASHES:
            self._link.send(made)

    def receive(self, deadline: float) -> Arrival | None:
        if not self._arrived:
            with CRASHES:
                while not self._arrived and self.now() < deadline:
                    self.bus.advance(deadline)
                    if not self._arrived:
                        self._take_reports()
            if not self._arrived:
                return None
        frame, at = self._arrived.popleft()
        if self._pending and frame is self._pending[0][0]:
            return Arrival(self._pending.popleft()[1], at, is_echo=True)
        return Arrival(RawFrame(*frame[:5]), at, is_echo=False)

    def _take_reports(self) -> None:
        """The link has the same frames; it reports errors, and raises when unplugged."""
        while (seen := self._link.receive(_AT_ONCE)) is not None:
            if seen.is_error:
                self._arrived.append((seen, self.now()))

    def _record(self, frame: Frame, at: float) -> Sequence[Frame]:
        """Take note of every frame on the wire, unless the adapter is off the bus."""
        if self.bus.faults.takes_part:
            self._arrived.append((frame, at))
        return (frame,)


class _Crashes(AbstractContextManager[None]):
    """A device model that raises has done what a real part does not allow."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, FlasherError) and not isinstance(error, BusError):
            cause = f" ({error.cause})" if error.cause else ""
            raise DeviceCrashed(f"the device stopped: {error.what}{cause}") from error


CRASHES: Final = _Crashes()
