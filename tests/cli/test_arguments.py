"""Arguments that commands share: numbers, targets, and python-can's own bus values."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

import can
import click
import pytest

from flasher.cli import values
from flasher.cli.extras import Actions
from flasher.cli.framework import Group
from flasher.cli.options import can_filter
from flasher.cli.plant.commands import plant
from flasher.cli.station.commands import station
from flasher.errors import ExitCode
from flasher.protocol.spec import BMS, OBC, TARGETS, WMC
from tests.cli.conftest import SAMPLES, Flasher
from tests.loops import each

OBC_BIN = SAMPLES / "obc.bin"


# -- single values --------------------------------------------------------------------------------


@each(
    "text, value",
    [("0", 0), ("1_000", 1000), ("0XfF", 255), ("2k", 2048), ("0x2K", 2048), ("3m", 3 << 20)],
)
def test_numbers_are_decimal_or_hexadecimal_with_a_suffix(text: str, value: int) -> None:
    assert values.number(text) == value


@each("text", ["", "-1", "1.5", "0b1", "12x", "K", "1 K", "0x", "٣"])
def test_what_is_no_number_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match="is not a number"):
        values.number(text)


def test_a_range_is_two_numbers_and_a_colon() -> None:
    assert values.address_range("0x8004000:0x8004800") == (0x8004000, 0x8004800)
    with pytest.raises(click.BadParameter, match="START:END"):
        values.address_range("0x8004000")


@each("text", ["-0.1", "nan", "inf", "soon", ""])
def test_a_time_is_a_finite_number_of_seconds(text: str) -> None:
    assert values.seconds("0.25") == 0.25
    assert values.seconds("0") == 0.0
    with pytest.raises(click.BadParameter, match="is not a time"):
        values.seconds(text)


@each("text", ["0.01", "-1", "fast"])
def test_a_speed_is_zero_or_fast_enough_to_be_stopped(text: str) -> None:
    assert values.speed("0") == 0.0
    assert values.speed("0.1") == 0.1
    with pytest.raises(click.BadParameter):
        values.speed(text)


def test_a_count_begins_at_one() -> None:
    assert values.count("1") == 1
    with pytest.raises(click.BadParameter, match="1 or more"):
        values.count("0")


def test_targets_go_by_every_name_that_the_documents_use() -> None:
    assert [values.target(name) for name in ("wmc", "MC", "bms", "obc", "Pbu")] == [
        WMC, WMC, BMS, OBC, OBC,
    ]  # fmt: skip
    with pytest.raises(click.BadParameter) as caught:
        values.target("hmi")
    assert all(name in caught.value.message for name in TARGETS)


@each("text, read", [("a=1", ("a", "1")), ("a=", ("a", "")), ("a_1=x y=2", ("a_1", "x y=2"))])
def test_a_keyword_has_a_value(text: str, read: tuple[str, str]) -> None:
    assert values.key_value(text) == read


@each("text", ["", "a", "=1", "1=2", "./b=2.hex"])
def test_what_is_no_keyword_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match="is not KEY=VALUE"):
        values.key_value(text)


def test_a_filter_is_two_hexadecimal_numbers() -> None:
    assert can_filter("725:7ff") == {"can_id": 0x725, "can_mask": 0x7FF}
    assert can_filter("725~7FF") == {"can_id": 0x20000725, "can_mask": 0x7FF}
    for text in ("725", "725:", "x:7FF", "725:7FF:1"):
        with pytest.raises(click.BadParameter, match="is not ID:MASK"):
            can_filter(text)


# -- the bus --------------------------------------------------------------------------------------


@pytest.fixture
def configurations(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What python-can was asked to open; it opens a bus of its own instead."""
    seen: list[dict[str, Any]] = []
    open_bus: Callable[..., can.BusABC] = can.Bus

    def record(**config: Any) -> can.BusABC:
        seen.append(config)
        return open_bus(interface="virtual", channel=uuid.uuid4().hex, ignore_config=True)

    monkeypatch.setattr("can.Bus", record)
    return seen


SHORT = ("--timeout", "0.01", "--allow-outside-vector")


def test_the_image_may_stand_between_options_that_repeat(
    flasher: Flasher, configurations: list[dict[str, Any]]
) -> None:
    run = flasher(
        "flash", "-t", "obc", *SHORT, "-i", "udp_multicast", "-c", "239.74.163.2",
        "--bus-kwargs", "hop_limit=0", OBC_BIN, "--bus-kwargs", "port=43210",
    )  # fmt: skip
    assert run.code == ExitCode.NO_ANSWER
    (config,) = configurations
    assert (config["interface"], config["channel"]) == ("udp_multicast", "239.74.163.2")
    assert (config["hop_limit"], config["port"]) == (0, 43210)
    assert config["bitrate"] == 250_000


def test_bus_kwargs_given_twice_add_up(
    flasher: Flasher, configurations: list[dict[str, Any]]
) -> None:
    flasher(
        "flash", OBC_BIN, "-t", "obc", *SHORT, "-i", "virtual",
        "--bus-kwargs", "first=1", "--bus-kwargs", "second=true",
    )  # fmt: skip
    assert configurations[0]["first"] == 1
    assert configurations[0]["second"] is True


def test_filters_and_the_bit_rate_reach_python_can(
    flasher: Flasher, configurations: list[dict[str, Any]]
) -> None:
    flasher(
        "flash", "-t", "obc", *SHORT, "-i", "virtual", "-b", "125000",
        "--filter", "735:7FF", OBC_BIN,
    )  # fmt: skip
    assert configurations[0]["can_filters"] == [{"can_id": 0x735, "can_mask": 0x7FF}]
    assert configurations[0]["bitrate"] == 125_000


def test_a_bit_timing_takes_the_place_of_the_bit_rate(
    flasher: Flasher, configurations: list[dict[str, Any]]
) -> None:
    given = ("f_clock=8_000_000", "tseg1=13", "tseg2=2", "sjw=1", "brp=2", "nof_samples=1")
    timing = [word for each in given for word in ("--timing", each)]
    run = flasher("flash", "-t", "obc", *SHORT, "-i", "virtual", *timing, OBC_BIN, "--json")
    assert run.document["exit_code"] == ExitCode.NO_ANSWER
    assert configurations[0]["timing"].bitrate == 250_000
    assert "bitrate" not in configurations[0]


def test_bus_kwargs_without_a_value_are_wrong_usage(flasher: Flasher) -> None:
    run = flasher("flash", OBC_BIN, "-t", "obc", "-i", "virtual", "--bus-kwargs")
    assert run.code == ExitCode.USAGE
    run = flasher("flash", "-t", "obc", "-i", "virtual", "--bus-kwargs", OBC_BIN)
    assert run.code == ExitCode.USAGE
    assert f"'{OBC_BIN}'" in run.err


def test_a_second_value_after_an_option_that_repeats_is_wrong_usage(flasher: Flasher) -> None:
    run = flasher("flash", "--bus-kwargs", "a=1", "b=2", OBC_BIN, "-t", "obc", "-i", "virtual")
    assert run.code == ExitCode.USAGE
    assert "--bus-kwargs takes one value, and may be repeated" in run.err
    run = flasher("conformance", "--mock", "-t", "bms", "--case", "FR-01", "UP-01")
    assert run.code == ExitCode.USAGE
    assert "--case takes one value, and may be repeated" in run.err


def test_after_two_dashes_everything_is_positional(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    image = SAMPLES / "obc.bin"
    for name in ("b=2", "--bus-kwargs", "-t"):
        (tmp_path / name).write_bytes(image.read_bytes())
        run = flasher("image-info", "--json", "--", name)
        assert run.document["image"]["source"] == name


def test_the_image_options_reach_the_loader(flasher: Flasher, tmp_path: Path) -> None:
    data = tmp_path / "data.bin"
    data.write_bytes(bytes(range(256)) * 4)
    run = flasher(
        "image-info", data, "--base", "0x8004000", "--range", "0x8004100:0x8004180", "--json"
    )
    assert run.document["image"]["size_bytes"] == 0x80
    assert run.document["image"]["base"] == 0x8004100


# -- actions that are declared apart from their functions ------------------------------------------


@each("group", [station, plant])
def test_a_function_of_an_action_takes_the_options_of_its_declaration(
    group: Group, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []

    def bind(self: Actions, action: str, *args: object, **named: object) -> int:
        module, _, name = action.partition(".")
        found = import_module(f"{self._package}.{module}")
        signature(getattr(found, name)).bind(*args, **named)
        called.append(action)
        return 0

    monkeypatch.setattr(Actions, "call", bind)
    for command in group.commands.values():
        names = [str(param.name) for param in command.params if param.expose_value]
        assert command.callback is not None
        command.callback(None, **dict.fromkeys(names))
    assert len(called) == len(group.commands)
