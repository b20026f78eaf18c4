"""`flasher mock` on a bus in memory: a single device and a whole bicycle, and what is printed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from flasher.api import Connection
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.host.options import UpgradeOptions
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, Dialect
from flasher.protocol.timing import Timings
from tests.cli.conftest import Flasher
from tests.host.upgrade import Upgrade
from tests.peers.wording import build, payloads

IMAGE = b"V2r0r0_20260101".ljust(300, b"\x5a")
WRITE, READ = 0x16, 0x11


class Tool:
    """Sends a message every 0.1 s, then nothing; keeps every frame that it hears."""

    done = False

    def __init__(self, *messages: tuple[int, int, int, bytes]) -> None:
        self.heard: list[Frame] = []
        self.reported = 0
        self._frames = [
            (0.1 * (index + 1), Frame(message[0], payload))
            for index, message in enumerate(messages)
            for payload in payloads(build(*message))
        ]

    def receive(self, frame: Frame, now: float) -> None:
        self.heard.append(frame)

    def tick(self, now: float) -> None:
        pass

    def deadline(self) -> float | None:
        return self._frames[0][0] if self._frames else None

    def next_frame(self, now: float) -> Frame | None:
        return self._frames[0][1] if self._frames and self._frames[0][0] <= now else None

    def frame_sent(self, now: float) -> None:
        del self._frames[0]

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> list[object]:
        return []


Serve = Callable[[Engine, float], list[dict[str, Any]]]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Serve:
    """Puts engines on the bus that the mock serves, and interrupts it at a time of that bus."""

    def prepare(engine: Engine, until_s: float) -> list[dict[str, Any]]:
        opened: list[dict[str, Any]] = []
        clock = VirtualClock()

        @contextmanager
        def connect(dialect: Dialect, **bus: Any) -> Iterator[Connection]:
            wire = SimulatedBus(dialect.bitrate_bps, clock)
            wire.attach(engine)
            opened.append({"dialect": dialect.name, **bus})
            yield Connection(wire.link(), clock, "a bus in memory")

        @contextmanager
        def interrupted() -> Iterator[Callable[[], bool]]:
            yield lambda: clock.now() >= until_s

        monkeypatch.setattr("flasher.api.connect", connect)
        monkeypatch.setattr("flasher.cli.bench.mock.stop_on_signal", interrupted)
        return opened

    return prepare


def an_upgrade() -> Upgrade:
    """A host that gives the device the time that it takes to be seen on the bus."""
    options = UpgradeOptions(timings=Timings(boot_version_timeout_s=10.0))
    return Upgrade(plan(Image.from_bytes(IMAGE), BMS, WELLING.bitrate_bps), options)


@pytest.mark.parametrize("words", [(), ("--system",)], ids=["alone", "system"])
def test_an_upgrade_is_received_printed_and_saved(
    flasher: Flasher, serve: Serve, tmp_path: Path, words: tuple[str, ...]
) -> None:
    serve(an_upgrade(), 60.0)
    saved = tmp_path / "received.bin"
    run = flasher("mock", "-t", "bms", *words, "--save-image", saved, "--upgrades", "1")
    assert (run.code, saved.read_bytes()) == (0, IMAGE)
    assert "state:   erasing: for 300 bytes in 3 packets\n" in run.out
    assert "packets: all 3 stored\n" in run.out
    assert f"saved:   {saved}\n" in run.out
    served = "a whole bicycle" if words else "BMS"
    assert f"{served} on a bus in memory" in run.err


def test_the_dialect_decides_the_bit_rate_and_what_is_answered(
    flasher: Flasher, serve: Serve
) -> None:
    tool = Tool((0x742, READ, 0x5000, b""))
    opened = serve(tool, 1.0)
    assert flasher("mock", "-t", "bms", "--dialect", "motinova").code == 0
    assert {frame.can_id for frame in tool.heard} == {0x720}
    assert opened[0]["dialect"] == "motinova"
    tool = Tool((0x742, READ, 0x5000, b""))
    serve(tool, 1.0)
    assert flasher("mock", "-t", "bms").code == 0
    assert tool.heard == []


def test_a_write_is_printed_with_its_old_and_new_value(flasher: Flasher, serve: Serve) -> None:
    serve(
        Tool(
            (0x752, WRITE, 0x4110, b"W2605999.       "),
            (0x752, WRITE, 0x3A10, b"\x1b[2Jhello.       "[:16]),
        ),
        1.0,
    )
    run = flasher("mock", "-t", "bms")
    assert "written: serial number: W2605999 (before: W2605001)\n" in run.out
    assert "written: user string 1: \\x1b[2Jhello (before: empty)\n" in run.out


def test_events_are_json_lines_when_asked_for(flasher: Flasher, serve: Serve) -> None:
    serve(Tool((0x752, WRITE, 0x4110, b"W2605999.       ")), 1.0)
    run = flasher("mock", "-t", "bms", "--json")
    lines = [json.loads(line) for line in run.out.splitlines()]
    (written,) = [line for line in lines if line.get("event") == "DeviceWritten"]
    assert written["text"] == "serial number: W2605999 (before: W2605001)"


def test_the_whole_bicycle_talks_without_being_asked(flasher: Flasher, serve: Serve) -> None:
    tool = Tool()
    serve(tool, 3.0)
    assert flasher("mock", "-t", "wmc", "--system", "--dialect", "motinova").code == 0
    assert {frame.can_id for frame in tool.heard} == {0x712, 0x720, 0x721, 0x732, 0x742}


def test_a_device_alone_is_silent_until_asked(flasher: Flasher, serve: Serve) -> None:
    tool = Tool()
    serve(tool, 3.0)
    assert flasher("mock", "-t", "wmc").code == 0
    assert tool.heard == []


def test_without_an_application_it_announces_itself_within_the_bicycle(
    flasher: Flasher, serve: Serve
) -> None:
    tool = Tool()
    serve(tool, 2.0)
    assert flasher("mock", "-t", "obc", "--system", "--no-app").code == 0
    heard = {frame.can_id for frame in tool.heard}
    assert 0x735 in heard
    assert 0x732 not in heard


@pytest.mark.slow
def test_faults_and_an_idle_shutdown_can_be_set(flasher: Flasher, serve: Serve) -> None:
    tool = Tool()
    serve(tool, 2000.0)
    run = flasher("mock", "-t", "bms", "--set", "idle_shutdown=on", "--set", "battery_use=resting")
    assert "power:   SHUTDOWN sent: bus idle\n" in run.out
    assert "power:   off; ready: none; no answer from WMC, OBC\n" in run.out
    assert "state:   off\n" in run.out
    tool = Tool()
    serve(tool, 1.05)
    flasher("mock", "-t", "bms", "--set", "faults=0x10000")
    assert sum(frame.data[4:6] == b"\x12\x04" for frame in tool.heard) == 6


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("--set", "faults"), "write KEY=VALUE"),
        (("--set", "falts=1"), "Did you mean faults"),
        (("--set", "silent_queries=38G0"), "is not a command"),
        (("--set", "dialect=klingon"), "dialect cannot be"),
    ],
)
def test_choices_that_make_no_sense_are_wrong_usage(
    flasher: Flasher, serve: Serve, words: tuple[str, ...], problem: str
) -> None:
    serve(Tool(), 1.0)
    run = flasher("mock", "-t", "bms", *words)
    assert run.code == 2
    assert problem in run.err
