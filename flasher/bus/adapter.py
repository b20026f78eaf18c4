"""A real adapter behind a `Link`, through python-can.

What python-can leaves to its users is done here: the bit rate never falls back to an adapter's own
default (a wrong one disturbs a live bus), a full transmit queue is waited for (every back end says
"full" in its own way), timeouts go by the monotonic clock, and foreign exceptions end at this edge.
"""

from __future__ import annotations

import configparser
import contextlib
import errno
import re
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

import can
import can.util

from flasher.bus.link import SEND_LIMIT_S
from flasher.errors import BusError, TransmitBlockedError, UsageError
from flasher.protocol.frame import Frame

_FULL_QUEUE_PAUSE_S: Final = 0.0005
"""Between two tries on a full queue: about one frame on the wire. Frames are received meanwhile."""
_CHANNELS: Final = {"socketcan": "can0", "pcan": "PCAN_USBBUS1", "slcan": "COM3"}
_DRAIN_FRAMES: Final = 100_000
_FAILURES: Final = (can.CanError, OSError)

_QUEUE_FULL_CODES: Final[Mapping[str, frozenset[int]]] = {
    "socketcan": frozenset({errno.ENOBUFS, errno.EAGAIN}),
    "kvaser": frozenset({-13}),  # canERR_TXBUFOFL
    "vector": frozenset({11}),  # XL_ERR_QUEUE_IS_FULL
    "systec": frozenset({0x01, 0x80}),  # CANERR_XMTFULL, CANERR_QXMTFULL
}
"""Error codes of back ends that hand on the driver's code."""
_QUEUE_FULL_TEXT: Final = re.compile(
    r"(transmit|send|tx|xmt)[ _-]?(queue|buffer|fifo)?.*\b(full|overflow)|TXQUEUE_FULL|XMTFULL",
    re.IGNORECASE,
)
"""What the others say in words (PCAN, IXXAT, and SocketCAN's own "Transmit buffer full")."""


def open_adapter(default_bitrate_bps: int, **config: Any) -> CanLink:
    """Open the adapter that `config` (python-can's keywords), its files and variables describe.

    `default_bitrate_bps` holds where none of them names a bit rate. Raises UsageError for an
    interface that python-can does not know, BusError when the adapter cannot be opened.
    """
    try:
        merged = dict(can.util.load_config(config=dict(config)))
    except can.CanInterfaceNotImplementedError as error:
        raise _no_interface(error) from error
    except (ValueError, TypeError, configparser.Error) as error:
        raise UsageError(
            f"The adapter's configuration makes no sense: {error}.",
            remedy="Check the bus arguments, python-can's configuration file and CAN_* variables.",
        ) from error
    if "timing" not in merged:
        merged.setdefault("bitrate", default_bitrate_bps)
    interface = str(merged["interface"])
    try:
        bus = can.Bus(**merged, ignore_config=True)
    except Exception as error:
        raise BusError(
            f"The adapter cannot be opened: {_words(error)}.",
            where=f"interface {interface}, channel {merged.get('channel')}",
            cause=_opening_cause(interface, error),
            remedy=_opening_remedy(
                interface, merged.get("channel"), merged.get("bitrate", default_bitrate_bps)
            ),
        ) from error
    return CanLink(bus, interface, str(merged.get("channel") or ""))


class CanLink:
    """A python-can bus as a `Link` on the monotonic clock."""

    def __init__(self, bus: can.BusABC, interface: str, channel: str = "") -> None:
        self._bus = bus
        self._interface = interface
        self._name = f"{interface} {channel}".strip()
        self._waiting: deque[Frame] = deque()
        # recv() measures its timeout by the wall clock, so that a jump of it can hang the call;
        # what it wraps does not. No filters are set that would need the wrapper, unless the back
        # end was given some and leaves them to it.
        self._receive_raw = (
            bus._recv_internal  # noqa: SLF001
            if type(bus).recv is can.BusABC.recv
            else lambda timeout: (bus.recv(timeout), True)
        )
        self._send_options: dict[str, float] = {}
        if interface == "slcan":
            # The serial port would block for ever; elsewhere the option costs time or is ignored.
            self._send_options["timeout"] = SEND_LIMIT_S

    def __str__(self) -> str:
        """The adapter as the user named it."""
        return self._name

    def send(self, frame: Frame) -> None:
        """Hand a frame to the adapter; a full queue is waited for up to `SEND_LIMIT_S`."""
        give_up_at: float | None = None
        while True:
            # A back end may alter a message: never the same object twice.
            message = can.Message(
                arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
            )
            try:
                self._bus.send(message, **self._send_options)
            except _FAILURES as error:
                if not self._is_queue_full(error):
                    raise self._failure("sending", error) from error
                now = time.monotonic()
                if give_up_at is None:
                    give_up_at = now + SEND_LIMIT_S
                elif now >= give_up_at:
                    raise self._blocked(error) from error
                self._pause()
            else:
                return

    def receive(self, deadline: float) -> Frame | None:
        """The next frame, or None at `deadline` (monotonic clock)."""
        if self._waiting:
            return self._waiting.popleft()
        remaining_s = deadline - time.monotonic()
        frame = self._receive_once(max(remaining_s, 0.0))
        # A filtered or foreign frame ends a wait early.
        while frame is None and (remaining_s := deadline - time.monotonic()) > 0:
            frame = self._receive_once(remaining_s)
        return frame

    def drain(self) -> int:
        """Throw away what is waiting, bounded on a babbling bus."""
        count = len(self._waiting)
        self._waiting.clear()
        while count < _DRAIN_FRAMES and self._receive_once(0.0) is not None:
            count += 1
        return count

    def close(self) -> None:
        """Shut the adapter down; a failure to do so is of no interest any more."""
        with contextlib.suppress(*_FAILURES):
            self._bus.shutdown()

    def _receive_once(self, timeout_s: float) -> Frame | None:
        try:
            message, filtered = self._receive_raw(timeout_s)
        except _FAILURES as error:
            if _is_foreign_datagram(error):
                return None
            raise self._failure("receiving", error) from error
        if message is None or message.is_fd:
            return None
        if not filtered and not self._bus._matches_filters(message):  # noqa: SLF001  as recv() does
            return None
        return Frame(
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_remote_frame,
            message.is_error_frame,
        )

    def _pause(self) -> None:
        """Wait for room in the transmit queue, and lose nothing that arrives meanwhile."""
        frame = self._receive_once(_FULL_QUEUE_PAUSE_S)
        if frame is not None:
            self._waiting.append(frame)

    def _is_queue_full(self, error: Exception) -> bool:
        code = getattr(error, "error_code", None)
        if code is not None and code in _QUEUE_FULL_CODES.get(self._interface, ()):
            return True
        return _QUEUE_FULL_TEXT.search(str(error)) is not None

    def _failure(self, doing: str, error: Exception) -> BusError:
        return BusError(
            f"The adapter failed while {doing}: {_words(error)}.",
            where=str(self),
            cause="it was unplugged, its interface went down, or the bus is off",
            remedy="Check the adapter and the wiring, then run the same command again.",
        )

    def _blocked(self, error: Exception) -> TransmitBlockedError:
        return TransmitBlockedError(
            f"The adapter took no frame for {SEND_LIMIT_S:g} s: {_words(error)}.",
            where=str(self),
            cause="nobody on the bus acknowledges (device off, wrong bit rate, wiring, "
            "termination), or other traffic takes the whole bus",
            remedy="Check that the device has power and that the bit rate is right.",
        )


def _is_foreign_datagram(error: Exception) -> bool:
    """Something else than a CAN frame on udp_multicast's port, which anybody may send to."""
    return "could not unpack" in str(error)


def _words(error: Exception) -> str:
    """What the back end said, without a full stop, or the kind of error when it said nothing."""
    return str(error).strip().rstrip(".") or type(error).__name__


def _no_interface(error: Exception) -> UsageError | BusError:
    known = ", ".join(sorted(can.VALID_INTERFACES))
    if '"None"' in str(error):
        return BusError(
            "No adapter is configured.",
            cause="neither -i/--interface, nor a python-can configuration file, nor the variable "
            "CAN_INTERFACE names one",
            remedy="Name it, for example `-i socketcan -c can0` or `-i pcan -c PCAN_USBBUS1`; "
            f"--mock needs none. Interfaces: {known}.",
        )
    return UsageError(f"{_words(error)}.", remedy=f"python-can knows: {known}.")


def _opening_cause(interface: str, error: Exception) -> str:
    if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
        return "this system's kernel has no CAN"
    if interface == "socketcan":
        return "the interface does not exist or is down"
    if isinstance(error, NameError | ImportError | AttributeError):
        return "the driver library of this interface is not installed"
    return "the adapter is not plugged in, in use by another program, or its driver is missing"


def _opening_remedy(interface: str, channel: object, bitrate_bps: object) -> str:
    if channel is None:
        return f"Name the channel, for example `-i {interface} -c {_CHANNELS.get(interface, 0)}`."
    if interface == "socketcan":
        return (
            f"`ip -details link show {channel}` shows its state; "
            f"`ip link set {channel} up type can bitrate {bitrate_bps}` (as root) starts it."
        )
    return (
        "Plug it in, close other programs that use it, install its driver and python-can's extra "
        f"for it (`pip install 'python-can[{interface}]'` where there is one)."
    )
