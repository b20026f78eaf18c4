"""Adapters with drivers of the kernel in the guest of `tests/socketcan_vm.sh`, and root's commands.

`FLASHER_CANDLELIGHT` is the control file of the program that emulates two candleLight adapters on
one bus, `FLASHER_SJA1000` the names of two SJA1000 controllers on another one. Neither is ever
looked for: what a computer has plugged in is no affair of tests.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final

import pytest

from tests.end_to_end.forks import Forked, run

_CONTROL: Final = os.environ.get("FLASHER_CANDLELIGHT", "")
_SJA1000: Final = os.environ.get("FLASHER_SJA1000", "").split(",")
_NETWORK: Final = Path("/sys/class/net")
_APPEARS_WITHIN_S: Final = 20.0
GUEST_TIMEOUT: Final = pytest.mark.timeout(3600)
"""Where time counts instructions, it runs ahead while something is read from disk."""
needs_candlelight = pytest.mark.skipif(not _CONTROL, reason="there are no simulated candleLights")
needs_sja1000 = pytest.mark.skipif(len(_SJA1000) != 2, reason="there are no SJA1000 controllers")


def figure(text: str) -> None:
    """Something measured; `pytest -rP` shows it."""
    sys.stdout.write(f"{text}\n")


def on(channel: str) -> tuple[str, ...]:
    return ("-i", "socketcan", "-c", channel)


def wait_until(is_so: Callable[[], bool], what: str, *, limit_s: float = _APPEARS_WITHIN_S) -> None:
    """Wait for the kernel, or for a program. Fails after `limit_s`."""
    until = time.perf_counter() + limit_s
    while not is_so():
        assert time.perf_counter() < until, f"{what} never came"
        time.sleep(0.01)


def shell(command: str) -> subprocess.CompletedProcess[str]:
    """What a person types as root."""
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)


def root(command: str) -> str:
    """A command of root that has to succeed; returns what it printed."""
    done = shell(command)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def start(channel: str, *options: str, bitrate_bps: int = 250_000) -> None:
    """Start an interface anew, with these options of its controller alone."""
    modes = ("listen-only off", "loopback off", "one-shot off", "restart-ms 0")
    root(f"ip link set {channel} down")
    root(f"ip link set {channel} type can bitrate {bitrate_bps} {' '.join((*modes, *options))}")
    root(f"ip link set {channel} up")


def state_of(channel: str) -> str:
    """The kernel's word for the state of a controller."""
    link = json.loads(root(f"ip -details -json link show {channel}"))[0]
    return str(link["linkinfo"]["info_data"]["state"])


@contextmanager
def background(command: str, *, output: IO[str] | int = subprocess.DEVNULL) -> Iterator[None]:
    """A program that runs meanwhile."""
    with subprocess.Popen(shlex.split(command), stdout=output, stderr=output) as process:
        try:
            yield
        finally:
            process.kill()


class Pair:
    """Two adapters on one bus: one for the tool, one for the device."""

    def __init__(self, tool: str, device: str) -> None:
        self.tool = tool
        self.device = device

    def flasher(self, command: str, *arguments: str, folder: Path) -> Forked:
        """Run a command on the tool's adapter to its end."""
        return run(command, *arguments, *on(self.tool), folder=folder)


class Candlelights(Pair):
    """Two adapters of which each can be unplugged, and a bus with trouble."""

    def __init__(self) -> None:
        super().__init__("", "")
        self.short(0)
        self.order("lose 0")
        for number in (0, 1):
            self.plug(number)

    def order(self, words: str) -> None:
        """A line for the program that emulates the adapters."""
        Path(_CONTROL).write_text(f"{words}\n", encoding="ascii")
        time.sleep(0.02)  # it reads one line at a time

    def unplug(self, number: int) -> None:
        """Take an adapter away: 0 is the tool's, 1 the device's."""
        self.order(f"unplug {number}")
        wait_until(lambda: number not in _candlelights(), "the end of an adapter")

    def plug(self, number: int) -> None:
        """Put it back; it is not started."""
        self.order(f"plug {number}")
        wait_until(lambda: number in _candlelights(), "an adapter")
        found = _candlelights()
        self.tool, self.device = found.get(0, self.tool), found.get(1, self.device)

    def plug_in_again(self, *numbers: int) -> None:
        """Unplug both, and put these back: the first one gets the first name."""
        for number in (0, 1):
            self.unplug(number)
        for number in numbers:
            self.plug(number)

    def short(self, milliseconds: int) -> None:
        """Every frame fails for so long."""
        self.order(f"short {milliseconds}")

    def leave_bus(self) -> None:
        """Let the tool's adapter send until it is bus-off."""
        self.short(60_000)
        root(f"cansend {self.tool} 7FF#00")
        wait_until(lambda: state_of(self.tool) == "BUS-OFF", "bus-off")
        self.short(0)


def _candlelights() -> dict[int, str]:
    """Their interfaces, by the last digit of their serial numbers."""
    found = {}
    for folder in _NETWORK.iterdir():
        serial = folder / "device" / ".." / "serial"
        if (folder / "device" / "driver").resolve().name == "gs_usb" and serial.exists():
            found[int(serial.read_text().strip()[-1])] = folder.name
    return found


def sja1000_pair() -> Pair:
    """Two controllers whose frames take no time."""
    return Pair(*_SJA1000)
