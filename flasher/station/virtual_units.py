"""Virtual units: they come into a socket, are good, slow, bad or dead, and leave again.

For training, demonstration and tests. Each socket has a simulated bus of its own at the pace of a
real one; what is decided about a unit follows from seed and serial number.
"""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from dataclasses import replace
from enum import StrEnum
from typing import Final

from flasher.api import Connection
from flasher.bus.link import Clock, PacedClock, VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.errors import UsageError
from flasher.image.release import Release
from flasher.mock.faults import AtTime, FaultInjector, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import IMAGE_MAX_SIZE, VERSION_FIELD_SIZE, Dialect, Target
from flasher.protocol.text import encode_text
from flasher.station.config import MockUnits
from flasher.station.messages import PresenceChanged, VirtualUnits
from flasher.station.recipe import SerialNumber
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import SERIAL_NUMBER

NO_NUMBER: Final = "NONE"
"""What a new unit has for a serial number."""
OTHER_HARDWARE: Final = "V0r0r1_20200101"
POWER_OFF_S: Final = 1.0
SLOW_PROGRAM_S: Final = 0.01
"""Ten times as long for each packet as a good unit takes."""
SLOW_ERASE_S: Final = 0.02
_DIGITS: Final = re.compile(r"[0-9]+")
_SERIALS_TRIED: Final = 2000
_NUMBERS_TRIED: Final = 10_000


class Health(StrEnum):
    """What a virtual unit is like."""

    GOOD = "good"
    SLOW = "slow"
    REFUSES = "refuses the image"
    WRONG_HARDWARE = "wrong hardware"
    DEAD = "dead"


def health_of(units: MockUnits, serial: str) -> Health:
    """What the unit with this serial number is like."""
    chance = random.Random(f"{units.seed} {serial}")  # noqa: S311  a play, no secret
    at = chance.random()
    if at < units.bad:
        return chance.choice((Health.REFUSES, Health.WRONG_HARDWARE))
    if at < units.bad + units.dead:
        return Health.DEAD
    return Health.SLOW if at < units.bad + units.dead + units.slow else Health.GOOD


def serial_numbers(rule: SerialNumber, first: int, step: int) -> Iterator[str]:
    """Serial numbers that fit a recipe: its example with other digits in its last number.

    Raises UsageError where none is found.
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
        remedy="End the serial number of the recipe with a number, or begin anew.",
    )


def next_number(rule: SerialNumber, known: set[str]) -> int:
    """The number behind that of the last virtual unit in `known` serial numbers."""
    last, left = 0, set(known)
    for number in range(1, _NUMBERS_TRIED):
        try:
            serial = next(serial_numbers(rule, number, 1))
        except UsageError:
            break
        if serial in left:
            left.remove(serial)
            last = number
        if not left:
            break
    return last + 1


class VirtualSocket:
    """A socket with virtual units: a bus, and who comes and goes."""

    def __init__(
        self, recipe: LoadedRecipe, virtual: VirtualUnits, clock: Clock | None = None
    ) -> None:
        self._recipe = recipe
        self._virtual = virtual
        made = PacedClock(virtual.speed) if virtual.speed else VirtualClock()
        self.clock = clock or made
        self.dialect = recipe.targets[0].profile.dialect
        self._bus = SimulatedBus(self.dialect.bitrate_bps, self.clock)
        self.devices: dict[str, FaultInjector] = {}
        """Those of the unit in the socket, by their targets."""
        self.connection = Connection(self._bus.link(), self.clock, "virtual units")
        self._serials = serial_numbers(
            recipe.recipe.serial_number, virtual.first_number, virtual.number_step
        )
        self._left = virtual.count
        self.serial = ""
        """The label of the unit in the socket; empty: none is."""
        self._next_at: float | None = self.clock.now() + virtual.arrive_after_s

    def step(self) -> PresenceChanged | None:
        """Let a unit come or go in its time; None when nothing happened."""
        now = self.clock.now()
        if self._next_at is None or now < self._next_at:
            return None
        self._next_at = None
        if self.serial:
            self.serial = ""
            for device in self.devices.values():
                self._bus.detach(device)
            self.devices.clear()
            self._next_at = now + self._virtual.arrive_after_s
            return PresenceChanged(is_there=False, is_certain=True)
        if self._left == 0:
            return None
        if self._left is not None:
            self._left -= 1
        self.arrive(next(self._serials))
        return PresenceChanged(is_there=True, how="a virtual unit came", label=self.serial)

    def arrive(self, serial: str) -> Health:
        """Put the unit with this label in."""
        self.serial = serial
        health = health_of(self._virtual.units, serial)
        own_number, now = self._own_number(serial), self.clock.now()
        for target in self._recipe.targets if health is not Health.DEAD else ():
            device = make_device(target.target, self.dialect, health, target.release, own_number)
            # Its power comes with the socket: it passes through its bootloader.
            device.power_cut(now)
            device.power_on(now)
            self.devices[target.name] = FaultInjector(device)
            self._bus.attach(self.devices[target.name])
        return health

    def _own_number(self, label: str) -> str:
        """What the unit says that it is: none yet where the recipe gives it its number, else what
        its label says, as far as it has room for it.
        """
        if any(write.item == SERIAL_NUMBER for write in self._recipe.recipe.write):
            return NO_NUMBER
        try:
            encode_text(label, VERSION_FIELD_SIZE)
        except ValueError:
            return ""
        return label

    def run_ended(self) -> None:
        """The run has ended: the unit leaves after a while."""
        self._next_at = self.clock.now() + self._virtual.leave_after_s

    # -- the power of the socket ------------------------------------------------------------------

    def begin_cycle(self) -> None:
        for injector in self.devices.values():
            if injector.device.has_power:
                injector.set(PowerCut(POWER_OFF_S), AtTime(self.clock.now()))

    def check(self) -> None:
        """It never fails."""


def make_device(
    target: Target, dialect: Dialect, health: Health, release: Release, serial_number: str
) -> MockDevice:
    """A device as it comes to the end of the line, with an older application."""
    usual = DeviceProfile()
    hardware = usual.hardware_version
    if health is Health.WRONG_HARDWARE:
        hardware = OTHER_HARDWARE
    elif not release.fits_hardware(hardware):
        hardware = release.hardware_versions[0].replace("*", "20220512")[:15]
    # Room for the image: a device with a smaller flash is made faster.
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
        # Its product wants a checksum in the image, which this image does not have.
        profile = replace(profile, image_checksum="crc32")
    return MockDevice(target, bitrate_bps=dialect.bitrate_bps, profile=profile)
