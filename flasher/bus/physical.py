"""Classification of python-can interfaces: physical CAN adapter or virtual bus."""

from __future__ import annotations

import os
import platform
import stat
from typing import Final

from flasher.bus.detect import BUILT_IN, SERIAL_PORTS, SOCKETCAN
from flasher.bus.inspect_interface import VIRTUAL_KINDS, Interface, read_interface

_PSEUDO_TERMINAL_MAJORS: Final = range(136, 144)
"""Linux: Documentation/admin-guide/devices.txt, "Unix98 PTY slaves"."""


def is_physical(interface: str, channel: str) -> bool:
    """Return False for python-can's own buses, vcan and vxcan interfaces (by the kernel), and
    serial adapters on a pseudo terminal. Unknown adapters are physical. Takes up to 2 s; never
    raises.
    """
    if interface in BUILT_IN:
        return False
    if interface == SOCKETCAN:
        state = read_interface(channel)
        return not (isinstance(state, Interface) and state.kind in VIRTUAL_KINDS)
    if interface in SERIAL_PORTS:
        # python-can takes PORT@BAUD.
        return not _is_pseudo_terminal(channel.partition("@")[0])
    return True


def _is_pseudo_terminal(port: str) -> bool:
    """Ask the kernel for the device type of a serial port."""
    try:
        found = os.stat(port)  # noqa: PTH116  a name that is not a path fails here
    except (OSError, ValueError):
        return False
    is_linux = platform.system() == "Linux"
    is_device = stat.S_ISCHR(found.st_mode)
    return is_linux and is_device and os.major(found.st_rdev) in _PSEUDO_TERMINAL_MAJORS
