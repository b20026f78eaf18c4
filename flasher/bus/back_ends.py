"""Exceptions of python-can's back ends, classified: damaged frame, full queue, lost adapter.

A back end may raise anything: its own CanError, exceptions of serial ports and USB libraries, and
errors of its parser. `tests/bus/test_back_ends.py` tabulates them.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator, Mapping
from enum import Enum, auto
from typing import Final

from flasher.bus.health import BusTrouble, TroubleKind
from flasher.errors import FlasherError
from flasher.python_can import can


class Meaning(Enum):
    """Cause of an exception that a back end raises."""

    UNREADABLE = auto()
    """The input was not a frame; the adapter works."""
    QUEUE_FULL = auto()
    BUS_OFF = auto()
    LOST = auto()
    """Adapter or driver no longer work."""


SERIAL_PORTS: Final[Mapping[str, str]] = {
    "robotell": "serialPortOrig",
    "seeedstudio": "ser",
    "serial": "_ser",
    "slcan": "serialPortOrig",
}
"""Attribute of each serial back end that holds its pyserial port."""
TAKES_SEND_TIMEOUT: Final = frozenset({"nixnet", "robotell", "slcan"})
"""Back ends that wait forever for a full transmit queue unless `send` gets a timeout. Others ignore
it or use it otherwise."""
SILENT_WHEN_GONE: Final = frozenset({"gs_usb", "seeedstudio", "socketcand"})
"""Back ends whose receive returns at once without a frame when the adapter is unplugged."""
_CANNOT_CONTINUE: Final = frozenset({"socketcand"})
"""Back ends that cannot continue after an error: the bad input stays in their buffer."""

_QUEUE_FULL_CODES: Final[Mapping[str, frozenset[int]]] = {
    "iscan": frozenset({7}),  # device is transmitting a message
    "kvaser": frozenset({-13}),  # canERR_TXBUFOFL
    "nixnet": frozenset({0xBFF63008, 0xBFF6300A}),  # output queue overflow, event timeout
    "socketcan": frozenset({errno.ENOBUFS, errno.EAGAIN}),
    "systec": frozenset({0x0B}),  # ERR_DLL_TXFULL
    "usb2can": frozenset({9, 21, 32}),  # FIFO_FULL, TRM_FULL, TIMEOUT
    "vector": frozenset({11}),  # XL_ERR_QUEUE_IS_FULL
}
"""Driver error codes for a full transmit queue."""
_QUEUE_FULL_TEXT: Final = re.compile(
    r"(transmit|send|tx|xmt|write)[ _-]?(queue|buffer|fifo)?.*\b(full|overflow)"
    r"|TXQUEUE_FULL|XMTFULL",
    re.IGNORECASE,
)
"""Error messages of other back ends (PCAN, IXXAT, NI-CAN, python-can for SocketCAN)."""
_BUS_OFF_CODES: Final[Mapping[str, int]] = {"iscan": 17, "usb2can": 2}
_BUS_OFF_TEXT: Final = re.compile(r"bus[ _-]?off", re.IGNORECASE)
_REPORT_CODES: Final[Mapping[str, Mapping[int, TroubleKind]]] = {
    "iscan": {
        11: TroubleKind.OTHER,  # buffer overrun
        16: TroubleKind.OTHER,  # bus error
        18: TroubleKind.PASSIVE,
        19: TroubleKind.OTHER,  # data overrun
        20: TroubleKind.WARNING,
    },
    "usb2can": {
        3: TroubleKind.PASSIVE,
        4: TroubleKind.WARNING,
        18: TroubleKind.OTHER,  # overrun
        22: TroubleKind.OTHER,  # stuff error
        23: TroubleKind.OTHER,  # form error
        24: TroubleKind.NOT_ACKNOWLEDGED,
        25: TroubleKind.OTHER,  # bit errors
        26: TroubleKind.OTHER,
        27: TroubleKind.OTHER,  # CRC error
    },
    "vector": {216: TroubleKind.OTHER},  # XL_ERR_QUEUE_OVERRUN
}
_REPORT_TEXTS: Final = (
    (re.compile(r"error[ -]?passive", re.IGNORECASE), TroubleKind.PASSIVE),
    (re.compile(r"warning limit", re.IGNORECASE), TroubleKind.WARNING),
    (re.compile(r"overrun|read too late", re.IGNORECASE), TroubleKind.OTHER),
)
"""Error messages of PCAN and IXXAT, whose exceptions have no code."""
_UNREADABLE_TEXT: Final = re.compile(r"invalid delimiter|could not unpack|out of range")
"""Error messages of back ends that raise CanError for a damaged frame (serial, udp_multicast)."""
_TRACEBACK: Final = "Traceback (most recent call last)"
"""The socketcand back end adds one to its messages."""
_FOREIGN_DATAGRAM: Final = "could not unpack"


def meaning_of_send_error(error: Exception, interface: str) -> Meaning:
    """Classify an exception raised by `send` of a back end."""
    chain = list(causes(error))
    if _is_bus_off(chain, interface):
        return Meaning.BUS_OFF
    is_full = (
        not _codes(chain).isdisjoint(_QUEUE_FULL_CODES.get(interface, ()))
        or any(_QUEUE_FULL_TEXT.search(str(each)) for each in chain)
        or any(map(_is_timeout, chain))
    )
    return Meaning.QUEUE_FULL if is_full else Meaning.LOST


def meaning_of_receive_error(error: Exception, interface: str) -> Meaning | BusTrouble:
    """Classify an exception raised by `recv`; a BusTrouble comes from a working adapter."""
    chain = list(causes(error))
    if _is_bus_off(chain, interface):
        return Meaning.BUS_OFF
    kind = _reported_trouble(chain, interface)
    if kind is not None:
        return BusTrouble(frozenset({kind}), error_text(error))
    if interface in _CANNOT_CONTINUE or any(isinstance(each, OSError) for each in chain):
        return Meaning.LOST
    is_own = isinstance(chain[-1], can.CanError)
    is_damage = not is_own or _UNREADABLE_TEXT.search(str(chain[-1]))
    return Meaning.UNREADABLE if is_damage else Meaning.LOST


def is_foreign_datagram(error: Exception) -> bool:
    """True for a datagram on the port of udp_multicast that is not a CAN frame."""
    return _FOREIGN_DATAGRAM in str(error)


def causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an exception and those that it was raised from, up to one of flasher's: back ends wrap
    the relevant one.
    """
    found: BaseException | None = error
    while found is not None and not isinstance(found, FlasherError):
        yield found
        found = found.__cause__ or (None if found.__suppress_context__ else found.__context__)


def error_text(error: BaseException) -> str:
    """Messages of an exception and its causes without full stop, or its type if there are none. A
    server may have written into them: control characters are escaped.
    """
    texts: list[str] = []
    for each in causes(error):
        words = " ".join(str(each).partition(_TRACEBACK)[0].split()).rstrip(".!")
        if words and not any(words in earlier for earlier in texts):
            texts.append(words)
    whole = ": ".join(texts) or type(error).__name__
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in whole)


def _codes(chain: list[BaseException]) -> set[int]:
    codes = (getattr(each, "error_code", None) for each in chain)
    return {int(code) for code in codes if isinstance(code, int)}


def _is_bus_off(chain: list[BaseException], interface: str) -> bool:
    is_code = _BUS_OFF_CODES.get(interface) in _codes(chain)
    return is_code or any(_BUS_OFF_TEXT.search(str(each)) for each in chain)


def _reported_trouble(chain: list[BaseException], interface: str) -> TroubleKind | None:
    known = _REPORT_CODES.get(interface, {})
    by_code = (known[code] for code in _codes(chain) if code in known)
    by_text = (
        kind
        for pattern, kind in _REPORT_TEXTS
        for each in chain
        if isinstance(each, can.CanError) and pattern.search(str(each))
    )
    return next(by_code, None) or next(by_text, None)


def _is_timeout(error: BaseException) -> bool:
    """True for a timeout, also those of pyserial and pyusb, which are not TimeoutErrors."""
    is_named_so = type(error).__name__ in ("SerialTimeoutException", "USBTimeoutError")
    return is_named_so or isinstance(error, TimeoutError)
