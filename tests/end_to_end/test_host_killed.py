"""The host's process is killed in the middle, and the same command is given again."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from flasher.history import FlashHistory
from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment, run_here
from tests.end_to_end.test_processes import GROUP, bus, free_port
from tests.firmware import VECTORS

pytestmark = pytest.mark.slow

__all__ = ["GROUP", "bus", "free_port"]  # `bus` is a fixture

PACKETS = 40
IMAGE = VECTORS + random.Random(40).randbytes(PACKETS * 128 - 21)
SLOW = ("--packet-gap", "0.02")
"""So that the kill hits while packets go."""
PAUSE_S = "transfer_timeout_s=0.3"
"""The device does not wait long for a host that is gone."""
NEVER_ENDS = tuple(
    word
    for choice in ("pause_in_transfer=waits", "reset_in_transfer=ignored")
    for word in ("--set", choice)
)
"""The device waits for ever, and knows no reset meanwhile."""
IMPATIENT = """\
[timings]
command_timeout_s = 0.3
boot_version_timeout_s = 0.3
request_transfer_timeout_s = 0.5
"""
"""A profile: silence means something sooner."""


@pytest.mark.skipif(sys.platform == "win32", reason="needs a kill that cannot be caught")
def test_a_host_that_is_killed_at_any_packet_is_repaired_by_the_same_command(
    bus: tuple[str, ...],
    tmp_path: Path,
) -> None:
    """A sample of `python -m tests.campaigns.two_processes`: the last packet but one."""
    kill_and_repair(bus, tmp_path, (PACKETS - 1,))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a kill that cannot be caught")
def test_a_session_that_a_killed_host_left_open_is_finished_by_the_same_command(
    bus: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sample of `python -m tests.campaigns.killed_hosts`."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    (tmp_path / "image.bin").write_bytes(IMAGE)
    (tmp_path / "flasher.toml").write_text(IMPATIENT)
    flash = ("flash", "-t", "bms", *bus, "image.bin")
    with MockProcess(
        "-t", "bms", *NEVER_ENDS, "--save-image", "out.bin", *bus, folder=tmp_path
    ) as mock:
        kill_at(7, (*flash, *SLOW), tmp_path)
        (left,), _ = FlashHistory().flashes()
        assert left.left_device_open
        assert left.reached is not None
        assert (left.reached.phase, left.reached.packet >= 7) == ("transfer", True)
        done = run_here(*flash, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "power-cycle" not in done.stderr
        mock.wait_for("image:")
    assert (tmp_path / "out.bin").read_bytes() == IMAGE


def kill_and_repair(bus: tuple[str, ...], tmp_path: Path, numbers: Iterable[int]) -> None:
    """One device lives through all of it; each time it is left without an application."""
    (tmp_path / "image.bin").write_bytes(IMAGE)
    serving = ("-t", "bms", "--set", PAUSE_S, "--save-image", "out.bin", "-v", *bus)
    flash = ("flash", "-t", "bms", *bus, "image.bin")
    with MockProcess(*serving, folder=tmp_path) as mock:
        for number in numbers:
            kill_at(number, (*flash, *SLOW), tmp_path)
            (tmp_path / "out.bin").unlink(missing_ok=True)
            done = run_here(*flash, folder=tmp_path)
            assert done.returncode == 0, done.stderr
            assert "application reported no version" in done.stderr  # it has none
            mock.wait_for("image:")
            assert (tmp_path / "out.bin").read_bytes() == IMAGE


def kill_at(number: int, words: tuple[str, ...], folder: Path) -> None:
    """Start a flash and kill it as soon as it says that a packet is acknowledged."""
    events = ("--json", "--events")
    with subprocess.Popen(
        [*FLASHER, *words, *events],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=folder,
        env=clean_environment(),
    ) as process:
        assert process.stdout is not None
        try:
            wanted = f'"number": {number}, "total": {PACKETS}'
            assert any(wanted in line for line in process.stdout)
        finally:
            process.kill()
    assert process.returncode < 0
