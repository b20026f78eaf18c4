"""What befalls the host's adapter on the simulated bus, as real adapters tell it."""

from __future__ import annotations

import pytest

from flasher.bus.health import ControllerState
from flasher.bus.link import SEND_LIMIT_S, VirtualClock
from flasher.bus.simulated import DEFAULT_QUEUE_FRAMES, SimulatedBus, SimulatedLink
from flasher.errors import BusError, ExitCode, TransmitBlockedError
from flasher.protocol.frame import Frame
from tests.bus.test_simulated import BITRATE, Talker

FRAME = Frame(0x752, b"12345678")


class World:
    """A host's link, and a listener on the same bus."""

    def __init__(self, *frames: Frame) -> None:
        self.clock = VirtualClock()
        self.bus = SimulatedBus(BITRATE, self.clock)
        self.device = Talker(*frames)
        self.bus.attach(self.device)
        self.link: SimulatedLink = self.bus.link()

    def heard(self) -> int:
        return len(self.device.heard)


def test_a_link_is_healthy_unless_something_befell_it() -> None:
    world = World(Frame(0x725, b"x"))
    world.link.send(FRAME)
    assert world.link.receive(0.1) is not None
    health = world.link.health()
    assert health.state is ControllerState.ACTIVE
    assert (health.frames_sent, health.frames_received, health.error_frames) == (1, 1, 0)
    assert health.error() is None


# -- unplugged ------------------------------------------------------------------------------------


def test_an_unplugged_adapter_fails_in_both_directions_and_loses_what_was_queued() -> None:
    world = World()
    world.link.send(FRAME)
    world.bus.unplug()
    with pytest.raises(BusError, match="while sending") as caught:
        world.link.send(FRAME)
    assert caught.value.exit_code == ExitCode.BUS
    with pytest.raises(BusError, match="while receiving"):
        world.link.receive(1.0)
    assert world.heard() == 0


def test_it_cannot_be_opened_before_it_is_back_and_has_to_be_opened_then() -> None:
    world = World()
    world.bus.unplug()
    with pytest.raises(BusError, match="cannot be opened"):
        world.link.reopen()
    world.bus.plug()
    with pytest.raises(BusError, match="while sending"):
        world.link.send(FRAME)
    world.link.reopen()
    world.link.send(FRAME)
    world.link.receive(world.clock.now() + 0.1)
    assert world.heard() == 1
    assert world.link.health().frames_sent == 1


def test_it_comes_back_by_itself_when_somebody_waits_for_it() -> None:
    world = World()
    world.bus.unplug(back_after_s=0.25)
    tries = 0
    for _ in range(10):
        tries += 1
        try:
            world.link.reopen()
        except BusError:
            world.clock.wait_until(world.clock.now() + 0.1)
        else:
            break
    assert tries == 4
    world.link.send(FRAME)


def test_the_devices_go_on_while_it_is_out() -> None:
    world = World(Frame(0x725, b"lost"))
    listener = Talker()
    world.bus.attach(listener)
    world.bus.unplug()
    for _ in range(3):
        world.clock.wait_until(world.clock.now() + 0.1)
        with pytest.raises(BusError):
            world.link.reopen()
    assert len(listener.heard) == 1
    world.bus.plug()
    world.link.reopen()
    assert world.link.receive(world.clock.now() + 0.1) is None


# -- bus-off --------------------------------------------------------------------------------------


def test_bus_off_is_reported_and_sending_fails_with_it() -> None:
    world = World()
    world.bus.bus_off()
    world.link.send(FRAME)  # taken and lost, until the report has been read
    report = world.link.receive(0.1)
    assert report is not None
    assert report.is_error
    with pytest.raises(BusError, match="while sending") as caught:
        world.link.send(FRAME)
    assert "bus-off" in caught.value.cause
    assert world.link.health().state is ControllerState.BUS_OFF
    assert world.heard() == 0
    with pytest.raises(BusError):
        world.link.reopen()


def test_a_controller_that_restarts_by_itself_takes_part_again() -> None:
    world = World()
    world.bus.bus_off(restart_after_s=0.1)
    kinds = [world.link.receive(1.0), world.link.receive(1.0)]
    assert [frame and frame.can_id for frame in kinds] == [0x040, 0x100]
    assert world.clock.now() == pytest.approx(0.1)
    world.link.send(FRAME)
    world.link.receive(0.2)
    assert world.heard() == 1
    assert world.link.health().state is ControllerState.ACTIVE


# -- no node acknowledges -------------------------------------------------------------------------


def test_without_acknowledgement_nothing_leaves_and_linux_reports_error_passive() -> None:
    world = World(Frame(0x725, b"x"))
    world.bus.is_unacknowledged = True
    world.link.send(FRAME)
    reports = [world.link.receive(1.0), world.link.receive(1.0)]
    assert [r and (r.can_id, r.data[1], r.data[6]) for r in reports] == [
        (0x204, 0x08, 96),
        (0x204, 0x20, 128),
    ]
    assert 0.005 < world.clock.now() < 0.02  # 16 tries of a full frame at 250 kbit/s
    assert world.link.receive(1.0) is None
    health = world.link.health()
    assert health.state is ControllerState.PASSIVE
    assert health.not_acknowledged
    assert health.frames_received == 0
    assert world.heard() == 0


def test_the_queue_stays_full() -> None:
    world = World()
    world.bus.is_unacknowledged = True
    for _ in range(DEFAULT_QUEUE_FRAMES):
        world.link.send(FRAME)
    with pytest.raises(TransmitBlockedError) as caught:
        world.link.send(FRAME)
    assert "acknowledges" in caught.value.cause
    assert world.clock.now() == pytest.approx(SEND_LIMIT_S)
    assert world.link.health().not_acknowledged


def test_a_link_that_never_sent_does_not_complain() -> None:
    world = World()
    world.bus.is_unacknowledged = True
    assert world.link.receive(1.0) is None
    assert world.link.health().error() is None


def test_once_somebody_acknowledges_the_queue_leaves() -> None:
    world = World()
    world.bus.is_unacknowledged = True
    world.link.send(FRAME)
    while world.link.receive(0.5):
        pass
    assert world.bus.is_unacknowledged
    world.bus.is_unacknowledged = False
    while world.link.receive(1.0):
        pass
    ((carried_at, _),) = world.device.heard
    assert carried_at > 0.5  # not when it was queued
    assert world.link.health().state is ControllerState.ACTIVE


def test_drain_keeps_what_the_adapter_reported() -> None:
    world = World()
    world.bus.bus_off()
    world.bus.advance(0.1)
    assert world.link.drain() == 1
    assert world.link.health().error() is not None
