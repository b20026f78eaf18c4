"""Other traffic on the bus while a device is flashed: nothing fails, nothing is sent into it."""

from __future__ import annotations

import pytest

from flasher import api, events
from flasher.errors import ExitCode
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.protocol.bittime import frame_bits
from flasher.protocol.engine import Engine, Tap
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, OBC, WELLING, WMC
from tests.end_to_end.stage import IMAGE, NEW, SMALL, Speaker, Stage, image_of
from tests.host.upgrade import Upgrade
from tests.loops import each


def data(text: str) -> bytes:
    return bytes.fromhex(text)


CANOPEN = (
    Frame(0x000, data("0100")),  # NMT: start all nodes
    Frame(0x080, b""),  # SYNC
    Frame(0x185, data("1122334455667788")),  # PDO
    Frame(0x605, data("4018100400000000")),  # SDO request
    Frame(0x585, data("4318100478563412")),  # SDO answer
    Frame(0x701, data("05")),  # heartbeat
    Frame(0x725, data("05")),  # heartbeat of node 0x25: the id on which the BMS answers
    Frame(0x7E5, data("0400000000000000")),  # LSS
)
XCP = (
    Frame(0x750, data("FF00")),  # CONNECT
    Frame(0x755, data("FF15000808000101")),  # its positive answer
    Frame(0x750, data("F50412345678")),
)
UDS = (
    Frame(0x7DF, data("02010C5555555555")),
    Frame(0x7E0, data("0322F19055555555")),
    Frame(0x7E8, data("101462F190574155")),
    Frame(0x7E0, data("3000000000000000")),
    Frame(0x7E8, data("21555A5A5A385832")),
    Frame(0x720, data("037F223155555555")),  # on the id of the BMS's broadcasts
)
OTHER_KINDS = (
    Frame(0x752, data("55AA1604A1"), is_extended=True),  # our id's number, 29 bits
    Frame(0x725, data("55AA0C04C502"), is_extended=True),
    Frame(0x18FF50E5, data("0102030405060708"), is_extended=True),
    Frame(0x752, b"", is_remote=True),
    Frame(0x725, b"", is_remote=True),
    Frame(0x720, b"", is_remote=True),
)
NEIGHBOURS = tuple(
    Frame(can_id, data("55AA0C04C50200"))
    for can_id in (0x712, 0x732, 0x742, 0x745, 0x751, 0x753, 0x754, 0x726, 0x735)
)


class Ids:
    """A tap: what the host has sent, and the share of the bus that others took."""

    def __init__(self) -> None:
        self.sent: set[int] = set()
        self.received: list[Frame] = []

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent:
            self.sent.add(frame.can_id)
        else:
            self.received.append(frame)


def flash(stage: Stage, *others: Engine, taps: tuple[Tap, ...] = ()) -> Ids:
    """A session beside `others`; it must end well and must speak on one id only."""
    for engine in others:
        stage.bus.attach(engine)
    ids = Ids()
    result = stage.flash(taps=(ids, *taps))
    assert result.exit_code == ExitCode.OK
    assert result.running_version in (NEW, None)
    assert stage.has == IMAGE.data
    assert ids.sent == {stage.target.request_id}
    assert {frame.can_id for frame in stage.heard} == {stage.target.request_id}
    return ids


@each("target", ["bms", "obc"])
@each(
    "frames",
    [CANOPEN, XCP, UDS, OTHER_KINDS],
)
def test_other_protocols_on_the_bus_are_nothing_to_an_upgrade(
    target: str, frames: tuple[Frame, ...]
) -> None:
    ids = flash(Stage(target), Speaker(*frames, every_s=0.002))
    assert {frame.can_id for frame in frames} <= {frame.can_id for frame in ids.received}


def test_neighbours_of_our_ids_are_neither_taken_for_the_device_nor_for_a_second_tool() -> None:
    flash(Stage(), Speaker(*NEIGHBOURS, every_s=0.001))


@pytest.mark.slow
@each("can_id, load", [(0x001, 0.7), (0x723, 0.7), (0x7FF, 0.7), (0x001, 0.9)])
def test_a_bus_that_others_use_to_70_percent_and_more_makes_it_slower_only(
    can_id: int, load: float
) -> None:
    stage = Stage()
    frame = Frame(can_id, data("0102030405060708"))
    frame_s = frame_bits(frame) / WELLING.bitrate_bps
    flash(stage, Speaker(frame, every_s=frame_s / load))
    if can_id == 0x001:  # above all others: it gets what it wants
        assert stage.bus.busy_s / stage.clock.now() > load * 0.95


def test_error_frames_of_the_adapter_are_no_traffic() -> None:
    """As SocketCAN reports a disturbed line that works all the same."""
    stage = Stage()
    report = Frame(0x088, data("0000020000000000"), is_error=True)
    ids = flash(stage, Speaker(report, every_s=0.003))
    assert any(frame.is_error for frame in ids.received)


def test_two_other_pairs_are_upgraded_at_the_same_time_and_do_not_notice_each_other() -> None:
    """Other tools upgrade other devices: they speak as CDL too, but not to ours."""
    stage = Stage("bms")
    pairs = []
    for target, version in ((WMC, "V5r0r0_20260101"), (OBC, "V6r0r0_20260101")):
        device = MockDevice(target, bitrate_bps=WELLING.bitrate_bps, profile=SMALL)
        image = image_of(3, version, seed=target.request_id)
        pairs.append((device, Upgrade(plan(image, target, WELLING.bitrate_bps)), image))
    flash(stage, *(engine for device, host, _ in pairs for engine in (device, host)))
    stage.wait(5.0)
    for device, host, image in pairs:
        assert host.outcome.ok
        assert device.stored_image == image.data


def test_a_whole_bicycle_talks_while_its_battery_is_flashed() -> None:
    stored: list[object] = []
    ids = Ids()
    with api.connect_mock("bms", speed=0, system=True, on_event=stored.append) as connection:
        planned = plan(IMAGE, BMS, WELLING.bitrate_bps)
        result = connection.device().upgrade(planned, taps=[ids])
    assert result.exit_code == ExitCode.OK
    assert ids.sent == {0x752}
    assert {frame.can_id for frame in ids.received} > {0x720, 0x725}
    assert events.ImageStored(IMAGE.size_bytes, IMAGE.sha256) in stored


def test_queries_of_other_nodes_are_answered_to_them_and_are_no_second_device() -> None:
    """The OBC asks for the version too: the same answer comes twice."""
    ask = Frame(0x732, data("55AA110251000000"))
    stage = Stage()
    flash(stage, Speaker(ask, every_s=0.01))
    assert not stage.seen(events.AttemptStarted)


class Flood(Speaker):
    """Takes the whole bus, until a time."""

    def __init__(self, stage: Stage, lasts_s: float) -> None:
        now = stage.clock.now()
        super().__init__(Frame(0x000, bytes(8)), every_s=0.0001, begins_at=now)
        self._clock, self._ends_at = stage.clock, now + lasts_s

    def deadline(self) -> float | None:
        return None if self._clock.now() > self._ends_at else super().deadline()


@each("lasts_s", [0.3, 1.5])
def test_a_bus_that_is_full_for_a_while_in_the_transfer_is_waited_for(lasts_s: float) -> None:
    """Not a single bit time is free, in the middle of a packet."""
    stage = Stage()
    stage.at_packet[2] = lambda: stage.bus.attach(Flood(stage, lasts_s))
    flash(stage)


def test_a_slow_adapter_queue_is_no_reason_to_repeat() -> None:
    stage = Stage()
    stage.queue_frames = 2
    flash(stage, Speaker(Frame(0x001, bytes(8)), every_s=0.0008))
    assert not stage.seen(events.MessageRepeated)
