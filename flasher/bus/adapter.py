"""A real adapter behind a `Link`, through python-can.

What python-can leaves to its users is done here: the bit rate never falls back to an adapter's own
default (a wrong one disturbs a live bus), a full transmit queue is waited for (every back end says
"full" in its own way), timeouts go by the monotonic clock, and foreign exceptions end at this edge.
"""

from __future__ import annotations

import contextlib
import platform
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NoReturn

from flasher.bus.back_ends import (
    SERIAL_PORTS,
    SILENT_WHEN_GONE,
    TAKES_SEND_TIMEOUT,
    Meaning,
    causes,
    is_foreign_datagram,
    meaning_in_receiving,
    meaning_in_sending,
    words_of,
)
from flasher.bus.bit_rate import BitRate, bit_rate
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
    unreadable_error,
)
from flasher.bus.inspect_interface import Interface, read_interface
from flasher.bus.link import AT_ONCE, SEND_LIMIT_S
from flasher.bus.lock import hold, place_of
from flasher.bus.opening import bus_config, open_bus
from flasher.bus.physical import is_physical
from flasher.errors import BusError, ErrorCode, TransmitBlockedError
from flasher.protocol.frame import EXTENDED_ID_MAX, STANDARD_ID_MAX, Frame
from flasher.protocol.spec import FRAME_DATA_SIZE
from flasher.python_can import can

_FULL_QUEUE_PAUSE_S: Final = 0.0005
"""Between two tries on a full queue: about one frame on the wire. Frames are received meanwhile."""
_DRAIN_FRAMES: Final = 100_000
_KERNEL_STAMPS: Final = frozenset({"socketcan", "udp_multicast"})
"""Back ends whose messages bear the time at which Linux had them, by the wall clock."""
_STAMP_AGE_MAX_S: Final = 1.0
"""A frame that seems to have waited for longer: rather the wall clock was set meanwhile."""
_UNREADABLE_LIMIT: Final = 100
"""So many times in a row nothing could be read: rather the adapter is broken than its line."""
_PASSED_OVER_LIMIT: Final = 1000
"""What is no frame is passed over so often before a frame: a port that babbles is never empty."""
_WAIT_MIN_S: Final = 0.02
"""A shorter wait may end early by rounding."""
_HASTE_S: Final = 0.0005
"""A back end that returns nothing sooner has not waited for it."""
_HASTE_LIMIT_S: Final = 0.25
_HASTE_LIMIT: Final = 100
"""For so long, and so often, it has not: the adapter is gone."""
_PCAN_BUS_OFF: Final = 0x00010
_PCAN_PASSIVE: Final = 0x40000
_PCAN_WARNING: Final = 0x00004 | 0x00008


def open_adapter(
    default_bitrate_bps: int,
    *,
    holder: str | None = None,
    sends: bool = True,
    listen_only: bool = False,
    fallback: Fallback | None = None,
    **config: Any,
) -> CanLink:
    """Open the adapter that `config` (python-can's keywords), its variables and files, and the
    `fallback` describe.

    `default_bitrate_bps` is the dialect's, and what holds unless `config` itself names another bit
    rate. As `holder` it is locked until it is closed (`lock.hold`). Who `sends` cannot use an
    interface that only listens. `listen_only` keeps the adapter from acknowledging, where its back
    end can be told (`opening.can_listen_only`).

    Raises UsageError for an interface that python-can does not know or a value that is no bit rate,
    BusError when the bit rate is another one, the adapter cannot be opened, or somebody holds it.
    """
    merged = bus_config(config, fallback, listen_only=listen_only)
    rate = bit_rate(default_bitrate_bps, config, merged, fallback)
    settled = merged if "timing" in merged else {**merged, "bitrate": rate.bps}

    interface = str(merged["interface"])
    channel = str(merged.get("channel") or "")
    place, give_back = place_of(merged), hold(merged, holder)

    def open_again() -> can.BusABC:
        # An interface that is back may have been set up anew, and otherwise.
        bit_rate(default_bitrate_bps, config, merged, fallback)
        nonlocal place, give_back
        # A serial port that is named by a link may be back as another one.
        new_place, give_new_back = place_of(merged), None
        if new_place != place:
            give_new_back = hold(merged, holder)
        try:
            bus = open_bus(settled, sends=sends)
        except BaseException:
            if give_new_back is not None:
                give_new_back()
            raise
        if give_new_back is not None:
            give_back()
            place, give_back = new_place, give_new_back
        return bus

    try:
        link = CanLink(
            open_bus(settled, sends=sends),
            interface,
            channel,
            open_again,
            lambda: give_back(),  # noqa: PLW0108  another one after a reopening
            gives_own=interface != "socketcan" or bool(merged.get("receive_own_messages")),
        )
    except BaseException:
        give_back()
        raise
    link.bit_rate = rate
    return link


class CanLink:
    """A python-can bus as a `Link` on the monotonic clock."""

    def __init__(
        self,
        bus: can.BusABC,
        interface: str,
        channel: str = "",
        open_again: Callable[[], can.BusABC] | None = None,
        give_back: Callable[[], None] = lambda: None,
        *,
        gives_own: bool = True,
    ) -> None:
        self._give_back = give_back
        self._interface = interface
        self._channel = channel
        self._name = f"{interface} {channel}".strip()
        self._open_again = open_again
        self.bit_rate: BitRate | None = None
        """What the bus was opened with; None where that is not known."""
        self._waiting: deque[tuple[Frame, float | None]] = deque()
        is_stamped = interface in _KERNEL_STAMPS and platform.system() == "Linux"
        self.stamp_source = "kernel" if is_stamped else ""
        self.received_at: float | None = None
        """Of the frame that `receive` returned last (`StampingLink`)."""
        self._health = HealthKeeper(LAYOUTS.get(interface, Layout.UNKNOWN))
        sender = FLAGGED_SENDER.get(interface, Sender.UNKNOWN)
        self._echoes = Echoes(sender, gives_own=gives_own)
        takes_timeout = interface in TAKES_SEND_TIMEOUT
        self._send_options = {"timeout": SEND_LIMIT_S} if takes_timeout else {}
        self._use(bus)

    def _use(self, bus: can.BusABC | None) -> None:
        """Send to and receive from this bus; None while there is none."""
        self._bus = bus
        self._port: Any = getattr(bus, SERIAL_PORTS.get(self._interface, ""), None)
        """The serial port that a back end works on, if it does."""
        if self._port is not None and not self._send_options:
            self._port.write_timeout = SEND_LIMIT_S  # a full port would block for ever
        self._unreadable_in_a_row = 0
        self._hasty = 0
        """Waits in a row that a back end has ended at once, with nothing."""
        self._hasty_since = 0.0
        self._was_passed_over = False
        """The last receive has consumed something that is no frame for the caller."""
        self._send_raw: Callable[..., None] = _no_bus if bus is None else bus.send
        # recv() measures its timeout by the wall clock, so that a jump of it can hang the call;
        # what it wraps does not. No filters are set that would need the wrapper, unless the back
        # end was given some and leaves them to it.
        self._receive_raw: Callable[[float], tuple[can.Message | None, bool]]
        if bus is None:
            self._receive_raw = _no_bus
        elif type(bus).recv is can.BusABC.recv:
            self._receive_raw = bus._recv_internal  # noqa: SLF001
        else:
            self._receive_raw = lambda timeout: (bus.recv(timeout), True)

    @property
    def channel(self) -> str:
        """Which adapter of its kind; empty where that was not said."""
        return self._channel

    def __str__(self) -> str:
        """The adapter as the user named it."""
        return self._name

    def send(self, frame: Frame) -> None:
        """Hand a frame to the adapter; a full queue is waited for up to `SEND_LIMIT_S`. Of a remote
        frame the data are as long as the answer that it asks for.

        A controller that is known to be bus-off is an error at once: its driver may take frames
        all the same, and lose them.
        """
        give_up_at: float | None = None
        if self._health.state is ControllerState.BUS_OFF:
            raise bus_off_error(str(self), "The adapter failed while sending: it is bus-off.")
        while True:
            # A back end may alter a message: never the same object twice.
            message = _message_of(frame)
            try:
                self._send_raw(message, **self._send_options)
            except MemoryError:
                raise
            except Exception as error:
                meaning = meaning_in_sending(error, self._interface)
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
                sent = frame._replace(data=b"") if frame[3] else frame  # as it comes back
                self._echoes.sent(sent)
                return

    def receive(self, deadline: float) -> Frame | None:
        """The next frame, or None at `deadline` (monotonic clock)."""
        if self._waiting:
            waited, self.received_at = self._waiting.popleft()
            return waited
        if deadline == AT_ONCE:
            for _ in range(_PASSED_OVER_LIMIT):
                frame = self._receive_once(0.0)
                if frame is not None or not self._is_more_waiting():
                    return frame
            return None
        frame = self._receive_once(max(0.0, deadline - time.perf_counter()))
        # A filtered or foreign frame ends a wait early.
        while frame is None and (remaining_s := deadline - time.perf_counter()) > 0:
            frame = self._receive_once(remaining_s)
        return frame

    def drain(self) -> int:
        """Throw away what is waiting, bounded on a babbling bus."""
        count = len(self._waiting)
        self._waiting.clear()
        while count < _DRAIN_FRAMES and self.receive(AT_ONCE) is not None:
            count += 1
        return count

    def close(self) -> None:
        """Shut the adapter down; a failure to do so is of no interest any more."""
        self._shut_down()
        self._give_back()

    def _shut_down(self) -> None:
        if self._bus is not None:
            with contextlib.suppress(Exception):
                self._bus.shutdown()
        if self._port is not None:
            # A back end that fails leaves it open, and Linux gives the adapter that is plugged in
            # again another name then.
            with contextlib.suppress(Exception):
                self._port.close()

    def reopen(self) -> None:
        """Close the adapter and open it again as it was. Raises BusError while it is not back.

        Frames that were waiting are gone, and the health begins anew.
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
        """True while the adapter is bus-off by its own report."""
        return self._health.state is ControllerState.BUS_OFF

    @property
    def is_physical(self) -> bool:
        """True unless the bus is known to exist in computers alone."""
        return is_physical(self._interface, self._channel)

    def health(self) -> LinkHealth:
        """What is known of the adapter and its bus. Sends nothing; takes up to 2 s on SocketCAN."""
        if self._interface == "socketcan":
            seen = read_interface(self._channel)
            if isinstance(seen, Interface):
                return self._health.health(seen.state, seen.tx_errors, seen.rx_errors)
        return self._health.health(_asked_state(self._bus, self._interface))

    def _is_more_waiting(self) -> bool:
        """True when a receive that returned no frame does not mean that none is waiting."""
        if self._was_passed_over or self._port is None:
            return self._was_passed_over
        try:  # a serial back end returns for each line, whatever it is
            return bool(self._port.in_waiting)
        except Exception:  # noqa: BLE001  the next receive reports what is wrong with the port
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
        self._was_passed_over = message is not None
        if message is None:
            if began:
                self._check_haste(began, timeout_s)
            return None
        if frame is None:
            return None
        self._unreadable_in_a_row = self._hasty = 0
        if self.stamp_source:
            self.received_at = _moment_of(message)
        if frame[0] in self._echoes.ids:
            frame = self._echoes.mark(frame, message.timestamp, is_rx=message.is_rx)
        # What filters hide was received all the same; what an adapter reports passes them.
        if message.is_error_frame:
            self._health.hear(frame)
            return frame
        self._health.received += 1
        if filtered or self._bus is None:
            return frame
        is_wanted = self._bus._matches_filters(message)  # noqa: SLF001  as recv() does
        return frame if is_wanted else None

    def _judge(self, error: Exception) -> None:
        """Return if the adapter works on after this error in receiving, else raise BusError."""
        meaning = meaning_in_receiving(error, self._interface)
        self._was_passed_over = meaning is Meaning.UNREADABLE
        if isinstance(meaning, BusTrouble):
            self._health.report(meaning)
        elif meaning is Meaning.UNREADABLE:
            self._health.add_unreadable(words_of(error))
            if is_foreign_datagram(error):
                return
            self._unreadable_in_a_row += 1
            if self._unreadable_in_a_row > _UNREADABLE_LIMIT:
                raise self._failure("receiving", error, meaning) from error
            if any(isinstance(each, UnicodeDecodeError) for each in causes(error)):
                # slcan keeps a line that is no text, and trips over it again.
                with contextlib.suppress(Exception):
                    self._bus.flush()  # type: ignore[union-attr]
        else:
            raise self._failure("receiving", error, meaning) from error

    def _check_haste(self, began: float, timeout_s: float) -> None:
        """Raise BusError when a back end has kept returning nothing without waiting for it."""
        now = time.perf_counter()
        if timeout_s < _WAIT_MIN_S:
            return
        if now - began > _HASTE_S:
            # A computer that is busy makes every call slow.
            self._hasty = 0 if now - began > _WAIT_MIN_S / 2 else self._hasty
            return
        if not self._hasty:
            self._hasty_since = began
        self._hasty += 1
        if self._hasty > _HASTE_LIMIT and now - self._hasty_since > _HASTE_LIMIT_S:
            gone = can.CanOperationError("it returns at once, with nothing")
            raise self._failure("receiving", gone, Meaning.LOST)

    def _pause(self) -> None:
        """Wait for room in the transmit queue, and lose nothing that arrives meanwhile."""
        frame = self._receive_once(_FULL_QUEUE_PAUSE_S)
        if frame is not None:
            self._waiting.append((frame, self.received_at))

    def _failure(self, doing: str, error: Exception, meaning: Meaning) -> BusError:
        what = f"The adapter failed while {doing}: {words_of(error)}."
        if meaning is Meaning.BUS_OFF:
            self._health.state = ControllerState.BUS_OFF
            return bus_off_error(str(self), what)
        if meaning is Meaning.UNREADABLE:
            how_often = f"{self._unreadable_in_a_row} times in a row"
            return unreadable_error(str(self), how_often, words_of(error))
        return BusError(
            what,
            where=str(self),
            cause="it was unplugged, its interface went down, or the bus is off",
            remedy="Check the adapter and the wiring, then run the same command again.",
            code=ErrorCode.ADAPTER_LOST,
        )

    def _blocked(self, error: Exception) -> TransmitBlockedError:
        return TransmitBlockedError(
            f"The adapter took no frame for {SEND_LIMIT_S:g} s: {words_of(error)}.",
            where=str(self),
            cause="nobody on the bus acknowledges (device off, wrong bit rate, wiring, "
            "termination), or other traffic takes the whole bus",
            remedy="Check that the device has power and that the bit rate is right.",
        )


def _moment_of(message: can.Message) -> float | None:
    """The kernel's stamp on the monotonic clock, by how long ago it was."""
    age_s = time.time() - message.timestamp
    return time.perf_counter() - age_s if 0.0 <= age_s <= _STAMP_AGE_MAX_S else None


def _no_bus(*_arguments: object, **_options: object) -> NoReturn:
    """What sending and receiving come to while an adapter is gone."""
    raise can.CanOperationError("it is not open")


def _asked_state(bus: can.BusABC | None, interface: str) -> ControllerState:
    """What a back end says when asked. python-can's own `state` is a constant, and PCAN's is the
    mode that was set; only ERROR is told by those that override it.
    """
    try:
        if interface == "pcan":
            return _pcan_state(int(bus.status()))  # type: ignore[union-attr]
        if bus is not None and bus.state is can.BusState.ERROR:
            return ControllerState.BUS_OFF
    except Exception:  # noqa: BLE001  a vendor's library; the question is no reason to fail
        return ControllerState.UNKNOWN
    return ControllerState.UNKNOWN


def _pcan_state(status: int) -> ControllerState:
    if status & _PCAN_BUS_OFF:
        return ControllerState.BUS_OFF
    if status & _PCAN_PASSIVE:
        return ControllerState.PASSIVE
    return ControllerState.UNKNOWN if status & ~_PCAN_WARNING else ControllerState.ACTIVE


def _frame_of(message: can.Message) -> Frame:
    """The frame that a message is; it may have more data than it says. Raises whatever a message
    leads to that is none: of a damaged line slcan makes ids and lengths that no frame has.
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
    """The frame as python-can sends it."""
    can_id, data, is_extended, is_remote = frame[:4]
    if is_remote:
        return can.Message(
            arbitration_id=can_id, is_extended_id=is_extended, is_remote_frame=True, dlc=len(data)
        )
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=is_extended)
