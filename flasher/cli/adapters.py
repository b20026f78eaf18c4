"""Adapter selection: detects the adapters of this computer, and chooses one if none is named."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Unpack

import click

from flasher.api import CallOptions, Device
from flasher.bus.detect import (
    SLOW,
    SOCKETCAN,
    DetectedAdapter,
    Detection,
    DetectionResult,
    serial_ports,
)
from flasher.bus.inspect_interface import VIRTUAL_KINDS, Interface, read_interface, start_command
from flasher.cli.framework import rebuild_command_line
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.cli.values import interface_names
from flasher.errors import BusError, ErrorCode, InterruptedByUserError, NoAnswerError, UsageError
from flasher.protocol.spec import Dialect
from flasher.protocol.text import printable

_NAMES: Final = ("device_name", "description")
"""Keys under which back ends and serial ports report an adapter's name."""


def detect_adapters(*, on_network: bool = False) -> DetectionResult:
    """Detect adapters, including servers in the network if `on_network`. Takes at most 5 s. Raises
    InterruptedByUserError.
    """
    with stop_on_signal() as stopped:
        return detect_until(stopped, on_network=on_network)


def detect_until(stopped: Callable[[], bool], *, on_network: bool = False) -> DetectionResult:
    """Detect adapters until `stopped` returns True. Raises InterruptedByUserError then."""
    asked = set(interface_names()) - (frozenset() if on_network else SLOW)
    with Detection(sorted(asked)) as detection:
        found = detection.collect(stopped)
        if stopped():
            raise InterruptedByUserError("Interrupted by the user.")
    return found


def slcan_ports() -> list[DetectedAdapter] | None:
    """List the serial ports as possible slcan adapters; None if pyserial is missing."""
    try:
        return list(serial_ports("slcan"))
    except ImportError:
        return None


def interface_of(found: DetectedAdapter) -> Interface | None:
    """State of a SocketCAN interface in the kernel; None for any other adapter."""
    state = read_interface(found.channel) if found.interface == SOCKETCAN else None
    return state if isinstance(state, Interface) else None


def describe_adapter(found: DetectedAdapter, dialect: Dialect) -> str:
    """Describe an adapter: its state if known, its name, its serial number."""
    words = []
    state = interface_of(found)
    if state is not None and state.is_up:
        words.append("up")
        if state.kind in VIRTUAL_KINDS:
            words.append("virtual")
        if state.bitrate_bps is not None:
            words.append(f"{state.bitrate_bps / 1000:g} kbit/s")
        words += [state.state_name.lower()] if state.state_name else []
    elif state is not None:
        words.append(f"down, `{start_command(found.channel, dialect.bitrate_bps)}` starts it")
    words += [str(found.details[name]) for name in _NAMES if found.details.get(name)]
    if found.serial_number:
        words.append(f"serial number {found.serial_number}")
    return printable(", ".join(words))


# -- the adapter of a command ----------------------------------------------------------------------


def choose_adapter(bus: Bus, output: Output) -> Bus:
    """Return the bus, with the only adapter detected (and a message) if none is named.

    Raises UsageError for several adapters, BusError for none.
    """
    if bus.mock or bus.is_named:
        return bus
    found = [each for each in detect_adapters().found if each.channel]
    if not found:
        raise _none_found()
    if len(found) > 1:
        raise _several_found(found, bus.dialect)
    return use_only_adapter(found[0], bus, output)


def use_only_adapter(found: DetectedAdapter, bus: Bus, output: Output) -> Bus:
    """Return the bus with the only detected adapter, and print a message."""
    output.progress(f"no adapter is named: using the only one found, {printable(found.arguments)}")
    return replace(with_adapter(found, bus), found=found)


def with_adapter(found: DetectedAdapter, bus: Bus) -> Bus:
    """Return the bus with this adapter."""
    kwargs = tuple((key, str(value)) for key, value in found.bus_kwargs.items())
    return replace(
        bus,
        interface=found.interface,
        channel=found.channel,
        bus_kwargs=(*kwargs, *bus.bus_kwargs),
    )


def check_heard(device: Device, bus: Bus, output: Output, **watch: Unpack[CallOptions]) -> None:
    """Check that the device is on an adapter that was chosen automatically, before changing it.
    Raises NoAnswerError; sends at most a version query.
    """
    if bus.found is None:
        return
    node = device.target.node.name
    output.progress(f"listening for the {node} ...")
    if not device.is_present(**watch):
        error = NoAnswerError(
            f"The {node} did not answer, and no option names the adapter: nothing was changed.",
            where=f"the only adapter found, {printable(device.connection.name)}",
            cause="it is off or asleep, it sends only at power-up, or it is on another "
            "bus than that of this adapter",
            remedy="Wake it with its key. Where you know that it is on this bus, name the adapter.",
            code=ErrorCode.NOBODY_HEARD,
        )
        ctx = click.get_current_context()
        name = ctx.info_name or ""
        words = rebuild_command_line(ctx, name)
        after = words.index(name) + 1
        error.command = shlex.join(["flasher", *words[:after], *bus.found.words, *words[after:]])
        raise error
    output.progress(f"the {node} is there")


def _several_found(found: list[DetectedAdapter], dialect: Dialect) -> UsageError:
    width = max(len(each.arguments) for each in found)
    listed = "".join(
        f"\n    {printable(each.arguments):<{width}}   {describe_adapter(each, dialect)}".rstrip()
        for each in found
    )
    return UsageError(
        f"{len(found)} adapters are there, and none of them is named.",
        remedy=f"Add one of these to the command:{listed}",
        code=ErrorCode.WHICH_ADAPTER,
    )


def _none_found() -> BusError:
    maybe = slcan_ports()
    listed = "".join(f"\n    {printable(each.arguments)}" for each in maybe or ())
    if listed:
        listed = f" One of the serial ports may be an slcan adapter:{listed}"
    return BusError(
        "No adapter is named, and none was found.",
        cause="none is plugged in, its driver is missing, or it is of a kind that cannot be found "
        "(slcan, gs_usb and others)",
        remedy="See with `flasher adapters` what is looked for and what is missing, or name an "
        f"adapter, as in `-i pcan -c PCAN_USBBUS1`; --mock needs none.{listed}",
        code=ErrorCode.NO_ADAPTER,
    )
