"""From the sockets of a station's file to what their processes are given: each socket finds its
adapter by serial number or place on the USB.

`resolve` is a pure function of what was detected (`flasher.bus.detect`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flasher.bus.detect import (
    SERIAL_PORTS,
    SOCKETCAN,
    DetectedAdapter,
    Detection,
    network_adapters,
    serial_ports,
)
from flasher.bus.inspect_interface import SYSFS
from flasher.bus.physical import is_physical
from flasher.errors import BusError, ErrorCode, UsageError
from flasher.image.sample import is_sample, sample_error
from flasher.protocol.text import printable
from flasher.station.config import SocketConfig
from flasher.station.messages import VirtualUnits, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe


@dataclass(frozen=True)
class Resolved:
    """A socket with the python-can configuration of its adapter; None for virtual units."""

    config: SocketConfig
    bus: Mapping[str, Any] | None


def resolve(
    sockets: Sequence[SocketConfig], detected: Iterable[DetectedAdapter]
) -> tuple[Resolved, ...]:
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


def _resolve(socket: SocketConfig, detected: Sequence[DetectedAdapter]) -> Resolved:
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
            code=ErrorCode.NO_ADAPTER,
        )
    if len(channels) > 1:
        raise UsageError(
            f"Socket {socket.name}: the adapter with the {what} {printable(wanted)} has "
            f"{len(channels)} channels: {', '.join(map(printable, channels))}.",
            remedy="Name the channel as well.",
        )
    return Resolved(socket, bus | {"channel": channels[0]})


def check_samples(sockets: Iterable[Resolved], recipe: LoadedRecipe) -> None:
    """Raise ImageError when the recipe has a firmware sample and a socket a physical adapter."""
    samples = [target.image for target in recipe.targets if is_sample(target.image)]
    for each in sockets if samples else ():
        if each.bus is None:
            continue
        interface, channel = str(each.bus["interface"]), str(each.bus["channel"])
        if is_physical(interface, channel):
            socket = printable(f"socket {each.config.name}, {interface} {channel}")
            raise sample_error(samples[0], socket)


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
    number twice, and dealt out like cards: `units` in all, or without end. Raises ImageError as
    `check_samples`.
    """
    check_samples(sockets, recipe)
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


def detect(
    sockets: Sequence[SocketConfig], *, network: Path = SYSFS
) -> tuple[DetectedAdapter, ...]:
    """The adapters for the interfaces of sockets that are found by serial number or USB path.

    Raises UsageError where a package is missing that finds them.
    """
    wanted = {s.interface for s in sockets if s.serial_number or s.usb_path}
    found: list[DetectedAdapter] = []
    for interface in sorted(wanted & SERIAL_PORTS):
        try:
            found += serial_ports(interface)
        except ImportError as error:
            raise UsageError(
                f"To find a {interface} adapter by its serial number, pyserial is needed.",
                remedy="Install python-can with its serial extra: pip install "
                "'python-can[serial]'.",
                code=ErrorCode.PACKAGE_MISSING,
            ) from error
    if SOCKETCAN in wanted:
        found += network_adapters(network)
    with Detection(sorted(wanted - SERIAL_PORTS - {SOCKETCAN})) as detection:
        found += detection.collect().found
    return tuple(found)
