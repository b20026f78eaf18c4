"""A service visit from beginning to end: every command is typed as a user does, against one battery
that lives through all of them.
"""

from __future__ import annotations

import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from intelhex import IntelHex

from flasher import api
from flasher.driver import drive
from flasher.errors import ExitCode
from flasher.mock.model import MockDevice
from flasher.protocol.spec import BMS, WELLING
from tests.cli import conftest
from tests.cli.conftest import SAMPLES, Flasher, Run
from tests.firmware import VECTORS

pytestmark = pytest.mark.slow

flasher = conftest.flasher
"""The fixture, for the tests here too."""

FACTORY_VERSION = "V1r0r0_20220512"
NEW_VERSION = "V1r0r4_20220512"
"""Written inside of firmware_samples/bms.hex."""
PART_BYTES = 12_345
"""Of it, with the version: several pages and a part of a packet."""


class ServedBattery:
    """The device model on python-can's `virtual` bus, in a thread of its own."""

    def __init__(self) -> None:
        self.device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps)
        self.bus = ("-i", "virtual", "-c", f"cycle-{uuid.uuid4()}")
        self.failure: BaseException | None = None
        self._is_listening = threading.Event()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> ServedBattery:
        self._thread.start()
        assert self._is_listening.wait(5.0)
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join(5.0)
        assert not self._thread.is_alive()
        assert self.failure is None

    def _serve(self) -> None:
        try:
            with api.connect(WELLING, interface="virtual", channel=self.bus[-1]) as connection:
                self._is_listening.set()
                drive(
                    self.device,
                    connection.link,
                    connection.clock,
                    cancelled=self._is_over.is_set,
                )
        except BaseException as failure:  # noqa: BLE001  reported by the test, not the thread
            self.failure = failure


@pytest.fixture
def battery(flasher: Flasher) -> Iterator[ServedBattery]:  # noqa: ARG001  for what it patches
    """After `flasher`, which takes the machine's configuration of python-can away."""
    with ServedBattery() as served:
        yield served


def items_of(run: Run) -> dict[str, Any]:
    """What `info --json` knows, by the name of the item."""
    assert run.code == 0, run.err
    items = run.document["items"]
    assert isinstance(items, dict)
    return items


def test_a_battery_keeps_its_identity_over_an_upgrade_that_was_verified_to_the_last_byte(
    flasher: Flasher, battery: ServedBattery, tmp_path: Path
) -> None:
    whole, image = IntelHex(str(SAMPLES / "bms.hex")), tmp_path / "bms.hex"
    part = whole[whole.minaddr() : whole.minaddr() + PART_BYTES]
    part.write_hex_file(str(image))
    at = ("-t", "bms", *battery.bus)
    before = items_of(flasher("info", *at, "--json"))
    assert before["version-information"]["firmware_version"] == FACTORY_VERSION
    assert before["version-information"]["serial_number"] != "W2699123"
    assert before["production-information"]["place"] != "SUZHOU"

    factory = ("--manufacturer", "--yes")
    serial = flasher("write", "serial-number", "W2699123", *at, *factory)
    assert serial.code == 0, serial.err
    assert "read back right" in serial.out
    produced = flasher(
        "write", "production-information", "ACME", "SUZHOU", "20260517", *at, *factory
    )
    assert produced.code == 0, produced.err
    assert "read back right" in produced.out

    flashed = flasher("flash", image, *at, "--verify", "memory", "--json")
    assert flashed.code == 0, flashed.err
    assert flashed.document["verification"]["level"] == "memory"
    assert flashed.document["verification"]["running_version"] == NEW_VERSION
    assert flashed.document["verification"]["verdict"] == "memory_right"

    after = items_of(flasher("info", *at, "--json"))
    identity = after["version-information"]
    assert identity["firmware_version"] == NEW_VERSION
    assert identity["serial_number"] == "W2699123"
    assert identity["model"] == before["version-information"]["model"]
    assert after["production-information"]["manufacturer"] == "ACME"
    assert after["production-information"]["place"] == "SUZHOU"
    assert after["production-information"]["date"] == "20260517"

    assert battery.device.stored_image == part.tobinstr()
    assert len(part) == PART_BYTES


def test_an_image_that_was_linked_for_another_address_is_found_by_reading_it_back(
    flasher: Flasher, battery: ServedBattery, tmp_path: Path
) -> None:
    """The update command names no address: the battery stores and confirms it all the same."""
    image = tmp_path / "image.bin"
    image.write_bytes(VECTORS + bytes(range(1, 185)))
    run = flasher(
        "flash", image, "--base", "0x08009000", "--allow-outside-vector", "-t", "bms",
        *battery.bus, "--verify", "memory", "--json",
    )  # fmt: skip
    assert run.code == ExitCode.VERIFICATION
    assert run.document["outcome"]["ending"] == "completed"
    assert run.document["verification"]["verdict"] == "memory_other"
    assert "0x08009000" in run.err
    assert battery.device.stored_image == image.read_bytes()
