"""Faults to the moment: power cuts in the middle of a flash operation, and bus-off (PW, BU-02)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from flasher.events import DeviceStateEntered
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import Outcome
from flasher.mock.faults import AtTime, FaultInjector, InOperation, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING
from tests.end_to_end import world
from tests.loops import each
from tests.mock.bench import image_of
from tests.mock.talk import READ, WRITE, Talk
from tests.mock.tool import Tool

PROFILE = DeviceProfile(application_area_bytes=8 * 1024)
IMAGE = image_of(600)
ERASES = 2
"""The record's page and one of the application."""
OPERATIONS = ERASES + 5 + 1
UPDATE_FRAMES = 3


def make_device() -> MockDevice:
    return MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=PROFILE)


def device_in_transfer(stored: int) -> Tool:
    tool = Tool(make_device())
    tool.transfer(IMAGE, stored)
    return tool


def upgrade(engine: Engine, attempts_left: int = 3) -> Outcome:
    """flasher's own host, again until the device has the image."""
    outcome = world.upgrade(engine, image=IMAGE, options=UpgradeOptions())
    if not outcome.ok and attempts_left:
        return upgrade(engine, attempts_left - 1)
    return outcome


# -- looking into the flash -----------------------------------------------------------------------


def test_readback_is_the_application_area_whole_or_torn() -> None:
    tool = device_in_transfer(2)
    assert tool.device.stored_image is None
    assert tool.device.readback()[:256] == IMAGE[:256]
    assert tool.device.readback()[:257][256:] == b"\xff"
    assert len(tool.device.readback()) == 8 * 1024
    assert tool.device.readback()[:256] == IMAGE[:256]


def test_flash_operations_can_be_followed_from_outside() -> None:
    tool = device_in_transfer(0)
    device = tool.device
    assert device.operations_done == ERASES
    assert device.operation_reaches(0.5) is None
    tool.packet(1, IMAGE)
    assert device.operations_done == ERASES + 1
    tool.end()
    assert device.operations_done == ERASES + 1


def test_an_operation_under_way_reports_when_it_is_half_done() -> None:
    tool = Tool(make_device())
    tool.boot()
    tool.update(600)
    began_at = tool.now
    reaches = tool.device.operation_reaches
    assert reaches(0.0) == began_at
    assert reaches(0.5) == pytest.approx(began_at + 0.001)
    assert reaches(1.0) == pytest.approx(began_at + 0.002)


# -- power cuts -----------------------------------------------------------------------------------


@each("share", [0.0, 0.5, 1.0])
@each("operation", range(OPERATIONS))
def test_a_power_cut_in_any_operation_leaves_the_old_image_none_or_the_new_and_a_way_back(
    operation: int, share: float
) -> None:
    """PW-01."""
    device = make_device()
    factory = device.stored_image
    injector = FaultInjector(device)
    injector.set(PowerCut(), InOperation(operation, share))
    world.upgrade(injector, image=IMAGE)
    assert injector.cuts_done == 1
    assert not injector.is_set
    assert device.stored_image in {factory, None, IMAGE}
    assert upgrade(injector).ok
    assert device.stored_image == IMAGE


def test_the_cut_comes_when_that_share_of_the_operation_is_done() -> None:
    device = make_device()
    injector = FaultInjector(device)
    # The third packet: two are whole, of the third half is there.
    injector.set(PowerCut(off_s=None), InOperation(ERASES + 2, 0.5))
    world.upgrade(injector, image=IMAGE, linger_s=0.0)
    assert device.state is BootloaderState.OFF
    assert device.operations_done == ERASES + 2
    assert device.readback()[:256] == IMAGE[:256]
    torn = device.readback()[:384][256:]
    assert torn[:64] == IMAGE[256:320]
    assert torn[72:] == b"\xff" * 56


def test_a_moment_that_never_comes_cuts_nothing() -> None:
    device = make_device()
    injector = FaultInjector(device)
    injector.set(PowerCut(), InOperation(OPERATIONS))
    assert world.upgrade(injector, image=IMAGE).ok
    assert injector.is_set
    assert injector.cuts_done == 0
    injector.clear()
    assert not injector.is_set


class AfterFrame(FaultInjector):
    """Lets a fault happen when the device has received so many frames."""

    def __init__(
        self, device: MockDevice, frames: int, fault: Callable[[AfterFrame, float], None]
    ) -> None:
        super().__init__(device)
        self._frames_left = frames
        self._fault = fault

    def receive(self, frame: Frame, now: float) -> None:
        super().receive(frame, now)
        self._frames_left -= frame.can_id == self.device.target.request_id
        if not self._frames_left:
            self._frames_left = -1
            self._fault(self, now)

    @property
    def has_happened(self) -> bool:
        return self._frames_left < 0


@each("frames", [1, UPDATE_FRAMES + 2, UPDATE_FRAMES + 2 + 40])
def test_a_power_cut_at_a_received_frame_is_survived(frames: int) -> None:
    """PW-01. The reset has two frames of its own."""
    device = make_device()
    injector = AfterFrame(device, frames, lambda it, now: it.set(PowerCut(), AtTime(now + 0.0002)))
    world.upgrade(injector, image=IMAGE)
    assert injector.cuts_done == 1
    assert upgrade(injector).ok
    assert device.stored_image == IMAGE


def test_power_that_was_cut_for_good_stays_off() -> None:
    device = make_device()
    talk = Talk(FaultInjector(device))
    assert isinstance(talk.engine, FaultInjector)
    talk.engine.set(PowerCut(off_s=None), AtTime(talk.now + 1.0))
    talk.run(0.99)
    assert talk.ask(0x752, READ, 0x3300) != []
    talk.run(100.0)
    assert talk.ask(0x752, READ, 0x3300) == []
    assert not device.has_power


def test_power_comes_back_after_its_time_and_the_device_announces_itself() -> None:
    device = make_device()
    talk = Talk(FaultInjector(device))
    assert isinstance(talk.engine, FaultInjector)
    talk.engine.set(PowerCut(off_s=2.0), AtTime(talk.now + 1.0))
    talk.run(5.0)
    assert [round(at_s, 3) for at_s in talk.times_of(0x725, 0xC109)] == [3.05, 3.1, 3.15, 3.2]
    states = [event.state for event in talk.events if isinstance(event, DeviceStateEntered)]
    assert states == ["application", "off", "restarting", "announcing", "application"]


# -- bus-off --------------------------------------------------------------------------------------


def test_off_the_bus_nothing_is_received_and_nothing_is_reported() -> None:
    device = make_device()
    talk = Talk(device)
    device.bus_off(talk.now, 0.5)
    seen = [device.is_off_bus]
    assert talk.ask(0x752, READ, 0x3300) == []
    talk.run(0.49)
    assert talk.ask(0x752, WRITE, 0x4205, b"RESET") == []
    talk.run(0.02)
    seen.append(device.is_off_bus)
    assert seen == [True, False]
    assert device.state is BootloaderState.APPLICATION
    assert talk.ask(0x752, READ, 0x3300) != []


def test_what_was_half_sent_is_lost_and_what_the_device_does_meanwhile_goes_on() -> None:
    tool = Tool(make_device())
    tool.boot()
    device = tool.device
    tool.run(0.05)
    first = device.next_frame(tool.now)
    assert first is None
    tool.update(600)
    device.bus_off(tool.now, 0.05)
    tool.run(0.1)
    assert tool.heard("request") == []
    # It erased and waits for packet 1; another update command gets its request again.
    assert device.state is BootloaderState.TRANSFER
    tool.update(600)
    tool.run(0.001)
    assert tool.heard() == ["request"]


def test_a_power_cut_ends_bus_off() -> None:
    tool = Tool(make_device())
    tool.device.bus_off(tool.now, 1000.0)
    tool.cycle_power()
    tool.run(1.0)
    assert len(tool.heard("version")) == 4


@each("frames", (1, 2, 4, 5, 13, 23, 24, 95, 96, 97))
def test_bus_off_at_any_frame_is_survived(frames: int) -> None:
    """BU-02."""
    device = make_device()
    injector = AfterFrame(device, frames, lambda it, now: it.device.bus_off(now))
    outcome = world.upgrade(injector, image=IMAGE)
    assert injector.has_happened
    assert not outcome.ok or device.stored_image == IMAGE
    assert upgrade(injector).ok
    assert device.stored_image == IMAGE
