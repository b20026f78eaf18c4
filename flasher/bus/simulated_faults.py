"""Adapter faults on a simulated bus: unplugged, bus-off, or not acknowledged; pure.

Error frames have the format of Linux's SocketCAN drivers.
"""

from __future__ import annotations

from math import inf
from typing import Final

from flasher.bus.health import PASSIVE_LIMIT, WARNING_LIMIT
from flasher.protocol.frame import Frame

_ERRORS_PER_TRY: Final = 8
"""Increase of the transmit error counter for a frame without acknowledgement."""
_ERROR_BITS: Final = 20
"""Error flag, delimiter and following pause, approximately."""


def _error_frame(classes: int, controller: int = 0, tx_errors: int = 0) -> Frame:
    """Create an error frame in Linux's format: classes in the id, state and counters in data."""
    return Frame(classes, bytes((0, controller, 0, 0, 0, 0, tx_errors, 0)), is_error=True)


BUS_OFF: Final = _error_frame(0x040)
RESTARTED: Final = _error_frame(0x100)
TX_WARNING: Final = _error_frame(0x204, 0x08, WARNING_LIMIT)
TX_PASSIVE: Final = _error_frame(0x204, 0x20, PASSIVE_LIMIT)
ACTIVE_AGAIN: Final = _error_frame(0x204, 0x40)


class AdapterFaults:
    """Faults of the host's adapter; it starts plugged in and working."""

    def __init__(self) -> None:
        self.is_plugged = True
        self.is_off = False
        self.is_isolated = False
        """True while no node acknowledges its frames."""
        self.takes_part = True
        """The adapter sends and receives frames. An attribute, as the bus asks with each frame."""
        self.times_unplugged = 0
        """A link that was opened before the last unplugging must be reopened."""
        self.due_at = inf
        """Time of the next fault or error frame; infinite without one."""
        self._back_at: float | None = None
        self._reports: list[tuple[float, Frame]] = []
        self._has_reported = False

    def unplug(self, back_at: float | None) -> None:
        """Unplug the adapter until `back_at`, or until `restore`."""
        self.is_plugged = False
        self.times_unplugged += 1
        self._back_at = back_at
        self._reports.clear()
        self._look_ahead()

    def enter_bus_off(self, now: float, back_at: float | None) -> None:
        """Set the controller bus-off until `back_at`, or until `restore`."""
        self.is_off = True
        self._back_at = back_at
        self._reports = [(now, BUS_OFF)]
        self._look_ahead()

    def restore(self, now: float) -> None:
        """Plug the adapter in and restart its controller."""
        if self.is_off and self.is_plugged:
            self._reports.append((now, RESTARTED))
        self.is_plugged, self.is_off = True, False
        self._back_at = None
        self._look_ahead()

    def isolate(self, now: float, *, alone: bool) -> None:
        """Isolate the adapter from all other nodes, or reconnect it."""
        if not alone and self._has_reported:
            self._reports = [(now, ACTIVE_AGAIN)]
        self.is_isolated, self._has_reported = alone, False
        self._look_ahead()

    def send_unacknowledged(self, now: float, frame_s: float, bit_s: float) -> None:
        """Send a frame without acknowledgement: the error counter rises to error-passive."""
        if not self.is_isolated or self._has_reported:
            return
        self._has_reported = True
        try_s = frame_s + _ERROR_BITS * bit_s
        for report, limit in ((TX_WARNING, WARNING_LIMIT), (TX_PASSIVE, PASSIVE_LIMIT)):
            self._reports.append((now + limit // _ERRORS_PER_TRY * try_s, report))
        self._look_ahead()

    def tick(self, now: float) -> list[Frame]:
        """End a fault that is over; return the error frames to report now."""
        if self._back_at is not None and self._back_at <= now:
            self.restore(now)
        due = [frame for at, frame in self._reports if at <= now]
        self._reports = [(at, frame) for at, frame in self._reports if at > now]
        self._look_ahead()
        return due

    def _look_ahead(self) -> None:
        self.takes_part = self.is_plugged and not self.is_off and not self.is_isolated
        times = [at for at, _ in self._reports]
        self.due_at = min(times if self._back_at is None else [*times, self._back_at], default=inf)
