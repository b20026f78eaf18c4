"""State of a SocketCAN interface on Linux, without sending anything or being root, and the commands
to set one up.

Uses `ip -details -json link show`; if that is missing or too old, /sys shows whether the interface
exists and is up.
"""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final

from flasher.bus.health import ControllerState

SYSFS: Final = Path("/sys/class/net")
_WITHOUT_RESTART: Final = frozenset({"can327", "gs_usb", "slcan"})
"""Drivers whose restart after bus-off the kernel refuses, automatic or manual."""
VIRTUAL_KINDS: Final = frozenset({"vcan", "vxcan"})
"""Interfaces without a controller: no bit rate, no error states."""
_IP_LIMIT_S: Final = 2.0
_NAME_SIZE_MAX: Final = 15
_ARPHRD_CAN: Final = 280
_IFF_UP: Final = 1

Run = Callable[[Sequence[str]], str]
"""Runs a command and returns its standard output. Raises OSError or subprocess.SubprocessError."""


class Unseen(Enum):
    """Why the state of an interface is unknown."""

    MISSING = "missing"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Interface:
    """Network interface as described by the kernel; None for unknown values."""

    name: str
    is_can: bool
    is_up: bool
    has_carrier: bool | None = None
    """False if the controller is bus-off, or the other end of a vxcan pair is down."""
    kind: str = ""
    """"can" (hardware), "vcan", "vxcan", "slcan"; may be empty."""
    bitrate_bps: int | None = None
    state_name: str = ""
    """The kernel's name: ERROR-ACTIVE, ERROR-WARNING, ERROR-PASSIVE, BUS-OFF, STOPPED."""
    tx_errors: int | None = None
    rx_errors: int | None = None
    restart_ms: int | None = None
    """Time after which bus-off ends automatically; 0 for never."""
    queue_frames: int | None = None
    modes: frozenset[str] = frozenset()
    """Active control modes: LISTEN-ONLY, LOOPBACK, ONE-SHOT, FD, ..."""
    driver: str = ""
    """Name of the driver, from its bit timing limits; may be empty."""

    @property
    def state(self) -> ControllerState:
        """State of its controller."""
        return _STATES.get(self.state_name, ControllerState.UNKNOWN)

    @property
    def only_listens(self) -> bool:
        """True if it acknowledges nothing and drops frames to send."""
        return "LISTEN-ONLY" in self.modes

    @property
    def can_restart(self) -> bool:
        """True if its driver supports `restart-ms`; False for an unknown driver."""
        return bool(self.driver) and self.driver not in _WITHOUT_RESTART


_STATES: Final = {
    "ERROR-ACTIVE": ControllerState.ACTIVE,
    "ERROR-WARNING": ControllerState.ACTIVE,  # it still takes part fully
    "ERROR-PASSIVE": ControllerState.PASSIVE,
    "BUS-OFF": ControllerState.BUS_OFF,
}


def read_interface(name: str, *, run: Run | None = None, sysfs: Path = SYSFS) -> Interface | Unseen:
    """Read all that is known about an interface. Takes 2 s at most; never raises."""
    seen = look_up(name, sysfs=sysfs)
    if seen is Unseen.MISSING:
        return seen
    described = _ask_ip(name, run or _run)
    return seen if described is None else described


def look_up(name: str, *, sysfs: Path = SYSFS) -> Interface | Unseen:
    """Read from /sys alone, without delay: existence, type, up, carrier."""
    if not sysfs.is_dir():
        return Unseen.CANNOT_TELL
    if not _is_a_name(name) or not (sysfs / name).exists():
        return Unseen.MISSING
    folder = sysfs / name
    flags = _number(folder / "flags")
    carrier = _number(folder / "carrier")  # unreadable while it is down
    return Interface(
        name,
        is_can=_number(folder / "type") == _ARPHRD_CAN,
        is_up=bool((flags or 0) & _IFF_UP),
        has_carrier=None if carrier is None else bool(carrier),
        queue_frames=_number(folder / "tx_queue_len"),
    )


def start_command(channel: object, bitrate_bps: object) -> str:
    """Command for root to start a SocketCAN interface; virtual ones need no options."""
    if str(channel).startswith(tuple(VIRTUAL_KINDS)):
        return f"ip link set {channel} up"
    return f"ip link set {channel} up type can bitrate {bitrate_bps}"


def kernel_has_can() -> bool:
    """False for a kernel without CAN, as in many virtual machines."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno != errno.EAFNOSUPPORT
    return True


def find_commands(channel: object) -> tuple[str, str]:
    """Commands that create a missing virtual interface, or list the existing ones."""
    if str(channel).startswith("vcan"):
        return (f"ip link add dev {channel} type vcan", f"ip link set {channel} up")
    return ("ip -brief link show type can", "dmesg | grep -i can")


def restart_commands(channel: object) -> tuple[str, str]:
    """Commands for root to restart an interface after bus-off; works with every driver."""
    return (f"ip link set {channel} down", f"ip link set {channel} up")


def change_commands(channel: object, *options: str) -> tuple[str, str, str]:
    """Commands for root to change options of a CAN interface, which must be down meanwhile."""
    down, up = restart_commands(channel)
    return (down, f"ip link set {channel} type can {' '.join(options)}", up)


def _is_a_name(name: str) -> bool:
    odd = any(letter in "/:" or letter.isspace() for letter in name)
    return 0 < len(name) <= _NAME_SIZE_MAX and not odd and name not in (".", "..")


def _number(path: Path) -> int | None:
    with contextlib.suppress(OSError, ValueError):
        return int(path.read_text(encoding="ascii").strip(), 0)
    return None


def _ask_ip(name: str, run: Run) -> Interface | None:
    """Return None if `ip` is missing, too old for JSON, or prints something unexpected."""
    try:
        answer = json.loads(run(("ip", "-details", "-json", "link", "show", "dev", name)))
        return _from_ip(answer[0])
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError):
        return None
    except AttributeError:  # another shape of JSON
        return None


def _from_ip(link: dict[str, Any]) -> Interface:
    info = link.get("linkinfo", {})
    details = info.get("info_data", {})
    counters = details.get("berr_counter", {})
    flags = link["flags"]
    return Interface(
        str(link["ifname"]),
        is_can=link.get("link_type") == "can",
        is_up="UP" in flags,
        # NO-CARRIER stays set for up to a second after an interface was started.
        has_carrier="LOWER_UP" in flags if "UP" in flags else None,
        kind=str(info.get("info_kind", "")),
        bitrate_bps=details.get("bittiming", {}).get("bitrate"),
        state_name=str(details.get("state", "")),
        tx_errors=counters.get("tx"),
        rx_errors=counters.get("rx"),
        restart_ms=details.get("restart_ms", 0 if info.get("info_kind") == "can" else None),
        queue_frames=link.get("txqlen"),
        modes=frozenset(str(mode) for mode in details.get("ctrlmode", ())),
        driver=str(details.get("bittiming_const", {}).get("name", "")),
    )


def _run(command: Sequence[str]) -> str:
    done = subprocess.run(  # noqa: S603  a fixed command, and an interface's name as one word
        command, capture_output=True, text=True, timeout=_IP_LIMIT_S, check=True
    )
    return done.stdout
