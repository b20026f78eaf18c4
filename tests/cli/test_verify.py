"""`flasher verify`: what a device runs, compared with an image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.image.image import Image
from flasher.protocol.frame import Frame
from tests.cli.conftest import SAMPLES, Flasher, Run
from tests.end_to_end.stage import IMAGE, NEW, OLD, SMALL, Stage, image_of

BASE = 0x0800_8000
"""Where the device model keeps its application."""
UPDATE = bytes.fromhex("55AA160DA10B")
READ_MEMORY = bytes.fromhex("55AA110A4308")


class Comparison:
    """A device, an image file beside it, and `flasher verify` on that bus."""

    def __init__(self, flasher: Flasher, patch: pytest.MonkeyPatch, folder: Path) -> None:
        self._flasher, self._patch, self._path = flasher, patch, folder / "image.bin"

    def __call__(self, stage: Stage, *words: str, image: Image = IMAGE) -> Run:
        self._path.write_bytes(image.data)
        self._patch.setattr("flasher.api.connect", stage.connect)
        stage.heard.clear()
        at = ("-t", stage.target.name, "-i", "virtual")
        run = self._flasher("verify", self._path, "--base", f"{BASE:#x}", *at, *words)
        assert not any(frame.data.startswith(UPDATE) for frame in stage.heard)
        return run


@pytest.fixture
def verify(flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Comparison:
    return Comparison(flasher, monkeypatch, tmp_path)


@pytest.fixture
def flashed() -> Stage:
    stage = Stage()
    assert stage.flash(IMAGE).ok
    return stage


def test_a_device_that_runs_the_image_is_compared_byte_by_byte(
    verify: Comparison, flashed: Stage
) -> None:
    run = verify(flashed)
    assert run.code == ExitCode.OK, run.err
    assert f"version: {NEW}" in run.out
    assert f"memory:  {IMAGE.size_bytes} bytes are the image's" in run.out
    assert f"OK  BMS runs {NEW} (memory read back)" in run.out
    document = verify(flashed, "--json").document
    assert document["verification"]["verdict"] == "memory_right"
    assert document["memory_not_compared"] is None


def test_another_version_decides_without_reading_the_memory(
    verify: Comparison, flashed: Stage
) -> None:
    run = verify(flashed, image=image_of(version=OLD))
    assert run.code == ExitCode.VERIFICATION
    assert f"{NEW} instead of {OLD}" in run.err
    assert "completed" not in run.err
    assert "memory:  not compared: the version decides already" in run.out
    assert not any(frame.data.startswith(READ_MEMORY) for frame in flashed.heard)


def test_an_image_that_names_another_target_is_compared_with_a_warning(
    flasher: Flasher, flashed: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.api.connect", flashed.connect)
    run = flasher("verify", SAMPLES / "wmc.hex", "-t", "bms", "-i", "virtual")
    assert run.code == ExitCode.VERIFICATION
    assert "warning: the image names the WMC inside, not the BMS" in run.err


def test_another_build_of_the_same_version_is_found_with_its_ranges(
    verify: Comparison, flashed: Stage
) -> None:
    data = bytearray(IMAGE.data)
    data[200:204] = bytes(each ^ 0xFF for each in data[200:204])
    data[-1] ^= 1
    other = replace(IMAGE, data=bytes(data))
    run = verify(flashed, image=other)
    assert run.code == ExitCode.VERIFICATION
    assert "memory:  differs in 2 ranges of 5 bytes together" in run.out
    assert f"0x{BASE + 200:08X}..0x{BASE + 203:08X} (4 bytes)" in run.out
    found = verify(flashed, "--json", image=other).document["verification"]["differing"]
    assert [each["size_bytes"] for each in found] == [4, 1]


def test_an_older_device_without_the_memory_query_is_compared_by_its_version(
    verify: Comparison, flashed: Stage
) -> None:
    def swallow(frame: Frame, _now: float) -> tuple[Frame, ...]:
        return () if frame.data.startswith(READ_MEMORY) else (frame,)

    flashed.disturb = swallow
    run = verify(flashed)
    assert run.code == ExitCode.OK, run.err
    assert "memory:  not compared: no answer to a memory read at 0x08008000" in run.out
    assert "names the version of the image" in run.out
    assert verify(flashed, "--level", "memory").code == ExitCode.NO_ANSWER


def test_the_version_alone_is_compared_on_request(verify: Comparison, flashed: Stage) -> None:
    run = verify(flashed, "--level", "version")
    assert run.code == ExitCode.OK
    assert "memory:  not compared: as requested" in run.out


def test_an_image_that_names_no_version_states_what_runs(verify: Comparison) -> None:
    nameless = replace(IMAGE, data=IMAGE.data.replace(NEW.encode(), b"no version here.."))
    run = verify(Stage(), "--level", "version", image=nameless)
    assert run.code == ExitCode.OK
    assert f"OK  BMS runs {OLD} (the application runs; the image names no version" in run.out


def test_a_device_in_its_bootloader_runs_nothing(verify: Comparison) -> None:
    run = verify(Stage(has_application=False))
    assert run.code == ExitCode.VERIFICATION
    assert "a bootloader keeps announcing itself" in run.err
    assert "flasher flash IMAGE -t bms" in run.err
    assert "version: not reported" in run.out


def test_a_silent_device_is_not_reported_to_run_another_image(verify: Comparison) -> None:
    stage = Stage()
    stage.cut_power()
    run = verify(stage)
    assert run.code == ExitCode.NO_ANSWER
    assert "version: not reported" in run.out


def test_a_target_without_a_version_query_is_refused_before_anything_is_sent(
    verify: Comparison,
) -> None:
    stage = Stage("wmc", profile=SMALL)
    run = verify(stage)
    assert run.code == ExitCode.USAGE
    assert "A WMC cannot be verified." in run.err
    assert "--level" not in run.err, "it was not given"
    assert not stage.heard


def test_a_raw_binary_without_a_base_is_compared_by_its_version(
    flasher: Flasher, flashed: Stage, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "image.bin").write_bytes(IMAGE.data)
    monkeypatch.setattr("flasher.api.connect", flashed.connect)
    run = flasher("verify", tmp_path / "image.bin", "-t", "bms", "-i", "virtual")
    assert run.code == ExitCode.OK, run.err
    assert "memory:  not compared: a raw binary has no addresses: --base gives" in run.out
