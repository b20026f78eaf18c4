"""What a user sees while an erased device is not given up, and the options that limit it."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from tests.cli.conftest import Flasher
from tests.end_to_end.stage import IMAGE, Speaker, Stage

OTHER_TOOL = Frame(0x752, bytes.fromhex("55AA16123A105A5A"))
BUS = ("-t", "bms", "-i", "virtual", "-c", "stage")


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    made = Stage()
    monkeypatch.setattr("flasher.api.connect", made.connect)
    return made


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE.data)
    return path


def silent_for(stage: Stage, seconds: float) -> None:
    """From packet 3 on the device has no power for so long."""

    def off() -> None:
        stage.cut_power()
        back_at = stage.clock.now() + seconds

        def look(now: float) -> None:
            if now >= back_at and not stage.device.has_power:
                stage.give_power()

        stage.clock.on_wait = look

    stage.at_packet[3] = off


def test_a_long_wait_is_shown_with_the_time_that_is_left(
    flasher: Flasher, stage: Stage, image: Path
) -> None:
    silent_for(stage, 80.0)
    run = flasher("flash", image, *BUS)
    assert run.code == ExitCode.OK
    assert stage.has == IMAGE.data
    lines = run.err.splitlines()
    shown = [
        "did not answer packet 3 in time: sending packet 3 again, try 10",
        "did not answer packet 3 in time: sending packet 3 again, try 60",
        "beginning again, attempt 2 (68 s left)",
        ">>> power-cycle the device now (waiting 51 s)",
        ">>> power-cycle the device now (waiting 19 s)",
    ]
    found = [next(n for n, line in enumerate(lines) if line.endswith(text)) for text in shown]
    assert found == sorted(found)
    assert not any(line.endswith("try 11") for line in lines)


@pytest.mark.parametrize("option", ["--attempts", "--timeout"])
def test_who_limits_it_waits_no_longer(
    flasher: Flasher, stage: Stage, image: Path, option: str
) -> None:
    silent_for(stage, 80.0)
    run = flasher("flash", image, *BUS, option, "3")
    assert run.code == ExitCode.TRANSFER
    assert "flasher rescue" in run.err
    assert "left)" not in run.err
    assert stage.clock.now() < 35.0


def test_a_tool_that_writes_is_named_and_waited_for(
    flasher: Flasher, stage: Stage, image: Path
) -> None:
    stage.at_packet[3] = lambda: stage.bus.attach(
        Speaker(OTHER_TOOL, every_s=1.0, begins_at=stage.clock.now(), limit=4)
    )
    run = flasher("flash", image, *BUS)
    assert run.code == ExitCode.OK
    assert "warning: another tool writes to the device (frame 55 aa 16 12 3a 10" in run.err
    assert "silent now: beginning again, attempt 2 (94 s left)" in run.err


def test_a_device_without_power_on_a_bus_of_two_is_asked_for(
    flasher: Flasher, stage: Stage, image: Path
) -> None:
    def alone() -> None:
        stage.cut_power()
        stage.bus.is_unacknowledged = True

    stage.at_packet[3] = alone
    run = flasher("flash", image, *BUS, "--timeout", "30")
    assert run.code == ExitCode.BUS
    assert "Trying on for 27 s: check power and contacts of the device." in run.err
    assert run.err.count("Trying on") == 1
    assert "flasher rescue" in run.err
