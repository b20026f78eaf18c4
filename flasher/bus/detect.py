"""Which adapters there are: what python-can's back ends detect, the kernel's CAN interfaces, and
serial ports behind which one may be.

Vendors' libraries hang, print and crash: they do it in another process, `python -m
flasher.bus.detect NAME...`, which is ended in time. It asks every back end in a thread of its own,
and says each answer at once.
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

from flasher.bus.inspect_interface import SYSFS, look_up

LIMIT_S: Final = 4.5
"""For everything together. The slowest honest back end (socketcand) listens for 4 s."""
_NOT_LOADED: Final = "not_loaded"
_CANNOT_TELL: Final = "cannot_tell"
_MARK: Final = "detected: "
"""Begins the lines that are answers: vendors' libraries print too."""
_LIFE_S: Final = 30.0
"""A process whose parent was killed ends itself after this."""
_SLICE_S: Final = 0.2
"""Between two looks whether the user wants to stop."""
_COMMAND: Final = (sys.executable, "-m", "flasher.bus.detect")
BUILT_IN: Final = frozenset({"virtual", "udp_multicast"})
"""Interfaces that are always there and reach no adapter."""
SOCKETCAN: Final = "socketcan"
SLOW: Final = frozenset({"socketcand"})
"""Back ends that wait for servers on the network."""
SERIAL_PORTS: Final = frozenset({"slcan", "robotell", "seeedstudio", "serial"})
"""Back ends that open a serial port. What is behind a port, only opening it would tell."""
_SERIAL_KEYS: Final = ("serial_number", "serial", "unique_hardware_id", "hw_serial", "hwid")
"""Where back ends put an adapter's serial number."""
_USB_PATH: Final = "usb_path"
_CHOOSING: Final[Mapping[str, tuple[str, ...]]] = {
    "ixxat": ("unique_hardware_id",),
    "neovi": ("serial",),
    "socketcand": ("host", "port"),
    "systec": ("device_number",),
    "vector": ("channel_index",),
}
"""What a back end needs besides the channel to open this adapter and no other."""


@dataclass(frozen=True)
class Found:
    """An adapter that is plugged in, and what its back end tells about it."""

    interface: str
    channel: str
    """Empty where the back end does not tell."""
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def serial_number(self) -> str:
        """Empty when not told."""
        return next((str(self.details[key]) for key in _SERIAL_KEYS if self.details.get(key)), "")

    @property
    def usb_path(self) -> str:
        """Its place on the USB, as "1-1.4"; empty when not told."""
        return str(self.details.get(_USB_PATH, ""))

    @property
    def bus_kwargs(self) -> dict[str, Any]:
        """The keywords besides interface and channel that choose it."""
        names = _CHOOSING.get(self.interface, ())
        return {name: self.details[name] for name in names if name in self.details}

    @property
    def words(self) -> list[str]:
        """The words that choose it on the command line."""
        words = ["-i", self.interface, "-c", self.channel or "CHANNEL"]
        for key, value in self.bus_kwargs.items():
            words += ["--bus-kwargs", f"{key}={value}"]
        return words

    @property
    def arguments(self) -> str:
        """The same as a shell takes it."""
        return shlex.join(self.words)


@dataclass
class Detected:
    """What was found, and the back ends of which nothing is known."""

    found: list[Found] = field(default_factory=list)
    hung: list[str] = field(default_factory=list)
    """They did not answer in time."""
    failed: dict[str, str] = field(default_factory=dict)
    """They failed or crashed, with what they said."""
    not_loaded: list[str] = field(default_factory=list)
    """Their package is missing, or they are for another operating system."""
    cannot_tell: list[str] = field(default_factory=list)
    """They have no way to list their adapters."""


class Detection:
    """Begins to look at once, in other processes, so that something else can be done meanwhile.

    `collect` ends them. Use it as a context manager: whatever happens, no process is left.
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

    def collect(self, cancelled: Callable[[], bool] = lambda: False) -> Detected:
        """What was found. Waits for the rest of the time at the most, or until `cancelled` says so;
        it is asked five times a second.
        """
        self._cancelled = cancelled
        detected = Detected()
        if self._asks_kernel:
            detected.found += network_adapters()
        unanswered = set(self._names)
        crashed = self._gather(detected, unanswered)
        if crashed and unanswered and not self._cancelled():
            # One of them took the others with it: each on its own, in the time that is left.
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
            start_new_session=True,  # Ctrl-C is for us: we end them
        )

    def _gather(self, detected: Detected, unanswered: set[str]) -> bool:
        """Take the answers of all processes; True when one ended without having answered."""
        crashed = False
        for names, process in self._processes:
            said, is_over = self._wait_for(process)
            _take(said, detected, unanswered)
            if not is_over:
                continue
            missing = unanswered & set(names)
            crashed = crashed or bool(missing)
            if len(names) == 1 and missing:
                detected.failed[names[0]] = f"its library ended the process ({process.returncode})"
        return crashed

    def _wait_for(self, process: subprocess.Popen[str]) -> tuple[str, bool]:
        """What a process said, and whether it ended by itself; else it is ended."""
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


def _take(said: str, detected: Detected, unanswered: set[str]) -> None:
    for line in said.splitlines():
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
                detected.found.append(Found(name, str(channel.pop("channel", "")), channel))
            unanswered.discard(name)


# -- without another process -----------------------------------------------------------------------


def network_adapters(sysfs: Path = SYSFS) -> Iterator[Found]:
    """CAN interfaces of Linux, up or down, with what their USB device says."""
    for folder in sorted(sysfs.glob("*")):
        if not getattr(look_up(folder.name, sysfs=sysfs), "is_can", False):
            continue
        device = (folder / "device").resolve()
        # The link leads to the USB interface; the device is above it.
        serial = _text(device.parent / "serial") or _text(device / "serial")
        is_usb = (device.parent / "serial").exists() or (
            ":" in device.name and (device.parent / "idVendor").exists()
        )
        usb_path = device.name.partition(":")[0] if is_usb else ""
        yield Found(SOCKETCAN, folder.name, _told(serial_number=serial, usb_path=usb_path))


def serial_ports(interface: str) -> Iterator[Found]:
    """Serial ports on the USB, each as an adapter of one of `SERIAL_PORTS`, which it may or may
    not be. Others hardly have one behind them: computers have ports of their own (ttyS0, COM1).

    Raises ImportError where pyserial is missing.
    """
    ports: Any = importlib.import_module("serial.tools.list_ports")
    for port in ports.comports():
        if port.vid is None:
            continue
        description = "" if port.description in (None, "n/a", port.device) else port.description
        details = _told(
            description=description, serial_number=port.serial_number, usb_path=port.location
        )
        yield Found(interface, port.device, details)


def _told(**details: str | None) -> dict[str, str]:
    return {key: value for key, value in details.items() if value}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""


# -- the other process -----------------------------------------------------------------------------


def say_detected(names: Sequence[str]) -> None:
    """Ask these interfaces and say what they answer, a line each."""
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
    """Why a back end can list nothing; empty where it can."""
    from flasher.python_can import can  # noqa: PLC0415

    place, kind = can.interfaces.BACKENDS[name]
    try:
        back_end = getattr(importlib.import_module(place), kind)
    except Exception:  # noqa: BLE001  whatever a vendor's library does
        return _NOT_LOADED
    own = back_end._detect_available_configs  # noqa: SLF001  python-can asks it so
    return _CANNOT_TELL if own is can.BusABC._detect_available_configs else ""  # noqa: SLF001


def _simple(config: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON holds of a configuration: some have objects of their library in it."""
    return {
        key: value
        for key, value in config.items()
        if isinstance(value, str | int | float) and key != "interface"
    }


if __name__ == "__main__":
    watchdog = threading.Timer(_LIFE_S, os._exit, (1,))
    watchdog.daemon = True
    watchdog.start()
    say_detected(sys.argv[1:])
