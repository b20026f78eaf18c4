"""The python-can adapter: what back ends do to their users, and what `CanLink` makes of it."""

from __future__ import annotations

import configparser
import contextlib
import errno
import sys
import time
import uuid
from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import can
import pytest

from flasher.bus import adapter
from flasher.bus.adapter import CanLink, open_adapter
from flasher.bus.detect import DetectedAdapter
from flasher.bus.health import ControllerState
from flasher.bus.inspect_interface import Interface, Unseen
from flasher.bus.link import AT_ONCE, SEND_LIMIT_S
from flasher.errors import BusError, ErrorCode, ExitCode, TransmitBlockedError, UsageError
from flasher.protocol.frame import Frame
from tests.loops import each

FRAME = Frame(0x752, b"\x55\xaa\x16\x07")


class FakeBus(can.BusABC):
    """A back end whose answers are given; `sent` is what it took."""

    def __init__(self) -> None:
        self.sent: list[can.Message] = []
        self.refusals: deque[Exception] = deque()
        self.inbox: deque[can.Message | Exception | None] = deque()
        self.channel_info = "fake channel"
        self.send_options: list[float | None] = []
        super().__init__(channel="fake")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.send_options.append(timeout)
        if self.refusals:
            raise self.refusals.popleft()
        self.sent.append(msg)
        # As gs_usb does: pads what it was given.
        msg.data.extend(bytes(8 - len(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self.inbox:
            return None, False
        item = self.inbox.popleft()
        if isinstance(item, Exception):
            raise item
        return item, False


@pytest.fixture
def bus() -> Any:
    fake = FakeBus()
    yield fake
    fake.shutdown()


def message(can_id: int = 0x725, data: bytes = b"\x01", **flags: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **flags})


# -- sending --------------------------------------------------------------------------------------


def test_every_frame_is_a_fresh_message_since_back_ends_alter_them(bus: FakeBus) -> None:
    link = CanLink(bus, "gs_usb")
    link.send(FRAME)
    link.send(FRAME)
    assert bus.sent[0] is not bus.sent[1]
    assert FRAME.data == b"\x55\xaa\x16\x07"
    assert not bus.sent[0].is_extended_id


FULL_QUEUES = [
    ("socketcan", can.CanOperationError("Failed to transmit: No buffer space", errno.ENOBUFS)),
    ("socketcan", can.CanOperationError("Transmit buffer full")),
    ("kvaser", can.CanOperationError("Function canWrite failed - Transmit buffer overflow", -13)),
    ("kvaser", can.CanOperationError("?", -13)),
    ("vector", can.CanOperationError("xlCanTransmit failed", 11)),
    ("pcan", can.CanOperationError("Failed to send: The transmit queue is full")),
    ("pcan", can.CanOperationError("The transmit buffer in CAN controller is full")),
    ("ixxat", can.CanOperationError("VCI_E_TXQUEUE_FULL")),
    ("systec", can.CanOperationError("Transmit queue is full", 0x80)),
]


@pytest.mark.parametrize(("interface", "error"), FULL_QUEUES)
def test_a_full_transmit_queue_is_waited_for_whatever_the_back_end_calls_it(
    bus: FakeBus, interface: str, error: Exception
) -> None:
    bus.refusals.extend([error] * 3)
    CanLink(bus, interface).send(FRAME)
    assert len(bus.sent) == 1


def test_frames_that_arrive_while_the_queue_is_full_are_kept_in_order(bus: FakeBus) -> None:
    bus.refusals.extend([can.CanOperationError("full", errno.ENOBUFS)] * 2)
    bus.inbox.extend([message(data=b"a"), message(data=b"b"), message(data=b"c")])
    link = CanLink(bus, "socketcan")
    link.send(FRAME)
    received = [link.receive(0.0) for _ in range(3)]
    assert [frame.data for frame in received if frame] == [b"a", b"b", b"c"]


def test_a_queue_that_stays_full_ends_with_an_error_in_bounded_time(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.bus.adapter.SEND_LIMIT_S", 0.02)
    bus.refusals.extend([can.CanOperationError("full", errno.ENOBUFS)] * 1_000_000)
    with pytest.raises(TransmitBlockedError, match="took no frame") as caught:
        CanLink(bus, "socketcan").send(FRAME)
    assert caught.value.exit_code == ExitCode.BUS
    assert "acknowledges" in str(caught.value)


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN),
        can.CanOperationError("Failed to transmit: No such device", errno.ENODEV),
        OSError(errno.ENODEV, "unplugged"),
        can.CanOperationError("bus off", 1),
    ],
)
def test_any_other_transmit_error_is_the_adapters_failure(bus: FakeBus, error: Exception) -> None:
    bus.refusals.append(error)
    with pytest.raises(BusError, match="failed while sending") as caught:
        CanLink(bus, "socketcan", "can3").send(FRAME)
    assert not isinstance(caught.value, TransmitBlockedError)
    assert caught.value.where == "socketcan can3"
    assert ("it is bus-off" in caught.value.cause) == ("bus off" in str(error))


def test_only_a_serial_adapter_gets_a_send_timeout(bus: FakeBus) -> None:
    CanLink(bus, "slcan").send(FRAME)
    CanLink(bus, "socketcan").send(FRAME)
    assert bus.send_options == [SEND_LIMIT_S, None]


# -- receiving ------------------------------------------------------------------------------------


def test_the_kinds_of_frames_are_distinguished(bus: FakeBus) -> None:
    bus.inbox.extend(
        [
            message(0x725, b"\x01\x02"),
            message(0x18DA00F1, b"\x01", is_extended_id=True),
            message(0x725, b"", is_remote_frame=True),
            message(0x725, b"\x01", is_error_frame=True),
        ]
    )
    link = CanLink(bus, "fake")
    assert [link.receive(0.0) for _ in range(4)] == [
        Frame(0x725, b"\x01\x02"),
        Frame(0x18DA00F1, b"\x01", is_extended=True),
        Frame(0x725, b"", is_remote=True),
        Frame(0x725, b"\x01", is_error=True),
    ]


def test_can_fd_frames_are_no_part_of_this_bus(bus: FakeBus) -> None:
    bus.inbox.extend([message(0x725, bytes(12), is_fd=True), message(0x725, b"\x01")])
    link = CanLink(bus, "fake")
    assert link.receive(time.perf_counter() + 1.0) == Frame(0x725, b"\x01")


def test_filters_that_the_back_end_leaves_to_python_can_hold(bus: FakeBus) -> None:
    bus.set_filters([{"can_id": 0x725, "can_mask": 0x7FF, "extended": False}])
    bus.inbox.extend([message(0x123), message(0x725)])
    assert CanLink(bus, "fake").receive(time.perf_counter() + 1.0) == Frame(0x725, b"\x01")


def test_a_receive_error_is_the_adapters_failure(bus: FakeBus) -> None:
    bus.inbox.append(can.CanOperationError("Failed to receive: Network is down"))
    with pytest.raises(BusError, match="failed while receiving"):
        CanLink(bus, "socketcan").receive(0.0)


def test_a_jump_of_the_wall_clock_does_not_lengthen_a_receive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """TM-04: python-can's own recv() would wait for an hour here."""
    wall = iter([1000.0] + [-2600.0] * 1000)
    monkeypatch.setattr("can.bus.time", lambda: next(wall))
    link = open_adapter(250_000, interface="virtual", channel=uuid.uuid4().hex)
    began = time.perf_counter()
    assert link.receive(began + 0.01) is None
    assert time.perf_counter() - began < 1.0
    link.close()


def test_a_back_end_with_its_own_recv_is_used_as_it_is() -> None:
    class Legacy(FakeBus):
        def recv(self, timeout: float | None = None) -> can.Message | None:
            return message(0x725, b"legacy")

    legacy = Legacy()
    assert CanLink(legacy, "fake").receive(0.0) == Frame(0x725, b"legacy")
    legacy.shutdown()


def test_drain_throws_away_what_waits_and_is_bounded(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus.inbox.extend(message() for _ in range(5))
    link = CanLink(bus, "fake")
    assert link.drain() == 5
    monkeypatch.setattr(adapter, "_DRAIN_FRAMES", 10)
    bus.inbox.extend(message() for _ in range(50))
    assert link.drain() == 10


def test_closing_twice_or_after_unplugging_is_harmless(bus: FakeBus) -> None:
    link = CanLink(bus, "fake")
    bus.shutdown = lambda: (_ for _ in ()).throw(OSError("gone"))  # type: ignore[method-assign]
    link.close()
    del bus.shutdown
    link.close()
    link.close()


# -- opening --------------------------------------------------------------------------------------


@pytest.fixture
def no_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can finds no configuration file and no CAN_* variables."""
    monkeypatch.setattr("can.util.load_file_config", lambda *_args: {})
    monkeypatch.setattr("can.util.load_environment_config", lambda *_args: {})


@pytest.mark.usefixtures("no_configuration")
def test_the_bit_rate_is_the_dialects_unless_somebody_names_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[dict[str, Any]] = []

    def open_bus(**config: Any) -> FakeBus:
        seen.append(config)
        return FakeBus()

    monkeypatch.setattr("can.Bus", open_bus)
    open_adapter(250_000, interface="virtual", channel="a").close()
    open_adapter(250_000, interface="virtual", channel="a", bitrate=125_000).close()
    assert [int(config["bitrate"]) for config in seen] == [250_000, 125_000]
    assert all(config["ignore_config"] for config in seen)


@pytest.mark.usefixtures("no_configuration")
def test_no_adapter_configured_names_the_fix() -> None:
    with pytest.raises(BusError, match="No adapter is configured") as caught:
        open_adapter(250_000)
    assert "-i socketcan -c can0" in str(caught.value)
    assert "--mock" in str(caught.value)


@pytest.mark.usefixtures("no_configuration")
def test_an_unknown_interface_is_wrong_usage_and_the_known_ones_are_named() -> None:
    with pytest.raises(UsageError, match="zzz") as caught:
        open_adapter(250_000, interface="zzz", channel="a")
    assert "socketcan" in str(caught.value)
    assert caught.value.exit_code == ExitCode.USAGE


@pytest.mark.usefixtures("no_configuration")
def test_a_configuration_that_makes_no_sense_is_wrong_usage() -> None:
    with pytest.raises(UsageError, match="Port"):
        open_adapter(250_000, interface="udp_multicast", channel="239.0.0.1", port="x")


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    "error", [OSError(errno.ENODEV, "No such device"), ImportError("no uptime"), ValueError()]
)
def test_an_adapter_that_cannot_be_opened_names_interface_channel_and_fix(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(**_config: Any) -> can.BusABC:
        raise error

    monkeypatch.setattr("can.Bus", fail)
    there = Interface("can7", is_can=True, is_up=True)
    for interface, channel, seen, fix in (
        ("socketcan", "can7", there, "`ip -details link show can7`"),
        ("socketcan", "can7", Unseen.MISSING, "`ip -brief link show type can`"),
        ("socketcan", "vcan7", Unseen.MISSING, "`ip link add dev vcan7 type vcan && ip link set"),
        ("pcan", "can7", there, "driver"),
    ):
        monkeypatch.setattr("flasher.bus.opening.look_up", lambda _name, seen=seen: seen)
        with pytest.raises(BusError, match="cannot be opened") as caught:
            open_adapter(250_000, interface=interface, channel=channel)
        assert channel in caught.value.where
        assert fix in caught.value.remedy


def test_a_damaged_configuration_file_is_wrong_usage(monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(**_options: Any) -> dict[str, Any]:
        raise configparser.MissingSectionHeaderError("can.conf", 1, "interface = socketcan")

    monkeypatch.setattr("can.util.load_config", damaged)
    with pytest.raises(UsageError, match=r"can\.conf"):
        open_adapter(250_000)


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    ("error", "interface", "channel", "words"),
    [
        (TypeError("expected str, not None"), "socketcan", None, "-i socketcan -c can0"),
        (OSError(errno.EAFNOSUPPORT, "not supported"), "socketcan", "can0", "no CAN"),
        (NameError("name 'canOpenChannel' is not defined"), "kvaser", "0", "driver library"),
    ],
)
def test_what_is_missing_for_an_adapter_is_named(
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    interface: str,
    channel: str | None,
    words: str,
) -> None:
    def fail(**_config: Any) -> can.BusABC:
        raise error

    monkeypatch.setattr("can.Bus", fail)
    with pytest.raises(BusError, match="cannot be opened") as caught:
        open_adapter(250_000, interface=interface, channel=channel)
    assert words in str(caught.value)


def test_a_foreign_datagram_on_the_multicast_port_is_passed_over(bus: FakeBus) -> None:
    bus.inbox.extend(
        [can.CanOperationError("could not unpack received message"), message(0x725, b"x")]
    )
    link = CanLink(bus, "udp_multicast")
    assert link.receive(time.perf_counter() + 1.0) == Frame(0x725, b"x")


# -- opening again --------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_configuration")
def test_a_lost_adapter_is_opened_again_with_the_same_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[dict[str, Any]] = []
    opened: list[FakeBus] = []

    def open_bus(**config: Any) -> FakeBus:
        seen.append(config)
        if len(seen) in (2, 3):
            raise OSError(errno.ENODEV, "No such device")
        opened.append(FakeBus())
        return opened[-1]

    monkeypatch.setattr("can.Bus", open_bus)
    link = open_adapter(250_000, interface="pcan", channel="PCAN_USBBUS1")
    opened[0].inbox.append(message())
    link.send(FRAME)
    for _ in range(2):
        with pytest.raises(BusError, match="cannot be opened"):
            link.reopen()
        with pytest.raises(BusError, match="not open"):
            link.send(FRAME)
        with pytest.raises(BusError, match="not open"):
            link.receive(0.0)
    link.reopen()
    link.send(FRAME)
    assert len(opened[1].sent) == 1
    assert link.health().frames_sent == 1
    assert seen[0] == seen[3]
    link.close()


@pytest.mark.usefixtures("no_configuration")
@each(
    "config, name",
    [
        (
            {"interface": "socketcand", "channel": "can0", "host": "pi1", "port": 29536},
            "socketcand can0 host=pi1 port=29536",
        ),
        (
            {"interface": "ixxat", "channel": "0", "unique_hardware_id": "HW1"},
            "ixxat 0 unique_hardware_id=HW1",
        ),
        ({"interface": "pcan", "channel": "PCAN_USBBUS1"}, "pcan PCAN_USBBUS1"),
    ],
)
def test_the_name_of_an_adapter_is_not_that_of_another_one_with_its_channel(
    monkeypatch: pytest.MonkeyPatch, config: dict[str, Any], name: str
) -> None:
    """The history finds an interrupted upgrade by it."""
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    link = open_adapter(250_000, **config)
    assert str(link) == name
    link.close()


def named(names: dict[str, dict[str, str]]) -> list[DetectedAdapter]:
    return [DetectedAdapter("socketcan", name, details) for name, details in names.items()]


A, B = {"serial_number": "A", "usb_path": "1-1"}, {"serial_number": "B", "usb_path": "1-2"}
NO_NUMBER = {"usb_path": "1-1"}
SECOND = {**A, "channel_index": "1"}
TWIN = {"serial_number": "A", "usb_path": "1-2"}


@pytest.mark.usefixtures("no_configuration")
@each(
    "before, after, channel",
    [
        ({"can2": A, "can3": B}, {"can2": B, "can3": A}, "can3"),
        ({"can2": A}, {"can2": A}, "can2"),
        ({"can2": A}, {"can2": TWIN}, "can2"),
        ({"can2": A}, {"can3": B}, "can2"),
        ({"can2": A, "can3": SECOND}, {"can2": B, "can3": A, "can4": SECOND}, "can3"),
        ({"can2": SECOND, "can1": A}, {"can2": A, "can3": SECOND}, "can3"),
        ({"can2": A, "can3": TWIN}, {"can2": TWIN, "can3": A}, "can3"),
        ({"can1": A, "can2": A}, {"can1": A, "can2": A}, "can2"),  # macOS tells no ports apart
        ({"can1": A, "can2": A}, {"can3": A, "can4": A}, "can2"),
        ({"can1": A, "can2": A}, {"can2": B, "can3": A, "can4": A}, None),
        ({"can2": A}, {"can2": B}, None),
        ({"can2": A, "can3": TWIN}, {"can2": TWIN, "can4": {**A, "usb_path": "1-3"}}, None),
        ({"can2": A, "can3": TWIN}, {"can3": TWIN}, "can2"),
        ({"can2": A, "can3": TWIN}, {"can2": TWIN}, None),
        ({"can2": NO_NUMBER}, {"can2": NO_NUMBER}, "can2"),
        ({"can2": NO_NUMBER}, {"can2": {"usb_path": "1-2"}}, None),
        ({"can2": {}, "can1": {}}, {"can2": {}, "can1": {}}, "can2"),
    ],
)  # fmt: skip
def test_a_lost_adapter_is_found_again_by_its_serial_number_and_never_by_its_name(
    monkeypatch: pytest.MonkeyPatch,
    before: dict[str, dict[str, str]],
    after: dict[str, dict[str, str]],
    channel: str | None,
) -> None:
    seen: list[dict[str, Any]] = []

    def open_bus(**config: Any) -> FakeBus:
        seen.append(config)
        return FakeBus()

    monkeypatch.setattr("can.Bus", open_bus)
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(before))
    link = open_adapter(250_000, interface="socketcan", channel="can2")
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(after))
    if channel is None:
        with pytest.raises(BusError, match="can2 is the name of another adapter now") as caught:
            link.reopen()
        assert caught.value.code is ErrorCode.ADAPTER_LOST
        assert len(seen) == 1
        assert (link.channel, str(link)) == ("", "socketcan"), "the name is another adapter's"
    else:
        link.reopen()
        assert (seen[1]["channel"], link.channel, str(link)) == (
            channel,
            channel,
            f"socketcan {channel}",
        )
    link.close()


@pytest.mark.usefixtures("no_configuration")
@each(
    "before, after, channel",
    [
        ({"can2": A, "can3": B}, {"can2": {**B, "usb_path": "1-1"}, "can3": TWIN}, "can2"),
        ({"can2": A}, {"can2": TWIN, "can3": {**B, "usb_path": "1-1"}}, "can3"),
        ({"can2": A}, {"can2": TWIN}, None),
        ({"can2": A, "can3": SECOND}, {"can2": SECOND, "can3": A}, "can3"),
    ],
)
def test_an_adapter_that_is_named_by_its_place_is_found_again_there_whatever_its_number(
    monkeypatch: pytest.MonkeyPatch,
    before: dict[str, dict[str, str]],
    after: dict[str, dict[str, str]],
    channel: str | None,
) -> None:
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(before))
    link = open_adapter(250_000, by_place=True, interface="socketcan", channel="can2")
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(after))
    if channel is None:
        with pytest.raises(BusError, match="can2 is the name of another adapter now"):
            link.reopen()
    else:
        link.reopen()
        assert link.channel == channel
    link.close()


@pytest.mark.usefixtures("no_configuration")
@each(
    "given, name, again",
    [
        ("/dev/ttyACM0@115200", "/dev/ttyACM0", "/dev/ttyACM1@115200"),
        ("com3", "COM3", "/dev/ttyACM1"),
        (r"\\.\COM3", "COM3", "/dev/ttyACM1"),
    ],
)
def test_a_lost_adapter_is_found_again_whichever_way_its_port_was_named(
    monkeypatch: pytest.MonkeyPatch, given: str, name: str, again: str
) -> None:
    seen: list[str] = []

    def open_bus(**config: Any) -> FakeBus:
        seen.append(config["channel"])
        return FakeBus()

    def ports(**names: dict[str, str]) -> None:
        listed = [DetectedAdapter("slcan", each, details) for each, details in names.items()]
        monkeypatch.setattr(adapter, "plugged_in", lambda _interface: listed)

    monkeypatch.setattr("can.Bus", open_bus)
    ports(**{name: A})
    link = open_adapter(250_000, interface="slcan", channel=given)
    ports(**{name: B, "/dev/ttyACM1": A})
    link.reopen()
    assert seen == [given, again]
    link.close()


@pytest.mark.usefixtures("no_configuration")
@each(
    "steps",
    [
        ({"can2": B, "can3": A},),
        ({"can2": B}, {"can2": B, "can3": A}),
        ({"can2": B}, {"can2": B}, {"can2": B, "can3": A}),
    ],
)
def test_two_programs_whose_adapters_exchange_their_names_do_not_lock_each_other_out(
    monkeypatch: pytest.MonkeyPatch, steps: tuple[dict[str, dict[str, str]], ...]
) -> None:
    """The names are the locks, and each holds what the other waits for."""
    seen = [{"can2": A, "can3": B}]
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(seen[-1]))
    links = [
        open_adapter(250_000, holder=f"socket {name}", interface="socketcan", channel=name)
        for name in ("can2", "can3")
    ]
    for step in (*steps, steps[-1]):
        seen.append(step)
        for link in links:
            with contextlib.suppress(BusError):
                link.reopen()
    for link, channel in zip(links, ("can3", "can2"), strict=True):
        link.send(FRAME)
        assert link.channel == channel
        with pytest.raises(BusError, match="is in use by"):
            open_adapter(250_000, holder="another", interface="socketcan", channel=channel)
        link.close()


@pytest.mark.usefixtures("no_configuration")
def test_an_adapter_that_is_away_does_not_lock_the_one_that_has_its_name_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = [{"can2": A, "can3": B}]
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    monkeypatch.setattr(adapter, "plugged_in", lambda _interface: named(seen[-1]))
    away, other = (
        open_adapter(250_000, holder=f"socket {name}", interface="socketcan", channel=name)
        for name in ("can2", "can3")
    )
    seen.append({"can2": B})
    with pytest.raises(BusError, match="can2 is the name of another adapter now"):
        away.reopen()
    other.reopen()
    assert other.channel == "can2"
    with pytest.raises(BusError, match="can2 is the name of another adapter now"):
        away.reopen()  # and it does not unlock what it does not hold
    with pytest.raises(BusError, match="is in use by"):
        open_adapter(250_000, holder="another", interface="socketcan", channel="can2")
    other.send(FRAME)
    for link in (away, other):
        link.close()


def test_a_link_that_was_handed_a_bus_cannot_be_opened_again(bus: FakeBus) -> None:
    with pytest.raises(BusError, match="cannot be opened again"):
        CanLink(bus, "fake").reopen()


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    ("seen", "code", "words"),
    [
        (
            Interface("can0", is_can=True, is_up=False),
            ErrorCode.ADAPTER_NOT_OPENED,
            "ip link set can0 up type can bitrate 250000",
        ),
        (
            Interface("can0", is_can=True, is_up=True, has_carrier=False),
            ErrorCode.BUS_OFF,
            "`ip link set can0 down; ip link set can0 up` (as root)",
        ),
        (
            Interface("can0", is_can=True, is_up=True, has_carrier=True, state_name="BUS-OFF"),
            ErrorCode.BUS_OFF,
            "`ip link set can0 down; ip link set can0 up` (as root)",
        ),
        (
            Interface("can0", is_can=True, is_up=True, modes=frozenset({"LISTEN-ONLY"})),
            ErrorCode.ADAPTER_NOT_OPENED,
            "`ip link set can0 down; ip link set can0 type can listen-only off; ip link",
        ),
        (
            Interface("can0", is_can=True, is_up=True, modes=frozenset({"LOOPBACK"})),
            ErrorCode.ADAPTER_NOT_OPENED,
            "`ip link set can0 down; ip link set can0 type can loopback off; ip link",
        ),
    ],
)
def test_an_interface_that_opens_but_carries_nothing_is_not_taken_for_open(
    monkeypatch: pytest.MonkeyPatch, seen: Interface, code: ErrorCode, words: str
) -> None:
    fake = FakeBus()
    monkeypatch.setattr("can.Bus", lambda **_config: fake)
    monkeypatch.setattr("flasher.bus.opening.read_interface", lambda _name: seen)
    with pytest.raises(BusError) as caught:
        open_adapter(250_000, interface="socketcan", channel="can0")
    assert words in caught.value.remedy
    assert caught.value.code is code
    assert fake._is_shutdown


@pytest.mark.usefixtures("no_configuration")
def test_an_interface_that_only_listens_is_open_for_who_never_sends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = Interface("can0", is_can=True, is_up=True, modes=frozenset({"LISTEN-ONLY"}))
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    monkeypatch.setattr("flasher.bus.opening.read_interface", lambda _name: seen)
    link = open_adapter(250_000, sends=False, interface="socketcan", channel="can0")
    link.reopen()
    link.close()


@pytest.mark.usefixtures("no_configuration")
def test_an_adapter_that_is_bus_off_is_not_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """gs_usb keeps its carrier, and a socket on it opens."""
    on = Interface("can0", is_can=True, is_up=True, has_carrier=True, state_name="ERROR-ACTIVE")
    states = [on, replace(on, state_name="BUS-OFF"), on]
    monkeypatch.setattr("can.Bus", lambda **_config: FakeBus())
    monkeypatch.setattr("flasher.bus.opening.read_interface", lambda _name: states.pop(0))
    link = open_adapter(250_000, interface="socketcan", channel="can0")
    with pytest.raises(BusError) as caught:
        link.reopen()
    assert caught.value.code is ErrorCode.BUS_OFF
    link.reopen()
    link.send(FRAME)
    link.close()


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    ("interface", "option"),
    [
        ("slcan", {"listen_only": True}),
        ("pcan", {"state": can.BusState.PASSIVE}),
        ("kvaser", {"driver_mode": False}),
        ("virtual", {}),
    ],
)
def test_listening_only_is_asked_for_in_the_back_ends_own_words(
    monkeypatch: pytest.MonkeyPatch, interface: str, option: dict[str, Any]
) -> None:
    seen: list[dict[str, Any]] = []

    def open_bus(**config: Any) -> FakeBus:
        seen.append(config)
        return FakeBus()

    monkeypatch.setattr("can.Bus", open_bus)
    for listen_only in (False, True):
        open_adapter(250_000, listen_only=listen_only, interface=interface, channel="a").close()
    assert {key: seen[1][key] for key in seen[1] if key not in seen[0]} == option


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    ("error", "cause", "remedy"),
    [
        (PermissionError(errno.EACCES, "denied"), "may not use", "dialout"),
        (OSError(errno.EBUSY, "busy"), "another program", "close other programs"),
        (FileNotFoundError(errno.ENOENT, "no file"), "another name", "`flasher adapters`"),
    ],
)
def test_why_it_cannot_be_opened_is_found_past_the_back_ends_own_error(
    monkeypatch: pytest.MonkeyPatch, error: Exception, cause: str, remedy: str
) -> None:
    def fail(**_config: Any) -> can.BusABC:
        raise can.CanInitializationError("could not create the serial device") from error

    def fail_plainly(**_config: Any) -> can.BusABC:
        raise error

    wrapped = isinstance(error, OSError)
    monkeypatch.setattr("can.Bus", fail if wrapped else fail_plainly)
    with pytest.raises(BusError) as caught:
        open_adapter(250_000, interface="slcan", channel="/dev/ttyACM0")
    assert cause in caught.value.cause
    assert remedy in caught.value.remedy
    assert "pip install" not in caught.value.remedy


@pytest.mark.usefixtures("no_configuration")
def test_a_missing_package_is_installed_into_the_python_that_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(**_config: Any) -> can.BusABC:
        raise can.CanInterfaceNotImplementedError("no module 'usb'")

    monkeypatch.setattr("can.Bus", fail)
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(BusError, match="software for the interface gs_usb is missing") as caught:
        open_adapter(250_000, interface="gs_usb", channel="0")
    assert caught.value.remedy.startswith(f"Run `{sys.executable} -m pip install ")
    assert "python-can[gs-usb]" in caught.value.remedy


@pytest.mark.usefixtures("no_configuration")
@pytest.mark.parametrize(
    ("interface", "error", "software"),
    [
        ("kvaser", NameError("name 'canGetNumberOfChannels' is not defined"), "CANlib"),
        ("pcan", can.CanInitializationError("pcanbasic library not found"), "PCAN-Basic"),
        ("ixxat", ImportError("cannot import name 'HRESULT'"), "VCI"),
        ("etas", AttributeError("module 'ctypes' has no attribute 'windll'"), "BOA"),
        ("vector", can.CanInitializationError("only supported on Windows"), "XL Driver Library"),
        ("neousys", can.CanInitializationError("Neousys WDT_DIO Can driver missing."), "WDT_DIO"),
        ("iscan", can.CanInitializationError("Could not load isCAN driver"), "isCAN"),
    ],
)
def test_a_back_end_without_its_driver_names_the_software_to_install(
    monkeypatch: pytest.MonkeyPatch, interface: str, error: Exception, software: str
) -> None:
    def fail(**_config: Any) -> can.BusABC:
        raise error

    monkeypatch.setattr("can.Bus", fail)
    with pytest.raises(BusError, match=f"software for the interface {interface}") as caught:
        open_adapter(250_000, interface=interface, channel="0")
    assert software in caught.value.remedy
    assert str(error) not in str(caught.value)


# -- health ---------------------------------------------------------------------------------------


def error_message(can_id: int, data: str) -> can.Message:
    return message(can_id, bytes.fromhex(data), is_error_frame=True)


NO_ACK = error_message(0x204, "00 20 00 00 00 00 80 00")
BUS_OFF = error_message(0x040, "00 00 00 00 00 00 00 00")


def test_frames_that_no_node_acknowledges_are_noticed(bus: FakeBus) -> None:
    bus.inbox.append(NO_ACK)
    link = CanLink(bus, "gs_usb", "0")
    link.send(FRAME)
    frame = link.receive(0.0)
    assert frame == Frame(0x204, bytes(NO_ACK.data), is_error=True)
    health = link.health()
    assert (health.state, health.tx_errors) == (ControllerState.PASSIVE, 128)
    assert health.not_acknowledged


def test_once_bus_off_is_reported_nothing_more_is_sent_into_the_void(bus: FakeBus) -> None:
    bus.inbox.append(BUS_OFF)
    link = CanLink(bus, "gs_usb", "0")
    link.receive(0.0)
    with pytest.raises(BusError) as caught:
        link.send(FRAME)
    assert "bus-off" in caught.value.cause
    assert bus.sent == []


def test_error_frames_pass_filters_and_filtered_frames_count_as_received(bus: FakeBus) -> None:
    bus.set_filters([{"can_id": 0x725, "can_mask": 0x7FF, "extended": False}])
    bus.inbox.extend([message(0x123), NO_ACK])
    link = CanLink(bus, "gs_usb")
    link.send(FRAME)
    frame = link.receive(time.perf_counter() + 1.0)
    assert frame is not None
    assert frame.is_error
    assert not link.health().not_acknowledged


def test_on_socketcan_the_kernel_is_asked(bus: FakeBus, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[Interface | Unseen] = [
        Interface("can0", is_can=True, is_up=True, state_name="BUS-OFF", tx_errors=9, rx_errors=1),
        Unseen.MISSING,
    ]
    monkeypatch.setattr("flasher.bus.adapter.read_interface", lambda _name: answers.pop(0))
    link = CanLink(bus, "socketcan", "can0")
    assert link.health().state is ControllerState.BUS_OFF
    assert link.health().state is ControllerState.UNKNOWN


@pytest.mark.parametrize(
    ("status", "state"),
    [
        (0x00000, ControllerState.ACTIVE),
        (0x00008, ControllerState.ACTIVE),
        (0x40000, ControllerState.PASSIVE),
        (0x00010, ControllerState.BUS_OFF),
        (0x00400, ControllerState.UNKNOWN),
    ],
)
def test_pcan_is_asked_for_its_status_since_its_state_is_the_mode_that_was_set(
    bus: FakeBus, status: int, state: ControllerState
) -> None:
    bus.status = lambda: status  # type: ignore[attr-defined]
    assert CanLink(bus, "pcan").health().state is state


def test_what_python_can_makes_up_for_a_state_is_not_believed(bus: FakeBus) -> None:
    assert bus.state is can.BusState.ACTIVE
    assert CanLink(bus, "kvaser").health().state is ControllerState.UNKNOWN


def test_a_back_end_that_knows_of_an_error_is_believed() -> None:
    class Ixxat(FakeBus):
        state = can.BusState.ERROR

    ixxat = Ixxat()
    assert CanLink(ixxat, "ixxat").health().state is ControllerState.BUS_OFF
    ixxat.shutdown()


def test_health_never_raises(bus: FakeBus) -> None:
    def fail() -> int:
        raise OSError("unplugged")

    bus.status = fail  # type: ignore[attr-defined]
    assert CanLink(bus, "pcan").health().state is ControllerState.UNKNOWN


def test_a_full_queue_is_remembered(bus: FakeBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flasher.bus.adapter.SEND_LIMIT_S", 0.01)
    link = CanLink(bus, "slcan")
    link.send(FRAME)
    bus.refusals.extend([can.CanOperationError("Transmit queue full")] * 100_000)
    with pytest.raises(TransmitBlockedError):
        link.send(FRAME)
    assert link.health().not_acknowledged


class SlcanBus(FakeBus):
    """Reads the answers of its serial adapter as python-can does, and drops them."""

    def __init__(self) -> None:
        super().__init__()
        self.answers = deque[bytes]()
        self.serialPortOrig = SimpleNamespace(
            in_waiting=0, read=lambda _size=1: self.answers.popleft() if self.answers else b""
        )

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self.serialPortOrig.read(1)
        self.serialPortOrig.in_waiting = len(self.answers)
        return super()._recv_internal(timeout)


@pytest.fixture
def slcan() -> Any:
    fake = SlcanBus()
    yield fake
    fake.shutdown()


def refuse(link: CanLink, slcan: SlcanBus, *answers: bytes) -> None:
    for answer in answers:
        link.send(FRAME)
        slcan.answers.append(answer)
        link.receive(AT_ONCE)


def test_an_adapter_that_refuses_frame_after_frame_is_lost(slcan: SlcanBus) -> None:
    link = CanLink(slcan, "slcan", "/dev/ttyACM0")
    slcan.answers.extend([b"\a"] * 50)  # to the commands that open it
    link.drain()
    assert link.health().refused == 0
    refuse(link, slcan, *[b"\a"] * (adapter._REFUSED_LIMIT - 1), b"\r")
    with pytest.raises(BusError, match="refused to send 36 frames in a row") as caught:
        refuse(link, slcan, *[b"\a"] * adapter._REFUSED_LIMIT)
    assert caught.value.code is ErrorCode.SEND_BLOCKED
    assert "its channel is closed" in caught.value.cause
    assert not isinstance(caught.value, TransmitBlockedError), "it is opened again"


@each(
    "answers, received, is_bad", [("aa", False, True), ("a\r", False, False), ("aa", True, False)]
)
def test_a_silent_bus_with_an_adapter_that_refuses_most_frames_is_not_the_devices_fault(
    slcan: SlcanBus, answers: str, *, received: bool, is_bad: bool
) -> None:
    link = CanLink(slcan, "slcan")
    refuse(link, slcan, *[each_answer.replace("a", "\a").encode() for each_answer in answers])
    if received:
        slcan.inbox.append(message())
        link.receive(AT_ONCE)
    error = link.health().error()
    assert (error is not None) is is_bad
    if error is not None:
        assert "refused to send 2 of 2 frames" in error.what


# -- echoes of own frames -------------------------------------------------------------------------


@each(
    "interface, asked, is_rx, is_echo",
    [
        ("gs_usb", None, False, True),
        ("gs_usb", None, True, False),
        ("socketcan", None, False, False),  # another program on this computer
        ("socketcan", True, False, True),
        ("socketcan", True, True, False),  # another dongle, on the wire
        ("udp_multicast", None, True, True),
    ],
)
def test_an_echo_is_distinguished_from_a_second_tool_by_what_the_back_end_knows(
    interface: str, asked: bool | None, *, is_rx: bool, is_echo: bool
) -> None:
    """The frame is the very same one that this link has sent."""
    fake = FakeBus()
    own: dict[str, Any] = {} if asked is None else {"receive_own_messages": asked}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adapter, "open_bus", lambda _config, **_options: fake)
        link = open_adapter(250_000, interface=interface, channel="x", **own)
    link.send(FRAME)
    fake.inbox.append(message(FRAME.can_id, FRAME.data, is_rx=is_rx))
    received = link.receive(AT_ONCE)
    link.close()
    assert received == FRAME._replace(is_echo=is_echo)
