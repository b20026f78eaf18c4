"""The table [bus] of flasher.toml: where it is found, what goes before it, what is refused."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import pytest

from flasher import api
from flasher.api import Connection
from flasher.bus import opening
from flasher.bus.bit_rate import BitRate
from flasher.bus.fallback import Fallback
from flasher.errors import ExitCode
from flasher.settings.profile import find_bus
from tests.api.battery import Battery, wire_to
from tests.bus.test_adapter import FakeBus
from tests.cli.conftest import SAMPLES, Flasher

TABLE = """\
attempts = 5

[bus]
interface = "pcan"
channel = "PCAN_USBBUS3"

[bus.bus_kwargs]
auto_reset = true
"""
BMS = str(SAMPLES / "bms.hex")
Variables = Callable[[dict[str, str]], None]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory and a user whose configuration is empty."""
    for name in ("HOME", "XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What python-can is asked to open, always a silent bus."""
    seen: list[dict[str, Any]] = []

    def bus(**config: Any) -> can.BusABC:
        seen.append(config)
        return FakeBus()

    monkeypatch.setattr("can.Bus", bus)
    return seen


@pytest.fixture
def variables(monkeypatch: pytest.MonkeyPatch) -> Variables:
    """Sets python-can's variables, after `flasher` has taken those of the computer away."""

    def set_(values: dict[str, str]) -> None:
        monkeypatch.setattr("can.util.load_environment_config", lambda *_args: values)

    return set_


def monitored(flasher: Flasher, *words: str) -> int:
    return flasher("monitor", "--duration", "0", *words).code


def user_file(tmp_path: Path) -> Path:
    folder = tmp_path / "home" / "flasher"
    folder.mkdir(parents=True)
    return folder / "flasher.toml"


# -- where it is found -----------------------------------------------------------------------------


def test_the_table_of_the_working_directory_is_opened(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    assert monitored(flasher) == ExitCode.OK
    (config,) = opened
    assert (config["interface"], config["channel"]) == ("pcan", "PCAN_USBBUS3")
    assert (config["auto_reset"], config["bitrate"]) == (True, 250_000)


def test_a_profile_without_the_table_leaves_it_to_the_users_file(
    here: Path, tmp_path: Path
) -> None:
    assert find_bus() is None
    (here / "flasher.toml").write_text("attempts = 3\n")
    path = user_file(tmp_path)
    path.write_text(TABLE)
    found = find_bus()
    assert found is not None
    assert found.source == f"[bus] of {path}"
    (here / "flasher.toml").write_text('[bus]\ninterface = "virtual"\nchannel = 7\n')
    assert find_bus() == Fallback(
        {"interface": "virtual", "channel": "7"}, f"[bus] of {here / 'flasher.toml'}"
    )


def test_the_file_of_the_profile_option_comes_first(here: Path) -> None:
    (here / "flasher.toml").write_text('[bus]\ninterface = "virtual"\n')
    (here / "bench.toml").write_text(TABLE)
    found = find_bus("bench.toml")
    assert found is not None
    assert found.bus["interface"] == "pcan"
    assert find_bus(os.devnull) is None


def test_flash_takes_the_adapter_of_its_profile(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    (here / "bench.toml").write_text(TABLE)
    flasher("flash", BMS, "-t", "bms", "--profile", "bench.toml", "--timeout", "0.01")
    assert [config["channel"] for config in opened] == ["PCAN_USBBUS3"]


# -- what goes before it ---------------------------------------------------------------------------


def test_an_option_goes_before_it_key_by_key(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    monitored(flasher, "-c", "PCAN_USBBUS9", "--bus-kwargs", "auto_reset=false")
    assert opened[0]["channel"] == "PCAN_USBBUS9"
    assert opened[0]["auto_reset"] is False


def test_a_variable_goes_before_it(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]], variables: Variables
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    variables({"channel": "PCAN_USBBUS5"})
    monitored(flasher)
    assert (opened[0]["interface"], opened[0]["channel"]) == ("pcan", "PCAN_USBBUS5")


def test_a_file_of_python_can_goes_before_it(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    monkeypatch.setattr("can.util.load_file_config", lambda *_args: {"channel": "PCAN_USBBUS6"})
    monitored(flasher)
    assert opened[0]["channel"] == "PCAN_USBBUS6"


def test_nothing_of_it_holds_for_an_adapter_of_another_interface(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    """Neither its channel nor its keywords nor its bit rate mean anything there."""
    (here / "flasher.toml").write_text(TABLE.replace("[bus.", "bitrate = 500000\n[bus."))
    assert monitored(flasher, "-i", "kvaser", "-c", "0") == ExitCode.OK
    (config,) = opened
    assert (config["interface"], config["channel"]) == ("kvaser", 0)
    assert "auto_reset" not in config


def test_the_mock_reads_none(flasher: Flasher, here: Path) -> None:
    (here / "flasher.toml").write_text("[bus]\ninterface = 3\n")
    assert flasher("read", "history", "--mock", "--mock-speed", "0").code == ExitCode.OK


def test_where_it_names_an_adapter_none_is_looked_for(
    flasher: Flasher, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    wire = wire_to(Battery())

    @contextmanager
    def connected(*_: object, fallback: Fallback, **_bus: Any) -> Iterator[Connection]:
        assert fallback.bus["channel"] == "PCAN_USBBUS3"
        yield wire

    monkeypatch.setattr("flasher.api.connect", connected)
    monkeypatch.setattr("flasher.cli.adapters.detect_adapters", lambda **_: 1 / 0)
    assert flasher("read", "history").code == ExitCode.OK


# -- the bit rate ----------------------------------------------------------------------------------

OTHER_RATE = TABLE.replace("[bus.", "bitrate = 500000\n[bus.")


@pytest.mark.parametrize(
    "words", [("monitor", "--duration", "0"), ("flash", BMS, "-t", "bms"), ("scan",)]
)
def test_another_bit_rate_than_the_dialects_is_refused_before_anything_is_opened(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]], words: tuple[str, ...]
) -> None:
    (here / "flasher.toml").write_text(OTHER_RATE)
    run = flasher(*words)
    assert run.code == ExitCode.BUS
    path = here / "flasher.toml"
    assert f"would be 500 kbit/s ([bus] of {path}), not 250 kbit/s (the dialect's)" in run.err
    assert f"take it out of [bus] of {path}" in run.err
    assert opened == []


def test_the_option_sets_another_bit_rate(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    (here / "flasher.toml").write_text(OTHER_RATE)
    assert monitored(flasher, "-b", "500000") == ExitCode.OK
    assert opened[0]["bitrate"] == 500_000
    assert monitored(flasher, "-b", "250000") == ExitCode.OK
    assert opened[1]["bitrate"] == 250_000


def test_the_source_that_is_reported_is_the_one_that_held(flasher: Flasher) -> None:
    assert flasher("profile", "show", "-t", "bms").code == ExitCode.OK  # no variables from here on
    fallback = Fallback({"interface": "pcan", "channel": "x", "bitrate": 250_000}, "[bus] of f")
    assert api.bit_rate(fallback=fallback) == BitRate(250_000, "[bus] of f")
    assert api.bit_rate(fallback=fallback, bitrate=125_000) == BitRate(125_000, "-b")
    timing = can.BitTiming(f_clock=8_000_000, brp=2, tseg1=13, tseg2=2, sjw=1)
    assert api.bit_rate(fallback=fallback, timing=timing) == BitRate(250_000, "--timing")
    assert "bitrate" not in opening.bus_config({"timing": timing}, fallback)


def test_a_variable_that_agrees_is_the_source_before_the_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("can.util.CONFIG_FILES", [])
    monkeypatch.setenv("CAN_BITRATE", "250000")
    fallback = Fallback({"interface": "pcan", "channel": "x", "bitrate": 500_000}, "[bus] of f")
    assert api.bit_rate(fallback=fallback) == BitRate(250_000, "CAN_BITRATE")


@pytest.mark.slow
def test_doctor_states_that_it_is_in_effect_and_what_it_names(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]]
) -> None:
    (here / "flasher.toml").write_text(TABLE)
    run = flasher("doctor", "--listen", "0")
    assert f"[bus] of {here / 'flasher.toml'} names pcan PCAN_USBBUS3" in run.out
    assert opened[0]["channel"] == "PCAN_USBBUS3"


# -- what is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("bus = 3", "bus is a table, [bus]."),
        ("[bus]\nchannel = 'x'", "bus has no interface."),
        ("[bus]\ninterface = 'sockectan'", "Did you mean socketcan?"),
        ("[bus]\ninterface = 'pcan'\nchanel = 'x'", "Did you mean channel?"),
        ("[bus]\ninterface = 'pcan'\nbitrate = 1", "It is a whole number from 5000 to 1000000"),
        ("[bus]\ninterface = 'pcan'\nbitrate = '250k'", "bus.bitrate cannot be '250k'"),
        ("[bus]\ninterface = 'pcan'\n[bus.bus_kwargs]\ntseg1 = 5", "tseg1 decides the bit rate"),
        ("[bus]\ninterface = 'pcan'\n[bus.bus_kwargs]\nchannel = 5", "belongs directly in [bus]"),
        ("[bus]\ninterface = 'pcan'\n[bus.bus_kwargs]\nx = [1]", "bus.bus_kwargs.x cannot be"),
    ],
)
def test_what_is_wrong_is_reported_by_every_command_that_reads_it(
    flasher: Flasher, here: Path, opened: list[dict[str, Any]], table: str, words: str
) -> None:
    (here / "flasher.toml").write_text(table)
    for command in (("info", "-t", "bms"), ("profile", "check", "flasher.toml")):
        run = flasher(*command)
        assert run.code == ExitCode.USAGE, run.err
        assert words in run.err
        assert "flasher.toml" in run.err
    assert opened == []


@pytest.mark.usefixtures("opened")
def test_what_else_is_wrong_in_the_file_is_no_matter_of_the_adapter(
    flasher: Flasher, here: Path
) -> None:
    (here / "flasher.toml").write_text("attemts = 5\n" + TABLE.partition("\n")[2])
    assert monitored(flasher) == ExitCode.OK
    assert flasher("flash", BMS, "-t", "bms").code == ExitCode.USAGE


@pytest.mark.usefixtures("here")
def test_none_at_all_reports_where_one_may_be(flasher: Flasher) -> None:
    run = flasher("mock", "-t", "bms")
    assert run.code == ExitCode.BUS
    assert "nor [bus] of flasher.toml names one" in run.err
