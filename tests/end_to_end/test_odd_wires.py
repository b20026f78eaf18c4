"""Host and device model on a wire where frames are held up, the device leaves the bus, somebody
else has its id, or the adapter is pulled out: the rest of the BU rows.
"""

from __future__ import annotations

import random

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import drive
from flasher.errors import BusError
from flasher.host.outcome import Outcome
from flasher.host.table import Ending
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING
from tests.end_to_end.world import upgrade
from tests.host.upgrade import Upgrade
from tests.loops import each
from tests.peers.wording import REPORT, build, payloads

IMAGE = random.Random(6).randbytes(300)
SMALL = DeviceProfile(application_area_bytes=16 * 1024)
FRAMES = range(76)
"""All that an undisturbed upgrade to this image puts on the bus."""
LATE_S = 0.15
"""Later than the frames of one message may follow each other (R12)."""


class Sender:
    """An engine that sends frames at the times that it was given."""

    done = False

    def __init__(self) -> None:
        self.due: list[tuple[float, Frame]] = []

    def receive(self, frame: Frame, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        pass

    def deadline(self) -> float | None:
        return self.due[0][0] if self.due else None

    def next_frame(self, now: float) -> Frame | None:
        return self.due[0][1] if self.due and self.due[0][0] <= now else None

    def frame_sent(self, now: float) -> None:
        self.due.pop(0)

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> list[object]:
        return []


def device_model(profile: DeviceProfile = SMALL) -> MockDevice:
    return MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)


def judge(outcome: Outcome, device: MockDevice) -> None:
    """The right image in any case; only the device's last word may be missed."""
    assert device.stored_image == IMAGE
    assert outcome.ok or outcome.ending is Ending.UNCONFIRMED


def test_the_frames_are_those_of_an_upgrade() -> None:
    carried: list[Frame] = []

    def count(frame: Frame, _now: float) -> list[Frame]:
        carried.append(frame)
        return [frame]

    assert upgrade(device_model(), image=IMAGE, disturbance=count).ok
    assert len(carried) == len(FRAMES)


@pytest.mark.slow
@pytest.mark.no_cover
@each("index", FRAMES)
def test_one_late_frame_anywhere_never_ends_in_a_wrong_image(index: int) -> None:
    """BU-01."""
    sender, seen = Sender(), iter(range(1_000_000))

    def hold(frame: Frame, now: float) -> list[Frame]:
        if next(seen) != index:
            return [frame]
        sender.due.append((now + LATE_S, frame))
        return []

    device = device_model()
    judge(upgrade(device, image=IMAGE, disturbance=hold, others=(sender,)), device)


@pytest.mark.slow
@pytest.mark.no_cover
@each("index", FRAMES)
def test_a_device_that_goes_bus_off_at_any_frame_is_upgraded_or_the_end_is_explicit(
    index: int,
) -> None:
    """BU-02."""
    device, seen = device_model(), iter(range(1_000_000))

    def go_off(frame: Frame, now: float) -> list[Frame]:
        if next(seen) == index:
            device.bus_off(now)
        return [frame]

    judge(upgrade(device, image=IMAGE, disturbance=go_off), device)


@pytest.mark.slow
@pytest.mark.no_cover
@each("index", FRAMES)
def test_somebody_who_speaks_with_the_devices_id_is_overcome_or_the_end_is_explicit(
    index: int,
) -> None:
    """BU-06: between any two frames, and so between those of an answer too."""
    sender, seen = Sender(), iter(range(1_000_000))
    ack = build(BMS.answer_id, REPORT, 0xC202, b"\x02\x00")

    def join_in(frame: Frame, now: float) -> list[Frame]:
        if next(seen) == index:
            sender.due += [(now, Frame(BMS.answer_id, part)) for part in payloads(ack)]
        return [frame]

    device = device_model()
    outcome = upgrade(device, image=IMAGE, disturbance=join_in, others=(sender,))
    if outcome.ending is Ending.TWO_DEVICES:  # the second ACK of packet 2
        assert outcome.device_left.needs_rescue
    else:
        judge(outcome, device)


class Puller(Sender):
    """Pulls the host's adapter out at a time."""

    def __init__(self, bus: SimulatedBus, at_s: float) -> None:
        super().__init__()
        self.bus, self.at_s = bus, at_s
        self.has_pulled = False

    def deadline(self) -> float | None:
        return None if self.has_pulled else self.at_s

    def tick(self, now: float) -> None:
        if not self.has_pulled and now >= self.at_s:
            self.has_pulled = True
            self.bus.unplug()


@each(
    "at_s",
    [0.0005, 0.03, 0.055, 0.5, 1.2, 1.25],
)
def test_an_adapter_that_is_pulled_out_ends_it_within_a_second(at_s: float) -> None:
    """BU-05: also while there is nothing to do but to wait."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    bus.attach(device_model(DeviceProfile(application_area_bytes=16 * 1024, erase_time_s=1.1)))
    bus.attach(Puller(bus, at_s))
    engine = Upgrade(plan(Image.from_bytes(bytes(2000)), BMS, WELLING.bitrate_bps))
    with pytest.raises(BusError, match="no such device"):
        drive(engine, bus.link(), clock)
    assert at_s <= clock.now() <= at_s + 1.0
