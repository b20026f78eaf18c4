"""What Linux says about a SocketCAN interface, without sending anything and without being root; and
the commands by which root sets one up.

`ip -details -json link show` tells most; where it is missing or too old, /sys tells whether the
interface is there and up.
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
"""Drivers for which the kernel refuses every restart after bus-off, by itself or asked for."""
VIRTUAL_KINDS: Final = frozenset({"vcan", "vxcan"})
"""Interfaces without a controller: no bit rate, no error states."""
_IP_LIMIT_S: Final = 2.0
_NAME_SIZE_MAX: Final = 15
_ARPHRD_CAN: Final = 280
_IFF_UP: Final = 1

Run = Callable[[Sequence[str]], str]
"""Runs a command and gives its standard output. Raises OSError or subprocess.SubprocessError."""


class Unseen(Enum):
    """Why nothing can be said about an interface."""

    MISSING = "missing"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Interface:
    """A network interface as the kernel describes it; None where it does not tell."""

    name: str
    is_can: bool
    is_up: bool
    has_carrier: bool | None = None
    """False when the controller is bus-off, or the other end of a vxcan pair is down."""
    kind: str = ""
    """"can" (hardware), "vcan", "vxcan", "slcan"; empty when not told."""
    bitrate_bps: int | None = None
    state_name: str = ""
    """The kernel's word: ERROR-ACTIVE, ERROR-WARNING, ERROR-PASSIVE, BUS-OFF, STOPPED."""
    tx_errors: int | None = None
    rx_errors: int | None = None
    restart_ms: int | None = None
    """Time after which a bus-off ends by itself; 0 never."""
    queue_frames: int | None = None
    modes: frozenset[str] = frozenset()
    """Control modes that are on: LISTEN-ONLY, LOOPBACK, ONE-SHOT, FD, ..."""
    driver: str = ""
    """The driver's name as its bit timing limits give it; empty when not told."""

    @property
    def state(self) -> ControllerState:
        """The state of its controller."""
        return _STATES.get(self.state_name, ControllerState.UNKNOWN)

    @property
    def only_listens(self) -> bool:
        """True when it acknowledges nothing and drops what it is given to send."""
        return "LISTEN-ONLY" in self.modes

    @property
    def can_restart(self) -> bool:
        """True when its driver takes `restart-ms`; False also when the driver is not known."""
        return bool(self.driver) and self.driver not in _WITHOUT_RESTART


_STATES: Final = {
    "ERROR-ACTIVE": ControllerState.ACTIVE,
    "ERROR-WARNING": ControllerState.ACTIVE,  # it still takes part fully
    "ERROR-PASSIVE": ControllerState.PASSIVE,
    "BUS-OFF": ControllerState.BUS_OFF,
}


def read_interface(name: str, *, run: Run | None = None, sysfs: Path = SYSFS) -> Interface | Unseen:
    """All that can be learned about an interface. Takes 2 s at the most; never raises."""
    seen = look_up(name, sysfs=sysfs)
    if seen is Unseen.MISSING:
        return seen
    described = _ask_ip(name, run or _run)
    return seen if described is None else described


def look_up(name: str, *, sysfs: Path = SYSFS) -> Interface | Unseen:
    """What /sys alone tells, in no time: there, a CAN interface, up, with a carrier."""
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
    """How root starts a SocketCAN interface; virtual ones, told by their name, take no options."""
    if str(channel).startswith(tuple(VIRTUAL_KINDS)):
        return f"ip link set {channel} up"
    return f"ip link set {channel} up type can bitrate {bitrate_bps}"


def kernel_has_can() -> bool:
    """False on a kernel that was built without CAN, as many of virtual machines are."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return error.errno != errno.EAFNOSUPPORT
    return True


def find_commands(channel: object) -> tuple[str, str]:
    """What makes a virtual interface that is missing, or lists those that are there."""
    if str(channel).startswith("vcan"):
        return (f"ip link add dev {channel} type vcan", f"ip link set {channel} up")
    return ("ip -brief link show type can", "dmesg | grep -i can")


def restart_commands(channel: object) -> tuple[str, str]:
    """How root starts an interface again after bus-off, with the settings that it has. `type can
    restart` does so only where the driver has it.
    """
    return (f"ip link set {channel} down", f"ip link set {channel} up")


def change_commands(channel: object, *options: str) -> tuple[str, str, str]:
    """How root changes options of a CAN interface, which it takes only while it is down."""
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
    """None when `ip` is missing, too old for JSON, or says something else than expected."""
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
