"""Host and device model on a bus that disturbs: BU, CO rows of the cases, and loss of power."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from math import inf

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome
from flasher.host.table import Ending
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, OBC, TARGETS, WELLING, WMC
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.end_to_end.world import Traffic, upgrade
from tests.host.upgrade import Upgrade
from tests.loops import each

IMAGE = random.Random(3).randbytes(300)
SMALL = DeviceProfile(application_area_bytes=16 * 1024)
"""Hundreds of devices are made here; a large flash takes time to make."""
VERSIONED = b"\x00\x50\x00\x20" + b"BMS\0V2r0r1_20260102\0" + random.Random(4).randbytes(200)


def device_model(target: str = "bms") -> MockDevice:
    return MockDevice(TARGETS[target], bitrate_bps=WELLING.bitrate_bps, profile=SMALL)


def frames_of_an_upgrade() -> int:
    """How many frames an undisturbed upgrade puts on the bus."""
    carried: list[Frame] = []

    def count(frame: Frame, _now: float) -> list[Frame]:
        carried.append(frame)
        return [frame]

    assert upgrade(device_model(), image=IMAGE, disturbance=count).ok
    return len(carried)


TOTAL = frames_of_an_upgrade()


def at(index: int, fate: Callable[[Frame], list[Frame]]) -> Callable[[Frame, float], list[Frame]]:
    """A disturbance of the frame with this index."""
    seen = iter(range(1_000_000))

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        return fate(frame) if next(seen) == index else [frame]

    return disturb


def judge(outcome: Outcome, device: MockDevice) -> None:
    """Right bytes, or an explicit end: what the device sends once may be missed."""
    if outcome.ending is Ending.NO_REQUEST:
        # Request transfer was damaged; the update command is never sent into silence (R2).
        assert device.stored_image is None
        assert outcome.device_left is DeviceLeft.PERHAPS_ERASED
        return
    assert device.stored_image == IMAGE
    # The final answer was damaged, and the image holds no version that could replace it.
    assert outcome.ok or outcome.ending is Ending.UNCONFIRMED


def flipped(frame: Frame) -> list[Frame]:
    return [frame._replace(data=bytes([frame.data[0] ^ 0x10]) + frame.data[1:])]


@pytest.mark.slow
@pytest.mark.no_cover
@each("index", range(TOTAL))
@each(
    "fate",
    [lambda _frame: [], lambda frame: [frame, frame], flipped],
)
def test_one_disturbed_frame_anywhere_never_ends_in_a_wrong_image(
    fate: Callable[[Frame], list[Frame]], index: int
) -> None:
    """BU-01: completes correctly or ends explicitly."""
    device = device_model()
    judge(upgrade(device, image=IMAGE, disturbance=at(index, fate)), device)


@pytest.mark.slow
@pytest.mark.no_cover
@each("index", range(TOTAL - 1))
def test_two_swapped_frames_anywhere_never_end_in_a_wrong_image(index: int) -> None:
    held: list[Frame] = []
    seen = iter(range(1_000_000))

    def swap(frame: Frame, _now: float) -> list[Frame]:
        number = next(seen)
        if number == index:
            held.append(frame)
            return []
        if number == index + 1:
            return [frame, held.pop()]
        return [frame]

    device = device_model()
    judge(upgrade(device, image=IMAGE, disturbance=swap), device)


@each("seed", range(20))
def test_a_bus_that_loses_frames_at_random_never_leads_to_a_wrong_image(seed: int) -> None:
    draw = random.Random(seed)
    device = device_model()
    outcome = upgrade(
        device,
        image=IMAGE,
        disturbance=lambda frame, _now: [frame] if draw.random() > 0.02 else [],
    )
    assert outcome.ok == (outcome.error() is None)
    assert device.stored_image == IMAGE or not outcome.ok


def test_two_devices_are_upgraded_on_one_bus_without_crosstalk() -> None:
    """CO-02: the other pair's whole traffic is on the same wire."""
    first, second = device_model("bms"), device_model("wmc")
    other_image = Image.from_bytes(random.Random(9).randbytes(500))
    other = Upgrade(plan(other_image, WMC, WELLING.bitrate_bps))
    outcome = upgrade(first, image=IMAGE * 3, others=(second, other))
    assert outcome.ok
    assert other.outcome.ok
    assert first.stored_image == IMAGE * 3
    assert second.stored_image == other_image.data


class Babbler:
    """Sends one id again and again, a given share of the time."""

    def __init__(self, frame: Frame, every_s: float) -> None:
        self._frame, self._every_s, self._next = frame, every_s, 0.0
        self._due = False

    done = False

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        self._due = True
        self._next = now + self._every_s

    def deadline(self) -> float | None:
        return -inf if self._due else self._next

    def next_frame(self, now: float) -> Frame | None:
        return self._frame if self._due else None

    def frame_sent(self, now: float) -> None:
        self._due = False

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> list[object]:
        return []


@pytest.mark.slow
@each("can_id", [0x001, 0x720, 0x7FF])
def test_other_traffic_at_high_load_changes_nothing_but_the_time(can_id: int) -> None:
    """CO-01: a frame of 8 bytes takes about 0.5 ms; 70 % and more of the bus are taken."""
    device = device_model()
    babbler = Babbler(Frame(can_id, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00"), every_s=0.0006)
    outcome = upgrade(device, image=IMAGE, others=(babbler,))
    assert outcome.ok
    assert device.stored_image == IMAGE


@each("target", ["wmc", "bms", "obc"])
def test_a_device_without_application_announces_on_and_is_upgraded(target: str) -> None:
    """R14."""
    device = MockDevice(TARGETS[target], bitrate_bps=WELLING.bitrate_bps, has_application=False)
    outcome = upgrade(device, target, IMAGE)
    assert outcome.ok
    assert device.stored_image == IMAGE


def test_three_upgrades_in_a_row_also_to_a_smaller_image() -> None:
    """EN-07."""
    device = device_model()
    for size in (300, 1000, 129):
        image = random.Random(size).randbytes(size)
        assert upgrade(device, image=image).ok
        assert device.stored_image == image


def test_the_version_answer_replaces_a_lost_final_answer() -> None:
    """It must show, 8: no second erase, done by the version answer."""
    traffic = Traffic()
    device = device_model()
    complete = bytes.fromhex("55AA0C04C5020000")

    def lose_complete(frame: Frame, _now: float) -> list[Frame]:
        return [] if frame.can_id == BMS.answer_id and frame.data == complete else [frame]

    outcome = upgrade(
        device, image=Image.from_bytes(VERSIONED), disturbance=lose_complete, traffic=traffic
    )
    assert outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert outcome.running_version == "V2r0r1_20260102"
    assert traffic.update_commands("bms") == 1
    assert device.stored_image == VERSIONED


def test_without_a_version_query_a_lost_final_answer_is_unconfirmed() -> None:
    traffic = Traffic()
    device = device_model("obc")
    complete = bytes.fromhex("55AA0C04C5020000")

    def lose_complete(frame: Frame, _now: float) -> list[Frame]:
        return [] if frame.can_id == OBC.answer_id and frame.data == complete else [frame]

    outcome = upgrade(device, "obc", IMAGE, disturbance=lose_complete, traffic=traffic)
    assert outcome.ending is Ending.UNCONFIRMED
    assert outcome.device_left is DeviceLeft.UNKNOWN
    assert traffic.update_commands("obc") == 1


def test_a_device_that_loses_power_is_reported_and_upgraded_when_it_comes_back() -> None:
    """A cut in the middle of the transfer; power comes back after the host has given up."""
    device = device_model()
    seen = 0

    def cut(frame: Frame, now: float) -> list[Frame]:
        nonlocal seen
        seen += 1
        if seen == TOTAL // 2:
            device.power_cut(now)
        return [frame]

    first = upgrade(device, image=IMAGE, disturbance=cut)
    assert first.ending is Ending.PACKET_FAILED
    assert first.device_left is DeviceLeft.NO_APPLICATION
    device.power_on(0.0)
    assert device.stored_image is None
    assert upgrade(device, image=IMAGE).ok
    assert device.stored_image == IMAGE


def test_an_upgrade_that_was_cancelled_in_the_middle_is_finished_by_the_same_command() -> None:
    """PW-03: the device times out and announces itself again."""
    device = device_model()
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    bus.attach(device)
    link = bus.link()
    planned = plan(Image.from_bytes(IMAGE), BMS, WELLING.bitrate_bps)
    first = Upgrade(planned)
    drive(first, link, clock, cancelled=lambda: device.program_count >= 1)
    assert first.outcome.ending is Ending.CANCELLED
    again = Upgrade(planned)
    drive(again, link, clock)
    assert again.outcome.ok
    assert device.stored_image == IMAGE


def test_slow_receivers_get_their_gaps() -> None:
    device = device_model()
    options = UpgradeOptions(frame_gap_s=0.002, packet_gap_s=0.01)
    outcome = upgrade(device, image=IMAGE, options=options)
    assert outcome.ok
    transfer_s = outcome.statistics.transfer_s
    assert transfer_s is not None
    assert transfer_s > 3 * (17 * 0.002 + 0.01)


@each("gap_s, is_named", [(0.005, False), (0.03, True)])
def test_an_unusual_gap_is_named_where_the_device_does_not_react(
    gap_s: float, *, is_named: bool
) -> None:
    timings = replace(DEFAULT_TIMINGS, inter_frame_timeout_s=0.004)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=SMALL, timings=timings)
    outcome = upgrade(device, image=IMAGE, options=UpgradeOptions(frame_gap_s=gap_s))
    assert outcome.ending is Ending.NO_BOOT_VERSION
    error = outcome.error()
    assert error is not None
    assert ("30 ms apart" in error.cause) is is_named
    assert ("Choose a shorter --frame-gap" in error.remedy) is is_named
