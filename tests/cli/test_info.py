"""`flasher info`: everything that a device tells, harmless and bounded whatever it sends."""

from __future__ import annotations

import pytest

from flasher.errors import ExitCode
from tests.api.battery import ANSWERS, RUNNING, Battery, opened
from tests.cli.conftest import Flasher

MOCK = ("--mock", "--mock-speed", "0")


@pytest.fixture
def battery(monkeypatch: pytest.MonkeyPatch) -> Battery:
    """What is on the bus in place of the device model."""
    battery = Battery()
    monkeypatch.setattr("flasher.api.connect_mock", lambda *_, **__: opened(battery))
    return battery


def rows(text: str) -> list[str]:
    """Lines with runs of spaces made one."""
    return [" ".join(line.split()) for line in text.splitlines()]


# Only one document says how often faults are sent: silence proves more there.
NO_FAULTS = {
    "welling": "faults none received",
    "motinova": "faults none received; how often they are sent is not documented: see monitor",
}


@pytest.mark.usefixtures("battery")
@pytest.mark.parametrize("dialect", ["welling", "motinova"])
def test_everything_is_shown_with_units(flasher: Flasher, dialect: str) -> None:
    run = flasher("info", "-t", "bms", "--dialect", dialect, *MOCK)
    assert run.code == ExitCode.OK
    shown = rows(run.out)
    for line in (
        f"BMS, {dialect} dialect",
        "serial number W2605001",
        "firmware version V1r0r0_20220512",
        "voltage 36000 mV",
        "state of health 99 %",
        "cell temperature 25 °C",
        "cell model 21700A",
        "date 2022-05-12",
        "highest cell temperature 45 °C",
        "lowest cell temperature -5 °C",
        NO_FAULTS[dialect],
    ):
        assert line in shown
    assert "not answered" not in shown


@pytest.mark.parametrize("dialect", ["welling", "motinova"])
def test_the_built_in_device_model_answers_all(flasher: Flasher, dialect: str) -> None:
    run = flasher("info", "-t", "bms", "--dialect", dialect, "--json", *MOCK)
    assert run.code == run.document["exit_code"] == ExitCode.OK
    assert run.document["unanswered"] == {}
    assert run.document["items"]["version-information"]["serial_number"]
    assert run.document["items"]["cell-voltages"]["cells_mv"][0] > 2000


def test_faults_are_named(flasher: Flasher, battery: Battery) -> None:
    battery.report(0x720, 0x1204, bytes.fromhex("04000100"))
    run = flasher("info", "-t", "bms", *MOCK)
    assert "faults short circuit protection, charge over voltage warning" in rows(run.out)
    battery.report(0x720, 0x1204, bytes.fromhex("04000100"))
    assert flasher("info", "-t", "bms", "--json", *MOCK).document["faults"] == [
        "short circuit protection",
        "charge over voltage warning",
    ]


def test_a_fault_that_is_over_before_the_last_question_is_shown_all_the_same(
    flasher: Flasher, battery: Battery
) -> None:
    battery.report(0x720, 0x1204, bytes(4))
    battery.repeats = tuple(
        (0x720, 0x1204, bytes.fromhex(flags)) for flags in ("00008001", "04000000", "00000000")
    )
    shown = rows(flasher("info", "-t", "bms", *MOCK).out)
    wanted = "short circuit protection, discharge under temperature warning"
    assert f"faults {wanted}, MOS over temperature warning" in shown


def test_an_older_device_gives_no_state_of_health(flasher: Flasher, battery: Battery) -> None:
    battery.answers[0x3400] = (0x720, 0x1010, RUNNING[:11] + bytes(5))
    battery.silent = frozenset({0x3700, 0x3900, 0x3B00, 0x3D00})
    run = flasher("info", "-t", "bms", *MOCK)
    assert run.code == ExitCode.OK
    shown = rows(run.out)
    assert "state of health 0 % (or an older device, which does not know it)" in shown
    assert "state of charge 80 %" in shown
    assert shown[shown.index("not answered") + 1 :] == [
        "production information no answer",
        "user string 1 no answer",
        "user string 2 no answer",
        "user string 3 no answer",
    ]
    document = flasher("info", "-t", "bms", "--json", *MOCK).document
    assert document["items"]["running-information"]["state_of_health_percent"] == 0
    assert document["items"]["production-information"] is None


def test_a_broken_device_is_shown_harmlessly(flasher: Flasher, battery: Battery) -> None:
    battery.delay_s = 0.15
    battery.silent = frozenset(list(ANSWERS)[::2])
    battery.answers[0x3100] = (0x720, 0x170C, b"\xff" * 12)
    battery.answers[0x3400] = (0x720, 0x100E, RUNNING[:14])
    battery.answers[0x3600] = (0x720, 0x1410, b"\xff" * 16)
    battery.answers[0x3B00] = (0x725, 0x5310, b"\x1b]0;x\x07\x9b31m\r\n\x00\xe9...")
    battery.answers[0x3800] = (0x725, 0x5028, b"\xff" * 40)
    run = flasher("info", "-t", "bms", *MOCK)
    assert run.code == ExitCode.OK
    assert "Traceback" not in run.err
    assert not set(run.out) & {"\x1b", "\x07", "\r", "\x00", "\x9b"}
    shown = rows(run.out)
    assert "running information came in another form: 100E with 14 bytes, mode 0C" in shown
    assert "cell model " + "\\xff" * 8 in shown
    assert "running time 4294967295 min" in shown


def test_a_silent_device_is_exit_5(flasher: Flasher, battery: Battery) -> None:
    battery.silent = frozenset(ANSWERS)
    run = flasher("info", "-t", "bms", "--json", *MOCK)
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert run.document["unanswered"]["history"] == "not asked: the device is silent"
    assert len(battery.received) == 3 * 5


def test_the_wmc_cannot_be_asked_and_what_it_sends_is_shown(
    flasher: Flasher, battery: Battery
) -> None:
    battery.report(0x710, 0x1305, b"READY")
    run = flasher("info", "-t", "wmc", *MOCK)
    assert run.code == ExitCode.OK
    assert "no query for it" in run.out
    assert any(line.startswith("710 1305 ready for shutdown") for line in rows(run.out))
    assert battery.received == []


@pytest.mark.usefixtures("battery")
def test_a_wmc_that_sends_nothing_is_exit_5_and_reported_to_be_unaskable(flasher: Flasher) -> None:
    run = flasher("info", "-t", "wmc", *MOCK)
    assert run.code == ExitCode.NO_ANSWER
    assert "no query for it" in " ".join(run.err.split())


@pytest.mark.parametrize("words", [("info",), ("read", "serial-number")])
def test_a_device_in_its_bootloader_is_reported_with_the_way_on(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    bootloader = Battery(silent=frozenset(range(0x10000)), repeats=((0x725, 0xC109, b"BMSV1.0.0"),))
    monkeypatch.setattr("flasher.api.connect_mock", lambda *_, **__: opened(bootloader))
    run = flasher(*words, "-t", "bms", *MOCK, "--json")
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert "The BMS is in its bootloader (BMS V1.0.0)" in run.document["error"]["what"]
    assert "flasher flash IMAGE -t bms" in run.document["error"]["remedy"]
    assert "key" not in run.err
