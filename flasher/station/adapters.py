"""Finds the adapters of a station's sockets by serial number or USB path.

Creates the settings of the sockets' processes.

`detect` lists the connected adapters (see `flasher.bus.detect`), and `resolve` assigns them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from flasher.errors import BusError, ErrorCode, UsageError, install_command
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
    """Assign an adapter to each socket.

    Raises BusError when an adapter is missing, UsageError when two sockets have the same adapter or
    when an adapter has several channels.
    """
    adapters = tuple(detected)
    resolved = tuple(_resolve(socket, adapters) for socket in sockets)
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
            remedy="Plug it in. `flasher doctor` lists the connected adapters.",
            code=ErrorCode.NO_ADAPTER,
        )
    if len(channels) > 1:
        raise UsageError(
            f"Socket {socket.name}: the adapter with the {what} {printable(wanted)} has "
            f"{len(channels)} channels: {', '.join(map(printable, channels))}.",
            remedy="Set the channel as well.",
        )
    return Resolved(socket, bus | {"channel": channels[0]})


def check_samples(sockets: Iterable[Resolved], recipe: LoadedRecipe) -> None:
    """Raises ImageError for a recipe with a firmware sample if a socket has a physical adapter."""
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
    """Create the settings of each socket's process. Virtual units are numbered from `first_number`,
    in turn over the sockets, up to `units`. Raises ImageError as `check_samples`.
    """
    check_samples(sockets, recipe)
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
        adapter = None if each.bus is None else each.config
        setup = WorkerSetup(name, recipe.path, {}, adapter, virtual, power)
        setups.append(with_recipe(setup, recipe))
    return setups


def with_recipe(setup: WorkerSetup, recipe: LoadedRecipe) -> WorkerSetup:
    """Settings of the same socket with another recipe."""
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    return replace(setup, recipe=recipe.path, files=files, is_from_plant=bool(recipe.digest))


# -- detection ------------------------------------------------------------------------------------


def detect(
    sockets: Sequence[SocketConfig], *, network: Path = SYSFS
) -> tuple[DetectedAdapter, ...]:
    """Detect the connected adapters of all interfaces that sockets look for by serial number or USB
    path. Raises UsageError when a package for it is not installed.
    """
    wanted = {s.interface for s in sockets if s.serial_number or s.usb_path}
    adapters: list[DetectedAdapter] = []
    for interface in sorted(wanted & SERIAL_PORTS):
        try:
            adapters += serial_ports(interface)
        except ImportError as error:
            raise UsageError(
                f"Finding a {interface} adapter by its serial number needs pyserial.",
                remedy=f"Run {install_command('python-can[serial]')}",
                code=ErrorCode.PACKAGE_MISSING,
            ) from error
    if SOCKETCAN in wanted:
        adapters += network_adapters(network)
    with Detection(sorted(wanted - SERIAL_PORTS - {SOCKETCAN})) as detection:
        adapters += detection.collect().found
    return tuple(adapters)
