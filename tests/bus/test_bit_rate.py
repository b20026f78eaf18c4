"""The one bit rate: where it comes from, and what is refused before anything is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can
import pytest

from flasher import api
from flasher.bus.bit_rate import BitRate
from flasher.bus.inspect_interface import Interface
from flasher.errors import BusError, ExitCode, UsageError
from tests.loops import each

CAN0: dict[str, Any] = {"interface": "socketcan", "channel": "can0"}
PCAN: dict[str, Any] = {"interface": "pcan", "channel": "PCAN_USBBUS1"}


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A computer without configuration, whose adapters must not be opened; its can.conf."""

    def opened(**_config: Any) -> None:
        raise AssertionError("a bus was opened")

    for name in ("CAN_BITRATE", "CAN_CONFIG", "CAN_INTERFACE", "CAN_CHANNEL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(tmp_path / "can.conf")])
    monkeypatch.setattr("can.Bus", opened)
    kernel_has(monkeypatch, None)
    return tmp_path / "can.conf"


def kernel_has(monkeypatch: pytest.MonkeyPatch, bitrate_bps: int | None) -> None:
    seen = Interface("can0", is_can=True, is_up=True, kind="can", bitrate_bps=bitrate_bps)
    monkeypatch.setattr("flasher.bus.bit_rate.read_interface", lambda _name: seen)


def test_the_dialect_holds_where_no_device_answers() -> None:
    assert api.bit_rate("welling", **PCAN) == BitRate(250_000, "the dialect's")
    assert api.bit_rate("motinova", **CAN0) == BitRate(125_000, "the dialect's")
    assert api.bit_rate() == BitRate(250_000, "the dialect's")


def test_an_option_names_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_BITRATE", "125000")
    assert api.bit_rate(**PCAN, bitrate=500_000) == BitRate(500_000, "-b")
    timing = can.BitTiming(f_clock=8_000_000, brp=1, tseg1=5, tseg2=2, sjw=1)
    assert api.bit_rate(**PCAN, timing=timing) == BitRate(1_000_000, "--timing")


@pytest.mark.parametrize(
    ("variable", "value"), [("CAN_BITRATE", "500000"), ("CAN_CONFIG", '{"bitrate": 500000}')]
)
def test_a_variable_that_differs_is_refused(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(BusError) as caught, api.connect(**PCAN):
        pass
    assert caught.value.exit_code is ExitCode.BUS
    assert f"500 kbit/s ({variable}), not 250 kbit/s (the dialect's)" in caught.value.what
    assert f"take it out of {variable}" in caught.value.remedy
    assert "-b 500000" in caught.value.remedy


def test_a_variable_that_agrees_is_the_source(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_BITRATE", "250000")
    assert api.bit_rate(**PCAN) == BitRate(250_000, "CAN_BITRATE")


@pytest.mark.parametrize(
    "setting",
    [
        "bitrate = 500000",
        "f_clock = 8000000\nbrp = 2\ntseg1 = 5\ntseg2 = 2\nsjw = 1\nnof_samples = 1",
    ],
)
def test_a_configuration_file_that_differs_is_refused_by_its_name(
    machine: Path, setting: str
) -> None:
    machine.write_text(f"[default]\ninterface = pcan\nchannel = PCAN_USBBUS1\n{setting}\n")
    with pytest.raises(BusError) as caught:
        api.bit_rate()
    assert f"500 kbit/s ({machine}), not 250 kbit/s (the dialect's)" in caught.value.what
    assert api.bit_rate(bitrate=500_000) == BitRate(500_000, "-b")


def test_on_socketcan_the_kernels_holds_and_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel_has(monkeypatch, 250_000)
    assert api.bit_rate(**CAN0) == BitRate(250_000, "the kernel's setting of can0")
    kernel_has(monkeypatch, 500_000)
    assert api.bit_rate(**CAN0, bitrate=500_000).bps == 500_000
    for bus in (CAN0, {**CAN0, "bitrate": 250_000}):
        with pytest.raises(BusError) as caught:
            api.bit_rate("welling", **bus)
        assert "500 kbit/s (the kernel's setting of can0), not 250 kbit/s" in caught.value.what
        assert "ip link set can0 type can bitrate 250000" in caught.value.remedy


@each("value", [0, -250_000, 1, 4_999, 1_000_001, 10**30, "fast", 2.5, True])
def test_what_is_no_bit_rate_is_wrong_usage(value: Any) -> None:
    with pytest.raises(UsageError, match="is not a bit rate"):
        api.bit_rate(**PCAN, bitrate=value)


def test_a_variable_that_is_no_bit_rate_is_wrong_usage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAN_BITRATE", "250k")
    with pytest.raises(UsageError, match="250k is not a bit rate") as caught:
        api.bit_rate(**PCAN)
    assert caught.value.where == "CAN_BITRATE"
