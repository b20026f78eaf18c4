"""Base class and port of subjects on a simulated bus, with exact end times of all frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Generic, NoReturn, TypeVar

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.conformance.firmware import GOOD, SECOND, Firmware, ImageMaker, make_firmware
from flasher.conformance.results import DeviceCrashed
from flasher.conformance.subject import SIMULATED_BUS, Arrival, FlashFaults
from flasher.conformance.wire import RawFrame
from flasher.errors import BusError, FlasherError
from flasher.protocol.frame import Frame
from flasher.protocol.spec import WELLING

if TYPE_CHECKING:
    from flasher.conformance.dut.device import CompiledDevice
    from flasher.mock.model import MockDevice

_AT_ONCE: Final = float("-inf")


class SimulatedPort:
    """Port on a simulated bus. Its methods raise DeviceCrashed too."""

    echoes = True
    timestamp_source = SIMULATED_BUS
    uncertainty_s = 0.0
    sends_error_frames = True

    def __init__(self, bitrate_bps: int) -> None:
        self.bitrate_bps = bitrate_bps
        self.bus = SimulatedBus(bitrate_bps, VirtualClock(), self._record)
        self._link = self.bus.link()
        self._arrived: deque[tuple[Frame, float]] = deque()
        self._pending: deque[tuple[Frame, RawFrame]] = deque()
        """Frames that have not left yet."""
        self._receives_until = _AT_ONCE
        self.now = self.bus.clock.now

    def quiet_until(self) -> float:
        """Time until which nothing is sent unless something is received: while `receive` waits."""
        return self._receives_until if self.bus.is_idle else _AT_ONCE

    def send(self, frame: RawFrame) -> None:
        made = Frame(*frame)
        self._pending.append((made, frame))
        try:
            self._link.send(made)
        except FlasherError as error:
            _raise_crash(error)

    def receive(self, deadline: float) -> Arrival | None:
        arrived = self._arrived
        if not arrived:
            self._receives_until = deadline
            try:
                while not arrived and self.now() < deadline:
                    self.bus.advance_message(deadline)
                    if not arrived:
                        self._take_reports()
            except FlasherError as error:
                _raise_crash(error)
            finally:
                self._receives_until = _AT_ONCE
            if not arrived:
                return None
        frame, at = arrived.popleft()
        if self._pending and frame is self._pending[0][0]:
            return Arrival(self._pending.popleft()[1], at, True)  # noqa: FBT003  faster than by name
        return Arrival(RawFrame(*frame[:5]), at, False)  # noqa: FBT003

    def _take_reports(self) -> None:
        """Take error frames from the link, which raises when unplugged; its other frames are
        duplicates.
        """
        while (seen := self._link.receive(_AT_ONCE)) is not None:
            if seen.is_error:
                self._arrived.append((seen, self.now()))

    def _record(self, frame: Frame, at: float) -> Sequence[Frame]:
        """Record every frame on the wire, unless the adapter is off the bus."""
        if self.bus.faults.takes_part:
            self._arrived.append((frame, at))
        return (frame,)


DeviceT = TypeVar("DeviceT", bound="MockDevice | CompiledDevice")


class SimulatedSubject(Generic[DeviceT]):
    """A simulated device as a subject. Without `good_image` it uses images made by `make_image`,
    some of which look like firmware for the device's erase sectors and application area.
    """

    has_own_clock: bool
    has_power = has_readback = has_bus_off = has_timed_cuts = True
    flash_faults: FlashFaults | None = None

    def __init__(
        self,
        device: DeviceT,
        target: str,
        make_image: ImageMaker,
        *,
        sector_bytes: int,
        area_bytes: int,
        name: str,
        good_image: bytes | None,
        second_image: bytes | None,
    ) -> None:
        self.name = name
        self.target = target
        self.device = device
        self.good_image = good_image or make_image(*GOOD, b"")
        self.second_image = second_image or (None if good_image else make_image(*SECOND, b""))
        self.firmware = Firmware(self.good_image, self.second_image)
        if not (good_image or second_image):
            made = make_firmware(make_image, sector_bytes, area_bytes)
            self.firmware = made or self.firmware
        self.port = SimulatedPort(WELLING.bitrate_bps)
        self.bus = self.port.bus

    def power(self, *, on: bool) -> None:
        switch = self.device.power_on if on else self.device.power_cut
        try:
            switch(self.port.now())
        except FlasherError as error:
            _raise_crash(error)

    def readback(self) -> bytes:
        return self.device.readback()

    def bus_off(self, for_s: float) -> None:
        self.device.bus_off(self.port.now(), for_s)


def _raise_crash(error: FlasherError) -> NoReturn:
    """Raise DeviceCrashed for a device model's error, as it did something impossible on hardware,
    and an error of the adapter as it is.
    """
    if isinstance(error, BusError):
        raise error
    cause = f" ({error.cause})" if error.cause else ""
    raise DeviceCrashed(f"the device stopped: {error.what}{cause}") from error
