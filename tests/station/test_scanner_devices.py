"""Scanners as real input devices of the kernel, made by uinput (as root, with the extra `scanner`,
and the modules uinput and evdev). They keep the pace of a USB device: a report a millisecond.
"""

from __future__ import annotations

import importlib.util
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from flasher.station.config import ScannerConfig
from flasher.station.events import ScannerChanged, StationEvent
from flasher.station.scanners import Scanner
from tests.station.scanner_keys import KEYS

pytestmark = [
    pytest.mark.kernel,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        not os.access("/dev/uinput", os.W_OK) or importlib.util.find_spec("evdev") is None,
        reason="needs /dev/uinput and evdev",
    ),
]
REPORT_S = 0.001
LIMIT_S = 240.0
SCANS = 250


class Plugged:
    """A scanner on the USB."""

    def __init__(self, name: str) -> None:
        evdev = importlib.import_module("evdev")
        codes = sorted({code for code, _ in KEYS.values()} | {28, 42})
        self._device: Any = evdev.UInput({evdev.ecodes.EV_KEY: codes}, name=name)
        self.path = str(self._device.device.path)

    def _key(self, code: int, value: int) -> None:
        self._device.write(1, code, value)
        self._device.syn()
        time.sleep(REPORT_S)

    def scan(self, text: str) -> None:
        for char in text:
            code, has_shift = KEYS[char]
            for key, value in ((42, 1), (code, 1), (code, 0), (42, 0)):
                if has_shift or key != 42:
                    self._key(key, value)
        self._key(28, 1)
        self._key(28, 0)

    def unplug(self) -> None:
        self._device.close()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


class Reading:
    """A scanner's thread, and what it reported."""

    def __init__(self, stack: ExitStack, path: str, socket: str) -> None:
        self.scans: list[tuple[str, str]] = []
        self.reported: list[StationEvent] = []
        self._came = threading.Condition()
        config = ScannerConfig(name=socket, input=path, socket=socket)
        scanner = Scanner(config, lambda *scan: self._add(self.scans, scan), self._hear)
        stack.enter_context(scanner)

    def _add(self, to: list[Any], what: Any) -> None:
        with self._came:
            to.append(what)
            self._came.notify_all()

    def _hear(self, event: StationEvent) -> None:
        self._add(self.reported, event)

    def wait(self, *, reported: int = 0, scans: int = 0) -> None:
        with self._came:
            is_there = self._came.wait_for(
                lambda: len(self.reported) >= reported and len(self.scans) >= scans, LIMIT_S
            )
        assert is_there, (len(self.scans), self.reported[-3:])


def test_500_scans_of_two_scanners_at_full_speed(stack: ExitStack) -> None:
    plugged = {name: Plugged(f"scanner {name}") for name in "AB"}
    reading = {name: Reading(stack, each.path, name) for name, each in plugged.items()}
    wanted = {
        name: [f"BAT-{name}{at:04}_{'x' * (at % 20)}" for at in range(SCANS)] for name in "AB"
    }
    threads = []
    for name, each in plugged.items():
        reading[name].wait(reported=1)
        texts = wanted[name]
        threads.append(threading.Thread(target=lambda p=each, t=texts: [p.scan(x) for x in t]))
    begun = time.perf_counter()
    for thread in threads:
        thread.start()
    for name in plugged:
        reading[name].wait(scans=SCANS)
    for thread in threads:
        thread.join()
    print(f"{2 * SCANS} scans in {time.perf_counter() - begun:.1f} s")  # noqa: T201
    for name, each in plugged.items():
        assert reading[name].scans == [(text, name) for text in wanted[name]]
        assert reading[name].reported == [ScannerChanged(name, is_ready=True)]
        each.unplug()


def test_no_one_else_gets_its_keys(stack: ExitStack) -> None:
    plugged = Plugged("scanner")
    other = importlib.import_module("evdev").InputDevice(plugged.path)
    reading = Reading(stack, plugged.path, "A")
    reading.wait(reported=1)
    plugged.scan("BAT2620-0001")
    reading.wait(scans=1)
    assert other.read_one() is None
    with pytest.raises(OSError, match="busy"):
        other.grab()
    other.close()
    plugged.unplug()


def test_it_is_unplugged_in_a_scan_and_comes_back(stack: ExitStack) -> None:
    plugged = Plugged("scanner")
    reading = Reading(stack, plugged.path, "A")
    reading.wait(reported=1)
    plugged.scan("BAT2620-0001")
    plugged._key(KEYS["B"][0], 1)
    plugged.unplug()
    reading.wait(reported=3, scans=1)
    again = Plugged("scanner")
    assert again.path == plugged.path
    reading.wait(reported=4)
    again.scan("BAT2620-0002")
    reading.wait(scans=2)
    assert reading.scans == [("BAT2620-0001", "A"), ("BAT2620-0002", "A")]
    states = [event.is_ready for event in reading.reported if isinstance(event, ScannerChanged)]
    assert (states[0], states[-1], set(states[1:-1])) == (True, True, {False})
    again.unplug()
