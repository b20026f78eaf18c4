"""Two batteries on one bus: what every command that asks says of them (R27)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.driver import drive
from flasher.errors import ErrorCode, ExitCode, WrongDeviceError
from flasher.host.survey import Survey
from flasher.host.write import plan_write
from flasher.mock.model import MockDevice
from flasher.protocol.spec import WELLING
from flasher.protocol.wire import Message, encode, split
from tests.cli.conftest import Flasher
from tests.end_to_end.stage import SMALL, Speaker, Stage
from tests.host.duplicates import Slow
from tests.loops import each

MOCK = ("-t", "bms", "--mock", "--mock-speed", "0")
SEEN = "serial number W2605001 / W2605002"


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    """Two that differ in their serial numbers; the second one answers later."""
    made = Stage()
    other = MockDevice(
        made.target,
        bitrate_bps=WELLING.bitrate_bps,
        profile=replace(SMALL, serial_number="W2605002"),
    )
    made.bus.attach(Slow(other, 0.012))
    monkeypatch.setattr("flasher.api.connect_mock", made.connect)
    return made


@pytest.mark.slow
@pytest.mark.usefixtures("stage")
@each("words", [("info",), ("read", "version-information"), ("read", "serial-number"), ("scan",)])
def test_what_asks_warns_and_names_the_fields_that_differ(
    flasher: Flasher, words: tuple[str, ...]
) -> None:
    run = flasher(*words, *MOCK)
    assert run.code == ExitCode.OK
    assert "warning: two devices of one kind are on the bus: two devices answered: " in run.err
    assert SEEN in run.err
    assert "Disconnect one of them." in run.err
    document = flasher(*words, *MOCK, "--json").document
    assert SEEN in document["two_devices"]


@pytest.mark.usefixtures("stage")
def test_memory_that_two_send_is_reported_too(flasher: Flasher) -> None:
    run = flasher("read", "memory", "0x8004000", "0x8004100", *MOCK)
    assert run.code == ExitCode.OK
    assert "two devices answered" in run.err


def test_nothing_is_written_to_two(flasher: Flasher, stage: Stage) -> None:
    run = flasher("write", "user-string-1", "both", *MOCK, "--yes")
    assert run.code == ExitCode.WRONG_DEVICE
    assert "Nothing was written." in run.err
    assert not any(frame.data.startswith(b"\x55\xaa\x16") for frame in stage.heard)


@pytest.mark.usefixtures("stage")
def test_a_backup_of_two_is_none(flasher: Flasher, tmp_path: Path) -> None:
    file = tmp_path / "backup.zip"
    run = flasher("backup", "-o", file, "--no-memory", *MOCK)
    assert run.code == ExitCode.WRONG_DEVICE
    assert "No file was written." in run.err
    assert not file.exists()


def test_a_write_that_two_confirm_is_an_error(stage: Stage) -> None:
    """The second half alone, as for an item that has no query."""
    device = stage.connection().device("bms")
    plan = plan_write("user-string-1", ["both"])
    with pytest.raises(WrongDeviceError, match="confirmed twice") as caught:
        device.write_planned(plan, None)
    assert caught.value.code is ErrorCode.TWO_DEVICES
    assert "may hold the new value" in caught.value.remedy


def test_one_battery_is_reported_as_such(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = Stage()
    monkeypatch.setattr("flasher.api.connect_mock", alone.connect)
    run = flasher("info", *MOCK, "--json")
    assert run.document["two_devices"] is None
    assert "two devices" not in run.err


def test_who_only_listens_counts_the_answers_to_others(stage: Stage) -> None:
    """As `flasher doctor` does; the display asks."""
    asks = split(0x732, encode(Message(0x732, 0x11, 0x5100, b"")))
    stage.bus.attach(Speaker(*asks, every_s=0.05))
    survey = Survey(listen_s=1.0, bitrate_bps=WELLING.bitrate_bps, dialect=WELLING)
    link = stage.bus.link()
    drive(survey, link, stage.clock)
    assert SEEN in survey.duplicates.evidence


def test_who_only_listens_detects_two_bootloaders() -> None:
    stage = Stage("wmc", has_application=False)
    other = MockDevice(
        stage.target, bitrate_bps=WELLING.bitrate_bps, profile=SMALL, has_application=False
    )
    stage.wait(0.013)
    stage.bus.attach(other)
    survey = Survey(listen_s=1.0, bitrate_bps=WELLING.bitrate_bps, dialect=WELLING)
    drive(survey, stage.bus.link(), stage.clock)
    assert "alternately" in survey.duplicates.evidence


def test_doctor_calls_it_a_problem(
    flasher: Flasher, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.api.connect_mock", stage.connect)
    asks = split(0x732, encode(Message(0x732, 0x11, 0x5100, b"")))
    stage.bus.attach(Speaker(*asks, every_s=0.05))
    run = flasher("doctor", "--mock", "--mock-speed", "0", "--json")
    assert run.code == ExitCode.BUS
    problems = [each for each in run.document["findings"] if each["severity"] == "problem"]
    assert [SEEN in each["what"] for each in problems] == [True]
    assert problems[0]["fix"] == ["disconnect one of them"]
