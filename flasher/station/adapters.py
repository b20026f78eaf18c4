"""From the sockets of a station's file to what their processes are given: each socket finds its
adapter by serial number or place on the USB.

`resolve` is a pure function of what was detected; `detect` asks python-can, pyserial and the
system.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import can

from flasher.errors import BusError, UsageError
from flasher.protocol.text import printable
from flasher.station.config import SocketConfig
from flasher.station.messages import VirtualUnits, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe

_SERIAL_KEYS: Final = ("serial_number", "serial", "unique_hardware_id", "hw_serial", "hwid")
"""Where back ends of python-can put an adapter's serial number."""
_SERIAL_PORTS: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
_NETWORK: Final = Path("/sys/class/net")


@dataclass(frozen=True)
class Detected:
    """An adapter that is plugged in."""

    interface: str
    channel: str
    serial_number: str = ""
    usb_path: str = ""


@dataclass(frozen=True)
class Resolved:
    """A socket with the python-can configuration of its adapter; None for virtual units."""

    config: SocketConfig
    bus: Mapping[str, Any] | None


def resolve(sockets: Sequence[SocketConfig], detected: Iterable[Detected]) -> tuple[Resolved, ...]:
    """Every socket with its adapter.

    Raises BusError when an adapter is not there, UsageError when two sockets come to the same one
    or when the channel does not follow from what is given.
    """
    found = tuple(detected)
    resolved = tuple(_resolve(socket, found) for socket in sockets)
    taken: dict[tuple[object, object], str] = {}
    for each in resolved:
        if each.bus is None:
            continue
        adapter = (each.bus["interface"], each.bus["channel"])
        if adapter in taken:
            raise UsageError(
                f"Sockets {taken[adapter]} and {each.config.name} have the same adapter: "
                f"{adapter[0]} {adapter[1]}.",
                remedy="One adapter serves one socket, since the ids on the bus are fixed.",
            )
        taken[adapter] = each.config.name
    return resolved


def _resolve(socket: SocketConfig, detected: Sequence[Detected]) -> Resolved:
    if socket.mock is not None:
        return Resolved(socket, None)
    bus: dict[str, Any] = {**socket.bus, "interface": socket.interface}
    if not (socket.serial_number or socket.usb_path):
        return Resolved(socket, bus | {"channel": socket.channel})
    wanted = socket.serial_number or socket.usb_path
    channels = sorted(
        {
            each.channel
            for each in detected
            if each.interface == socket.interface
            and wanted == (each.serial_number if socket.serial_number else each.usb_path)
            and socket.channel in ("", each.channel)
        }
    )
    what = "serial number" if socket.serial_number else "USB path"
    if not channels:
        raise BusError(
            f"Socket {socket.name}: no {socket.interface} adapter with the {what} "
            f"{printable(wanted)} is plugged in.",
            remedy="Plug it in. `flasher doctor` shows the adapters that there are.",
        )
    if len(channels) > 1:
        raise UsageError(
            f"Socket {socket.name}: the adapter with the {what} {printable(wanted)} has "
            f"{len(channels)} channels: {', '.join(map(printable, channels))}.",
            remedy="Name the channel as well.",
        )
    return Resolved(socket, bus | {"channel": channels[0]})


def worker_setups(
    sockets: Sequence[Resolved],
    recipe: LoadedRecipe,
    *,
    first_number: int = 1,
    units: int | None = None,
    speed: float = 1.0,
    leave_after_s: float = 1.0,
) -> list[WorkerSetup]:
    """What each socket's process needs. Virtual units are numbered from `first_number` on, no
    number twice, and dealt out like cards: `units` in all, or without end.
    """
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    total = len(sockets)
    setups = []
    for at, each in enumerate(sockets):
        virtual = None
        if each.config.mock is not None:
            count = None if units is None else (units - at + total - 1) // total
            virtual = VirtualUnits(
                each.config.mock,
                first_number + at,
                total,
                speed=speed,
                leave_after_s=leave_after_s,
                count=count,
            )
        name, power = each.config.name, each.config.power
        setups.append(WorkerSetup(name, recipe.path, files, each.bus, virtual, power))
    return setups


# -- what is plugged in ---------------------------------------------------------------------------


def detect(sockets: Sequence[SocketConfig], *, network: Path = _NETWORK) -> tuple[Detected, ...]:
    """The adapters for the interfaces of sockets that are found by serial number or USB path.

    It may take as long as the back ends take.
    """
    wanted = {s.interface for s in sockets if s.serial_number or s.usb_path}
    found: list[Detected] = []
    for interface in sorted(wanted):
        if interface == "socketcan":
            found += _network_adapters(network)
        elif interface in _SERIAL_PORTS:
            found += _serial_ports(interface)
        else:
            found += _of_back_end(interface)
    return tuple(found)


def _of_back_end(interface: str) -> Iterator[Detected]:
    for config in can.detect_available_configs(interface):
        details: Mapping[str, Any] = config
        serial = next((str(details[key]) for key in _SERIAL_KEYS if details.get(key)), "")
        yield Detected(interface, str(details.get("channel", "")), serial)


def _serial_ports(interface: str) -> Iterator[Detected]:
    try:
        ports: Any = importlib.import_module("serial.tools.list_ports")
    except ImportError as error:
        raise UsageError(
            f"To find a {interface} adapter by its serial number, pyserial is needed.",
            remedy="Install python-can with its serial extra: pip install 'python-can[serial]'.",
        ) from error
    for port in ports.comports():
        yield Detected(interface, port.device, port.serial_number or "", port.location or "")


def _network_adapters(network: Path) -> Iterator[Detected]:
    """CAN interfaces of Linux with what their USB device says."""
    for folder in sorted(network.glob("*")):
        if _text(folder / "type") != "280":  # ARPHRD_CAN
            continue
        device = (folder / "device").resolve()
        # The link leads to the USB interface; the device is above it.
        serial = _text(device.parent / "serial") or _text(device / "serial")
        usb_path = (
            device.name.partition(":")[0]
            if (device.parent / "serial").exists()
            or (":" in device.name and (device.parent / "idVendor").exists())
            else ""
        )
        yield Detected("socketcan", folder.name, serial, usb_path)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""
