"""Host and device model as two processes on one bus: UDP multicast that stays on this machine."""

from __future__ import annotations

import random
import socket
import subprocess
from contextlib import closing
from pathlib import Path

import can
import pytest

from tests.end_to_end.processes import MockProcess, transfer
from tests.firmware import VECTORS
from tests.loops import sample

pytestmark = pytest.mark.slow

GROUP = "239.74.163.2"


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    assert isinstance(port, int)
    return port


@pytest.fixture(scope="module")
def bus() -> tuple[str, ...]:
    """Arguments of a bus that other processes hear."""
    port = free_port()
    try:
        probe = can.Bus(
            interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, ignore_config=True
        )
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast bus here: {error}")
    with probe:
        try:
            probe.send(can.Message(arbitration_id=1, is_extended_id=False))
            heard = probe.recv(1.0)
        except (can.CanError, OSError) as error:
            pytest.skip(f"multicast cannot be sent here: {error}")
    if heard is None:
        pytest.skip("multicast does not come back on this machine")
    return bus_words(port)


def bus_words(port: int) -> tuple[str, ...]:
    """Bus arguments with a port of their own; `hop_limit=0` keeps the frames on this machine."""
    options = ("--bus-kwargs", "hop_limit=0", "--bus-kwargs", f"port={port}")
    return ("-i", "udp_multicast", "-c", GROUP, *options)


def test_images_of_every_edge_size_arrive_byte_for_byte_at_one_mock(
    bus: tuple[str, ...], tmp_path: Path
) -> None:
    sizes = sample((129, 16), (128, 16, 129, 127))
    data = random.Random(11)
    serving = ("-t", "bms", "--save-image", "out.bin", "--upgrades", str(len(sizes)), *bus)
    with MockProcess(*serving, folder=tmp_path) as mock:
        for size_bytes in sizes:
            done = transfer(mock, tmp_path, VECTORS + data.randbytes(size_bytes - 16), *bus)
            assert "completed:    the device confirmed" in done.stdout
        assert mock.end() == 0


def test_more_than_64_kib_arrive_byte_for_byte(bus: tuple[str, ...], tmp_path: Path) -> None:
    """A sample of `python -m tests.campaigns.two_processes`, which sends 300 KiB."""
    done = long_upgrade(bus, tmp_path, 65 * 1024)
    assert "66,560 bytes in 520 packets" in done.stdout


def long_upgrade(
    bus: tuple[str, ...], folder: Path, size_bytes: int
) -> subprocess.CompletedProcess[str]:
    """The mock's flash takes no time here: a packet would last 1 ms longer."""
    fast = ("--set", "program_time_s=0", "--set", "erase_time_s=0")
    image = VECTORS + random.Random(12).randbytes(size_bytes - len(VECTORS))
    serving = ("-t", "bms", "--save-image", "out.bin", "--upgrades", "1", *fast, *bus)
    with MockProcess(*serving, folder=folder) as mock:
        done = transfer(mock, folder, image, *bus)
        assert mock.end() == 0
    return done
