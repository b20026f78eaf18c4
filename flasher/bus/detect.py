"""Adapter detection: python-can's back ends, CAN interfaces of the kernel, serial ports.

Vendors' libraries hang, print and crash, so they run in another process, `python -m
flasher.bus.detect NAME...`, with a time limit. It asks every back end in its own thread, and prints
each answer at once.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from flasher.builds import module_command
from flasher.bus.inspect_interface import SYSFS, look_up

LIMIT_S: Final = 4.5
"""Total time limit. The slowest back end (socketcand) listens for 4 s."""
_NOT_LOADED: Final = "not_loaded"
_CANNOT_TELL: Final = "cannot_tell"
_MARK: Final = "detected: "
"""Prefix of lines with an answer, because vendors' libraries print too."""
_LIFE_S: Final = 30.0
"""Time after which a detection process ends by itself if its parent was killed."""
_SLICE_S: Final = 0.2
"""Interval at which a wait checks for cancellation."""
_COMMAND: Final = module_command("flasher.bus.detect")
BUILT_IN: Final = frozenset({"virtual", "udp_multicast"})
"""Interfaces of python-can without an adapter; they always exist."""
SOCKETCAN: Final = "socketcan"
SLOW: Final = frozenset({"socketcand"})
"""Back ends that wait for servers in the network."""
SERIAL_PORTS: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
"""Back ends that open a serial port: which adapter is connected shows only then."""
_SERIAL_KEYS: Final = ("serial_number", "serial", "unique_hardware_id", "hw_serial", "hwid")
"""Keys under which back ends report an adapter's serial number."""
_USB_PATH: Final = "usb_path"
_INDEX: Final = "channel_index"
_CHOOSING: Final[Mapping[str, tuple[str, ...]]] = {
    "ixxat": ("unique_hardware_id",),
    "neovi": ("serial",),
    "socketcand": ("host", "port"),
    "systec": ("device_number",),
    "vector": ("channel_index",),
}
"""Keys besides the channel that a back end needs to open a certain adapter."""


@dataclass(frozen=True)
class DetectedAdapter:
    """CAN adapter as its back end reports it."""

    interface: str
    channel: str
    """Channel or port; empty if not reported."""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def serial_number(self) -> str:
        """Serial number of the adapter; empty if not reported."""
        return next((str(self.details[key]) for key in _SERIAL_KEYS if self.details.get(key)), "")

    @property
    def usb_path(self) -> str:
        """USB path of the adapter, such as "1-1.4"; empty if not reported."""
        return str(self.details.get(_USB_PATH, ""))

    @property
    def identity(self) -> tuple[str, str]:
        """Serial number, or USB path without one, and index of the channel in the adapter; what it
        keeps when it is plugged in again under another name. Empty if not reported.
        """
        usb_path, index = self.place
        mark = self.serial_number or usb_path
        return (mark, index) if mark else ("", "")

    @property
    def place(self) -> tuple[str, str]:
        """USB path, and index of the channel in the adapter."""
        return self.usb_path, str(self.details.get(_INDEX, ""))

    @property
    def bus_kwargs(self) -> dict[str, Any]:
        """Bus arguments besides interface and channel that open this adapter."""
        names = _CHOOSING.get(self.interface, ())
        return {name: self.details[name] for name in names if name in self.details}

    @property
    def words(self) -> list[str]:
        """Command-line options that open this adapter."""
        words = ["-i", self.interface, "-c", self.channel or "CHANNEL"]
        for key, value in self.bus_kwargs.items():
            words += ["--bus-kwargs", f"{key}={value}"]
        return words

    @property
    def arguments(self) -> str:
        """Command-line options that open this adapter, quoted for a shell."""
        return shlex.join(self.words)


@dataclass
class DetectionResult:
    """Detected adapters, and back ends without a result."""

    found: list[DetectedAdapter] = field(default_factory=list)
    hung: list[str] = field(default_factory=list)
    """Back ends without an answer in time."""
    failed: dict[str, str] = field(default_factory=dict)
    """Back ends that failed or crashed, with the message."""
    not_loaded: list[str] = field(default_factory=list)
    """Back ends whose package is missing or is for another operating system."""
    cannot_tell: list[str] = field(default_factory=list)
    """Back ends that cannot list their adapters."""


class Detection:
    """Adapter detection in other processes, which start at once and end in `collect`.

    A context manager, which ends the processes in any case.
    """

    def __init__(
        self,
        interfaces: Iterable[str],
        *,
        command: Sequence[str] = _COMMAND,
        limit_s: float = LIMIT_S,
    ) -> None:
        self._command = command
        names = list(interfaces)
        self._asks_kernel = SOCKETCAN in names
        others = BUILT_IN | SERIAL_PORTS | {SOCKETCAN}
        self._names = [name for name in names if name not in others]
        self._ends_at = time.perf_counter() + limit_s
        self._cancelled: Callable[[], bool] = lambda: False
        self._processes = [self._start(self._names)] if self._names else []

    def __enter__(self) -> Detection:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def collect(self, cancelled: Callable[[], bool] = lambda: False) -> DetectionResult:
        """Wait for the result; `cancelled` is called five times a second and ends the wait."""
        self._cancelled = cancelled
        detected = DetectionResult()
        if self._asks_kernel:
            detected.found += network_adapters()
        unanswered = set(self._names)
        crashed = self._gather(detected, unanswered)
        if crashed and unanswered and not self._cancelled():
            # A crash ended the others too: run each one alone in the remaining time.
            self._processes = [self._start([name]) for name in sorted(unanswered)]
            self._gather(detected, unanswered)
        detected.hung = sorted(unanswered - set(detected.failed))
        detected.found.sort(key=lambda found: (found.interface, found.channel))
        return detected

    def _start(self, names: Sequence[str]) -> tuple[list[str], subprocess.Popen[str]]:
        return list(names), subprocess.Popen(  # noqa: S603  our own interpreter
            [*self._command, *names],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C is for this process, which ends them
        )

    def _gather(self, detected: DetectionResult, unanswered: set[str]) -> bool:
        """Collect the answers of all processes; True if one ended without an answer."""
        crashed = False
        for names, process in self._processes:
            output, is_over = self._wait_for(process)
            _take(output, detected, unanswered)
            if not is_over:
                continue
            missing = unanswered & set(names)
            crashed = crashed or bool(missing)
            if len(names) == 1 and missing:
                detected.failed[names[0]] = f"its library ended the process ({process.returncode})"
        return crashed

    def _wait_for(self, process: subprocess.Popen[str]) -> tuple[str, bool]:
        """Return the output of a process, and whether it ended by itself and not by the limit."""
        while True:
            remaining_s = max(self._ends_at - time.perf_counter(), 0.01)
            try:
                return process.communicate(timeout=min(remaining_s, _SLICE_S))[0], True
            except subprocess.TimeoutExpired:
                if time.perf_counter() < self._ends_at and not self._cancelled():
                    continue
            process.kill()
            return process.communicate()[0], False

    def _end(self) -> None:
        for _, process in self._processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
            elif process.stdout is not None:
                process.stdout.close()


def _take(output: str, detected: DetectionResult, unanswered: set[str]) -> None:
    for line in output.splitlines():
        if not line.startswith(_MARK):
            continue
        with contextlib.suppress(ValueError, LookupError, TypeError):
            answer = json.loads(line.removeprefix(_MARK))
            name = str(answer["interface"])
            if answer["error"]:
                detected.failed[name] = str(answer["error"])
            if answer["sees"] == _NOT_LOADED:
                detected.not_loaded.append(name)
            elif answer["sees"] == _CANNOT_TELL:
                detected.cannot_tell.append(name)
            for channel in answer["channels"]:
                detected.found.append(
                    DetectedAdapter(name, str(channel.pop("channel", "")), channel)
                )
            unanswered.discard(name)


# -- without another process -----------------------------------------------------------------------


def plugged_in(interface: str) -> list[DetectedAdapter]:
    """List the adapters of the kernel, or the serial ports; none of other back ends."""
    if interface == SOCKETCAN:
        return list(network_adapters())
    return list(serial_ports(interface)) if interface in SERIAL_PORTS else []


def network_adapters(sysfs: Path = SYSFS) -> Iterator[DetectedAdapter]:
    """Yield the SocketCAN interfaces of Linux, up or down, with serial number and USB path."""
    for folder in sorted(sysfs.glob("*")):
        if not getattr(look_up(folder.name, sysfs=sysfs), "is_can", False):
            continue
        device = (folder / "device").resolve()
        # The link leads to the USB interface; its parent is the device.
        serial = _text(device.parent / "serial") or _text(device / "serial")
        is_usb = (device.parent / "serial").exists() or (
            ":" in device.name and (device.parent / "idVendor").exists()
        )
        usb_path = device.name.partition(":")[0] if is_usb else ""
        # Drivers number the channels of an adapter in one of the two, from 0.
        index = max(int(_text(folder / name) or "0", 0) for name in ("dev_port", "dev_id"))
        details = _without_empty(
            serial_number=serial, usb_path=usb_path, channel_index=str(index or "")
        )
        yield DetectedAdapter(SOCKETCAN, folder.name, details)


def serial_ports(interface: str) -> Iterator[DetectedAdapter]:
    """Yield the USB serial ports, each as a possible adapter of one of `SERIAL_PORTS`. Built-in
    ports (ttyS0, COM1) are skipped.

    Raises ImportError if pyserial is missing.
    """
    ports: Any = importlib.import_module("serial.tools.list_ports")
    for port in ports.comports():
        if port.vid is None:
            continue
        description = "" if port.description in (None, "n/a", port.device) else port.description
        details = _without_empty(
            description=description, serial_number=port.serial_number, usb_path=port.location
        )
        yield DetectedAdapter(interface, port.device, details)


def _without_empty(**details: str | None) -> dict[str, str]:
    return {key: value for key, value in details.items() if value}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""


# -- the other process -----------------------------------------------------------------------------


def print_detected(names: Sequence[str]) -> None:
    """Detect the adapters of these interfaces and print one answer line for each."""
    threads = [threading.Thread(target=_ask, args=(name,), daemon=True) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _ask(name: str) -> None:
    answer: dict[str, Any] = {"interface": name, "channels": [], "sees": "", "error": ""}
    try:
        from flasher.python_can import can  # noqa: PLC0415  needed in the other process only

        answer["sees"] = _sees(name)
        answer["channels"] = [_simple(config) for config in can.detect_available_configs(name)]
    except BaseException as error:  # noqa: BLE001  whatever a vendor's library does
        answer["error"] = f"{type(error).__name__}: {error}"
    sys.stdout.write(f"{_MARK}{json.dumps(answer)}\n")
    sys.stdout.flush()


def _sees(name: str) -> str:
    """Reason why a back end cannot list adapters; empty if it can."""
    from flasher.python_can import can  # noqa: PLC0415

    place, kind = can.interfaces.BACKENDS[name]
    try:
        back_end = getattr(importlib.import_module(place), kind)
    except Exception:  # noqa: BLE001  whatever a vendor's library does
        return _NOT_LOADED
    own = back_end._detect_available_configs  # noqa: SLF001  python-can asks it so
    return _CANNOT_TELL if own is can.BusABC._detect_available_configs else ""  # noqa: SLF001


def _simple(config: Mapping[str, Any]) -> dict[str, Any]:
    """Keep values that JSON can represent; some configurations contain objects of a library."""
    return {
        key: value
        for key, value in config.items()
        if isinstance(value, str | int | float) and key != "interface"
    }


if __name__ == "__main__":
    watchdog = threading.Timer(_LIFE_S, os._exit, (1,))
    watchdog.daemon = True
    watchdog.start()
    print_detected(sys.argv[1:])
