"""A firmware sample does not reach a real device, through no door and with nothing waived."""

from __future__ import annotations

import asyncio
import io
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

import flasher as library
from flasher import api
from flasher.bus.simulated import SimulatedLink
from flasher.conformance.bench_options import BenchOptions, open_bench
from flasher.errors import ErrorCode, ExitCode, ImageError
from flasher.host.waivers import WAIVERS
from flasher.web.bench import BenchController
from flasher.web.virtual_bike import BikeFault
from tests.cli.conftest import SAMPLES, Flasher
from tests.cli.station_threads import ThreadPort
from tests.web.bench_place import BenchPlace, order

CHANNEL = "doors"
ON = ("-i", "virtual", "-c", CHANNEL)
BMS = SAMPLES / "bms.hex"
RECIPE = SAMPLES / "station" / "recipe.toml"
EVERYTHING = ("--force", *(f"--allow-{name}" for name in sorted(WAIVERS)))


@pytest.fixture(autouse=True)
def no_command_sends(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Listens at a bus that counts as a real one."""
    for place in ("bus.adapter", "station.adapters", "cli.upgrade.bench_page"):
        monkeypatch.setattr(f"flasher.{place}.is_physical", lambda *_: True)
    monkeypatch.setattr(SimulatedLink, "is_physical", True)
    with can.Bus(CHANNEL, interface="virtual", ignore_config=True) as bus:
        yield
        assert bus.recv(0) is None


@pytest.mark.parametrize(
    "words",
    [
        ("flash", BMS, "-t", "bms"),
        ("flash", SAMPLES / "wmc.s19", "-t", "wmc", *EVERYTHING),
        ("flash", SAMPLES / "obc.elf", "-t", "obc", *EVERYTHING, "--verify", "none"),
        ("flash", BMS, "-t", "bms", *EVERYTHING, "--format", "bin"),
        ("flash", BMS, "-t", "bms", *EVERYTHING, "--range", "0x08008000:0x08008400"),
        ("flash", SAMPLES / "bad" / "text.bin", "-t", "bms", *EVERYTHING),
        ("rescue", BMS, "-t", "bms", *EVERYTHING),
        ("conformance", "-t", "bms", "--good-image", BMS, "--yes"),
        ("conformance", "init", "-t", "bms", "--good-image", BMS, "-o", "p.toml", "--yes"),
    ],
)
def test_no_command_sends_one(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[Any, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    run = flasher(*words, *ON)
    assert run.code == ExitCode.IMAGE, run.err
    assert "is a firmware sample: no device can run it. [E309]" in run.err
    assert f"virtual {CHANNEL}" in run.err


def test_no_manifest_and_no_profile_lets_one_through(flasher: Flasher, tmp_path: Path) -> None:
    image, profile = tmp_path / "firmware.hex", tmp_path / "p.toml"
    image.write_bytes(BMS.read_bytes())
    profile.write_text('cpu = "other"\n')
    assert flasher("manifest", "create", image, "-t", "bms").code == ExitCode.OK
    run = flasher("flash", image, "-t", "bms", "--profile", profile, *EVERYTHING, *ON)
    assert run.code == ExitCode.IMAGE
    assert "[E309]" in run.err


def refused(call: Callable[[], object]) -> None:
    with pytest.raises(ImageError) as caught:
        call()
    assert caught.value.code is ErrorCode.IMAGE_SAMPLE


@pytest.mark.slow
def test_no_program_sends_one() -> None:
    image = library.load(BMS)
    bus: dict[str, Any] = {"interface": "virtual", "channel": CHANNEL}
    refused(lambda: library.flash(BMS, "bms", **bus))
    refused(lambda: library.flash(image, "bms", **bus))
    with api.connect(**bus) as connection:
        device = connection.device("bms")
        waiting = connection.async_device("bms")
        plan = device.plan(image)
        refused(lambda: device.flash(BMS))
        refused(lambda: device.rescue(image))
        refused(lambda: device.upgrade(plan))
        refused(lambda: asyncio.run(waiting.flash(BMS)))
        refused(lambda: asyncio.run(waiting.rescue(BMS)))
        refused(lambda: asyncio.run(waiting.upgrade(plan)))


def test_no_conformance_run_of_pytest_sends_one() -> None:
    bus: dict[str, Any] = {"interface": "virtual", "channel": CHANNEL}
    for second in (None, str(SAMPLES / "obc.bin")):
        options = BenchOptions("bms", good_image=str(BMS), second_image=second, bus=bus)
        with pytest.raises(ImageError) as caught, open_bench(options):
            pass
        assert caught.value.code is ErrorCode.IMAGE_SAMPLE


def test_no_station_begins_with_one(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    sockets = tmp_path / "sockets.toml"
    sockets.write_text(f'[[socket]]\nname = "A"\ninterface = "virtual"\nchannel = "{CHANNEL}"\n')
    for words in (
        ("check", RECIPE, "--sockets", sockets),
        ("run", "--recipe", RECIPE, "--sockets", sockets, "--database", tmp_path / "r.sqlite"),
    ):
        run = flasher("station", *words)
        assert run.code == ExitCode.IMAGE, run.err
        assert "[E309]" in run.err
        assert f"socket A, virtual {CHANNEL}" in run.err


@pytest.mark.slow
def test_the_bench_page_neither_offers_nor_sends_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = BenchPlace(tmp_path)
    (tmp_path / "sample.hex").write_bytes(BMS.read_bytes())
    looked = (
        order(BenchController.use_adapter, BikeFault.NONE.value),
        order(BenchController.choose_target, "bms"),
    )
    state = place.do(*looked)
    offer = next(each for each in state.offers if each.name == "sample.hex")
    assert offer.refusal is None, "a virtual bike takes it"
    done = place.do(
        order(BenchController.choose_image, offer.name),
        lambda bench: bench.upgrade(bench.state.selection),
    ).done
    assert done is not None
    assert done.error is not None
    assert done.error.code is ErrorCode.IMAGE_SAMPLE, "the upgrade itself looks again"
    monkeypatch.setattr(type(place.bikes), "is_physical", lambda *_: True)
    state = place.do(BenchController.start_over, *looked)
    offer = next(each for each in state.offers if each.name == "sample.hex")
    assert offer.refusal is not None
    assert offer.refusal.code is ErrorCode.IMAGE_SAMPLE
    assert not offer.refusal.waiver
