"""Virtual units for training, demonstration and tests, put into a socket and taken out again.

They are good, slow, bad or dead, and keep their labels, contents and numbers. Some are exchanged
for another one during their run and put in again later; some have the label of another unit. Each
socket has a simulated bus as fast as a real one. Seed and serial number determine a unit.
"""

from __future__ import annotations

import random
import re
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf
from typing import Final

from flasher.api import Connection
from flasher.bus.link import Clock, SteadyClock, VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.errors import UsageError
from flasher.image.release import Release
from flasher.mock.faults import AtTime, FaultInjector, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.place import Place
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    IMAGE_MAX_SIZE,
    PACKET_DATA_SIZE,
    VERSION_FIELD_SIZE,
    Dialect,
    Target,
)
from flasher.protocol.text import encode_text
from flasher.station.config import MockUnits
from flasher.station.messages import PresenceChanged, VirtualUnits
from flasher.station.recipe import SerialNumberRule
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import SERIAL_NUMBER

NO_NUMBER: Final = "NONE"
"""Serial number of a new unit, which has none."""
OTHER_HARDWARE: Final = "V0r0r1_20200101"
POWER_OFF_S: Final = 1.0
EXCHANGE_GAPS_S: Final = (0.3, 0.5, 1.0, 3.5)
"""Times for which a socket is empty while its unit is exchanged."""
SLOW_PROGRAM_S: Final = 0.01
"""Programming time of a packet in slow units, ten times the usual one."""
SLOW_ERASE_S: Final = 0.02
_DIGITS: Final = re.compile(r"[0-9]+")
_SERIALS_TRIED: Final = 2000
_NUMBERS_TRIED: Final = 10_000
_BLOCK: Final = 100
_BLOCKS: Final = 90


class Health(StrEnum):
    """Behaviour of a virtual unit in its run."""

    GOOD = "good"
    SLOW = "slow"
    REFUSES = "refuses the image"
    WRONG_HARDWARE = "wrong hardware"
    DEAD = "dead"


def _chance(units: MockUnits, what: str, serial: str) -> random.Random:
    return random.Random(f"{units.seed} {what} {serial}")  # noqa: S311  a play, no secret


def health_of(units: MockUnits, serial: str) -> Health:
    """Health of the unit with this serial number, drawn by the seed."""
    chance = random.Random(f"{units.seed} {serial}")  # noqa: S311  a play, no secret
    at = chance.random()
    if at < units.bad:
        return chance.choice((Health.REFUSES, Health.WRONG_HARDWARE))
    if at < units.bad + units.dead:
        return Health.DEAD
    return Health.SLOW if at < units.bad + units.dead + units.slow else Health.GOOD


def serial_numbers(rule: SerialNumberRule, first: int, step: int) -> Iterator[str]:
    """Serial numbers that fit a recipe: its example with other digits in its last number.

    Raises UsageError if none is found.
    """
    places = list(_DIGITS.finditer(rule.example))
    for number in range(first, first + step * _SERIALS_TRIED, step):
        for place in reversed(places):
            size = place.end() - place.start()
            digits = f"{number % 10**size:0{size}d}"
            serial = rule.example[: place.start()] + digits + rule.example[place.end() :]
            try:
                rule.read(serial)
            except ValueError:
                continue
            yield serial
            break
    raise UsageError(
        "There are no serial numbers for further virtual units.",
        remedy="End the serial number of the recipe with a number, or use new records.",
    )


def number_of_first(station: str) -> int:
    """The number with which the virtual units of a station of a plant begin: one of a few blocks,
    so that those of two stations with the same recipe seldom look like duplicates.
    """
    return 1 + zlib.crc32(station.encode("utf-8")) % _BLOCKS * _BLOCK


def next_number(
    rule: SerialNumberRule,
    known: Callable[[Collection[str]], Collection[str]],
    first: int = 1,
) -> int:
    """The number after the last virtual unit in the records; `first` without one. `known` returns
    those of the given serial numbers that are recorded.
    """
    numbers: dict[str, int] = {}
    for number in range(1, _NUMBERS_TRIED):
        try:
            numbers.setdefault(next(serial_numbers(rule, number, 1)), number)
        except UsageError:
            break
    return max((numbers[serial] for serial in known(numbers)), default=first - 1) + 1


@dataclass(frozen=True)
class VirtualUnit:
    """A virtual unit, which keeps its paper label, contents and numbers wherever it is put."""

    label: str
    """Text of the paper label."""
    health: Health
    devices: Mapping[str, MockDevice]
    """Devices by target; without power while the unit is in no socket."""


class _Seat(Place):
    """Place of one target's device in a socket. Calls `look` with the time of each event."""

    def __init__(self, look: Callable[[float], None]) -> None:
        super().__init__()
        self._look = look

    def receive(self, frame: Frame, now: float) -> None:
        super().receive(frame, now)
        self._look(now)

    def tick(self, now: float) -> None:
        super().tick(now)
        self._look(now)


class VirtualSocket:
    """A socket with virtual units: its bus, and the units that are put in and taken out."""

    def __init__(
        self, recipe: LoadedRecipe, virtual: VirtualUnits, clock: Clock | None = None
    ) -> None:
        self._recipe = recipe
        self._virtual = virtual
        made = SteadyClock(virtual.speed) if virtual.speed else VirtualClock()
        self.clock = clock or made
        self.dialect = recipe.targets[0].profile.dialect
        self._bus = SimulatedBus(self.dialect.bitrate_bps, self.clock)
        self._seats = {target.name: _Seat(self._look) for target in recipe.targets}
        for seat in self._seats.values():
            self._bus.attach(seat)
        self.connection = Connection(self._bus.link(), self.clock, "virtual units")
        self._serials = serial_numbers(
            recipe.recipe.serial_number, virtual.first_number, virtual.number_step
        )
        self._left = virtual.count
        self.unit: VirtualUnit | None = None
        """The unit in the socket."""
        self._next_at: float | None = self.clock.now() + virtual.arrive_after_s
        self._exchanged: set[str] = set()
        self._returns: deque[VirtualUnit] = deque()
        """Units that were exchanged during their run and will be put in again."""
        self._exchange_at_operation: int | None = None
        """The operation of the flash during which the unit is pulled out."""
        self._in_hand: VirtualUnit | None = None
        """Unit that replaces it, at `_put_at`."""
        self._put_at = 0.0
        self._is_other = False
        """A unit was replaced during a run, which is not reported yet."""

    @property
    def serial(self) -> str:
        """Label of the unit in the socket; "" without a unit."""
        return "" if self.unit is None else self.unit.label

    @property
    def devices(self) -> Mapping[str, FaultInjector]:
        """Devices of the unit in the socket, by target."""
        seats = self._seats.items()
        return {name: seat.device for name, seat in seats if seat.device is not None}

    def step(self) -> PresenceChanged | None:
        """Put a unit in or take it out if due. Returns the change, or None."""
        now = self.clock.now()
        if self._next_at is None or now < self._next_at:
            return None
        self._next_at = None
        if self._is_other and self.unit is not None:
            self._is_other = False
            return self._put_in("another virtual unit was put in")
        if self.unit is not None:
            self.take_out()
            self._next_at = now + self._virtual.arrive_after_s
            return PresenceChanged(is_there=False, is_certain=True)
        unit = self._returns.popleft() if self._returns else self._new_unit()
        if unit is None:
            return None
        self.put(unit)
        return self._put_in("a virtual unit arrived")

    def _put_in(self, how: str) -> PresenceChanged:
        return PresenceChanged(is_there=True, how=how, label=self.serial, is_power_up=True)

    def _new_unit(self) -> VirtualUnit | None:
        """The next unit; None after the last one."""
        if self._left == 0:
            return None
        if self._left is not None:
            self._left -= 1
        return self.make(next(self._serials))

    def make(self, label: str) -> VirtualUnit:
        """Make a unit with this label, as it arrives at the end of the line."""
        health, number = health_of(self._virtual.units, label), self._own_number(label)
        devices, now = {}, self.clock.now()
        for target in self._recipe.targets if health is not Health.DEAD else ():
            device = make_device(target.target, self.dialect, health, target.release, number)
            device.power_cut(now)
            devices[target.name] = device
        return VirtualUnit(label, health, devices)

    def arrive(self, serial: str) -> Health:
        """Put in a new unit with this label."""
        unit = self.make(serial)
        self.put(unit)
        return unit.health

    def put(self, unit: VirtualUnit) -> None:
        """Put a unit in. The socket powers it, so it starts with its bootloader."""
        self.unit, now = unit, self.clock.now()
        for name, device in unit.devices.items():
            device.power_on(now)
            self._seats[name].device = FaultInjector(device)
        self._exchange_at_operation = self._planned_exchange(unit)

    def take_out(self) -> VirtualUnit | None:
        """Take the unit out, which switches it off, and return it; None without a unit."""
        unit, self.unit, now = self.unit, None, self.clock.now()
        self._exchange_at_operation = None
        for seat in self._seats.values():
            injector, seat.device = seat.device, None
            if injector is not None and injector.device.has_power:
                injector.device.power_cut(now)
        return unit

    def _planned_exchange(self, unit: VirtualUnit) -> int | None:
        """Draw the flash operation during which the unit is exchanged; None: no exchange."""
        chance, units = _chance(self._virtual.units, "exchanged", unit.label), self._virtual.units
        was_exchanged = unit.label in self._exchanged
        if not unit.devices or was_exchanged or chance.random() >= units.exchanged:
            return None
        name = next(iter(unit.devices))
        target = next(each for each in self._recipe.targets if each.name == name)
        packets = -(-target.release.size_bytes // PACKET_DATA_SIZE)
        return unit.devices[name].operations_done + int(packets * chance.uniform(0.2, 0.9))

    def _look(self, now: float) -> None:
        """Exchange the unit if due."""
        if self._in_hand is not None:
            if now >= self._put_at:
                self.put(self._in_hand)
                self._in_hand = None
                self._be_due(inf)
                self._is_other = True
            return
        if self._exchange_at_operation is None:
            return
        device = next(iter(self.devices.values())).device
        if device.operations_done < self._exchange_at_operation:
            return
        self._exchange_at_operation = None
        other = self._new_unit()
        pulled = None if other is None else self.take_out()
        if pulled is not None:
            self._returns.append(pulled)
            self._exchanged.add(pulled.label)
            gap_s = _chance(self._virtual.units, "gap", pulled.label).choice(EXCHANGE_GAPS_S)
            self._in_hand, self._put_at = other, now + gap_s
            self._be_due(self._put_at)

    def _be_due(self, at_s: float) -> None:
        for seat in self._seats.values():
            seat.due_at = at_s

    def _own_number(self, label: str) -> str:
        """Serial number that the unit reports: none if the recipe writes it, else that of its
        label, shortened to the field; of another unit if it is mislabelled.
        """
        chance, units = _chance(self._virtual.units, "label", label), self._virtual.units
        number = label
        if chance.random() < units.mislabelled:
            rule = self._recipe.recipe.serial_number
            others = serial_numbers(rule, chance.randrange(1, _NUMBERS_TRIED), 1)
            number = next(other for other in others if other != label)
        elif any(write.item == SERIAL_NUMBER for write in self._recipe.recipe.write):
            return NO_NUMBER
        try:
            encode_text(number, VERSION_FIELD_SIZE)
        except ValueError:
            return ""
        return number

    def run_ended(self) -> None:
        """Take the unit out some time after the end of its run."""
        self._next_at = self.clock.now() + self._virtual.leave_after_s
        self._exchange_at_operation = None
        if self._in_hand is not None:  # the bus did not run up to the moment of the exchange
            self._look(self._put_at)

    # -- the power of the socket ------------------------------------------------------------------

    def begin_cycle(self) -> None:
        for injector in self.devices.values():
            if injector.device.has_power:
                injector.set(PowerCut(POWER_OFF_S), AtTime(self.clock.now()))

    def check(self) -> None:
        """Never raises."""


def make_device(
    target: Target, dialect: Dialect, health: Health, release: Release, serial_number: str
) -> MockDevice:
    """Make a device as it arrives at the end of the line, with an older application."""
    usual = DeviceProfile()
    hardware = usual.hardware_version
    if health is Health.WRONG_HARDWARE:
        hardware = OTHER_HARDWARE
    elif not release.fits_hardware(hardware):
        hardware = release.hardware_versions[0].replace("*", "20220512")[:15]
    # The flash is as large as the image needs: a device with a smaller one is made faster.
    pages = -(-2 * release.size_bytes // usual.page_size_bytes) + 2
    area_bytes = min(pages * usual.page_size_bytes, usual.application_area_bytes, IMAGE_MAX_SIZE)
    profile = DeviceProfile(
        dialect=dialect.name,  # type: ignore[arg-type]
        serial_number=serial_number,
        hardware_version=hardware,
        application_area_bytes=area_bytes,
    )
    if health is Health.SLOW:
        profile = replace(profile, program_time_s=SLOW_PROGRAM_S, erase_time_s=SLOW_ERASE_S)
    if health is Health.REFUSES:
        # The product requires a checksum in the image, which this image does not have.
        profile = replace(profile, image_checksum="crc32")
    return MockDevice(target, bitrate_bps=dialect.bitrate_bps, profile=profile)
