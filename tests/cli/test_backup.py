"""`flasher backup`: what is in the archive, what is not, and that it is whole or not there."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
from intelhex import IntelHex

from flasher.api import Device, DeviceInfo
from flasher.errors import ExitCode
from tests.api.battery import ANSWERS, Battery, opened
from tests.cli.conftest import SAMPLES, Flasher, Run

MOCK = ("--mock", "--mock-speed", "0")
AREA = "[bms.application_area]\nstart = 0x1000\nsize_bytes = 0x210\n"


@pytest.fixture
def battery(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Battery:
    """What is on the bus in place of the device model; the working directory is empty."""
    battery = Battery()
    monkeypatch.setattr("flasher.api.connect_mock", lambda *_, **__: opened(battery))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return battery


def unpacked(path: Path) -> tuple[dict[str, Any], bytes]:
    """The data of a backup, and its memory as Intel HEX."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        memory = archive.read("memory.hex") if "memory.hex" in archive.namelist() else b""
        return json.loads(archive.read("backup.json")), memory


def test_the_area_of_the_profile_is_saved_with_everything_that_the_battery_reports(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--json", *MOCK)
    assert run.code == ExitCode.OK
    data, memory = unpacked(tmp_path / "b.zip")
    image = IntelHex(io.StringIO(memory.decode()))
    assert (image.minaddr(), image.maxaddr()) == (0x1000, 0x120F)
    assert image.tobinstr() == battery.memory[:0x210]
    document = run.document
    assert document["memory"] == data["memory"]
    assert document["memory"]["range_from"] == "application_area of the profile"
    assert {"version-information", "history", "user-string-1"} <= data["info"]["items"].keys()
    assert data["info"]["items"]["version-information"]["serial_number"] == "W2605001"
    assert {"history", "faults"} <= set(document["items"])
    assert set(document["not_in_it"]) == {"other memory"}
    assert document["size_bytes"] == (tmp_path / "b.zip").stat().st_size
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".part"] == []


def test_the_addresses_may_be_those_of_an_image(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    running = IntelHex()
    running.frombytes(bytes(range(100)), offset=0x1040)
    running.write_hex_file(str(tmp_path / "running.hex"))
    (tmp_path / "flasher.toml").write_text(AREA)
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--image", "running.hex", *MOCK)
    assert run.code == ExitCode.OK, run.err
    assert "0x00001040..0x000010A3, 100 bytes" in run.out
    assert "addresses of the image running.hex" in run.out
    image = IntelHex(io.StringIO(unpacked(tmp_path / "b.zip")[1].decode()))
    assert image.tobinstr() == battery.memory[0x40:0xA4]


@pytest.mark.usefixtures("battery")
def test_memory_that_does_not_name_the_running_version_is_saved_with_a_warning(
    flasher: Flasher, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--json", *MOCK)
    assert run.document["memory"]["names_running_version"] is False
    assert "is not in this memory" in run.err


def test_memory_that_names_it_is_reported(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    battery.memory = b"..V1r0r0_20220512.".ljust(1024, b"\xff")
    run = flasher("backup", "-t", "bms", "-o", "b.zip", *MOCK)
    assert "contains the version that runs" in run.out
    assert "warning" not in run.err


def test_what_is_not_answered_is_not_in_it_and_is_reported(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    battery.silent = frozenset({0x3800, 0x3300})
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--no-memory", "--json", *MOCK)
    assert run.code == ExitCode.OK
    assert run.document["not_in_it"]["history"] == "no answer"
    assert run.document["not_in_it"]["memory"] == "left out on request"
    assert run.document["memory"] is None
    assert "history" not in run.document["items"]
    assert unpacked(tmp_path / "b.zip")[1] == b""
    assert not [command for command, _ in battery.received if command == 0x4308]


def test_without_addresses_nothing_is_guessed(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "-i", "virtual", "-c", "x")
    assert run.code == ExitCode.USAGE
    for word in ("--image", "[bms.application_area]", "--no-memory"):
        assert word in run.err
    (tmp_path / "running.bin").write_bytes((SAMPLES / "obc.bin").read_bytes())
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--image", "running.bin")
    assert run.code == ExitCode.USAGE
    assert "has no addresses" in run.err
    assert not (tmp_path / "b.zip").exists()


@pytest.mark.parametrize("target", ["wmc", "obc"])
def test_a_device_that_cannot_be_read_is_refused_with_the_reason(
    flasher: Flasher, battery: Battery, target: str
) -> None:
    run = flasher("backup", "-t", target, "-o", "b.zip", *MOCK)
    assert run.code == ExitCode.USAGE
    assert "the documents give no way to read its memory" in run.err
    assert battery.received == []


def test_a_file_that_is_there_is_not_written_over_unless_asked_to(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    (tmp_path / "b.zip").write_text("the only copy")
    words = ("backup", "-t", "bms", "-o", "b.zip", *MOCK)
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "add --force" in run.err
    assert (tmp_path / "b.zip").read_text() == "the only copy"
    assert battery.received == []
    assert flasher(*words, "--force").code == ExitCode.OK
    assert zipfile.is_zipfile(tmp_path / "b.zip")
    assert flasher("backup", "-t", "bms", "-o", "no/b.zip", *MOCK).code == ExitCode.USAGE


@pytest.mark.usefixtures("battery")
def test_memory_that_ends_in_silence_leaves_the_older_file_as_it_was(
    flasher: Flasher, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA.replace("0x210", "0x1000"))
    (tmp_path / "b.zip").write_text("the only copy")
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--force", "--json", *MOCK)
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert "memory at 0x00001400" in run.document["error"]["where"]
    assert "No file was written" in run.err
    assert (tmp_path / "b.zip").read_text() == "the only copy"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.zip", "flasher.toml"]


def test_a_battery_that_is_not_there_leaves_no_file(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    battery.silent = frozenset({*ANSWERS, 0x4308})
    run = flasher("backup", "-t", "bms", "-o", "b.zip", *MOCK)
    assert run.code == ExitCode.NO_ANSWER
    assert not (tmp_path / "b.zip").exists()
    assert 0x4308 not in {command for command, _ in battery.received}


@pytest.mark.slow
def test_the_device_model_knows_its_own_area(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    run = flasher("backup", "-t", "bms", "-o", "b.zip", "--json", *MOCK)
    assert run.code == ExitCode.OK
    assert run.document["memory"]["names_running_version"] is True
    image = IntelHex(io.StringIO(unpacked(tmp_path / "b.zip")[1].decode()))
    assert image.tobinstr().startswith(b"factory application")


@pytest.mark.usefixtures("battery")
def test_a_second_backup_into_the_same_new_file_is_refused_while_the_first_one_runs(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    words = ("backup", "-t", "bms", "-o", "b.zip", *MOCK)
    second: list[Run] = []
    identify = Device.identify

    def identify_meanwhile(device: Device, **watch: Any) -> DeviceInfo:
        if not second:
            second.append(flasher(*words))
        return identify(device, **watch)

    monkeypatch.setattr(Device, "identify", identify_meanwhile)
    assert flasher(*words).code == ExitCode.OK
    assert second[0].code == ExitCode.USAGE
    assert "b.zip exists already" in second[0].err
    assert zipfile.is_zipfile(tmp_path / "b.zip")


@pytest.mark.usefixtures("battery")
def test_restore_takes_a_profile(flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "flasher.toml").write_text(AREA)
    assert flasher("backup", "-t", "bms", "-o", "b.zip", *MOCK).code == ExitCode.OK
    words = ("backup", "restore", "b.zip", "--yes", *MOCK)
    assert flasher(*words, "--profile", "flasher.toml").code == ExitCode.OK
    run = flasher(*words, "--profile", "none.toml")
    assert run.code == ExitCode.USAGE
    assert "none.toml" in run.err
