"""Worlds with two units of one kind on a bus, or with one, drawn from a seed.

    judged = play(world(7, units=2))
    assert not judged.is_false

A unit is a right device (`tests.campaigns.right_devices`) with a latency of its own; the other one
is the very same, or differs in version, speed, state or in everything. The bus is a wire, on which
frames of one id collide, or a virtual network, on which they take no time; it may lose, double,
damage and delay frames.
"""

from __future__ import annotations

import contextlib
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final, NamedTuple

from flasher import api
from flasher.bus.link import Clock, Link, VirtualClock
from flasher.bus.simulated import Disturbance, SimulatedBus, SimulatedLink
from flasher.errors import FlasherError
from flasher.host.options import UpgradeOptions
from flasher.host.session import Result
from flasher.host.table import Ending
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING, Command
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler
from tests.campaigns.right_devices import right_device
from tests.end_to_end.stage import image_of

AREA: Final = 16 * 1024
VIRTUAL_BPS: Final = 25_000_000
PAUSES_S: Final = (0.0, 0.0, 0.05, 0.3, 3.0, 12.0)
KINDS: Final = ("alike", "speed", "version", "state", "silent", "open", "any")
"""How the second unit differs from the first one."""


class Log:
    """A tap that keeps the intact messages that came and that were sent, with their times."""

    def __init__(self) -> None:
        self.came: list[tuple[float, Message]] = []
        self.sent: list[tuple[float, Message]] = []
        self._wire: dict[tuple[int, bool], Reassembler] = {}

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        key = frame.can_id, sent
        wire = self._wire.setdefault(key, Reassembler(frame.can_id, inf))
        found = wire.feed(frame.data, now)
        (self.sent if sent else self.came).extend(
            (now, each) for each in found if isinstance(each, Message)
        )


class Slow:
    """An engine (`flasher.protocol.engine`) that hears everything later by `latency_s`, and with
    `chance` by up to as much again.
    """

    def __init__(
        self, device: MockDevice, latency_s: float, chance: random.Random | None = None
    ) -> None:
        self.device = device
        self._latency_s = latency_s
        self._chance = chance
        self._waiting: deque[tuple[float, Frame]] = deque()
        self.sent = Log()
        self.next_frame = device.next_frame
        self.cancel, self.take_events = device.cancel, device.take_events

    @property
    def done(self) -> bool:
        return self.device.done

    def frame_sent(self, now: float) -> None:
        frame = self.device.next_frame(now)
        assert frame is not None
        self.sent(frame, sent=False, now=now)
        self.device.frame_sent(now)

    def receive(self, frame: Frame, now: float) -> None:
        heard_at = now + self._latency_s
        if self._chance is not None:
            heard_at += self._latency_s * self._chance.random()
        if self._waiting:
            heard_at = max(heard_at, self._waiting[-1][0])
        self._waiting.append((heard_at, frame))
        self._hear(now)

    def tick(self, now: float) -> None:
        self._hear(now)
        self.device.tick(now)

    def deadline(self) -> float | None:
        wanted = self.device.deadline()
        if not self._waiting:
            return wanted
        heard_at = self._waiting[0][0]
        return heard_at if wanted is None else min(wanted, heard_at)

    def _hear(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            self.device.receive(self._waiting.popleft()[1], now)


class Pausing(SimulatedLink):
    """An adapter whose computer pauses once, after so many frames: the bus goes on."""

    def __init__(self, link: SimulatedLink, after_frames: int, pause_s: float) -> None:
        self.__dict__ = link.__dict__
        self._left, self._pause_s = after_frames, pause_s

    def send(self, frame: Frame) -> None:
        super().send(frame)
        self._left -= 1

    def receive(self, deadline: float) -> Frame | None:
        if self._left <= 0 and self._pause_s and deadline > 0:
            pause_s, self._pause_s = self._pause_s, 0.0
            _wait(self._bus.link(), self._bus.clock, pause_s)
        return super().receive(deadline)


class Unit(NamedTuple):
    """How to make one unit."""

    device_type: type[MockDevice]
    profile: DeviceProfile
    timings: dict[str, float]
    latency_s: float
    state: str = "application"
    """"application", "bootloader" (it has no application), or "session" (left open)."""

    def make(self, target: str, chance: random.Random) -> Slow:
        device = self.device_type(
            TARGETS[target],
            bitrate_bps=WELLING.bitrate_bps,
            profile=self.profile,
            timings=replace(DEFAULT_TIMINGS, **self.timings),  # type: ignore[arg-type]
            has_application=self.state != "bootloader",
        )
        return Slow(device, self.latency_s, chance)


@dataclass(frozen=True)
class World:
    """What is on a bus, and what befalls it."""

    seed: int
    target: str
    kind: str
    units: tuple[Unit, ...]
    packets: int
    collides: bool
    faults: float
    """Share of the frames that is lost, doubled, damaged or late."""
    starts_s: float
    """When the host begins."""
    pause: tuple[int, float]
    """After how many frames its computer pauses, and how long; only beside one unit."""

    def __str__(self) -> str:
        units = "\n  ".join(map(str, self.units))
        bus = "a wire" if self.collides else "a virtual network"
        what = f"{self.seed} {self.target} {self.kind}: {self.packets} packets on {bus}"
        return f"{what}, faults {self.faults}\n  {units}"


class Judged(NamedTuple):
    """How an upgrade in a world ended."""

    result: Result | FlasherError
    holds: tuple[bool, ...]
    """Whether each unit has the image."""
    erased: tuple[bool, ...]
    tells: tuple[int, ...]
    """How many messages of each unit reached the host that a single device does not send."""

    @property
    def ending(self) -> str:
        if isinstance(self.result, FlasherError):
            return type(self.result).__name__
        if self.result.outcome.ok and not self.result.ok:
            return self.result.verification.verdict.value
        return self.result.outcome.ending.value

    @property
    def is_ok(self) -> bool:
        return isinstance(self.result, Result) and self.result.ok

    @property
    def is_false(self) -> bool:
        """It claims success, and not every unit has the image."""
        return self.is_ok and not all(self.holds)

    @property
    def is_missed(self) -> bool:
        """It is false, although the units that do not have the image have shown themselves: more
        than a bad line makes of one device.
        """
        return self.is_false and any(
            tells > 2 for holds, tells in zip(self.holds, self.tells, strict=True) if not holds
        )

    @property
    def is_two(self) -> bool:
        """It ended as two devices."""
        return self.ending == Ending.TWO_DEVICES.value


def _unit(chance: random.Random, seed: int) -> Unit:
    made = right_device(seed)
    profile = replace(
        made.choices,
        image_checksum="none",
        page_size_bytes=2048,
        application_area_bytes=AREA,
        largest_image_bytes=None,
        erase_time_s=chance.choice((0.0, 0.02, 0.2)) * chance.random(),
        serial_number=f"W{chance.randrange(10**6)}",
        battery_seed=chance.randrange(1000),
    )
    return Unit(made.device_type, profile, made.timings, chance.choice((0.0001, 0.0005, 0.003)))


def _other(chance: random.Random, kind: str, one: Unit, seed: int) -> Unit:
    """A unit that differs from `one` as its kind says."""
    profile = one.profile
    latency_s = max(0.0, one.latency_s + chance.choice((0.0, 1e-6, 3e-5, 0.0007, 0.004, 0.02)))
    other = one._replace(latency_s=latency_s)
    match kind:
        case "speed":
            changes: dict[str, object] = {
                "erase_time_s": profile.erase_time_s + chance.choice((0.0, 0.01, 0.3)),
                "program_time_s": profile.program_time_s + chance.choice((0.0, 0.002, 0.03)),
                "reset_delay_s": profile.reset_delay_s + chance.choice((0.0, 0.01, 0.4)),
            }
        case "version":
            changes = {"factory_version": "V1r0r7_20250101", "boot_version": profile.boot_version}
            changes["boot_version"] = chance.choice((profile.boot_version, "V9.9.9"))
        case "silent":
            changes = {"silent_queries": "3300,3400"}
        case "any":
            return _unit(chance, seed + 1_000_000)
        case "state" | "open":
            return other._replace(state="bootloader" if kind == "state" else "session")
        case _:
            changes = {}
    if chance.random() < 0.5:
        changes["serial_number"] = f"W{chance.randrange(10**6)}"
    return other._replace(profile=replace(profile, **changes))  # type: ignore[arg-type]


def world(seed: int, *, units: int, target: str | None = None) -> World:
    """The world of that seed with one unit or with two."""
    chance = random.Random(f"twins/{seed}")
    target_name = target or chance.choice(("bms", "wmc", "obc"))
    kind = chance.choice(KINDS)
    collides = chance.random() < 0.6
    one = _unit(chance, seed)
    if units == 1 and kind in {"state", "open"}:
        one = one._replace(state="bootloader" if kind == "state" else "session")
    made = [one] if units == 1 else [one, _other(chance, kind, one, seed)]
    chance.shuffle(made)
    return World(
        seed,
        target_name,
        kind,
        tuple(made),
        packets=chance.choice((8, 30, 120)),
        collides=collides,
        faults=chance.choice((0.0, 0.0, 0.001, 0.01, 0.03) if collides else (0.0, 0.001)),
        starts_s=chance.random(),
        pause=(chance.randrange(300), chance.choice(PAUSES_S) if units == 1 else 0.0),
    )


def disturbed(seed: int, share: float) -> Disturbance:
    """A line that loses, doubles, damages and delays this share of the frames."""
    chance = random.Random(f"line/{seed}")
    held: list[Frame] = []

    def disturb(frame: Frame, _now: float) -> Sequence[Frame]:
        carried, held[:] = [*held], []
        if chance.random() >= share:
            return [frame, *carried]
        match chance.choice(("lost", "doubled", "damaged", "late")):
            case "lost":
                return carried
            case "doubled":
                return [frame, frame, *carried]
            case "damaged" if frame.data:
                at = chance.randrange(len(frame.data))
                flipped = bytes([frame.data[at] ^ 1 << chance.randrange(8)])
                data = frame.data[:at] + flipped + frame.data[at + 1 :]
                return [frame._replace(data=data), *carried]
        held.append(frame)
        return carried

    return disturb


def play(
    world: World,
    options: UpgradeOptions | None = None,
    wrap: Callable[[Engine], Engine] = lambda device: device,
) -> Judged:
    """Upgrade what is there with `flasher flash`, and judge it by the flash of every unit."""
    clock = VirtualClock()
    line = disturbed(world.seed, world.faults) if world.faults else None
    bitrate_bps = WELLING.bitrate_bps if world.collides else VIRTUAL_BPS
    bus = SimulatedBus(bitrate_bps, clock, line, collides=world.collides)
    chance = random.Random(f"latency/{world.seed}")
    units = [unit.make(world.target, chance) for unit in world.units]
    for unit, made in zip(units, world.units, strict=True):
        if made.state == "session":
            _leave_open(unit, world, clock)
    for unit in units:
        bus.attach(wrap(unit))
    before = [unit.device.erase_count for unit in units]
    image = image_of(world.packets)
    heard = Log()
    link = Pausing(bus.link(), *world.pause)
    connection = api.Connection(link, clock, "the simulated bus")
    waiting = bus.link()
    _wait(waiting, clock, world.starts_s)
    target = TARGETS[world.target]
    try:
        result: Result | FlasherError = connection.device(target).upgrade(
            plan(image, target, WELLING.bitrate_bps), options=options, taps=[heard]
        )
    except FlasherError as error:
        result = error
    _wait(waiting, clock, 8.0)
    return Judged(
        result,
        tuple(unit.device.stored_image == image.data for unit in units),
        tuple(unit.device.erase_count > count for unit, count in zip(units, before, strict=True)),
        tuple(_reports(unit, units, heard) for unit in units),
    )


_UPGRADE: Final = (Command.UPDATE, Command.PACKET, Command.END_OF_TRANSFER)


def _reports(unit: Slow, units: Sequence[Slow], heard: Log) -> int:
    """From the first update command on: what reached the host, is no general feedback (R15), no
    announcement before request transfer, right after it (R11) or after the end, and not the very
    message that the other unit sent in the same moment.
    """
    updates = [at for at, each in heard.sent if each.command == Command.UPDATE]
    requests = [at for at, each in heard.came if each.command == Command.REQUEST_TRANSFER]
    if not updates or not requests:
        return 0
    leftover_until = requests[0] + DEFAULT_TIMINGS.leftover_boot_version_s
    ended_at = max(at for at, each in heard.sent if each.command in _UPGRADE)
    others = [each for other in units if other is not unit for each in other.sent.came]
    return sum(
        message.command != Command.GENERAL_FEEDBACK
        and not (message.command == Command.BOOT_VERSION and not leftover_until < at < ended_at)
        and any(message == each and 0 <= then - at < 0.02 for then, each in heard.came)
        and not any(message == each and abs(then - at) < 0.0003 for then, each in others)
        for at, message in unit.sent.came
        if at > updates[0]
    )


def _wait(link: Link, clock: Clock, seconds: float) -> None:
    end = clock.now() + seconds
    while clock.now() < end:
        link.receive(end)


def _leave_open(unit: Slow, world: World, clock: VirtualClock) -> None:
    """An upgrade of this unit alone is broken off in its middle."""
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    bus.attach(unit)
    connection = api.Connection(bus.link(), clock, "the simulated bus")
    target = TARGETS[world.target]
    old: Image = image_of(max(world.packets, 4), seed=9)

    def is_halfway() -> bool:
        return unit.device.state is BootloaderState.TRANSFER and unit.device.program_count > 1

    with contextlib.suppress(FlasherError):
        connection.device(target).upgrade(
            plan(old, target, WELLING.bitrate_bps), cancelled=is_halfway
        )
