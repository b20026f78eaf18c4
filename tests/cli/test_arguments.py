"""Arguments that commands share: numbers, targets, and python-can's own bus arguments."""

from __future__ import annotations

import argparse
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from flasher.cli import arguments
from flasher.cli.lists import gather_lists
from flasher.errors import ExitCode
from flasher.protocol.spec import BMS, OBC, TARGETS, WMC
from tests.cli.conftest import SAMPLES, Flasher

OBC_BIN = SAMPLES / "obc.bin"


# -- single values --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [("0", 0), ("1_000", 1000), ("0XfF", 255), ("2k", 2048), ("0x2K", 2048), ("3m", 3 << 20)],
)
def test_numbers_are_decimal_or_hexadecimal_with_a_suffix(text: str, value: int) -> None:
    assert arguments.number(text) == value


@pytest.mark.parametrize("text", ["", "-1", "1.5", "0b1", "12x", "K", "1 K", "0x", "٣"])
def test_what_is_no_number_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is no number"):
        arguments.number(text)


def test_a_range_is_two_numbers_and_a_colon() -> None:
    assert arguments.address_range("0x8004000:0x8004800") == (0x8004000, 0x8004800)
    with pytest.raises(argparse.ArgumentTypeError, match="START:END"):
        arguments.address_range("0x8004000")


@pytest.mark.parametrize("text", ["-0.1", "nan", "inf", "soon", ""])
def test_a_time_is_a_finite_number_of_seconds(text: str) -> None:
    assert arguments.seconds("0.25") == 0.25
    assert arguments.seconds("0") == 0.0
    with pytest.raises(argparse.ArgumentTypeError, match="is no time"):
        arguments.seconds(text)


@pytest.mark.parametrize("text", ["0.01", "-1", "fast"])
def test_a_speed_is_zero_or_fast_enough_to_be_stopped(text: str) -> None:
    assert arguments.speed("0") == 0.0
    assert arguments.speed("0.1") == 0.1
    with pytest.raises(argparse.ArgumentTypeError):
        arguments.speed(text)


def test_a_count_begins_at_one() -> None:
    assert arguments.count("1") == 1
    with pytest.raises(argparse.ArgumentTypeError, match="1 or more"):
        arguments.count("0")


def test_targets_go_by_every_name_that_the_documents_use() -> None:
    assert [arguments.target(name) for name in ("wmc", "MC", "bms", "obc", "Pbu")] == [
        WMC, WMC, BMS, OBC, OBC,
    ]  # fmt: skip
    with pytest.raises(argparse.ArgumentTypeError) as caught:
        arguments.target("hmi")
    assert all(name in str(caught.value) for name in TARGETS)


# -- lists ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("typed", "read"),
    [
        ("flash f.hex -t bms", "flash f.hex -t bms"),
        ("flash --bus-kwargs a=1 b=2 f.hex", "flash f.hex --bus-kwargs a=1 b=2"),
        ("flash --bus-kwargs a=1 -t bms f.hex", "flash -t bms f.hex --bus-kwargs a=1"),
        ("flash --bus-kwargs=a=1 f.hex", "flash f.hex --bus-kwargs a=1"),
        ("flash --bus-kwargs a=1 --bus-kwargs b=2 f", "flash f --bus-kwargs a=1 b=2"),
        ("flash --bus-kwargs a=1 ./b=2.hex", "flash ./b=2.hex --bus-kwargs a=1"),
        ("flash --filter 725:7FF 7A~7f dad.hex", "flash dad.hex --filter 725:7FF 7A~7f"),
        ("flash --timing brp=2 sjw=1 f.hex", "flash f.hex --timing brp=2 sjw=1"),
        ("flash --bus-kwargs a=1 -- b=2", "flash --bus-kwargs a=1 -- b=2"),
        ("flash -- --bus-kwargs a=1", "flash -- --bus-kwargs a=1"),
        # What is no value stays with its option, which says so.
        ("flash --bus-kwargs f.hex", "flash --bus-kwargs f.hex"),
        ("flash f.hex --bus-kwargs", "flash f.hex --bus-kwargs"),
        ("flash --bus-kwargs -t bms f.hex", "flash -t bms f.hex --bus-kwargs"),
        ("", ""),
    ],
)
def test_a_list_ends_at_the_first_word_that_is_no_value(typed: str, read: str) -> None:
    assert gather_lists(typed.split()) == read.split()


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


def test_the_image_survives_behind_bus_kwargs(
    flasher: Flasher, configurations: list[dict[str, Any]]
) -> None:
    run = flasher(
        "flash", "-t", "obc", *SHORT, "-i", "udp_multicast", "-c", "239.74.163.2",
        "--bus-kwargs", "hop_limit=0", "port=43210", OBC_BIN,
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
    timing = ["f_clock=8_000_000", "tseg1=13", "tseg2=2", "sjw=1", "brp=2", "nof_samples=1"]
    run = flasher(
        "flash", "-t", "obc", *SHORT, "-i", "virtual", "--timing", *timing, OBC_BIN, "--json"
    )
    assert run.document["exit_code"] == ExitCode.NO_ANSWER
    assert configurations[0]["timing"].bitrate == 250_000
    assert "bitrate" not in configurations[0]


def test_bus_kwargs_without_a_value_are_wrong_usage(flasher: Flasher) -> None:
    run = flasher("flash", OBC_BIN, "-t", "obc", "-i", "virtual", "--bus-kwargs")
    assert run.code == ExitCode.USAGE
    run = flasher("flash", "-t", "obc", "-i", "virtual", "--bus-kwargs", OBC_BIN)
    assert run.code == ExitCode.USAGE
    assert f"'{OBC_BIN}'" in run.err


def test_the_image_options_reach_the_loader(flasher: Flasher, tmp_path: Path) -> None:
    data = tmp_path / "data.bin"
    data.write_bytes(bytes(range(256)) * 4)
    run = flasher(
        "image-info", data, "--base", "0x8004000", "--range", "0x8004100:0x8004180", "--json"
    )
    assert run.document["image"]["size_bytes"] == 0x80
    assert run.document["image"]["base"] == 0x8004100
