"""Health of a CAN link: controller state, error counters, frame counts, decoded error frames.

An error frame is not on the wire: the driver creates it to report trouble. Two formats are
documented (Linux's error.h, PCAN-Basic); in any other, an error frame only means that something
went wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from flasher.errors import BusError, ErrorCode
from flasher.protocol.frame import Frame
from flasher.validation import json_keys


class TroubleKind(Enum):
    """Kinds of trouble that an error frame reports, the worst first."""

    BUS_OFF = "bus_off"
    RESTARTED = "restarted"
    NOT_ACKNOWLEDGED = "not_acknowledged"
    PASSIVE = "passive"
    WARNING = "warning"
    OTHER = "other"


@dataclass(frozen=True)
class BusTrouble:
    """Decoded error frame. Counters are the controller's; None if not reported."""

    kinds: frozenset[TroubleKind]
    words: str
    tx_errors: int | None = None
    rx_errors: int | None = None
    is_active_again: bool = False
    """The controller reports that it is error-active again."""

    @property
    def kind(self) -> TroubleKind:
        """Worst kind of trouble reported."""
        return next(kind for kind in TroubleKind if kind in self.kinds)


class Layout(Enum):
    """Format of a back end's error frames."""

    SOCKETCAN = "socketcan"
    PCAN = "pcan"
    UNKNOWN = "unknown"


LAYOUTS: Final[Mapping[str, Layout]] = {
    "socketcan": Layout.SOCKETCAN,
    "gs_usb": Layout.SOCKETCAN,  # the firmware speaks Linux's layout
    "socketcand": Layout.SOCKETCAN,  # the class in the id, no data
    "pcan": Layout.PCAN,
}
"""Error frame format by python-can interface; other formats are not documented."""

# -- Linux, include/uapi/linux/can/error.h --------------------------------------------------------

_TX_TIMEOUT: Final = 0x001
_LOST_ARBITRATION: Final = 0x002
_CONTROLLER: Final = 0x004
_PROTOCOL: Final = 0x008
_TRANSCEIVER: Final = 0x010
_NO_ACK: Final = 0x020
_BUS_OFF: Final = 0x040
_BUS_ERROR: Final = 0x080
_RESTARTED: Final = 0x100
_COUNTERS: Final = 0x200
_ACTIVE_BIT: Final = 0x40
_ACK_SLOT: Final = 0x19
"""Position code of the acknowledge slot, the SJA1000's in both formats."""
_CLASSES: Final = (
    (_TX_TIMEOUT, TroubleKind.OTHER, "the driver's transmission timed out"),
    (_LOST_ARBITRATION, TroubleKind.OTHER, "arbitration lost"),
    (_TRANSCEIVER, TroubleKind.OTHER, "trouble of the transceiver (wiring)"),
    (_NO_ACK, TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"),
    (_BUS_OFF, TroubleKind.BUS_OFF, "bus-off"),
    (_BUS_ERROR, TroubleKind.OTHER, "bus error"),
    (_RESTARTED, TroubleKind.RESTARTED, "the controller was restarted"),
)
_CONTROLLER_STATES: Final = (
    (0x01, TroubleKind.OTHER, "receive buffer overflow"),
    (0x02, TroubleKind.OTHER, "transmit buffer overflow"),
    (0x04, TroubleKind.WARNING, "error-warning by receiving"),
    (0x08, TroubleKind.WARNING, "error-warning by sending"),
    (0x10, TroubleKind.PASSIVE, "error-passive by receiving"),
    (0x20, TroubleKind.PASSIVE, "error-passive by sending"),
)
_VIOLATIONS: Final = (
    (0x01, "bit error"),
    (0x02, "form error"),
    (0x04, "stuff error"),
    (0x08, "no dominant bit possible"),
    (0x10, "no recessive bit possible"),
    (0x20, "overload"),
)
_ERROR_FRAME_SIZE: Final = 8
WARNING_LIMIT: Final = 96
"""Error counter at which a controller reports error-warning."""
PASSIVE_LIMIT: Final = 128
"""Error counter at which a controller becomes error-passive."""


def decode_error_frame(frame: Frame, layout: Layout = Layout.SOCKETCAN) -> BusTrouble:
    """Decode an error frame. Never raises."""
    if layout is Layout.SOCKETCAN:
        return _decode_socketcan(frame.can_id, frame.data.ljust(_ERROR_FRAME_SIZE, b"\0"))
    if layout is Layout.PCAN:
        return _decode_pcan(frame.can_id, frame.data.ljust(_ERROR_FRAME_SIZE, b"\0"))
    return BusTrouble(frozenset({TroubleKind.OTHER}), "an error frame without details")


def _decode_socketcan(classes: int, data: bytes) -> BusTrouble:
    found = [(kind, words) for bit, kind, words in _CLASSES if classes & bit]
    if classes & _CONTROLLER:
        found += [(kind, words) for bit, kind, words in _CONTROLLER_STATES if data[1] & bit]
    if classes & _PROTOCOL:
        found += [(TroubleKind.OTHER, words) for bit, words in _VIOLATIONS if data[2] & bit]
        if data[3] == _ACK_SLOT:
            found.append((TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"))
    is_active_again = bool(classes & _CONTROLLER and data[1] & _ACTIVE_BIT)
    if is_active_again:
        found.append((TroubleKind.OTHER, "error-active again"))
    # Older kernels fill in the counters without setting their class bit.
    counted = classes & _COUNTERS or (classes & _CONTROLLER and any(data[6:8]))
    tx_errors, rx_errors = (data[6], data[7]) if counted else (None, None)
    return _trouble(found, tx_errors, rx_errors, is_active_again=is_active_again)


def _decode_pcan(kind_of_error: int, data: bytes) -> BusTrouble:
    """Decode an error frame of PCAN-Basic: id = kind; data = direction, position, counters."""
    is_received, place, rx_errors, tx_errors = data[:4]
    names = {0: "", 1: "bit error", 2: "form error", 4: "stuff error"}
    words = names.get(kind_of_error, "bus error")
    found = [(TroubleKind.OTHER, words)] if words else []
    if kind_of_error and place == _ACK_SLOT and not is_received:
        found.append((TroubleKind.NOT_ACKNOWLEDGED, "no acknowledgement"))
    if max(rx_errors, tx_errors) >= PASSIVE_LIMIT:
        by = "sending" if tx_errors >= rx_errors else "receiving"
        found.append((TroubleKind.PASSIVE, f"error-passive by {by}"))
    elif max(rx_errors, tx_errors) >= WARNING_LIMIT:
        found.append((TroubleKind.WARNING, "error-warning"))
    return _trouble(
        found,
        tx_errors,
        rx_errors,
        is_active_again=not kind_of_error and max(rx_errors, tx_errors) < WARNING_LIMIT,
    )


def _trouble(
    found: list[tuple[TroubleKind, str]],
    tx_errors: int | None,
    rx_errors: int | None,
    *,
    is_active_again: bool,
) -> BusTrouble:
    kinds = frozenset(kind for kind, _ in found) or frozenset({TroubleKind.OTHER})
    words = ", ".join(dict.fromkeys(words for _, words in found)) or "error counters"
    if tx_errors is not None:
        words += f" (error counters: tx {tx_errors}, rx {rx_errors})"
    return BusTrouble(kinds, words, tx_errors, rx_errors, is_active_again)


# -- the health of a link ---------------------------------------------------------------------


class ControllerState(Enum):
    """State of a CAN controller: error-active, error-passive, bus-off."""

    ACTIVE = "active"
    PASSIVE = "passive"
    BUS_OFF = "bus_off"
    UNKNOWN = "unknown"


@json_keys("state tx_errors rx_errors error_frames unreadable")
@dataclass(frozen=True)
class LinkHealth:
    """State of the CAN controller, as its adapter reports it."""

    # Since the link was opened; counters are None if not reported.
    state: ControllerState
    tx_errors: int | None
    rx_errors: int | None
    frames_sent: int
    """Frames that the adapter accepted; some may still be in its queue."""
    frames_received: int
    """Frames received from the bus, without error frames."""
    error_frames: int
    is_blocked: bool
    """The transmit queue stayed full for the whole time limit of a frame."""
    last_trouble: BusTrouble | None
    not_acknowledged: bool
    """No node acknowledges: frames were sent, nothing was ever received, and error frames, the
    controller state or the full transmit queue show it."""
    unreadable: int
    """Number of unreadable inputs from the adapter."""  # also before it was reopened
    last_unreadable: str
    """Description of the last unreadable input."""
    refused: int = 0
    """Number of frames that the adapter refused to send."""

    def error(self, where: str = "") -> BusError | None:
        """Create the BusError for this health; None for a healthy link."""
        if self.state is ControllerState.BUS_OFF:
            return bus_off_error(where)
        if self.not_acknowledged:
            return BusError(
                f"No node on the bus acknowledges: {self.frames_sent} frames were passed to the "
                "adapter, and nothing was received.",
                where=where,
                cause="the device is off or not connected, the bit rate is wrong, CAN-H and "
                f"CAN-L are swapped or open, or termination is missing{self._evidence}",
                remedy="Check power, wiring and bit rate; flasher doctor checks the adapter.",
                code=ErrorCode.NOBODY_ACKNOWLEDGES,
            )
        if self.refused * 2 > self.frames_sent and not self.frames_received:
            return refused_error(where, f"{self.refused} of {self.frames_sent} frames")
        if self.unreadable and not self.frames_received:
            return unreadable_error(where, f"{self.unreadable} times so far", self.last_unreadable)
        return None

    @property
    def _evidence(self) -> str:
        if self.last_trouble is not None:
            return f"; the adapter reports: {self.last_trouble.words}"
        return "; the transmit queue stays full" if self.is_blocked else ""


def bus_off_error(where: str, what: str = "The adapter has left the bus.") -> BusError:
    """Create the error for a controller that is bus-off."""
    return BusError(
        what,
        where=where,
        cause="it is bus-off: too many of its frames met errors (another bit rate on the bus, a "
        "short circuit, CAN-H and CAN-L swapped)",
        remedy="Check bit rate and wiring, then start the adapter again; flasher doctor names "
        "the command.",
        code=ErrorCode.BUS_OFF,
    )


def refused_error(where: str, how_many: str) -> BusError:
    """Create the error for an adapter that does not send what it is given."""
    return BusError(
        f"The adapter refused to send {how_many}.",
        where=where,
        cause="its channel is closed because it restarted (a loose plug, too little power), its "
        "queue is full because no node acknowledges, or it takes frames more slowly",
        remedy="Check its plug, the wiring and the device's power, then run the same command "
        "again; --frame-gap 0.001 is for a slow adapter.",
        code=ErrorCode.SEND_BLOCKED,
    )


def unreadable_error(where: str, how_often: str, words: str) -> BusError:
    """Create the error for an adapter that delivers unreadable data."""
    return BusError(
        f"The adapter delivers unreadable data, {how_often}: {words}.",
        where=where,
        cause="its serial speed is wrong, or its cable or plug is bad",
        remedy="Try another cable; for slcan, `--bus-kwargs tty_baudrate=...` sets the speed.",
        code=ErrorCode.ADAPTER_LOST,
    )


class HealthKeeper:
    """Counts frames and error frames of a link."""

    def __init__(self, layout: Layout = Layout.UNKNOWN) -> None:
        self._layout = layout
        self._unreadable = 0
        self._last_unreadable = ""
        self.reset()

    def reset(self) -> None:
        """Reset all but the count of unreadable inputs, after the adapter was reopened."""
        self.sent = 0
        self.refused = 0
        self.received = 0
        self.error_frames = 0
        self.is_blocked = False
        self.state = ControllerState.UNKNOWN
        self._last: BusTrouble | None = None
        self._tx_errors: int | None = None
        self._rx_errors: int | None = None
        self._was_unacknowledged = False

    def count_frame(self, frame: Frame) -> None:
        """Count a received frame or error frame."""
        if not frame.is_error:
            self.received += 1
            return
        self.report(decode_error_frame(frame, self._layout))

    def add_unreadable(self, words: str) -> None:
        """Count an unreadable input."""
        self._unreadable += 1
        self._last_unreadable = words

    def report(self, trouble: BusTrouble) -> None:
        """Record trouble that the controller reported."""
        self.error_frames += 1
        self._last = trouble
        if trouble.tx_errors is not None:
            self._tx_errors, self._rx_errors = trouble.tx_errors, trouble.rx_errors
        if TroubleKind.NOT_ACKNOWLEDGED in trouble.kinds:
            self._was_unacknowledged = True
        if TroubleKind.BUS_OFF in trouble.kinds:
            self.state = ControllerState.BUS_OFF
        elif TroubleKind.PASSIVE in trouble.kinds:
            self.state = ControllerState.PASSIVE
        elif trouble.is_active_again or TroubleKind.RESTARTED in trouble.kinds:
            self.state = ControllerState.ACTIVE

    def health(
        self,
        state: ControllerState = ControllerState.UNKNOWN,
        tx_errors: int | None = None,
        rx_errors: int | None = None,
    ) -> LinkHealth:
        """Return the link's health; the adapter's own values override those of error frames."""
        if state is ControllerState.UNKNOWN:
            state = self.state
        if tx_errors is None:
            tx_errors, rx_errors = self._tx_errors, self._rx_errors
        # Without acknowledgement a sending controller stops at error-passive, never
        # bus-off. At a wrong bit rate the receive counter may be higher, so silence decides.
        is_evident = self._was_unacknowledged or self.is_blocked or state is ControllerState.PASSIVE
        return LinkHealth(
            state=state,
            tx_errors=tx_errors,
            rx_errors=rx_errors,
            frames_sent=self.sent,
            frames_received=self.received,
            error_frames=self.error_frames,
            is_blocked=self.is_blocked,
            last_trouble=self._last,
            not_acknowledged=bool(self.sent)
            and not (self.received or self._unreadable)
            and is_evident,
            unreadable=self._unreadable,
            last_unreadable=self._last_unreadable,
            refused=self.refused,
        )
