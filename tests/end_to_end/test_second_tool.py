"""Commands beside an upgrade of another process, and a program that knows no lock."""

from __future__ import annotations

import json
import random
import subprocess
from pathlib import Path

import pytest

from tests.cli import conftest
from tests.cli.conftest import Flasher
from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment
from tests.end_to_end.stranger import Stranger
from tests.end_to_end.test_processes import GROUP, bus, free_port
from tests.firmware import VECTORS

pytestmark = pytest.mark.slow

__all__ = ["GROUP", "bus", "free_port"]  # `bus` is a fixture

flasher = conftest.flasher
"""The fixture, for the tests here too."""

IMAGE = VECTORS + random.Random(41).randbytes(120 * 128 - 21)
SLOW = ("--packet-gap", "0.02")
"""So that the others have their time."""


def test_an_upgrade_survives_commands_beside_it_and_a_program_that_knows_no_lock(
    bus: tuple[str, ...], tmp_path: Path, flasher: Flasher
) -> None:
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE)
    words = ("flash", "-t", "bms", "--verify", "none", *SLOW, "--json", "--events", *bus)
    with (
        MockProcess("-t", "bms", "--save-image", "out.bin", *bus, folder=tmp_path) as mock,
        subprocess.Popen(
            [*FLASHER, *words, "image.bin"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=tmp_path,
            env=clean_environment(),
        ) as flash,
    ):
        assert flash.stdout is not None
        assert any('"number": 1,' in line for line in flash.stdout)
        with Stranger(bus, every_s=0.15):
            read = flasher("read", "history", "-t", "bms", *bus)
            second = flasher("flash", "-t", "bms", *bus, image)
            for refused in (read, second):
                assert refused.code == 4, refused.err
                assert f"in use by flasher flash (process {flash.pid}, since 20" in refused.err
            reported = flash.stdout.read().splitlines()
        assert flash.wait() == 0, reported[-1]
        assert flasher("read", "history", "-t", "bms", *bus).code == 0, "the lock is given back"
        mock.wait_for("image:")
        assert (tmp_path / "out.bin").read_bytes() == IMAGE
    asked = [event for event in map(json.loads, reported) if event.get("event") == "ForeignQuery"]
    assert [event["title"] for event in asked] == ["read user string 1"]
