"""flasher on SJA1000 controllers of a PCI card: a driver that restarts after bus-off, and counts
errors.

Those that QEMU emulates take no time for a frame, acknowledge every frame, and never go bus-off.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from tests.end_to_end.forks import Device, Forked
from tests.end_to_end.kernel import (
    GUEST_TIMEOUT,
    Pair,
    needs_sja1000,
    on,
    root,
    sja1000_pair,
    start,
)
from tests.firmware import VECTORS

pytestmark = [pytest.mark.kernel, GUEST_TIMEOUT, needs_sja1000]
IMAGE = VECTORS + random.Random(30).randbytes(9_984)
FLASH = ("flash", "image.bin", "-t", "bms", "--frame-gap", "0.002")
"""Without a gap the receiver is overrun by frames that take no time."""


@pytest.fixture
def bus(tmp_path: Path) -> Pair:
    (tmp_path / "image.bin").write_bytes(IMAGE)
    pair = sja1000_pair()
    start(pair.tool, "restart-ms 100")
    start(pair.device, "restart-ms 100")
    return pair


@pytest.fixture
def device(bus: Pair, tmp_path: Path) -> Iterator[Device]:
    impatient = ("--set", "pause_in_transfer=announces", "--set", "transfer_timeout_s=2")
    with Device(*on(bus.device), *impatient, folder=tmp_path) as serving:
        yield serving


@pytest.mark.usefixtures("device")
def test_a_flash_at_once_after_the_interface_was_started(bus: Pair, tmp_path: Path) -> None:
    """The kernel still reports NO-CARRIER then."""
    start(bus.tool, "restart-ms 100")
    done = bus.flasher(*FLASH, folder=tmp_path)
    assert done.end() == ExitCode.OK, done.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE


@pytest.mark.usefixtures("device")
def test_doctor_has_nothing_to_report_of_an_interface_that_restarts(
    bus: Pair, tmp_path: Path
) -> None:
    done = bus.flasher("doctor", folder=tmp_path)
    assert done.end() == ExitCode.OK, done.reported
    assert "after a bus-off" not in done.stdout
    assert "error counters: transmit 0, receive 0" in done.stdout


@pytest.mark.usefixtures("device")
def test_an_interface_that_is_taken_down_and_up_in_a_transfer_goes_on(
    bus: Pair, tmp_path: Path
) -> None:
    """BU-05."""
    with Forked(*FLASH, *on(bus.tool), folder=tmp_path) as host:
        host.until("transferring ...")
        root(f"ip link set {bus.tool} down && sleep 1 && ip link set {bus.tool} up")
        assert host.end() == ExitCode.OK, host.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE
    assert "error: can." not in host.stderr


@pytest.mark.usefixtures("device")
def test_an_interface_that_only_listens_is_refused(bus: Pair, tmp_path: Path) -> None:
    start(bus.tool, "listen-only on")
    done = bus.flasher(*FLASH, folder=tmp_path)
    assert done.end() == ExitCode.BUS, done.reported
    assert "only listens" in done.stderr
    assert bus.flasher("monitor", "--duration", "0.5", folder=tmp_path).end() == ExitCode.OK
