"""Opening of a python-can bus: merged configuration, and errors with cause and remedy."""

from __future__ import annotations

import configparser
import contextlib
import errno
import importlib.util
import platform
import re
import socket
import threading
from collections.abc import Iterator, Mapping
from typing import Any, Final

from flasher.bus.back_ends import SERIAL_PORTS, causes, error_text
from flasher.bus.fallback import Fallback
from flasher.bus.health import ControllerState, bus_off_error
from flasher.bus.inspect_interface import (
    SYSFS,
    Unseen,
    change_commands,
    find_commands,
    look_up,
    read_interface,
    restart_commands,
    start_command,
)
from flasher.errors import BusError, ErrorCode, UsageError, install_command
from flasher.protocol.text import printable
from flasher.python_can import can

_ANSWER_LIMIT_S: Final = 5.0
"""Maximum time for each answer of a socketcand server while it is opened."""
_LIMITING: Final = threading.Lock()
"""The limit is of the whole process: who sets it restores it before another thread does."""
_FASTER: Final[Mapping[str, Mapping[str, object]]] = {
    "socketcand": {"tcp_tune": platform.system() != "Windows"},
}
"""Bus arguments unless others are given: each frame is sent without awaiting TCP's confirmation of
the last one, which may take 40 ms."""
_CHANNELS: Final = {
    "pcan": "PCAN_USBBUS1",
    "slcan": "COM3",
    "socketcan": "can0",
    "udp_multicast": "239.74.163.2",
}
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
_DRIVERS: Final[Mapping[str, str]] = {
    "etas": "BOA of ETAS (Windows)",
    "iscan": "the isCAN driver of Thorsis (Windows)",
    "ixxat": "the VCI driver of Ixxat (Windows)",
    "kvaser": "CANlib of Kvaser",
    "neousys": "the WDT_DIO driver of Neousys",
    "nican": "NI-CAN of National Instruments (Windows, 32-bit Python)",
    "nixnet": "NI-XNET of National Instruments (Windows)",
    "pcan": "PCAN-Basic of PEAK",
    "systec": "the USB-CANmodul driver of SYS TEC (Windows)",
    "usb2can": "the USB2CAN CANAL driver of 8devices and the Python package pywin32 (Windows)",
    "vector": "the XL Driver Library of Vector (Windows)",
}
"""Software of the maker that an interface needs."""
_IN_KERNEL: Final = frozenset({"kvaser", "pcan", "usb2can"})
"""Interfaces whose USB adapters Linux drives itself, as SocketCAN."""
_DRIVER_MISSING: Final = re.compile(
    r"library not found|driver missing|could not (be )?load|only supported", re.IGNORECASE
)
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
_UNFIT_MODES: Final = {
    "listen-only": (
        "only listens",
        "it acknowledges and sends no frame; flasher monitor works as it is",
    ),
    "loopback": (
        "receives its own frames alone",
        "it reaches no device, and its own frames look like those of another tool",
    ),
}
"""Modes of a SocketCAN interface in which no device can be reached."""
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
            f"The adapter's configuration is invalid: {printable(error_text(error))}.",
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
    interface that is down, bus-off, or in a mode in which no device can be reached although the
    program `sends`.
    """
    interface, channel = str(config["interface"]), config.get("channel")
    try:
        with _answers_limited() if interface == "socketcand" else contextlib.nullcontext():
            bus = can.Bus(**{**_FASTER.get(interface, {}), **config}, ignore_config=True)
    except Exception as error:
        where = f"interface {interface}, channel {channel}"
        raise _software_missing(interface, where, error) or BusError(
            f"The adapter cannot be opened: {error_text(error)}.",
            where=where,
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


@contextlib.contextmanager
def _answers_limited() -> Iterator[None]:
    """Give the sockets that are made here a time limit, and connect once: python-can awaits the
    greeting of a socketcand server without a limit, and connects for 10 s without a pause.
    """
    module: Any = importlib.import_module("can.interfaces.socketcand.socketcand")
    with _LIMITING:
        before = socket.getdefaulttimeout(), module.connect_to_server
        socket.setdefaulttimeout(_ANSWER_LIMIT_S)
        module.connect_to_server = lambda its, host, port: its.connect((host, port))
        try:
            yield
        finally:
            socket.setdefaulttimeout(before[0])
            module.connect_to_server = before[1]


def _unusable(channel: str, bitrate_bps: object, *, sends: bool) -> BusError | None:
    """Return the error for a SocketCAN interface that is down, bus-off or in an unfit mode, all of
    which open without error. The carrier alone is not enough: gs_usb keeps it after bus-off.
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
    for mode, (what, harm) in _UNFIT_MODES.items() if sends else ():
        if mode.upper() in interface.modes:
            off = "; ".join(change_commands(channel, mode, "off"))
            return BusError(
                f"The adapter cannot be used: {channel} {what}, and nothing was sent.",
                where=where,
                cause=f"its {mode} mode is on, in which {harm}",
                remedy=f"`{off}` (as root) switches it off.",
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


def _software_missing(interface: str, where: str, error: Exception) -> BusError | None:
    """Return the error for an interface whose Python package or driver is not installed; None if
    the back end has failed for another reason.
    """
    found = BusError(
        f"The adapter cannot be opened: software for the interface {interface} is missing.",
        where=where,
        code=ErrorCode.ADAPTER_NOT_OPENED,
    )
    extra = needed_extra(interface)
    driver = _DRIVERS.get(interface)
    if extra is not None and importlib.util.find_spec(extra[1]) is None:
        found.cause = "the Python package for this interface is not installed"
        command = install_command(f"python-can[{extra[0]}]")
        found.remedy = f"Run `{command}`."
    elif driver is not None and _is_driver_missing(error):
        found.cause = "the driver library of this interface is not installed"
        found.remedy = f"Install {driver}; `flasher adapters` lists the adapter then."
        if SYSFS.is_dir() and interface in _IN_KERNEL:
            found.remedy = (
                f"Use Linux's own driver, as in `-i socketcan -c can0`, or install {driver}; "
                "`flasher adapters` lists the adapter then."
            )
    else:
        return None
    return found


def _is_driver_missing(error: Exception) -> bool:
    wrong_names = (NameError, ImportError, AttributeError, can.CanInterfaceNotImplementedError)
    return isinstance(error, wrong_names) or _DRIVER_MISSING.search(error_text(error)) is not None


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
    if interface in SERIAL_PORTS:
        return "it is not plugged in, its port has another name, or another program uses it"
    if interface == "socketcand":
        return "no socketcand server answers at this host and port, or it has no such channel"
    if interface == "udp_multicast":
        return "the channel is not a multicast address"
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
    if interface in SERIAL_PORTS:
        return (
            "Plug it in, and close other programs that use it; `flasher adapters` lists the serial "
            "ports."
        )
    if interface == "udp_multicast":
        return f"Name one, as in `-i udp_multicast -c {_CHANNELS[interface]}`."
    if interface == "socketcand" and isinstance(error, TypeError):
        return "Name its server with `--bus-kwargs host=HOST --bus-kwargs port=29536`."
    if interface == "socketcand":
        return "Start socketcand there with this channel, and compare host and port."
    return "Plug it in, close other programs that use it, install its driver."
