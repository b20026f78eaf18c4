"""Opens a python-can bus: merged configuration, and errors with cause and remedy."""

from __future__ import annotations

import configparser
import contextlib
import errno
from collections.abc import Mapping
from typing import Any, Final

from flasher.bus.back_ends import causes, error_text
from flasher.bus.fallback import Fallback
from flasher.bus.health import ControllerState, bus_off_error
from flasher.bus.inspect_interface import (
    Unseen,
    change_commands,
    find_commands,
    look_up,
    read_interface,
    restart_commands,
    start_command,
)
from flasher.errors import BusError, ErrorCode, UsageError
from flasher.protocol.text import printable
from flasher.python_can import can

_CHANNELS: Final = {"socketcan": "can0", "pcan": "PCAN_USBBUS1", "slcan": "COM3"}
_EXTRAS: Final[Mapping[str, tuple[str, str]]] = {
    "canalystii": ("canalystii", "canalystii"),
    "cantact": ("cantact", "cantact"),
    "gs_usb": ("gs-usb", "gs_usb"),
    "neovi": ("neovi", "ics"),
    "nixnet": ("nixnet", "nixnet"),
    "robotell": ("serial", "serial"),
    "seeedstudio": ("seeedstudio", "serial"),
    "serial": ("serial", "serial"),
    "slcan": ("serial", "serial"),
    "udp_multicast": ("multicast", "msgpack"),
}
"""python-can extra that an interface needs, and the module it installs."""
_LISTEN_ONLY: Final[Mapping[str, Mapping[str, object]]] = {
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},
    "nixnet": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
    "slcan": {"listen_only": True},
    "systec": {"state": can.BusState.PASSIVE},
    "vector": {"listen_only": True},
}
"""Bus arguments for listen-only mode. SocketCAN is configured by root; python-can has no argument
for other back ends."""
_PERMISSION: Final = frozenset({errno.EACCES, errno.EPERM})


def needed_extra(interface: str) -> tuple[str, str] | None:
    """Return the python-can extra and the module that an interface needs; None if it needs none."""
    return _EXTRAS.get(interface)


def can_listen_only(interface: str) -> bool:
    """True if a bus argument puts the adapter in listen-only mode."""
    return interface in _LISTEN_ONLY


def bus_config(
    given: Mapping[str, Any], fallback: Fallback | None = None, *, listen_only: bool = False
) -> dict[str, Any]:
    """Merge the keywords for `can.Bus` from arguments, variables, files and the `fallback`, in this
    order. A bit rate is included only if one of them names it (see `flasher.bus.bit_rate`).

    `listen_only` adds arguments for listen-only mode, if the back end has any. Raises UsageError
    for an invalid configuration, BusError if no adapter is configured.
    """
    merged = _configured(given, fallback)
    if "timing" in given:
        merged.pop("bitrate", None)
    elif "bitrate" in given:
        merged.pop("timing", None)
    if listen_only:
        merged.update(_LISTEN_ONLY.get(str(merged["interface"]), {}))
    return merged


def _configured(given: Mapping[str, Any], fallback: Fallback | None) -> dict[str, Any]:
    if fallback is None:
        return _by_python_can(given)
    try:
        merged = _by_python_can(given)
    except BusError:  # only the fallback names an interface
        merged = _by_python_can({**given, "interface": fallback.bus["interface"]})
    if merged["interface"] != fallback.bus["interface"]:
        return merged
    more = {key: value for key, value in fallback.bus.items() if merged.get(key) is None}
    if "timing" in merged:
        more.pop("bitrate", None)
    return _by_python_can({**given, "interface": merged["interface"], **more})


def _by_python_can(given: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return dict(can.util.load_config(config=dict(given)))
    except can.CanInterfaceNotImplementedError as error:
        raise _no_interface(error) from error
    except (ValueError, TypeError, configparser.Error) as error:
        raise UsageError(
            f"The adapter's configuration makes no sense: {printable(error_text(error))}.",
            remedy="Check the bus arguments, python-can's configuration file and CAN_* variables.",
        ) from error


def names_adapter(given: Mapping[str, Any], fallback: Fallback | None = None) -> bool:
    """True if arguments, a variable or a file name an adapter. Raises UsageError."""
    try:
        return bool(bus_config(given, fallback))
    except BusError:
        return bus_config({**given, "interface": "virtual"}).get("channel") is not None


def open_bus(config: Mapping[str, Any], *, sends: bool = True) -> can.BusABC:
    """Open a bus by the result of `bus_config`. Raises BusError with cause and remedy, also for an
    interface that is down, bus-off, or in listen-only mode although the program `sends`.
    """
    interface, channel = str(config["interface"]), config.get("channel")
    try:
        bus = can.Bus(**config, ignore_config=True)
    except Exception as error:
        raise BusError(
            f"The adapter cannot be opened: {error_text(error)}.",
            where=f"interface {interface}, channel {channel}",
            cause=_opening_cause(interface, error),
            remedy=_opening_remedy(interface, channel, config.get("bitrate"), error),
            code=ErrorCode.ADAPTER_NOT_OPENED,
        ) from error
    if interface == "socketcan":
        failure = _unusable(str(channel), config.get("bitrate"), sends=sends)
        if failure is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()
            raise failure
    return bus


def _unusable(channel: str, bitrate_bps: object, *, sends: bool) -> BusError | None:
    """Return the error for a SocketCAN interface that is down, bus-off or in listen-only mode, all
    of which open without error. The carrier alone is not enough: gs_usb keeps it after bus-off.
    """
    interface = read_interface(channel)
    if isinstance(interface, Unseen) or not interface.is_can:
        return None
    where = f"interface socketcan, channel {channel}"
    if not interface.is_up:
        return BusError(
            f"The adapter cannot be opened: the interface {channel} is down.",
            where=where,
            cause="it was not started after it was plugged in",
            remedy=f"`{start_command(channel, bitrate_bps)}` (as root) starts it.",
            code=ErrorCode.ADAPTER_NOT_OPENED,
        )
    if interface.state is ControllerState.BUS_OFF or interface.has_carrier is False:
        what = "is bus-off" if interface.state is ControllerState.BUS_OFF else "has no carrier"
        error = bus_off_error(where, f"The adapter cannot be used: {channel} {what}.")
        if interface.has_carrier is False:
            error.cause += ", or the other end of a vxcan pair is down"
        error.remedy = (
            f"Check bit rate and wiring; `{'; '.join(restart_commands(channel))}` (as root) "
            "starts the controller again."
        )
        return error
    if sends and interface.only_listens:
        return BusError(
            f"The adapter cannot be used: {channel} only listens, and nothing was sent.",
            where=where,
            cause="its listen-only mode is on, in which it acknowledges and sends no frame",
            remedy=f"`{'; '.join(change_commands(channel, 'listen-only off'))}` (as root) lets it "
            "send; flasher monitor works as it is.",
            code=ErrorCode.ADAPTER_NOT_OPENED,
        )
    return None


def _no_interface(error: Exception) -> UsageError | BusError:
    known = ", ".join(sorted(can.VALID_INTERFACES))
    if '"None"' in str(error):
        return BusError(
            "No adapter is configured.",
            cause="neither -i/--interface, nor the variable CAN_INTERFACE, nor a python-can "
            "configuration file, nor [bus] of flasher.toml names one",
            remedy="Name it, for example `-i socketcan -c can0` or `-i pcan -c PCAN_USBBUS1`; "
            f"--mock needs none. flasher adapters lists what is plugged in. Interfaces: {known}.",
            code=ErrorCode.NO_ADAPTER,
        )
    return UsageError(f"{error_text(error)}.", remedy=f"python-can knows: {known}.")


def _code(error: BaseException) -> int | None:
    """Error code of the operating system, which back ends wrap once or twice."""
    for each in causes(error):
        code = getattr(each, "errno", None) or getattr(each, "error_code", None)
        if isinstance(code, int):
            return code
    return None


def _opening_cause(interface: str, error: Exception) -> str:
    code = _code(error)
    if code == errno.EAFNOSUPPORT:
        return "this system's kernel has no CAN"
    if code in _PERMISSION:
        return "this user may not use the adapter"
    if code == errno.EBUSY:
        return "another program uses the adapter"
    if interface == "socketcan":
        return "the interface does not exist or is down"
    if isinstance(error, can.CanInterfaceNotImplementedError | ImportError) and needed_extra(
        interface
    ):
        return "the Python package for this interface is not installed"
    if isinstance(error, NameError | ImportError | AttributeError):
        return "the driver library of this interface is not installed"
    return "the adapter is not plugged in, in use by another program, or its driver is missing"


def _opening_remedy(interface: str, channel: object, bitrate_bps: object, error: Exception) -> str:
    if channel is None:
        return f"Name the channel, for example `-i {interface} -c {_CHANNELS.get(interface, 0)}`."
    if _code(error) in _PERMISSION:
        return (
            "On Linux, add the user to the group of the device (`sudo usermod -aG dialout $USER`, "
            "then log in again) or install the adapter's udev rule."
        )
    if _code(error) == errno.EAFNOSUPPORT:
        return (
            "Use a kernel with CAN, or an adapter that python-can drives itself (slcan, gs_usb, "
            "pcan); `flasher adapters` lists what is there."
        )
    if interface == "socketcan":
        if look_up(str(channel)) is Unseen.MISSING:
            find = find_commands(channel)
            if str(channel).startswith("vcan"):
                return f"`{' && '.join(find)}` (as root) makes it."
            return (
                f"Plug it in, then start it: `{start_command(channel, bitrate_bps)}` (as root). "
                f"`{find[0]}` lists the interfaces that are there."
            )
        return (
            f"`ip -details link show {channel}` shows its state; "
            f"`{start_command(channel, bitrate_bps)}` (as root) starts it."
        )
    extra = needed_extra(interface)
    package = f" (`pip install 'python-can[{extra[0]}]'`)" if extra else ""
    return f"Plug it in, close other programs that use it, install its driver{package}."
