"""When a frame arrived: the kernel's stamp where there is one, on the monotonic clock."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator

import can
import pytest

from flasher.bus.adapter import CanLink
from flasher.bus.link import StampingLink
from flasher.conformance.real import RealPort
from flasher.protocol.frame import Frame

from .test_adapter import FakeBus, message

pytestmark = pytest.mark.skipif(platform.system() != "Linux", reason="Linux stamps the frames")
_LATE_S = 0.3


@pytest.fixture(name="bus")
def _bus() -> Iterator[FakeBus]:
    fake = FakeBus()
    yield fake
    fake.shutdown()


def stamped(age_s: float) -> can.Message:
    """A message that the kernel had `age_s` ago."""
    return message(timestamp=time.time() - age_s)


def test_a_frame_that_is_read_late_arrived_when_the_kernel_had_it(bus: FakeBus) -> None:
    link = CanLink(bus, "socketcan")
    assert isinstance(link, StampingLink)
    bus.inbox.append(stamped(_LATE_S))
    assert link.receive(0.0) is not None
    assert link.received_at == pytest.approx(time.perf_counter() - _LATE_S, abs=0.05)


def test_a_frame_that_came_while_the_queue_was_full_keeps_its_stamp(bus: FakeBus) -> None:
    link = CanLink(bus, "socketcan")
    bus.refusals.append(can.CanOperationError("Transmit buffer full"))
    bus.inbox += [stamped(_LATE_S), stamped(0.0)]
    link.send(Frame(0x752, b"\x01"))
    assert link.receive(0.0) is not None
    first_at = link.received_at
    assert link.receive(0.0) is not None
    assert first_at is not None
    assert link.received_at is not None
    assert link.received_at - first_at == pytest.approx(_LATE_S, abs=0.05)


@pytest.mark.parametrize("age_s", [3600.0, -3600.0])
def test_a_stamp_from_before_a_jump_of_the_wall_clock_is_not_believed(
    bus: FakeBus, age_s: float
) -> None:
    link = CanLink(bus, "socketcan")
    bus.inbox.append(stamped(age_s))
    assert link.receive(0.0) is not None
    assert link.received_at is None


def test_what_other_back_ends_put_into_that_field_is_not_used(bus: FakeBus) -> None:
    link = CanLink(bus, "pcan")
    bus.inbox.append(stamped(_LATE_S))
    assert link.receive(0.0) is not None
    assert (link.stamp_source, link.received_at) == ("", None)


def port_on(bus: FakeBus, interface: str, now: Callable[[], float]) -> RealPort:
    class Clock:
        speed = 1.0

        def now(self) -> float:
            return now()

        def wait_until(self, moment: float) -> None:
            raise AssertionError(moment)

    return RealPort(CanLink(bus, interface), Clock(), 250_000, echoes=False)


@pytest.mark.parametrize(
    ("interface", "source", "late_s"), [("socketcan", "kernel", _LATE_S), ("pcan", "host", 0.0)]
)
def test_the_suite_states_whose_time_stamps_it_has_and_uses_them(
    bus: FakeBus, interface: str, source: str, late_s: float
) -> None:
    opened_s = 1.0
    clock_is_early = iter([opened_s])
    port = port_on(bus, interface, lambda: next(clock_is_early, 0.0) or time.perf_counter())
    bus.inbox += [stamped(late_s), stamped(_LATE_S)]
    arrivals = [port.receive(0.0) for _ in range(2)]
    times = [arrival.at for arrival in arrivals if arrival is not None]
    assert port.timestamp_source == source
    assert times[0] == pytest.approx(time.perf_counter() - late_s, abs=0.05)
    assert times == sorted(times)
