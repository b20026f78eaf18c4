"""udev rules that let users open CAN adapters on Linux."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flasher.protocol.spec import Dialect

_USB: Final = (
    ("1d50", "606f", "candleLight, CANable with that firmware (gs_usb)"),
    ("1209", "2323", "candleLight (gs_usb)"),
    ("1209", "ca01", "CANnectivity (gs_usb)"),
    ("1cd2", "606f", "CES CANext FD (gs_usb)"),
    ("16d0", "10b8", "ABE CANdebugger FD (gs_usb)"),
    ("04d8", "0053", "CANalyst-II (canalystii)"),
)
"""Vendor, product and name of adapters that libusb opens."""
_SERIAL: Final = (
    ("ad50", "60c4", "CANable (slcan)"),
    ("16d0", "117e", "CANable 2 (slcan)"),
    ("04d8", "000a", "USBtin (slcan)"),
    ("0403", "ffa8", "Lawicel CANUSB (slcan)"),
)
"""The same of adapters that are serial ports."""
_ACCESS: Final = 'GROUP="dialout", MODE="0660", TAG+="uaccess"'
"""The user at the screen, and the group that may use serial ports."""


def udev_rules(dialect: Dialect) -> Iterator[str]:
    """Yield the lines of a file for /etc/udev/rules.d."""
    yield "# CAN adapters: the user who is logged in at the screen, and the group dialout, may open"
    yield "# them. The last rule sets the bit rate of SocketCAN interfaces when they appear. It is"
    yield "# for computers whose CAN interfaces are all of this system: remove its #."
    for vendor, product, name in _USB:
        yield f"# {name}"
        yield f'SUBSYSTEM=="usb", {_matches(vendor, product)}, {_ACCESS}'
    for vendor, product, name in _SERIAL:
        yield f"# {name}"
        yield f'SUBSYSTEM=="tty", {_matches(vendor, product, parent=True)}, {_ACCESS}'
    up = f"ip link set %k up type can bitrate {dialect.bitrate_bps}"
    yield f'#ACTION=="add", SUBSYSTEM=="net", KERNEL=="can[0-9]*", RUN+="/usr/sbin/{up}"'


def _matches(vendor: str, product: str, *, parent: bool = False) -> str:
    key = "ATTRS" if parent else "ATTR"
    return f'{key}{{idVendor}}=="{vendor}", {key}{{idProduct}}=="{product}"'
