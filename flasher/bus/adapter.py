"""CAN adapter: a `Link` through python-can.

Differences from a plain `can.Bus`: the bit rate never defaults to the adapter's, because a wrong
one disturbs a live bus; a full transmit queue is waited for, however the back end reports it;
timeouts use the monotonic clock; every back end's exceptions become BusError.
"""

from __future__ import annotations

import contextlib
import platform
import time
from collections import deque
from collections.abc import Callable, Mapping
from itertools import compress
from typing import Any, Final, NoReturn

from flasher.bus.back_ends import (
    SERIAL_PORTS,
    SILENT_WHEN_GONE,
    TAKES_SEND_TIMEOUT,
    Meaning,
    causes,
    error_text,
    is_foreign_datagram,
    meaning_of_receive_error,
    meaning_of_send_error,
)
from flasher.bus.bit_rate import BitRate, bit_rate
from flasher.bus.detect import DetectedAdapter, plugged_in
from flasher.bus.echoes import FLAGGED_SENDER, Echoes, Sender
from flasher.bus.fallback import Fallback
from flasher.bus.health import (
    LAYOUTS,
    BusTrouble,
    ControllerState,
    HealthKeeper,
    Layout,
    LinkHealth,
    bus_off_error,
    refused_error,
    unreadable_error,
)
from flasher.bus.inspect_interface import Interface, read_interface
from flasher.bus.link import AT_ONCE, SEND_LIMIT_S
from flasher.bus.lock import acquire, lock_name
from flasher.bus.opening import bus_config, open_bus
from flasher.bus.physical import is_physical
from flasher.errors import BusError, ErrorCode, TransmitBlockedError
from flasher.i18n import text
from flasher.protocol.frame import EXTENDED_ID_MAX, STANDARD_ID_MAX, Frame
from flasher.protocol.spec import FRAME_DATA_SIZE
from flasher.protocol.text import printable
from flasher.python_can import can

_FULL_QUEUE_PAUSE_S: Final = 0.0005
"""Pause between two tries on a full transmit queue: about one frame on the wire. Frames are
received meanwhile."""
_DRAIN_FRAMES: Final = 100_000
_KERNEL_STAMPS: Final = frozenset({"socketcan", "udp_multicast"})
"""Back ends whose messages have Linux's receive time (wall clock)."""
_STAMP_AGE_MAX_S: Final = 1.0
"""Maximum age of a frame by its time stamp; an older one means that the wall clock was set."""
_UNREADABLE_LIMIT: Final = 100
"""Consecutive unreadable inputs after which the adapter counts as broken."""
_REFUSED_LIMIT: Final = 36
"""Frames in a row that an slcan adapter refuses, two whole packets, after which it counts as lost:
its channel is closed after a restart, and opening it again may help."""
_BEL: Final = b"\a"
_CR: Final = b"\r"
_SKIPPED_LIMIT: Final = 1000
"""Maximum number of inputs that one receive skips: a babbling serial port is never empty."""
_WAIT_MIN_S: Final = 0.02
"""Shortest timeout that is checked; a shorter one may end early by rounding."""
_INSTANT_S: Final = 0.0005
"""A back end that returns no frame sooner than this did not wait."""
_INSTANT_LIMIT_S: Final = 0.25
_INSTANT_LIMIT: Final = 100
"""Number of returns without waiting, and their minimum duration, that mean a lost adapter."""
_PCAN_BUS_OFF: Final = 0x00010
_PCAN_PASSIVE: Final = 0x40000
_PCAN_WARNING: Final = 0x00004 | 0x00008


def open_adapter(
    default_bitrate_bps: int,
    *,
    holder: str | None = None,
    sends: bool = True,
    listen_only: bool = False,
    by_place: bool = False,
    fallback: Fallback | None = None,
    **config: Any,
) -> CanLink:
    """Open a CAN adapter by python-can's keywords (`config`), python-can's variables and files, and
    the settings file (`fallback`).

    `default_bitrate_bps` is the dialect's bit rate, which applies unless `config` names another
    one. `holder` locks the adapter until it is closed (`lock.acquire`). With `sends`, an interface
    in listen-only mode is refused. `listen_only` keeps the adapter from acknowledging, if its back
    end supports that (`opening.can_listen_only`). A lost adapter is found again by its serial
    number if it has one; with `by_place`, by its USB path, whatever its serial number is.

    Raises UsageError for an unknown interface or an invalid bit rate; BusError if the bit rate
    differs, the adapter cannot be opened, or another program holds it.
    """
    merged = bus_config(config, fallback, listen_only=listen_only)
    rate = bit_rate(default_bitrate_bps, config, merged, fallback)
    settings = merged if "timing" in merged else {**merged, "bitrate": rate.bps}

    interface = str(merged["interface"])
    channel = "" if merged.get("channel") is None else str(merged["channel"])
    place, release = lock_name(merged), acquire(merged, holder)

    def open_again() -> can.BusABC:
        nonlocal place, release
        try:
            if known is not None:
                name = _find_again(known, by_place=by_place, has_twin=has_twin)
                given, *rate_of_port = channel.partition("@")  # slcan: DEVICE@BAUDRATE
                name = "".join((given if name == known.channel else name, *rate_of_port))
                link.channel = merged["channel"] = settings["channel"] = name
        except BusError:
            release()  # it may belong to the adapter that has the name now
            link.channel = place = ""
            raise
        # A symbolic link may lead to another serial port now.
        if (new_place := lock_name(merged)) != place:
            release()  # first: another program may wait for it, whose lock this one needs
            place = ""
            release = acquire(merged, holder)
            place = new_place
        # The interface may have come back with other settings.
        bit_rate(default_bitrate_bps, config, merged, fallback)
        return open_bus(settings, sends=sends)

    try:
        link = CanLink(
            open_bus(settings, sends=sends),
            interface,
            channel,
            open_again,
            lambda: release(),  # noqa: PLW0108  replaced when reopened
            gives_own=interface != "socketcan" or bool(merged.get("receive_own_messages")),
            chosen_by=DetectedAdapter(interface, channel, merged).bus_kwargs,
        )
    except BaseException:
        release()
        raise
    link.bit_rate = rate
    listed = [each for each in plugged_in(interface) if any(each.identity)]
    is_known = (lock_name({**merged, "channel": each.channel}) == place for each in listed)
    known = next(compress(listed, is_known), None)
    has_twin = known is not None and [each.identity for each in listed].count(known.identity) > 1
    return link


def _find_again(known: DetectedAdapter, *, by_place: bool, has_twin: bool) -> str:
    """Return the channel of an adapter, whose name may have changed when it was plugged in again.
    Ports that cannot be told apart keep their names. Raises BusError if another adapter has its
    name now.
    """
    found = plugged_in(known.interface)
    if by_place:
        same = [each for each in found if each.place == known.place]
    else:
        same = [each for each in found if each.identity == known.identity]
    if has_twin or len(same) > 1:  # makers may give all adapters one serial number
        same = [each for each in same if each.usb_path == known.usb_path]
    if len(same) == 1:
        return same[0].channel
    if all(each in same for each in found if each.channel == known.channel):
        return known.channel
    raise BusError(
        f"{printable(known.channel)} is the name of another adapter now.",
        where=known.interface,
        cause=f"the adapter {printable(known.identity[0])} is not plugged in any more, or it has "
        "no serial number of its own and is in another port",
        remedy="Plug it in where it was.",
        code=ErrorCode.ADAPTER_LOST,
    )


class CanLink:
    """`Link` of a python-can bus; deadlines are times of `time.perf_counter`."""

    def __init__(
        self,
        bus: can.BusABC,
        interface: str,
        channel: str = "",
        open_again: Callable[[], can.BusABC] | None = None,
        release: Callable[[], None] = lambda: None,
        *,
        gives_own: bool = True,
        chosen_by: Mapping[str, Any] | None = None,
    ) -> None:
        self._release = release
        self._chosen_by = [f"{key}={value}" for key, value in (chosen_by or {}).items()]
        self._interface = interface
        self.channel = channel
        """Channel of the adapter; may be empty, also while another adapter has its name."""
        self._open_again = open_again
        self.bit_rate: BitRate | None = None
        """Bit rate of the bus; None if unknown."""
        self._waiting: deque[tuple[Frame, float | None]] = deque()
        is_stamped = interface in _KERNEL_STAMPS and platform.system() == "Linux"
        self.stamp_source = "kernel" if is_stamped else ""
        self.received_at: float | None = None
        """Arrival time of the last frame returned by `receive` (`StampingLink`)."""
        self._health = HealthKeeper(LAYOUTS.get(interface, Layout.UNKNOWN))
        sender = FLAGGED_SENDER.get(interface, Sender.UNKNOWN)
        self._echoes = Echoes(sender, gives_own=gives_own)
        takes_timeout = interface in TAKES_SEND_TIMEOUT
        self._send_options = {"timeout": SEND_LIMIT_S} if takes_timeout else {}
        self._use(bus)

    def _use(self, bus: can.BusABC | None) -> None:
        """Send and receive through this bus; None while the adapter is gone."""
        self._bus = bus
        self._port: Any = getattr(bus, SERIAL_PORTS.get(self._interface, ""), None)
        """pyserial port of the back end; None without one."""
        if self._port is not None and not self._send_options:
            self._port.write_timeout = SEND_LIMIT_S  # otherwise a full port blocks forever
        self._unreadable_in_a_row = self._refused_in_a_row = 0
        if self._port is not None and self._interface == "slcan":
            self._count_refusals(self._port)
        self._instant_returns = 0
        """Consecutive receives that ended at once without a frame."""
        self._instant_since = 0.0
        self._has_skipped_input = False
        """The last receive consumed an input that is not a frame, or not one for the caller."""
        self._send_raw: Callable[..., None] = _no_bus if bus is None else bus.send
        # recv() measures its timeout by the wall clock, so that a clock jump can hang the call; the
        # wrapped method does not. Its filters are only needed if the back end got some and leaves
        # them to the wrapper.
        self._receive_raw: Callable[[float], tuple[can.Message | None, bool]]
        if bus is None:
            self._receive_raw = _no_bus
        elif type(bus).recv is can.BusABC.recv:
            self._receive_raw = bus._recv_internal  # noqa: SLF001
        else:
            self._receive_raw = lambda timeout: (bus.recv(timeout), True)

    def _count_refusals(self, port: Any) -> None:
        """Count the frames that the adapter refuses: it answers them by BEL, which python-can drops
        (and the commands that opened it, which do not count).
        """
        read = port.read

        def counting(size: int = 1) -> bytes:
            data: bytes = read(size)
            if data == _BEL and self._health.sent:
                self._health.refused += 1
                self._refused_in_a_row += 1
            elif data == _CR:
                self._refused_in_a_row = 0
            return data

        port.read = counting

    def __str__(self) -> str:
        """Name of the adapter, with what distinguishes it from others with its channel."""
        return " ".join(filter(None, (self._interface, self.channel, *self._chosen_by)))

    def send(self, frame: Frame) -> None:
        """Pass a frame to the adapter; wait up to `SEND_LIMIT_S` for room in a full transmit queue.
        The data of a remote frame give the length of the requested answer.

        Raises TransmitBlockedError for a full queue; BusError if the adapter fails or is bus-off,
        when its driver may still accept frames, and lose them.
        """
        give_up_at: float | None = None
        if self._health.state is ControllerState.BUS_OFF:
            raise bus_off_error(str(self), "The adapter failed while sending: it is bus-off.")
        while True:
            # A back end may modify a message: never pass the same object twice.
            message = _message_of(frame)
            try:
                self._send_raw(message, **self._send_options)
            except MemoryError:
                raise
            except Exception as error:
                meaning = meaning_of_send_error(error, self._interface)
                if meaning is not Meaning.QUEUE_FULL:
                    raise self._failure("sending", error, meaning) from error
                now = time.perf_counter()
                has_waited = self._send_options or self._port is not None
                if has_waited or (give_up_at is not None and now >= give_up_at):
                    self._health.is_blocked = True
                    raise self._blocked(error) from error
                give_up_at = give_up_at or now + SEND_LIMIT_S
                self._pause()
            else:
                self._health.sent += 1
                sent = frame._replace(data=b"") if frame[3] else frame  # as its echo
                self._echoes.sent(sent)
                return

    def receive(self, deadline: float) -> Frame | None:
        """Return the next frame, or None at `deadline` (time of `time.perf_counter`)."""
        if self._waiting:
            waited, self.received_at = self._waiting.popleft()
            return waited
        if deadline == AT_ONCE:
            for _ in range(_SKIPPED_LIMIT):
                frame = self._receive_once(0.0)
                if frame is not None or not self._is_more_waiting():
                    return frame
            return None
        frame = self._receive_once(max(0.0, deadline - time.perf_counter()))
        # A filtered or foreign frame ends the wait early.
        while frame is None and (remaining_s := deadline - time.perf_counter()) > 0:
            frame = self._receive_once(remaining_s)
        return frame

    def drain(self) -> int:
        """Discard received frames, up to a limit on a babbling bus; return their number."""
        count = len(self._waiting)
        self._waiting.clear()
        while count < _DRAIN_FRAMES and self.receive(AT_ONCE) is not None:
            count += 1
        return count

    def close(self) -> None:
        """Shut the adapter down and unlock it; failures are ignored. It cannot be reopened."""
        self._open_again = _open_closed  # an upgrade would open it without its lock
        self._shut_down()
        self._use(None)
        self._release()

    def _shut_down(self) -> None:
        if self._bus is not None:
            with contextlib.suppress(Exception):
                self._bus.shutdown()
        if self._port is not None:
            # A failing back end leaves it open; Linux then renames the adapter when it is plugged
            # in again.
            with contextlib.suppress(Exception):
                self._port.close()

    def reopen(self) -> None:
        """Close the adapter and open it again with the same settings. Raises BusError while it is
        gone.

        Received frames are discarded, and the health is reset.
        """
        if self._open_again is None:
            raise BusError(
                "This adapter cannot be opened again.", where=str(self), code=ErrorCode.ADAPTER_LOST
            )
        self._shut_down()
        self._use(None)
        self._waiting.clear()
        self._use(self._open_again())
        self._health.reset()
        self._echoes.reopened()

    @property
    def is_off(self) -> bool:
        """True while the adapter reports bus-off."""
        return self._health.state is ControllerState.BUS_OFF

    @property
    def is_physical(self) -> bool:
        """True unless the bus is known to be virtual."""
        return is_physical(self._interface, self.channel)

    def health(self) -> LinkHealth:
        """Return the health of adapter and bus without sending. Takes up to 2 s on SocketCAN."""
        if self._interface == "socketcan" and self.channel:
            state = read_interface(self.channel)
            if isinstance(state, Interface):
                return self._health.health(state.state, state.tx_errors, state.rx_errors)
        return self._health.health(_reported_state(self._bus, self._interface))

    def _is_more_waiting(self) -> bool:
        """True if frames may be waiting although the last receive returned none."""
        if self._has_skipped_input or self._port is None:
            return self._has_skipped_input
        try:  # a serial back end returns after each line
            return bool(self._port.in_waiting)
        except Exception:  # noqa: BLE001  the next receive reports the failure
            return False

    def _receive_once(self, timeout_s: float) -> Frame | None:
        began = time.perf_counter() if self._interface in SILENT_WHEN_GONE else 0.0
        try:
            message, filtered = self._receive_raw(timeout_s)
            frame = None if message is None or message.is_fd else _frame_of(message)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  a back end may raise anything
            self._judge(error)
            return None
        self._has_skipped_input = message is not None
        if message is None:
            if self._refused_in_a_row >= _REFUSED_LIMIT:
                self._refused_in_a_row = 0
                raise refused_error(str(self), f"{_REFUSED_LIMIT} frames in a row")
            if began:
                self._check_instant_return(began, timeout_s)
            return None
        if frame is None:
            return None
        self._unreadable_in_a_row = self._instant_returns = 0
        if self.stamp_source:
            self.received_at = _moment_of(message)
        if frame[0] in self._echoes.ids:
            frame = self._echoes.mark(frame, message.timestamp, is_rx=message.is_rx)
        # Filtered frames count as received; error frames pass the filters.
        if message.is_error_frame:
            self._health.count_frame(frame)
            return frame
        self._health.received += 1
        if filtered or self._bus is None:
            return frame
        is_wanted = self._bus._matches_filters(message)  # noqa: SLF001  as recv() does
        return frame if is_wanted else None

    def _judge(self, error: Exception) -> None:
        """Return for a receive error after which the adapter still works; else raise BusError."""
        meaning = meaning_of_receive_error(error, self._interface)
        self._has_skipped_input = meaning is Meaning.UNREADABLE
        if isinstance(meaning, BusTrouble):
            self._health.report(meaning)
        elif meaning is Meaning.UNREADABLE:
            self._health.add_unreadable(error_text(error))
            if is_foreign_datagram(error):
                return
            self._unreadable_in_a_row += 1
            if self._unreadable_in_a_row > _UNREADABLE_LIMIT:
                raise self._failure("receiving", error, meaning) from error
            if any(isinstance(each, UnicodeDecodeError) for each in causes(error)):
                # slcan keeps a line that is not text, and fails on it again.
                with contextlib.suppress(Exception):
                    self._bus.flush()  # type: ignore[union-attr]
        else:
            raise self._failure("receiving", error, meaning) from error

    def _check_instant_return(self, began: float, timeout_s: float) -> None:
        """Raise BusError if the back end keeps returning at once without a frame."""
        now = time.perf_counter()
        if timeout_s < _WAIT_MIN_S:
            return
        if now - began > _INSTANT_S:
            if now - began > _WAIT_MIN_S / 2:  # it waited, or a busy computer held it up
                self._instant_returns -= -(-self._instant_returns // 4)
            return
        if not self._instant_returns:
            self._instant_since = began
        self._instant_returns += 1
        if self._instant_returns > _INSTANT_LIMIT and now - self._instant_since > _INSTANT_LIMIT_S:
            gone = can.CanOperationError("it returns at once, with nothing")
            raise self._failure("receiving", gone, Meaning.LOST)

    def _pause(self) -> None:
        """Wait for room in the transmit queue, and keep frames that arrive meanwhile."""
        frame = self._receive_once(_FULL_QUEUE_PAUSE_S)
        if frame is not None:
            self._waiting.append((frame, self.received_at))

    def _failure(self, doing: str, error: Exception, meaning: Meaning) -> BusError:
        what = f"The adapter failed while {doing}: {error_text(error)}."
        if meaning is Meaning.BUS_OFF:
            self._health.state = ControllerState.BUS_OFF
            return bus_off_error(str(self), what)
        if meaning is Meaning.UNREADABLE:
            how_often = f"{self._unreadable_in_a_row} times in a row"
            return unreadable_error(str(self), how_often, error_text(error))
        return BusError(
            what,
            where=str(self),
            cause="it was unplugged, its interface went down, or the bus is off",
            remedy="Check the adapter and the wiring. Run the same command again.",
            code=ErrorCode.ADAPTER_LOST,
        )

    def _blocked(self, error: Exception) -> TransmitBlockedError:
        cause = (
            "no node on the bus acknowledges (device off, wrong bit rate, wiring, termination), or "
            "other traffic takes the whole bus"
        )
        remedy = "Check that the device has power and that the bit rate is right."
        if self._port is not None:
            cause = text("the adapter hangs; or {cause}", cause=cause)
            remedy = text("{remedy} Unplug the adapter and plug it in again.", remedy=remedy)
        return TransmitBlockedError(
            f"The adapter took no frame for {SEND_LIMIT_S:g} s: {error_text(error)}.",
            where=str(self),
            cause=cause,
            remedy=remedy,
        )


def _moment_of(message: can.Message) -> float | None:
    """Convert the kernel's time stamp to the monotonic clock; None if the wall clock was set."""
    age_s = time.time() - message.timestamp
    return time.perf_counter() - age_s if 0.0 <= age_s <= _STAMP_AGE_MAX_S else None


def _no_bus(*_arguments: object, **_options: object) -> NoReturn:
    """Replaces send and receive while the adapter is gone."""
    raise can.CanOperationError("it is not open")


def _open_closed() -> NoReturn:
    """Replaces opening again once the adapter was closed."""
    raise BusError(
        "The connection to the adapter was closed.",
        cause="it is used after the end of its block",
        remedy="Open a new connection.",
        code=ErrorCode.ADAPTER_LOST,
    )


def _reported_state(bus: can.BusABC | None, interface: str) -> ControllerState:
    """Ask a back end for the controller state. python-can's default `state` is constant, and PCAN's
    is the configured mode; only overrides report ERROR.
    """
    try:
        if interface == "pcan":
            return _pcan_state(int(bus.status()))  # type: ignore[union-attr]
        if bus is not None and bus.state is can.BusState.ERROR:
            return ControllerState.BUS_OFF
    except Exception:  # noqa: BLE001  a vendor's library; this query must not fail
        return ControllerState.UNKNOWN
    return ControllerState.UNKNOWN


def _pcan_state(status: int) -> ControllerState:
    if status & _PCAN_BUS_OFF:
        return ControllerState.BUS_OFF
    if status & _PCAN_PASSIVE:
        return ControllerState.PASSIVE
    return ControllerState.UNKNOWN if status & ~_PCAN_WARNING else ControllerState.ACTIVE


def _frame_of(message: can.Message) -> Frame:
    """Convert a python-can message to a frame; data past 8 bytes are cut off. Raises ValueError for
    impossible ids and lengths, which slcan makes of a damaged line.
    """
    can_id, is_extended, data = message.arbitration_id, message.is_extended_id, message.data
    if message.is_error_frame:
        return Frame(can_id, bytes(data), is_extended, message.is_remote_frame, is_error=True)
    if not 0 <= can_id <= (EXTENDED_ID_MAX if is_extended else STANDARD_ID_MAX):
        raise ValueError(f"no frame has the id 0x{can_id:X}")
    if message.is_remote_frame:
        return Frame(can_id, b"", is_extended, is_remote=True)
    size = min(message.dlc, FRAME_DATA_SIZE)
    if len(data) < size:
        raise ValueError(f"a frame of {size} bytes has only {len(data)}")
    return Frame(can_id, bytes(data[:size]), is_extended)


def _message_of(frame: Frame) -> can.Message:
    """Convert a frame to a python-can message."""
    can_id, data, is_extended, is_remote = frame[:4]
    if is_remote:
        return can.Message(
            arbitration_id=can_id, is_extended_id=is_extended, is_remote_frame=True, dlc=len(data)
        )
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=is_extended)
