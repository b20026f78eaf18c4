"""Reads scanners directly, whatever window has the focus: Linux input devices and serial ports.

A thread reads each scanner, and opens it again after it was unplugged.
"""

from __future__ import annotations

import importlib
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, Protocol

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.config import ScannerConfig
from flasher.station.events import ScannerChanged, ScanRefused, StationEvent
from flasher.station.keys import KeyDecoder, ScanBuilder
from flasher.station.socket import SCANNER, Source

REOPEN_S: Final = 1.0
READ_S: Final = 0.2
_SYS_INPUT: Final = Path("/sys/class/input")
_DEV_INPUT: Final = Path("/dev/input")
_TYPES_TEXT: Final = 1 << 28 | 1 << 2
"""Bits of the keys that a device with text input has: Enter and 1."""
_ENDS: Final = b"\r\n\t"


class NoScanner(Exception):  # noqa: N818  it may be plugged in later
    """A scanner cannot be opened or read. The message is one sentence with the reason."""


class Reads(Protocol):
    """An open scanner. Methods raise OSError if it was unplugged."""

    def read(self, limit_s: float) -> None:
        """Read scanned characters; wait for them up to `limit_s`."""

    def close(self) -> None: ...


Open = Callable[[ScanBuilder], Reads]
"""Opens a scanner. Raises NoScanner, OSError."""


class Scanner:
    """A configured scanner, plugged in or not. A thread reads it while the block runs."""

    def __init__(
        self,
        config: ScannerConfig,
        submit: Callable[[str, Source], None],
        publish: Callable[[StationEvent], None],
        open_scanner: Open | None = None,
    ) -> None:
        """`submit` is called with each scan and the scanner as its source."""
        self.config = config
        self._source = Source(SCANNER + printable(config.name), config.socket)
        self._publish = publish
        self._builder = ScanBuilder(lambda text: submit(text, self._source), self._damaged)
        self._open = open_scanner or _opener(config)
        self._device: Reads | None = None
        self._why: str | None = None
        """Reason of the last failure; None before the first one."""
        self._ended = threading.Event()
        self._thread = threading.Thread(
            target=self._work, name=f"scanner {config.name}", daemon=True
        )

    def __enter__(self) -> Scanner:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join(2 * READ_S)

    def _work(self) -> None:
        while not self._ended.is_set():
            if not self.step(READ_S):
                self._ended.wait(REOPEN_S)
        self.close()

    def step(self, limit_s: float) -> bool:
        """Open or read the scanner. Returns False while it cannot be read."""
        try:
            if self._device is None:
                self._device = self._open(self._builder)
                self._why = ""
                self._publish(ScannerChanged(self.config.name, is_ready=True))
            else:
                self._device.read(limit_s)
        except NoScanner as error:
            self._gone(error.args[0])
        except OSError as error:
            self._gone(printable(error.strerror or str(error)))
        except Exception as error:  # noqa: BLE001  by a library (termios.error): reopened
            self._gone(printable(str(error) or type(error).__name__))
        return self._device is not None

    def close(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None

    def _gone(self, why: str) -> None:
        """Report once per reason that the scanner cannot be read."""
        self._builder.drop()
        was_open = self._device is not None
        try:
            self.close()
        except OSError:
            self._device = None
        if was_open or why != self._why:
            self._why = why
            self._publish(ScannerChanged(self.config.name, is_ready=False, reason=why))

    def _damaged(self) -> None:
        self._publish(
            ScanRefused(
                "",
                "DAMAGED",
                text("A part of a scan of {scanner} is lost.", scanner=printable(self.config.name)),
                text("Scan it again."),
                self.config.socket,
                self._source.name,
            )
        )


# -- input devices --------------------------------------------------------------------------------


class InputScanner:
    """A scanner that acts as a keyboard; `device` is an evdev device."""

    def __init__(self, device: Any, builder: ScanBuilder) -> None:
        self._device = device
        self._decoder = KeyDecoder(builder, device.active_keys)
        device.grab()  # no console or window gets its keys

    def read(self, limit_s: float) -> None:
        if not select.select([self._device.fd], [], [], limit_s)[0]:
            return
        for event in self._device.read():
            self._decoder.feed(event.type, event.code, event.value, event.timestamp())

    def close(self) -> None:
        self._device.close()


def input_device(config: ScannerConfig, sys_input: Path = _SYS_INPUT) -> Path:
    """Find the input device of a scanner by its path or USB path. Raises NoScanner."""
    if config.input:
        return Path(config.input)
    for entry in sorted(sys_input.glob("event*"), key=lambda each: int(each.name[5:])):
        if config.usb_path in entry.resolve().parts and _types_text(entry):
            return _DEV_INPUT / entry.name
    raise NoScanner(text("No scanner is plugged in at {place}.", place=config.usb_path))


def _types_text(entry: Path) -> bool:
    try:
        words = (entry / "device" / "capabilities" / "key").read_text("ascii").split()
    except (OSError, ValueError):
        return False
    return bool(words) and int(words[-1], 16) & _TYPES_TEXT == _TYPES_TEXT


# -- serial ports ---------------------------------------------------------------------------------


class SerialScanner:
    """A scanner on a serial port; `port` is a pyserial port."""

    def __init__(self, port: Any, builder: ScanBuilder) -> None:
        self._port = port
        self._builder = builder

    def read(self, limit_s: float) -> None:
        self._port.timeout = limit_s
        data = self._port.read(1)
        data += self._port.read(self._port.in_waiting) if data else b""
        now = time.perf_counter()
        for byte in data:
            if byte in _ENDS:
                self._builder.end(now)
            else:
                self._builder.put(chr(byte), now)

    def close(self) -> None:
        self._port.close()


def _opener(config: ScannerConfig) -> Open:
    if config.port:
        serial = importlib.import_module("serial")

        def open_port(builder: ScanBuilder) -> Reads:
            port = serial.Serial(config.port, config.baudrate, timeout=READ_S, exclusive=True)
            return SerialScanner(port, builder)

        return open_port
    evdev = importlib.import_module("evdev")

    def open_input(builder: ScanBuilder) -> Reads:
        device = evdev.InputDevice(str(input_device(config)))
        try:
            return InputScanner(device, builder)
        except OSError:
            device.close()
            raise

    return open_input
