"""A whole bicycle on a simulated bus: its messages in 30 s, its bus load, upgrades meanwhile."""

from __future__ import annotations

import hashlib
from collections import Counter

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus, SimulatedLink
from flasher.driver import drive
from flasher.events import DeviceStateEntered, ImageStored
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.profile import DeviceProfile
from flasher.mock.system import System
from flasher.mock.table import BootloaderState
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, MOTINOVA, TARGETS, WELLING, WMC, Dialect, Node, Target
from tests.host.upgrade import Upgrade
from tests.loops import each
from tests.mock.bench import image_of
from tests.mock.talk import READ, WRITE, Talk
from tests.peers.wording import build, intact, payloads

DIALECTS = [WELLING, MOTINOVA]
IMAGE = image_of(40 * 128 - 5)


class Ear:
    """Puts frames together to messages, an id each."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[int, int]] = Counter()
        self.order: list[tuple[int, int]] = []
        self._partial: dict[int, bytes] = {}

    def __call__(self, frame: Frame, *, sent: bool = False, now: float = 0.0) -> None:
        wire = self._partial.pop(frame.can_id, b"") + frame.data
        if len(wire) < 4 or len(wire) < wire[3] + 9:
            self._partial[frame.can_id] = wire
            return
        assert intact(frame.can_id, wire)
        key = frame.can_id, int.from_bytes(wire[4:6], "big")
        self.counts[key] += 1
        self.order.append(key)


class Street:
    """A bicycle on a bus of its own."""

    def __init__(
        self, dialect: Dialect, target: Target = BMS, profile: DeviceProfile | None = None
    ) -> None:
        self.clock = VirtualClock()
        self.bus = SimulatedBus(dialect.bitrate_bps, self.clock)
        self.system = System(dialect, target, profile=profile or DeviceProfile())
        self.events: list[object] = []
        self.bus.attach(self.system, self.events.append)
        self.link: SimulatedLink = self.bus.link()
        self.ear = Ear()

    def powered(self) -> set[bool]:
        """Who has power: the bicycle as a whole, and each of its members."""
        members = self.system.members.values()
        return {self.system.has_power, *(member.has_power for member in members)}

    def say(self, command: int, data: bytes) -> None:
        """The tool writes something to the BMS."""
        for payload in payloads(build(0x752, WRITE, command, data)):
            self.link.send(Frame(0x752, payload))

    def listen(self, duration_s: float) -> None:
        end = self.clock.now() + duration_s
        while (frame := self.link.receive(end)) is not None:
            self.ear(frame)


ONCE_IN_BOTH = {
    (0x712, 0x3009): 1,
    (0x721, 0x3005): 1,
    (0x712, 0x3100): 1,
    (0x720, 0x160C): 1,
    (0x712, 0x3200): 1,
    (0x720, 0x170C): 1,
    (0x712, 0x3300): 1,
    (0x732, 0x5100): 1,
    (0x732, 0x5200): 1,
    (0x732, 0x5300): 1,
    (0x732, 0x5000): 30,
    (0x720, 0x1010): 30,
}
# Answers that several ask for.
SPEECH = {
    "welling": ONCE_IN_BOTH | {(0x720, 0x1410): 2, (0x720, 0x1540): 1, (0x720, 0x1120): 1},
    "motinova": ONCE_IN_BOTH
    | {
        (0x742, 0x5000): 1,
        (0x742, 0x5100): 1,
        (0x742, 0x5200): 6,
        (0x720, 0x1410): 3,
        (0x720, 0x1540): 2,
        (0x720, 0x1120): 7,
    },
}
LOAD_PERCENT = {"welling": 0.31, "motinova": 0.82}


@each("dialect", DIALECTS)
def test_in_30_s_every_question_is_asked_and_answered_and_the_bus_is_hardly_busy(
    dialect: Dialect,
) -> None:
    street = Street(dialect)
    street.listen(29.99)
    assert dict(street.ear.counts) == SPEECH[dialect.name]
    load_percent = 100 * street.bus.busy_s / street.clock.now()
    assert load_percent == pytest.approx(LOAD_PERCENT[dialect.name], abs=0.01)


@each("dialect", DIALECTS)
def test_the_key_shuts_the_whole_bicycle_down_and_power_wakes_it(dialect: Dialect) -> None:
    street = Street(dialect)
    street.listen(5.05)
    street.ear.order.clear()
    street.system.hold_key(street.clock.now())
    street.listen(0.2)
    ready = [(0x710, 0x1305), (0x730, 0x1405)]
    ready += [(0x740, 0x1305)] if dialect is MOTINOVA else [(0x710, 0x1808)]
    assert street.ear.order[0] == (0x720, 0x1308)
    assert sorted(street.ear.order[1:]) == sorted(ready)
    assert street.powered() == {True}
    street.listen(1.0)
    assert street.powered() == {False}
    street.ear.order.clear()
    street.listen(60.0)
    assert street.ear.order == []
    street.system.power_on(street.clock.now())
    street.listen(3.0)
    # Each device passes through its bootloader (R19); then the questions begin anew.
    assert [street.ear.order.count((can_id, 0xC109)) for can_id in (0x715, 0x725, 0x735)] == [4] * 3
    assert street.ear.order[-1] == (0x720, 0x1010)


@each("target", TARGETS.values())
def test_each_device_is_upgraded_while_the_others_talk(target: Target) -> None:
    street = Street(WELLING, target)
    street.listen(2.05)
    planned = plan(Image.from_bytes(IMAGE), target, WELLING.bitrate_bps)
    engine = Upgrade(planned)
    street.ear.counts.clear()
    drive(engine, street.link, street.clock, taps=[street.ear])
    assert engine.outcome.error() is None
    street.listen(3.0)
    assert street.system.device.stored_image == IMAGE
    stored = [event for event in street.events if isinstance(event, ImageStored)]
    assert stored == [ImageStored(len(IMAGE), hashlib.sha256(IMAGE).hexdigest())]
    talk = Counter({key: n for key, n in street.ear.counts.items() if key[0] >> 4 & 7 != 5})
    assert talk[0x720, 0x1010] >= 2
    # Whoever is in its bootloader does not talk; whoever has restarted begins anew.
    assert talk[0x712, 0x3009] == (1 if target is WMC else 0)


def test_a_bms_that_is_being_upgraded_answers_no_query_and_afterwards_all() -> None:
    street = Street(WELLING, profile=DeviceProfile(pause_in_transfer="waits"))
    street.listen(2.05)
    street.say(0x4205, b"RESET")
    street.listen(0.15)
    street.say(0xA10B, b"BMS_UPD" + (128).to_bytes(4, "little"))
    street.listen(0.5)
    assert street.system.device.state is BootloaderState.TRANSFER
    street.ear.counts.clear()
    street.listen(10.0)
    assert street.ear.counts[0x720, 0x1010] == 0
    # Five copies in a second, then it waits for the next time that it wants to know.
    assert street.ear.counts[0x732, 0x5000] == 25
    street.say(0xA385, b"\x01\x01\x00\x01\x00" + b"V3r1r4_20260203".ljust(128, b"\x00"))
    street.listen(0.1)
    street.say(0xA401, b"\x04")
    street.listen(2.5)
    street.ear.counts.clear()
    street.listen(10.0)
    assert street.ear.counts[0x720, 0x1010] == street.ear.counts[0x732, 0x5000] == 10


def test_only_the_target_s_events_are_reported() -> None:
    street = Street(WELLING, WMC)
    street.listen(1.0)
    states = [event for event in street.events if isinstance(event, DeviceStateEntered)]
    assert states == [DeviceStateEntered("application", "version V1r0r0_20220512")]


def test_the_profile_is_the_batterys_too_and_the_dialect_is_the_systems() -> None:
    profile = DeviceProfile(serial_number="W1", silent_queries="3800")
    talk = Talk(System(MOTINOVA, WMC, profile=profile))
    talk.run(2.0)  # the bicycle's own questions of its start are no echoes any more
    assert talk.ask(0x752, READ, 0x3800) == []
    (answer,) = talk.ask(0x742, READ, 0x5000)
    assert answer.data[16:32] == b"W1.             "
    assert talk.ask(0x752, READ, 0x3700)[0].can_id == 0x725


class _Echoed(System):
    """On an adapter that gives back what it was given to send."""

    def frame_sent(self, now: float) -> None:
        frame = self.next_frame(now)
        super().frame_sent(now)
        if frame is not None:
            self.receive(frame._replace(is_echo=True), now)


@each("dialect", DIALECTS)
def test_a_bus_that_gives_own_frames_back_is_answered_once(dialect: Dialect) -> None:
    reported = []
    for build_system in (System, _Echoed):
        talk = Talk(build_system(dialect))
        talk.run(10.0)
        reported.append(Counter((heard.can_id, heard.command) for heard in talk.take()))
    assert reported[0] == reported[1]
    assert reported[0][0x720, 0x1010] > 5


def test_a_device_without_an_application_announces_itself_while_the_others_talk() -> None:
    talk = Talk(System(WELLING, WMC, has_application=False))
    talk.run(1.02)
    commands = Counter((heard.can_id, heard.command) for heard in talk.take())
    assert commands[0x715, 0xC109] >= 20
    assert commands[0x712, 0x3009] == 0
    assert commands[0x720, 0x1010] == 2


def test_frames_of_the_members_take_turns_and_each_message_stays_in_order() -> None:
    system = System(MOTINOVA)
    ear, senders = Ear(), []
    system.tick(1000.0)
    for _ in range(400):
        frame = system.next_frame(1000.0)
        if frame is None:
            break
        assert system.next_frame(1000.0) == frame
        system.frame_sent(1000.0)
        ear(frame)
        senders.append(frame.can_id >> 4 & 7)
        system.tick(1000.0)
    assert ear.counts[0x720, 0x1540] == 2
    assert senders[:3] == [1, 3, 4]
    assert system.deadline() is not None


def test_a_frame_that_no_one_gave_out_is_not_missed() -> None:
    system = System(WELLING)
    system.frame_sent(1000.0)
    system.power_cut(1000.0)
    assert system.next_frame(1000.0) is None
    assert system.deadline() is None
    assert not system.done


def test_power_that_is_on_already_restarts_no_device() -> None:
    street = Street(WELLING)
    street.listen(3.0)
    street.ear.counts.clear()
    street.system.power_on(street.clock.now())
    street.listen(3.0)
    assert [street.ear.counts[can_id, 0xC109] for can_id in (0x715, 0x725, 0x735)] == [0] * 3


def test_cancelling_ends_all_members() -> None:
    system = System(WELLING)
    system.tick(1000.0)
    system.cancel(1000.0)
    while (system.next_frame(1000.0)) is not None:
        system.frame_sent(1000.0)
    assert system.done
    assert system.deadline() is None


def test_what_cannot_be_upgraded_is_no_target() -> None:
    with pytest.raises(TypeError, match="cannot be upgraded"):
        System(MOTINOVA, Target(Node.HMI, "HMI_UPD", "HMI", has_version_query=False))
