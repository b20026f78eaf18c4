"""What python-can's back ends raise, where, and what `CanLink` makes of it.

The table was made from the sources of python-can 4.6 and of the libraries under it (pyserial,
gs_usb, canalystii, nixnet). A row is a back end, an exception as it leaves that back end, and what
it means. Back ends that run without hardware are run themselves further down.
"""

from __future__ import annotations

import errno
import gc
import itertools
import socket
import struct
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import can
import pytest
import serial
from can import CanOperationError as Op
from can.interfaces.pcan.pcan import PcanCanOperationError
from can.interfaces.vector.exceptions import VectorOperationError

from flasher.bus import adapter, opening
from flasher.bus.adapter import CanLink, open_adapter
from flasher.bus.health import ControllerState, TroubleKind
from flasher.bus.link import AT_ONCE, SEND_LIMIT_S
from flasher.bus.opening import open_bus
from flasher.errors import BusError, ErrorCode, TransmitBlockedError
from flasher.protocol.frame import Frame
from tests.bus.test_adapter import FRAME, FakeBus, message
from tests.loops import each

UNREADABLE = "unreadable"
FULL = "full"
LOST = ErrorCode.ADAPTER_LOST
BUS_OFF = ErrorCode.BUS_OFF
GOOD = Frame(0x725, b"\x01")


class Foreign(Exception):  # noqa: N818  as a vendor may call it
    """Replaces the exceptions of libraries that are not installed here."""

    def __init__(self, text: str, error_code: int | None = None) -> None:
        super().__init__(text)
        self.error_code = error_code


class USBTimeoutError(OSError):
    """As pyusb's, which is no TimeoutError."""


def wrapped(outer: Exception, inner: Exception) -> Exception:
    """As after `raise outer from inner`, which is how python-can wraps."""
    outer.__cause__ = inner
    return outer


def hidden(outer: Exception, inner: Exception) -> Exception:
    """As after `raise outer from None` where `inner` was caught."""
    outer.__context__, outer.__suppress_context__ = inner, True
    return outer


def damaged_text() -> UnicodeDecodeError:
    return UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")


SERIAL_GONE = serial.SerialException("device reports readiness to read but returned no data")
NOTHING_CAME = TypeError("ord() expected a character, but string of length 0 found")
NO_SUCH_DEVICE = OSError(errno.ENODEV, "No such device (it may have been disconnected)")
READ_FAILED = "Could not read from serial device"

RECEIVING: list[tuple[str, Exception, object]] = [
    # canalystii: pyusb's errors, checks and assertions of the library, as they are.
    ("canalystii", NO_SUCH_DEVICE, LOST),
    ("canalystii", RuntimeError("Expected response minimum 8 bytes, got 3 bytes."), UNREADABLE),
    ("canalystii", AssertionError(), UNREADABLE),
    ("canalystii", AttributeError("'NoneType' object has no attribute 'receive'"), UNREADABLE),
    # cantact: everything of the library is wrapped.
    ("cantact", wrapped(Op("Cannot receive message"), NO_SUCH_DEVICE), LOST),
    (
        "cantact",
        wrapped(Op("Cannot receive message"), SystemError("?")),
        UNREADABLE,
    ),
    ("cantact", KeyError("dlc"), UNREADABLE),
    # etas
    ("etas", Op("OCI_ReadCANDataEx failed with error 0x80010001"), LOST),
    # gs_usb: "never raises", but for frames of another length; a lost adapter is silent (below).
    ("gs_usb", struct.error("unpack requires a buffer of 20 bytes"), UNREADABLE),
    # iscan: IscanError with the driver's number.
    ("iscan", Foreign("Function isCAN_ReceiveMessageEx failed: Bus off", 17), BUS_OFF),
    ("iscan", Foreign("Function isCAN_ReceiveMessageEx failed", 17), BUS_OFF),
    ("iscan", Foreign("Function isCAN_ReceiveMessageEx failed", 18), TroubleKind.PASSIVE),
    ("iscan", Foreign("Function isCAN_ReceiveMessageEx failed", 20), TroubleKind.WARNING),
    ("iscan", Foreign("Function isCAN_ReceiveMessageEx failed", 19), TroubleKind.OTHER),
    ("iscan", can.CanError("Function isCAN_ReceiveMessageEx failed: Device timeout", 6), LOST),
    # ixxat: the state of the controller, after every receive that gave nothing.
    ("ixxat", Op("Error warning limit exceeded"), TroubleKind.WARNING),
    ("ixxat", Op("Data overrun occurred"), TroubleKind.OTHER),
    ("ixxat", Op("Bus off status"), BUS_OFF),
    ("ixxat", Op("Controller is in BUSOFF state"), BUS_OFF),
    ("ixxat", Op("Bus coupling error"), LOST),
    ("ixxat", Op("function canChannelReadMessage failed (the device is gone)"), LOST),
    ("ixxat", can.CanTimeoutError("Function canControlGetStatus timed out"), LOST),
    ("ixxat", StopIteration(), UNREADABLE),
    # kvaser: CANLIBOperationError, or a function that is missing in an old library.
    ("kvaser", Op("Function canReadWait failed - no card", -26), LOST),
    ("kvaser", NotImplementedError("This function is not implemented in canlib"), UNREADABLE),
    # neousys: a callback of the driver fills a queue. neovi: what it does with the frame.
    ("neousys", ValueError("'timeout' must be a non-negative number"), UNREADABLE),
    ("neovi", Foreign("Error: get_timestamp_for_msg(): Failed"), UNREADABLE),
    ("neovi", Op("Cannot operate on a closed bus"), LOST),
    # nican, nixnet: nican's own error; nixnet's XnetError, which is no CanError.
    ("nican", Op("ncRead failed: the device is gone", -1074388957), LOST),
    ("nixnet", Foreign("The interface is not there any more.", 0xBFF63091), UNREADABLE),
    # pcan: the text of the driver for each bit of its status.
    ("pcan", PcanCanOperationError("The receive queue was read too late"), TroubleKind.OTHER),
    ("pcan", PcanCanOperationError("The CAN controller was read too late"), TroubleKind.OTHER),
    (
        "pcan",
        PcanCanOperationError("Bus error: the CAN controller is error passive"),
        TroubleKind.PASSIVE,
    ),
    ("pcan", PcanCanOperationError("Bus error: the CAN controller is in bus-off state"), BUS_OFF),
    ("pcan", PcanCanOperationError("The value of a handle is invalid"), LOST),
    # robotell: a checksum keeps damaged frames away; pyserial's errors as they are.
    ("robotell", SERIAL_GONE, LOST),
    ("robotell", IndexError("bytearray index out of range"), UNREADABLE),
    # seeedstudio: half a frame, in the middle of which the port had nothing more.
    ("seeedstudio", NOTHING_CAME, UNREADABLE),
    ("seeedstudio", struct.error("unpack requires a buffer of 2 bytes"), UNREADABLE),
    (
        "seeedstudio",
        wrapped(Op("failed to read message information"), SERIAL_GONE),
        LOST,
    ),
    ("seeedstudio", Op("reading from closed port"), LOST),
    # serial: damaged and cut frames.
    ("serial", ValueError("received DLC may not exceed 8 bytes"), UNREADABLE),
    ("serial", struct.error("unpack requires a buffer of 4 bytes"), UNREADABLE),
    ("serial", NOTHING_CAME, UNREADABLE),
    ("serial", Op("invalid delimiter byte while reading: 7"), UNREADABLE),
    ("serial", wrapped(Op("could not read from serial"), SERIAL_GONE), LOST),
    # slcan: damaged lines; everything of the port is wrapped, a line that is no text too.
    ("slcan", ValueError("invalid literal for int() with base 16: '7\\x002'"), UNREADABLE),
    ("slcan", ValueError("non-hexadecimal number found in fromhex()"), UNREADABLE),
    ("slcan", IndexError("string index out of range"), UNREADABLE),
    ("slcan", wrapped(Op(READ_FAILED), damaged_text()), UNREADABLE),
    ("slcan", wrapped(Op(READ_FAILED), SERIAL_GONE), LOST),
    ("slcan", wrapped(Op(READ_FAILED), OSError(errno.EIO, "I/O error")), LOST),
    ("slcan", wrapped(Op(READ_FAILED), TypeError("None is no fd")), UNREADABLE),
    # socketcan: the system's errors with their number, checks of what came beside the frame.
    ("socketcan", Op("Failed to receive: Network is down", errno.ENETDOWN), LOST),
    ("socketcan", wrapped(Op("Error receiving", 19), NO_SUCH_DEVICE), LOST),
    ("socketcan", AssertionError("only requested a single extra field"), UNREADABLE),
    ("socketcan", struct.error("unpack requires a buffer of 8 bytes"), UNREADABLE),
    ("socketcan", Op("Timestamp nanoseconds field was out of range"), UNREADABLE),
    ("socketcan", ValueError("file descriptor cannot be a negative integer (-1)"), UNREADABLE),
    # socketcand: all is wrapped; what it tripped over stays in its buffer, before all that follows.
    ("socketcand", wrapped(can.CanError("Failed to receive: ..."), ValueError("'72g'")), LOST),
    ("socketcand", wrapped(can.CanError("Failed to receive: ..."), damaged_text()), LOST),
    ("socketcand", wrapped(can.CanError("Failed to receive"), ConnectionResetError()), LOST),
    # systec: the library's error is only in the cause. python-can 4.6.1 cannot even make it, and
    # calls the library with one argument too many.
    ("systec", wrapped(Op(), can.CanError("disconnected", 0x0E)), LOST),
    ("systec", TypeError("unhashable type"), UNREADABLE),
    ("systec", TypeError("read_can_msg() takes 3 positional arguments"), UNREADABLE),
    # udp_multicast: anybody may send anything to its port; the network may go.
    ("udp_multicast", wrapped(Op("could not unpack"), TypeError("?")), UNREADABLE),
    ("udp_multicast", Op("Timestamp nanoseconds field was out of range"), UNREADABLE),
    ("udp_multicast", wrapped(Op("Failed to wait"), NO_SUCH_DEVICE), LOST),
    ("udp_multicast", OSError(errno.ENETDOWN, "Network is down"), LOST),
    # usb2can: a CanalError as the code; a number that is none is wrapped.
    ("usb2can", Op("could not receive message", 2), BUS_OFF),
    ("usb2can", Op("could not receive message", 3), TroubleKind.PASSIVE),
    ("usb2can", Op("could not receive message", 4), TroubleKind.WARNING),
    ("usb2can", Op("could not receive message", 18), TroubleKind.OTHER),
    ("usb2can", Op("could not receive message", 24), TroubleKind.NOT_ACKNOWLEDGED),
    ("usb2can", Op("could not receive message", 37), LOST),
    (
        "usb2can",
        wrapped(Op("Receive error"), ValueError("99 is no CanalError")),
        UNREADABLE,
    ),
    # vector: VectorOperationError with the driver's code.
    ("vector", VectorOperationError(216, "XL_ERR_QUEUE_OVERRUN", "xlReceive"), TroubleKind.OTHER),
    ("vector", VectorOperationError(129, "XL_ERR_HW_NOT_PRESENT", "xlReceive"), LOST),
    # virtual
    ("virtual", Op("Cannot operate on a closed bus"), LOST),
]  # fmt: skip

WRITE_FAILED = "Could not write to serial device"
WRITE_TIMEOUT = serial.SerialTimeoutException("Write timeout")

SENDING: list[tuple[str, Exception, object]] = [
    ("canalystii", NO_SUCH_DEVICE, LOST),
    ("canalystii", can.CanTimeoutError("Send timed out after 2 seconds"), FULL),
    ("canalystii", RuntimeError("Channel 0 is stopped, can't send messages."), LOST),
    ("cantact", wrapped(Op("Cannot send message"), SystemError("gone")), LOST),
    ("etas", Op("OCI_WriteCANDataEx failed with error 0x80010001"), LOST),
    (
        "gs_usb",
        wrapped(Op("The message could not be sent"), USBTimeoutError(110, "?")),
        FULL,
    ),
    (
        "gs_usb",
        wrapped(Op("The message could not be sent"), NO_SUCH_DEVICE),
        LOST,
    ),
    ("iscan", can.CanError("Function isCAN_TransmitMessageEx failed", 7), FULL),
    ("iscan", can.CanError("Function isCAN_TransmitMessageEx failed", 17), BUS_OFF),
    ("iscan", can.CanError("Function isCAN_TransmitMessageEx failed", 30), LOST),
    ("ixxat", Op("function canChannelPostMessage failed (VCI_E_TXQUEUE_FULL)"), FULL),
    ("ixxat", Op("function canChannelPostMessage failed (transmit queue full)"), FULL),
    ("ixxat", can.CanTimeoutError("Function canChannelSendMessage timed out"), FULL),
    ("ixxat", Op("function canChannelPostMessage failed (invalid handle)"), LOST),
    ("kvaser", Op("Function canWrite failed", -13), FULL),
    ("kvaser", Op("Function canWrite failed - no card", -26), LOST),
    ("neousys", Op("Neousys Can can't send message"), LOST),
    ("neovi", Op("bus not open"), LOST),
    ("neovi", can.CanTimeoutError("Transmit timeout"), FULL),
    ("nican", Op("ncWrite failed: write queue overflow", -1074388985), FULL),
    ("nixnet", Op("... (Err.OUTPUT_QUEUE_OVERFLOW)", 0xBFF63008), FULL),
    ("nixnet", Op("... (Err.EVENT_TIMEOUT)", 0xBFF6300A), FULL),
    ("nixnet", Op("... (Err.INTERNAL_ERROR)", 0xBFF63001), LOST),
    ("pcan", PcanCanOperationError("Failed to send: The transmit queue is full"), FULL),
    (
        "pcan",
        PcanCanOperationError("Failed to send: The transmit buffer in CAN controller is full"),
        FULL,
    ),
    (
        "pcan",
        PcanCanOperationError("Bus error: the CAN controller is in bus-off state"),
        BUS_OFF,
    ),
    ("pcan", PcanCanOperationError("Failed to send: The value of a handle is invalid"), LOST),
    ("robotell", WRITE_TIMEOUT, FULL),
    ("robotell", serial.SerialException("write failed: [Errno 5]"), LOST),
    ("seeedstudio", wrapped(can.CanTimeoutError(), WRITE_TIMEOUT), FULL),
    ("seeedstudio", serial.SerialException("write failed: [Errno 5]"), LOST),
    ("serial", wrapped(can.CanTimeoutError(), WRITE_TIMEOUT), FULL),
    ("serial", Op("writing to closed port"), LOST),
    ("serial", ValueError("Timestamp is out of range: -1"), LOST),
    ("slcan", wrapped(Op(WRITE_FAILED), WRITE_TIMEOUT), FULL),
    ("slcan", wrapped(Op(WRITE_FAILED), OSError(errno.EIO, "?")), LOST),
    ("slcan", wrapped(Op(WRITE_FAILED), Foreign("termios: (5, 'I/O')")), LOST),
    ("socketcan", Op("Failed to transmit", errno.ENOBUFS), FULL),
    ("socketcan", Op("Transmit buffer full"), FULL),
    ("socketcan", Op("Failed to transmit: No such device", errno.ENODEV), LOST),
    ("socketcan", OSError(errno.EBADF, "Bad file descriptor"), LOST),
    ("socketcand", BrokenPipeError(errno.EPIPE, "Broken pipe"), LOST),
    ("systec", wrapped(Op(), can.CanError("did not fit into the buffer", 0x0B)), FULL),
    ("systec", wrapped(Op(), can.CanError("could not create a resource", 0x01)), LOST),
    ("systec", TypeError("unhashable type"), LOST),
    ("udp_multicast", hidden(can.CanTimeoutError(), TimeoutError()), FULL),
    ("udp_multicast", wrapped(Op("failed to send"), NO_SUCH_DEVICE), LOST),
    ("usb2can", Op("could not send message", 9), FULL),
    ("usb2can", Op("could not send message", 21), FULL),
    ("usb2can", Op("could not send message", 2), BUS_OFF),
    ("usb2can", Op("could not send message", 13), LOST),
    ("vector", VectorOperationError(11, "XL_ERR_QUEUE_IS_FULL", "xlCanTransmit"), FULL),
    ("vector", VectorOperationError(129, "XL_ERR_HW_NOT_PRESENT", "xlCanTransmit"), LOST),
    ("virtual", Op("Could not send message to one or more recipients"), LOST),
    ("virtual", AttributeError("'NoneType' object has no attribute 'put'"), LOST),
]  # fmt: skip

SHUTDOWN: list[tuple[str, Exception]] = [
    ("canalystii", NO_SUCH_DEVICE),
    ("cantact", Op("Cannot shutdown interface")),
    ("gs_usb", AttributeError("'NoneType' object has no attribute 'ctrl_transfer'")),
    ("ixxat", Op("function canControlReset failed")),
    ("kvaser", Op("Function canBusOff failed", -10)),
    ("neousys", AttributeError("'NoneType' object has no attribute 'CAN_Stop'")),
    ("neovi", Foreign("Error: close_device(): Failed")),
    ("nixnet", Foreign("The session is not there any more.", 0xBFF63091)),
    ("robotell", serial.SerialException("port is closed")),
    ("slcan", Op(WRITE_FAILED)),
    ("usb2can", Op("could not shut down bus", 13)),
    ("virtual", ValueError("list.remove(x): x not in list")),
]

OPENING: list[tuple[str, Exception]] = [
    ("canalystii", ValueError("Can't open device_index 0, only 0 devices found.")),
    ("cantact", can.CanInitializationError("Cannot create the cantact.Interface")),
    ("gs_usb", can.CanInitializationError("Cannot find device 0. Devices found: 0")),
    ("gs_usb", AttributeError("'NoneType' object has no attribute 'fclk_can'")),
    ("ixxat", can.CanInitializationError("The device was not found")),
    ("kvaser", NameError("name 'canOpenChannel' is not defined")),
    ("neovi", ImportError("Please install python-ics")),
    ("nixnet", can.CanInterfaceNotImplementedError("The NI-XNET driver was not found")),
    ("robotell", TypeError("unsupported operand type(s) for <=: 'str' and 'int'")),
    ("seeedstudio", KeyError(250_001)),
    ("slcan", ValueError("Invalid bitrate, choose one of 10000, 20000.")),
    ("socketcan", OSError(errno.ENODEV, "No such device")),
    ("socketcand", TimeoutError("connect_to_server: Failed to connect server for 10000 ms")),
    ("vector", FileNotFoundError("Vector XL library not found: vxlapi64")),
    ("etas", FileNotFoundError("Could not find module 'dll-ocdProxy.dll'")),
]


@pytest.fixture
def bus() -> Iterator[FakeBus]:
    fake = FakeBus()
    yield fake
    fake.shutdown()


def test_every_interface_of_python_can_is_in_the_table() -> None:
    """The newest python-can may know more: then its source has to be read."""
    known = {interface for interface, *_ in (*RECEIVING, *SENDING)}
    assert known == set(can.VALID_INTERFACES) - _of_plugins()


def _of_plugins() -> set[str]:
    backends = can.interfaces.BACKENDS.items()
    return {name for name, (module, _) in backends if not module.startswith("can.interfaces.")}


@each("interface, error, meaning", RECEIVING)
def test_what_a_back_end_raises_in_receiving(
    interface: str, error: Exception, meaning: object
) -> None:
    fake = FakeBus()
    fake.inbox.extend([error, message()])
    link = CanLink(fake, interface, "0")
    if isinstance(meaning, ErrorCode):
        with pytest.raises(BusError) as caught:
            link.receive(AT_ONCE)
        assert caught.value.code is meaning
        assert link.is_off == (meaning is BUS_OFF)
        assert caught.value.where == f"{interface} 0"
    else:
        received = [link.receive(AT_ONCE), link.receive(AT_ONCE)]
        assert GOOD in received  # reception goes on
        health = link.health()
        assert health.unreadable == (meaning is UNREADABLE)
        assert (health.last_trouble and health.last_trouble.kind) == (
            meaning if isinstance(meaning, TroubleKind) else None
        )
    fake.shutdown()


@each("interface, error, meaning", SENDING)
def test_what_a_back_end_raises_in_sending(
    interface: str, error: Exception, meaning: object
) -> None:
    fake = FakeBus()
    fake.refusals.append(error)
    link = CanLink(fake, interface, "0")
    if meaning is not FULL:
        with pytest.raises(BusError) as caught:
            link.send(FRAME)
        assert caught.value.code is meaning
        assert not fake.sent
    elif interface in ("nixnet", "robotell", "slcan"):  # they have waited themselves
        with pytest.raises(TransmitBlockedError):
            link.send(FRAME)
        assert link.health().is_blocked
    else:
        link.send(FRAME)
        assert len(fake.sent) == 1
    fake.shutdown()


@each("interface, error", SHUTDOWN)
def test_what_a_back_end_raises_in_closing_is_of_no_interest(
    interface: str, error: Exception
) -> None:
    fake, again = FakeBus(), FakeBus()
    link = CanLink(fake, interface, "0", open_again=lambda: again)
    fake.shutdown = _raiser(error)  # type: ignore[method-assign]
    link.reopen()
    again.shutdown = _raiser(error)  # type: ignore[method-assign]
    link.close()
    for each_one in (fake, again):
        del each_one.shutdown
        each_one.shutdown()


@each("interface, error", OPENING)
def test_what_a_back_end_raises_in_opening(interface: str, error: Exception) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("can.util.load_file_config", lambda *_args: {})
        patched.setattr("can.util.load_environment_config", lambda *_args: {})
        patched.setattr("can.Bus", _raiser(error))
        with pytest.raises(BusError) as caught:
            open_adapter(250_000, interface=interface, channel="0")
    assert caught.value.code is ErrorCode.ADAPTER_NOT_OPENED
    assert caught.value.remedy


def _raiser(error: Exception) -> Callable[..., Any]:
    def fail(*_arguments: object, **_options: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError()])
def test_what_is_no_word_of_the_adapter_passes(bus: FakeBus, error: BaseException) -> None:
    link = CanLink(bus, "slcan")
    bus._recv_internal = bus.send = _raiser(error)  # type: ignore[method-assign, arg-type]
    link = CanLink(bus, "slcan")
    with pytest.raises(type(error)):
        link.receive(AT_ONCE)
    with pytest.raises(type(error)):
        link.send(FRAME)


# -- one after the other --------------------------------------------------------------------------


def test_an_adapter_of_which_nothing_can_be_read_for_long_is_broken(bus: FakeBus) -> None:
    bus.inbox.extend(ValueError("bad line") for _ in range(adapter._UNREADABLE_LIMIT))
    bus.inbox.append(message())
    link = CanLink(bus, "slcan", "/dev/ttyACM0")
    assert link.receive(AT_ONCE) == GOOD
    bus.inbox.extend(ValueError("bad line") for _ in range(adapter._UNREADABLE_LIMIT + 1))
    with pytest.raises(BusError, match="101 times in a row: bad line") as caught:
        link.receive(AT_ONCE)
    assert caught.value.code is LOST
    assert "tty_baudrate" in caught.value.remedy


def test_what_others_send_to_a_multicast_port_never_breaks_it(bus: FakeBus) -> None:
    foreign = [Op("could not unpack received message") for _ in range(900)]
    bus.inbox.extend([*foreign, message()])
    link = CanLink(bus, "udp_multicast")
    assert link.receive(AT_ONCE) == GOOD
    assert link.health().unreadable == 900


def test_unreadable_frames_are_counted_over_reopenings(bus: FakeBus) -> None:
    bus.inbox.append(ValueError("bad line"))
    again = FakeBus()
    link = CanLink(bus, "slcan", open_again=lambda: again)
    link.receive(AT_ONCE)
    link.reopen()
    health = link.health()
    assert (health.unreadable, health.last_unreadable) == (1, "bad line")
    link.close()


def test_an_adapter_of_which_nothing_at_all_was_read_is_named_as_the_cause(bus: FakeBus) -> None:
    bus.inbox.extend([ValueError("bad line"), ValueError("bad line")])
    link = CanLink(bus, "slcan")
    link.send(FRAME)
    assert link.receive(AT_ONCE) is None
    error = link.health().error("here")
    assert error is not None
    assert "unreadable data, 2 times so far: bad line" in error.what
    bus.inbox.append(message())
    link.receive(AT_ONCE)
    assert link.health().error() is None


@pytest.mark.parametrize(
    "bad",
    [
        can.Message(arbitration_id=0xF25, data=b"\x01", is_extended_id=False),
        can.Message(arbitration_id=-0x25, data=b"\x01", is_extended_id=False),
        can.Message(arbitration_id=0x2000_0000, data=b"\x01", is_extended_id=True),
        can.Message(arbitration_id=0x725, data=b"\x01\x02", dlc=8, is_extended_id=False),
        can.Message(arbitration_id=0x725, data=b"\x01\x02", dlc=12, is_extended_id=False),
    ],
    ids=["long id", "negative id", "long extended id", "data missing", "length of FD"],
)
def test_a_message_that_no_frame_can_be_is_unreadable(bus: FakeBus, bad: can.Message) -> None:
    bus.inbox.extend([bad, message()])
    link = CanLink(bus, "slcan")
    assert link.receive(AT_ONCE) == GOOD
    assert link.health().unreadable == 1
    assert link.health().frames_received == 1


def test_data_after_the_end_of_a_frame_do_not_count(bus: FakeBus) -> None:
    """canalystii delivers eight bytes, however many the frame has."""
    bus.inbox.extend(
        [
            can.Message(arbitration_id=0x725, data=bytes(range(8)), dlc=5, is_extended_id=False),
            can.Message(arbitration_id=0x725, data=bytes(range(8)), dlc=12, is_extended_id=False),
        ]
    )
    link = CanLink(bus, "canalystii")
    assert link.receive(AT_ONCE) == Frame(0x725, bytes(range(5)))
    assert link.receive(AT_ONCE) == Frame(0x725, bytes(range(8)))


def test_an_answer_after_a_damaged_line_is_received_before_its_time_is_over(bus: FakeBus) -> None:
    """After a stall of the computer: what waits is received at once, and drained."""
    link = CanLink(bus, "slcan")
    bus.inbox.extend([ValueError("bad line"), message(0x7FF, bytes(12), is_fd=True), message()])
    assert link.receive(AT_ONCE) == GOOD
    bus.inbox.extend([ValueError("bad line"), message(), ValueError("bad line"), message()])
    assert link.drain() == 2


def test_a_port_that_babbles_does_not_hold_up_who_looks_at_it(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    fd_frame = message(0x7FF, bytes(12), is_fd=True)
    monkeypatch.setattr(bus, "_recv_internal", lambda _timeout: (fd_frame, False))
    link = CanLink(bus, "slcan")
    assert link.receive(AT_ONCE) is None
    assert link.drain() == 0


def test_a_state_that_is_reported_again_and_again_is_no_frame_to_wait_for(bus: FakeBus) -> None:
    passive = Op("Error warning limit exceeded")
    bus._recv_internal = _raiser(passive)  # type: ignore[method-assign]
    link = CanLink(bus, "ixxat")
    for _ in range(3 * adapter._UNREADABLE_LIMIT):
        assert link.receive(AT_ONCE) is None
    assert link.health().error_frames == 3 * adapter._UNREADABLE_LIMIT


def test_the_words_of_the_driver_are_reported_after_those_of_python_can(bus: FakeBus) -> None:
    bus.inbox.append(wrapped(Op(READ_FAILED), SERIAL_GONE))
    with pytest.raises(BusError, match="serial device: device reports readiness"):
        CanLink(bus, "slcan").receive(AT_ONCE)


# -- back ends that say nothing of a lost adapter --------------------------------------------------


@pytest.mark.parametrize("interface", ["gs_usb", "seeedstudio", "socketcand"])
def test_a_back_end_that_returns_nothing_without_waiting_has_lost_its_adapter(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch, interface: str
) -> None:
    ticks = itertools.count(0.0, 0.0001)
    monkeypatch.setattr("flasher.bus.adapter.time.perf_counter", lambda: next(ticks))
    link = CanLink(bus, interface)
    with pytest.raises(BusError, match="returns at once") as caught:
        link.receive(60.0)
    assert caught.value.code is LOST
    assert next(ticks) < 1.0


@pytest.mark.parametrize(
    ("interface", "waits_s"), [("gs_usb", 0.09), ("seeedstudio", 0.001), ("slcan", 0.0001)]
)
def test_a_back_end_that_waits_or_is_none_of_these_is_only_silent(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch, interface: str, waits_s: float
) -> None:
    """seeedstudio waits as long as its port does, whatever the timeout."""
    now = [0.0]

    def wait(_timeout: float | None) -> tuple[None, bool]:
        now[0] += waits_s
        return None, False

    monkeypatch.setattr("flasher.bus.adapter.time.perf_counter", lambda: now[0])
    monkeypatch.setattr(bus, "_recv_internal", wait)
    link = CanLink(bus, interface)
    for turn in range(200):
        assert link.receive(0.1 * turn) is None


@each("at_once, is_lost", [(60, True), (10, False)])
def test_a_computer_that_stalls_does_not_hide_a_lost_adapter(
    bus: FakeBus, monkeypatch: pytest.MonkeyPatch, at_once: int, is_lost: bool
) -> None:
    """Between two calls that take 20 ms, a lost adapter returns at once many times; one that waits
    does so a few times.
    """
    now, calls = [0.0], itertools.count(1)

    def receive(_timeout: float | None) -> tuple[None, bool]:
        now[0] += 0.0001 if next(calls) % (at_once + 1) else 0.02
        return None, False

    monkeypatch.setattr("flasher.bus.adapter.time.perf_counter", lambda: now[0])
    monkeypatch.setattr(bus, "_recv_internal", receive)
    link = CanLink(bus, "socketcand")
    with pytest.raises(BusError, match="returns at once") if is_lost else nullcontext():
        link.receive(10.0)


# -- a full serial port ---------------------------------------------------------------------------


@pytest.mark.parametrize(("interface", "attribute"), [("serial", "_ser"), ("seeedstudio", "ser")])
def test_a_serial_port_whose_back_end_has_no_timeout_is_given_one(
    bus: FakeBus, interface: str, attribute: str
) -> None:
    with serial.serial_for_url("loop://") as port:
        setattr(bus, attribute, port)
        CanLink(bus, interface)
        assert port.write_timeout == SEND_LIMIT_S


def test_a_serial_port_is_closed_whatever_its_back_end_does() -> None:
    """A port that stays open keeps its name: the adapter would come back under another one."""
    fake = FakeBus()
    port = serial.serial_for_url("loop://")
    fake.serialPortOrig = port  # type: ignore[attr-defined]
    link = CanLink(fake, "slcan")
    fake.shutdown = _raiser(Op(WRITE_FAILED))  # type: ignore[method-assign]
    link.close()
    assert not port.is_open
    del fake.shutdown
    fake.shutdown()


# -- real back ends -------------------------------------------------------------------------------


@contextmanager
def looped(interface: str) -> Iterator[tuple[CanLink, Any]]:
    """A back end on a port that gives back what is written to it."""
    options: dict[str, Any] = {"sleep_after_open": 0.0} if interface == "slcan" else {}
    bus = can.Bus("loop://", interface, ignore_config=True, **options)
    link = CanLink(bus, interface, "loop://")
    port = link._port
    port.reset_input_buffer()
    try:
        yield link, port
    finally:
        link.close()


SLCAN_GOOD = b"t725101\r"


@each(
    "bad",
    [
        b"t\r",
        b"t72\r",
        b"t7258\r",
        b"t725801020304\r",
        b"t7251G1\r",
        b"t7\x0051\r",
        b"tFF5101\r",
        b"T72\r",
        b"TFFFFFFFF0\r",
        b"r72\r",
        b"t-25101\r",
        b"\xff\xfe\r",
        b"t725\xe4101\r",
    ],
)
def test_a_damaged_line_of_a_real_slcan_costs_one_frame(bad: bytes) -> None:
    with looped("slcan") as (link, port):
        port.write(SLCAN_GOOD + bad)
        frames = [link.receive(AT_ONCE), link.receive(AT_ONCE)]
        assert frames == [GOOD, None]
        assert link.health().unreadable == 1
        port.write(SLCAN_GOOD)
        assert link.receive(AT_ONCE) == GOOD
        assert link.receive(AT_ONCE) is None


def test_what_an_slcan_adapter_confirms_hides_no_answer() -> None:
    with looped("slcan") as (link, port):
        port.write(b"z\r" * 18 + SLCAN_GOOD)
        assert link.receive(AT_ONCE) == GOOD


SERIAL_GOOD = b"\xaa" + bytes(4) + b"\x01" + (0x725).to_bytes(4, "little") + b"\x01\xbb"


@pytest.mark.slow
@each(
    "bad",
    [
        b"\xaa" + bytes(4) + b"\x09",  # a length that no frame has
        b"\xaa\x00",  # cut in its time stamp
        b"\xaa" + bytes(4),  # before its length
        SERIAL_GOOD[:-1],  # before its end
        SERIAL_GOOD[:-1] + b"\xbc",
    ],
)
def test_a_damaged_frame_of_the_serial_back_end_costs_one_frame(bad: bytes) -> None:
    with looped("serial") as (link, port):
        port.write(bad)
        assert link.receive(AT_ONCE) is None
        assert link.health().unreadable == 1
        port.write(SERIAL_GOOD)
        assert link.receive(AT_ONCE) == GOOD


def test_a_serial_port_that_is_gone_is_lost_at_once() -> None:
    for interface in ("serial", "robotell", "slcan"):
        with looped(interface) as (link, port):
            port.close()
            with pytest.raises(BusError) as caught:
                link.receive(AT_ONCE)
            assert caught.value.code is LOST
            with pytest.raises(BusError) as caught:
                link.send(FRAME)
            assert caught.value.code is LOST


@contextmanager
def socketcand() -> Iterator[tuple[CanLink, socket.socket]]:
    """The back end, and the server's end of its connection."""
    server = socket.create_server(("127.0.0.1", 0))
    accepted: list[socket.socket] = []

    def greet() -> None:
        connection, _ = server.accept()
        accepted.append(connection)
        for hello in (b"< hi >", b"< ok >", b"< ok >"):
            connection.sendall(hello)
            connection.recv(256)

    greeter = threading.Thread(target=greet)
    greeter.start()
    bus = can.Bus(
        interface="socketcand",
        channel="can0",
        host="127.0.0.1",
        port=server.getsockname()[1],
        ignore_config=True,
    )
    link = CanLink(bus, "socketcand", "can0")
    link.send(FRAME)  # the third thing that the server waits for
    greeter.join()
    try:
        yield link, accepted[0]
    finally:
        link.close()
        accepted[0].close()
        server.close()


@pytest.mark.slow
def test_a_socketcand_that_sends_nonsense_or_is_gone_is_lost() -> None:
    with socketcand() as (link, server):
        server.sendall(b"< frame 725 0.1 01 >< frame 7zz 0.2 01 >")
        with pytest.raises(BusError, match="7zz") as caught:
            link.receive(time.perf_counter() + 10.0)
        assert caught.value.code is LOST
        assert "Traceback" not in caught.value.what
    with socketcand() as (link, server):
        server.close()
        with pytest.raises(BusError, match="returns at once") as caught:
            link.receive(time.perf_counter() + 10.0)
        assert caught.value.code is LOST


def fails_to_open_socketcand(port: int, why: str) -> None:
    config = {"interface": "socketcand", "channel": "can0", "host": "127.0.0.1", "port": port}
    with pytest.raises(BusError, match=f"cannot be opened: .*{why}") as caught:
        open_bus(config)
    assert "no socketcand server answers" in caught.value.cause
    assert "Start socketcand there" in caught.value.remedy
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # python-can leaves its socket open
        caught.value.__cause__ = None
        del caught
        gc.collect()


def test_a_socketcand_that_does_not_greet_ends_in_bounded_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.bus.opening._ANSWER_LIMIT_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as server:
        fails_to_open_socketcand(server.getsockname()[1], "timed out")
    assert socket.getdefaulttimeout() is None


def test_what_a_server_answers_in_place_of_a_greeting_reaches_no_terminal_as_it_is() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            with server.accept()[0] as connection:
                connection.sendall(b"\x1b[2JHTTP/1.1 400\r\n\x07")

        answering = threading.Thread(target=answer)
        answering.start()
        fails_to_open_socketcand(server.getsockname()[1], r"'\\x1b\[2JHTTP/1.1 400 \\x07'")
        answering.join()


def test_a_socketcand_server_that_is_down_is_tried_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[object] = []

    def refuse(_socket: socket.socket, address: object) -> None:
        tries.append(address)
        if len(tries) > 1:
            pytest.fail("it is tried again without a pause")
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    fails_to_open_socketcand(29536, "Connection refused")
    assert tries == [("127.0.0.1", 29536)]


@each("given, tuned", [({}, True), ({"tcp_tune": False}, False)])
def test_frames_to_a_socketcand_server_do_not_wait_for_the_confirmation_of_the_last_one(
    monkeypatch: pytest.MonkeyPatch, given: dict[str, bool], tuned: bool
) -> None:
    seen: list[dict[str, Any]] = []
    monkeypatch.setattr("can.Bus", lambda **config: seen.append(config))
    monkeypatch.setattr("platform.system", lambda: "Linux")
    open_bus({"interface": "socketcand", "channel": "can0", **given})
    assert seen[0]["tcp_tune"] is tuned


def test_two_threads_that_open_a_socketcand_leave_sockets_without_a_limit() -> None:
    second_is_in, first_is_out = threading.Event(), threading.Event()

    def open_second() -> None:
        with opening._answers_limited():
            second_is_in.set()
            first_is_out.wait(10.0)

    second = threading.Thread(target=open_second)
    with opening._answers_limited():
        second.start()
        second_is_in.wait(0.05)  # it has to wait for the first one
    first_is_out.set()
    second.join()
    assert socket.getdefaulttimeout() is None


def test_a_controller_that_is_off_by_exception_is_reported_as_by_an_error_frame(
    bus: FakeBus,
) -> None:
    bus.inbox.append(Op("Bus off status"))
    link = CanLink(bus, "ixxat")
    with pytest.raises(BusError):
        link.receive(AT_ONCE)
    assert link.health().state is ControllerState.BUS_OFF
