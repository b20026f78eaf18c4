"""SocketCAN interface on Linux: its state, read without root, and commands to set it up.

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
"""Drivers for which the kernel refuses a restart after bus-off, automatic or manual."""
VIRTUAL_KINDS: Final = frozenset({"vcan", "vxcan"})
"""Interfaces without controller: no bit rate, no error states."""
_IP_LIMIT_S: Final = 2.0
_NAME_SIZE_MAX: Final = 15
_ARPHRD_CAN: Final = 280
_IFF_UP: Final = 1

Run = Callable[[Sequence[str]], str]
"""Runs a command and returns its standard output. Raises OSError or subprocess.SubprocessError."""


class Unseen(Enum):
    """Reason why the state of an interface is unknown."""

    MISSING = "missing"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Interface:
    """Network interface as the kernel describes it; unknown values are None."""

    name: str
    is_can: bool
    is_up: bool
    has_carrier: bool | None = None
    """False if the controller is bus-off, or if the other end of a vxcan pair is down."""
    kind: str = ""
    """"can" (hardware), "vcan", "vxcan" or "slcan"; may be empty."""
    bitrate_bps: int | None = None
    state_name: str = ""
    """Kernel's name: ERROR-ACTIVE, ERROR-WARNING, ERROR-PASSIVE, BUS-OFF, STOPPED."""
    tx_errors: int | None = None
    rx_errors: int | None = None
    restart_ms: int | None = None
    """Delay of the automatic restart after bus-off; 0 for none."""
    queue_frames: int | None = None
    modes: frozenset[str] = frozenset()
    """Active control modes: LISTEN-ONLY, LOOPBACK, ONE-SHOT, FD, ..."""
    driver: str = ""
    """Driver name, from its bit timing limits; may be empty."""

    @property
    def state(self) -> ControllerState:
        return _STATES.get(self.state_name, ControllerState.UNKNOWN)

    @property
    def only_listens(self) -> bool:
        """True in listen-only mode: acknowledges no frame and sends none."""
        return "LISTEN-ONLY" in self.modes

    @property
    def can_restart(self) -> bool:
        """True if the driver supports `restart-ms`; False for an unknown driver."""
        return bool(self.driver) and self.driver not in _WITHOUT_RESTART


_STATES: Final = {
    "ERROR-ACTIVE": ControllerState.ACTIVE,
    "ERROR-WARNING": ControllerState.ACTIVE,  # it still takes part fully
    "ERROR-PASSIVE": ControllerState.PASSIVE,
    "BUS-OFF": ControllerState.BUS_OFF,
}


def read_interface(name: str, *, run: Run | None = None, sysfs: Path = SYSFS) -> Interface | Unseen:
    """Read the state of an interface from `ip`, else from /sys. Takes up to 2 s; never raises."""
    basic = look_up(name, sysfs=sysfs)
    if basic is Unseen.MISSING:
        return basic
    described = _ask_ip(name, run or _run)
    return basic if described is None else described


def look_up(name: str, *, sysfs: Path = SYSFS) -> Interface | Unseen:
    """Read the state of an interface from /sys alone, without delay: type, up, carrier."""
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
    """Command (as root) that starts a SocketCAN interface; virtual ones need no options."""
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
    """Commands that create a missing virtual interface, or that list the existing ones."""
    if str(channel).startswith("vcan"):
        return (f"ip link add dev {channel} type vcan", f"ip link set {channel} up")
    return ("ip -brief link show type can", "dmesg | grep -i can")


def restart_commands(channel: object) -> tuple[str, str]:
    """Commands (as root) that restart an interface after bus-off, with every driver."""
    return (f"ip link set {channel} down", f"ip link set {channel} up")


def change_commands(channel: object, *options: str) -> tuple[str, str, str]:
    """Commands (as root) that stop a CAN interface, change its options and start it again."""
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
    """Read an interface from `ip`; None if that is missing, too old, or prints something else."""
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
