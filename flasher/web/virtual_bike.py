"""Virtual bikes of the bench page, each with at most one fault, or exchanged after an upgrade."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from functools import partial
from math import inf
from typing import Final

from flasher import events
from flasher.api import Connection
from flasher.bus.bit_rate import BitRate
from flasher.bus.link import Clock, SteadyClock, VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.i18n import text
from flasher.jobs import Job
from flasher.mock.clients import ClientApplication
from flasher.mock.faults import AtTime, FaultInjector, InOperation, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.place import Place
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, TARGETS, Dialect, Target

_ONE_FAULT: Final = 1 << 3
_HAND_S: Final = 2.0
"""Time until the user interrupts the power, and duration of the interruption."""
_EXCHANGED_AFTER_S: Final = 8.0
_AWAY_S: Final = 4.0
_OTHER_HARDWARE: Final = "V0r0r1_20200101"
_FOREIGN: Final = bytes.fromhex("55AA168700000000")
"""First bytes of a message that only a tool sends."""


class BikeFault(Enum):
    """Fault of a virtual bike; the value is the bike's name."""

    NONE = "virtual bike"
    POWER = "virtual bike 2"
    PULLED = "virtual bike 3"
    SECOND_TOOL = "virtual bike 4"
    REFUSES = "virtual bike 5"
    HARDWARE = "virtual bike 6"
    NO_APPLICATION = "virtual bike 7"
    OFF = "virtual bike 8"
    EXCHANGED = "virtual bike 9"


NOTES: Final = {
    BikeFault.NONE: text("has no fault"),
    BikeFault.POWER: text("loses its power in the middle of the upgrade"),
    BikeFault.PULLED: text("the adapter is pulled out in the middle of the upgrade"),
    BikeFault.SECOND_TOOL: text("another tool sends in the middle of the upgrade"),
    BikeFault.REFUSES: text("its devices refuse the image at the end"),
    BikeFault.HARDWARE: text("has other hardware, and reports a fault"),
    BikeFault.NO_APPLICATION: text("its upgrade was interrupted: its devices do not start"),
    BikeFault.OFF: text("is switched off"),
    BikeFault.EXCHANGED: text("is taken away after its upgrade, and another one is connected"),
}


class _BikeClock:
    """Clock that advances only while the bus is used, so that an unwatched bike stands still."""

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._passed = 0.0
        self._running: SteadyClock | None = None

    def now(self) -> float:
        return self._passed + (0.0 if self._running is None else self._running.now())

    def wait_until(self, moment: float) -> None:
        if self._running is not None:
            self._running.wait_until(moment - self._passed)

    def resume(self) -> None:
        self._running = SteadyClock(self.speed)

    def rest(self) -> None:
        self._passed, self._running = self.now(), None


class _Exchanged(Place):
    """Place of a device that is taken out at `due_at`, and replaced by another one."""

    done = False

    def __init__(self, made: Callable[[], FaultInjector]) -> None:
        super().__init__()
        self._made = made
        self.device = made()

    def tick(self, now: float) -> None:
        if now >= self.due_at and self.device is not None:
            self.device, self.due_at = None, now + _AWAY_S
        elif now >= self.due_at:
            self.device, self.due_at = self._made(), inf
            self.device.device.power_on(now)
        super().tick(now)


class VirtualBike:
    """Three upgradable devices on a simulated bus. With `speed` 0 transfers take no time."""

    def __init__(self, fault: BikeFault, dialect: Dialect, *, speed: float = 1.0) -> None:
        self._fault = fault
        self._dialect = dialect
        self._clock: Clock = _BikeClock(speed) if speed else VirtualClock()
        self._bus = SimulatedBus(dialect.bitrate_bps, self._clock)
        self._link = self._bus.link()
        self._devices: dict[Target, FaultInjector] = {}
        self._places: list[_Exchanged] = []
        self._bikes = dict.fromkeys(TARGETS.values(), 0)
        """Number of devices made so far for each target."""
        for target in TARGETS.values() if fault is not BikeFault.OFF else ():
            if fault is BikeFault.EXCHANGED:
                place = _Exchanged(partial(self._next_device, target))
                self._places.append(place)
                self._bus.attach(place)
            else:
                self._bus.attach(self._next_device(target))
        self._job: Job | None = None

    def _next_device(self, target: Target) -> FaultInjector:
        self._bikes[target] += 1
        self._devices[target] = FaultInjector(self._device(target))
        return self._devices[target]

    def _device(self, target: Target) -> MockDevice:
        fault = self._fault
        profile = DeviceProfile().speaking(self._dialect)
        if fault is BikeFault.EXCHANGED:
            profile = replace(profile, serial_number=f"W2605{self._bikes[target]:03}")
        if fault is BikeFault.REFUSES:
            profile = replace(profile, image_checksum="crc32")
        if fault is BikeFault.HARDWARE:
            profile = replace(profile, hardware_version=_OTHER_HARDWARE, faults=_ONE_FAULT)
        if fault is BikeFault.NO_APPLICATION:
            profile = replace(profile, without_application="listens")
        is_battery = target is BMS
        return MockDevice(
            target,
            bitrate_bps=self._dialect.bitrate_bps,
            profile=profile,
            has_application=fault is not BikeFault.NO_APPLICATION,
            application=None if is_battery else ClientApplication(target.node, self._dialect),
        )

    @contextmanager
    def connect(self) -> Iterator[Connection]:
        """Connect an adapter and yield the bus."""
        self._bus.plug()
        if isinstance(self._clock, _BikeClock):
            self._clock.resume()
        try:
            self._link.reopen()
            rate = BitRate(self._dialect.bitrate_bps, "the dialect's")
            yield Connection(self._link, self._clock, self._fault.value, rate)
        finally:
            if isinstance(self._clock, _BikeClock):
                self._clock.rest()

    def begin(self, job: Job) -> None:
        """Start an upgrade, which triggers the fault."""
        self._job = job
        device = self._devices.get(job.plan.target)
        if device is not None and self._fault is BikeFault.POWER and not job.options.at_power_up:
            device.set(PowerCut(None), InOperation(job.plan.total_packets // 2))

    def ended(self) -> None:
        """The upgrade has ended: the bike is exchanged if it is such a one."""
        for place in self._places:
            place.due_at = self._clock.now() + _EXCHANGED_AFTER_S

    def happened(self, event: object) -> None:
        job = self._job
        match event:
            case events.PowerCycleAwaited() if job is not None:
                device = self._devices.get(job.plan.target)
                if device is not None:
                    device.set(PowerCut(_HAND_S), AtTime(self._clock.now() + _HAND_S))
            case events.PacketAcknowledged(number, total, _) if (
                number == total // 2 and job is not None and not job.options.at_power_up
            ):
                if self._fault is BikeFault.PULLED:
                    self._bus.unplug()
                elif self._fault is BikeFault.SECOND_TOOL:
                    self._bus.link().send(Frame(job.plan.target.request_id, _FOREIGN))
