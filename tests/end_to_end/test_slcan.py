"""python-can's real slcan at a pseudo terminal, with an adapter that says anything, or nothing.

Everything takes real time here; `python -m tests.campaigns.slcan` has more of it.
"""

from __future__ import annotations

import itertools
import json
import random
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pty", reason="there are no pseudo terminals here")

from flasher import api, events
from flasher.bus.link import Link
from flasher.bus.lock import acquire
from flasher.errors import BusError, ErrorCode, ExitCode, TransmitBlockedError
from flasher.host.options import UpgradeOptions
from flasher.host.session import Result
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.end_to_end.lawicel import ERROR, Damage, Lawicel, Program
from tests.end_to_end.processes import run_flasher
from tests.end_to_end.stage import SMALL, image_of

pytestmark = pytest.mark.slow

IMAGE = image_of(8)
HASTY = UpgradeOptions(timings=replace(DEFAULT_TIMINGS, ack_timeout_s=0.1), adapter_return_s=2.0)


@pytest.fixture
def adapter(tmp_path: Path) -> Iterator[Lawicel]:
    with Lawicel(tmp_path / "port") as plugged:
        yield plugged


class Flashed:
    """One upgrade over the adapter, the device on its other side, and what was reported."""

    def __init__(self, adapter: Lawicel, options: UpgradeOptions = HASTY) -> None:
        self.device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=SMALL)
        self.seen: list[object] = []
        self.error: BusError | None = None
        self.result: Result | None = None
        with (
            adapter.device(self.device),
            api.connect(interface="slcan", channel=str(adapter.port), sleep_after_open=0.0) as bus,
        ):
            try:
                self.result = bus.device("bms").upgrade(
                    IMAGE, options=options, on_event=self.seen.append
                )
            except BusError as error:
                self.error = error
            self.health = bus.link.health()

    @property
    def is_good(self) -> bool:
        """Claimed, and true."""
        claimed = self.result is not None and self.result.exit_code is ExitCode.OK
        assert not claimed or self.device.stored_image == IMAGE.data
        return claimed


def test_an_upgrade_over_an_adapter_that_follows_its_manual(adapter: Lawicel) -> None:
    flashed = Flashed(adapter)
    assert flashed.is_good
    assert flashed.health.unreadable == 0
    assert adapter.program.commands == [b"C", b"S5", b"", b"O", b"O", b"C"]
    assert not adapter.program.is_open


def test_damaged_lines_are_counted_and_sent_again(adapter: Lawicel) -> None:
    damage = adapter.damage = Damage(0.08, seed=3)
    flashed = Flashed(adapter, replace(HASTY, attempts=9))
    assert flashed.is_good
    assert damage.lines > 5
    assert 0 < flashed.health.unreadable <= 3 * damage.lines


def test_lines_in_pieces_and_with_time_stamps_are_understood(adapter: Lawicel) -> None:
    adapter.is_slow = adapter.program.has_stamps = True
    flashed = Flashed(adapter)
    assert flashed.is_good
    assert flashed.health.unreadable == 0


def test_an_adapter_that_confirms_nothing_or_refuses_frames_is_overcome(adapter: Lawicel) -> None:
    draw = random.Random(4)
    adapter.program.confirms_frames = False
    adapter.program.refuses = lambda: draw.random() < 0.01
    flashed = Flashed(adapter)
    assert flashed.is_good
    assert flashed.health.refused > 0


def test_an_adapter_that_restarts_with_its_channel_closed_is_opened_again(
    adapter: Lawicel,
) -> None:
    def restart() -> None:
        adapter.program.is_open = False

    adapter.at_frame[100] = restart
    flashed = Flashed(adapter)
    assert flashed.is_good
    (lost,) = (event for event in flashed.seen if isinstance(event, events.AdapterLost))
    assert "refused to send 36 frames in a row" in lost.reason


def test_an_adapter_that_is_pulled_out_and_plugged_in_again_goes_on(adapter: Lawicel) -> None:
    adapter.at_frame[100] = lambda: adapter.pull(0.3)
    flashed = Flashed(adapter)
    assert flashed.is_good
    kinds = [type(event) for event in flashed.seen]
    assert events.AdapterLost in kinds
    assert events.AdapterBack in kinds


def test_an_adapter_that_is_back_under_another_name_is_locked_there(
    adapter: Lawicel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The link leads to the new port; the lock is on what it leads to."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    options: dict[str, Any] = {"interface": "slcan", "sleep_after_open": 0.0}
    with api.connect(channel=str(adapter.port), **options) as bus, Lawicel(tmp_path / "x") as other:
        first = adapter.port.resolve()
        adapter.pull()
        with pytest.raises(BusError, match="could not open port"):
            bus.link.reopen()
        adapter.port.symlink_to(other.port.resolve())
        bus.link.reopen()
        with pytest.raises(BusError, match="in use by a program"):
            acquire({"channel": str(other.port), **options}, "another")
        acquire({"channel": str(first), **options}, "another")()
    acquire({"channel": str(other.port), **options}, "another")()


def test_an_adapter_that_is_pulled_out_for_good_ends_it_with_the_state_of_the_device(
    adapter: Lawicel,
) -> None:
    adapter.at_frame[100] = adapter.pull
    began = time.perf_counter()
    flashed = Flashed(adapter, replace(HASTY, adapter_return_s=0.5))
    assert time.perf_counter() - began < 5.0
    assert flashed.error is not None
    assert flashed.error.code is ErrorCode.ADAPTER_LOST
    assert flashed.error.needs_rescue
    assert "could not open port" in flashed.error.what
    assert "failed while" not in flashed.error.what
    assert "it was lost with: The adapter failed while" in flashed.error.cause


def test_an_adapter_whose_serial_speed_is_another_is_named_as_the_cause(adapter: Lawicel) -> None:
    draw = random.Random(1)
    adapter.damage = lambda line: bytes(draw.randrange(128, 256) for _ in line[:-1]) + b"\r"
    timings = replace(HASTY.timings, boot_version_timeout_s=0.3, command_timeout_s=0.3)
    flashed = Flashed(adapter, replace(HASTY, timings=timings, attempts=1))
    assert flashed.error is not None
    assert "The adapter delivers unreadable data" in flashed.error.what
    assert not flashed.error.needs_rescue


def test_an_adapter_that_takes_nothing_ends_a_send_in_bounded_time(
    adapter: Lawicel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.bus.adapter.SEND_LIMIT_S", 0.1)
    began = time.perf_counter()

    def fill(link: Link) -> None:
        for _ in range(10_000):
            link.send(Frame(0x752, bytes(8)))

    with (
        api.connect(interface="slcan", channel=str(adapter.port), sleep_after_open=0.0) as bus,
        pytest.raises(TransmitBlockedError) as caught,
    ):
        fill(bus.link)
    assert "the adapter hangs" in caught.value.cause
    assert "plug it in again" in caught.value.remedy
    assert time.perf_counter() - began < 5.0


def test_the_adapter_of_the_tests_refuses_what_the_manual_does_not_allow() -> None:
    program = Program()

    def answers(*lines: bytes) -> list[bytes]:
        return [answer for line in lines for answer, _ in program.take(line + b"\r")]

    frame = b"t7521AB"
    assert answers(b"O", b"C", b"F", b"Z2", b"S9", b"x", frame) == [ERROR] * 7
    assert answers(b"V", b"N", b"S5", b"O", b"F", b"") == [
        b"V1013\r", b"NA123\r", b"\r", b"\r", b"F00\r", b"\r"
    ]  # fmt: skip
    assert answers(b"O", b"S5", b"Z1", b"t7529", b"t75", b"tFFF0", b"t7521A", b"r7521A") == (
        [ERROR] * 8
    )
    assert list(program.take(frame + b"\r" + b"T0000075")) == [(b"z\r", Frame(0x752, b"\xab"))]
    assert list(program.take(b"20\r")) == [(b"Z\r", Frame(0x752, b"", is_extended=True))]
    assert answers(b"C", b"L", frame) == [b"\r", b"\r", ERROR]


# -- as a user has it ------------------------------------------------------------------------------


def flash(adapter: Lawicel, *more: str) -> subprocess.CompletedProcess[str]:
    """`flasher flash` as a process, on the adapter with a device."""
    folder = adapter.port.parent
    (folder / "image.bin").write_bytes(IMAGE.data)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=SMALL)
    bus = ("-i", "slcan", "-c", str(adapter.port), "--bus-kwargs", "sleep_after_open=0")
    with adapter.device(device):
        return run_flasher("flash", "image.bin", "-t", "bms", *bus, *more, folder=folder)


def test_a_user_learns_of_damaged_lines(adapter: Lawicel) -> None:
    count = itertools.count(1)

    def damage(line: bytes) -> bytes:
        return line + b"t72\r" if next(count) % 20 == 0 else line

    adapter.damage = damage
    run = flash(adapter, "--json", "--no-bundle")
    assert run.returncode == ExitCode.OK
    link = json.loads(run.stdout)["link"]
    assert link["unreadable"] > 1
    assert f"{link['unreadable']} times the adapter delivered unreadable frames" in run.stderr


def test_a_user_learns_how_to_go_on_when_the_adapter_is_gone(adapter: Lawicel) -> None:
    adapter.at_frame[100] = adapter.pull
    run = flash(adapter, "--adapter-wait", "0.5", "--no-bundle")
    assert run.returncode == ExitCode.BUS
    assert "Waiting 0.5 s for the adapter ..." in run.stderr
    assert "State of the device: " in run.stderr
    assert "flasher rescue image.bin -t bms" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("words", [("info", "-t", "bms"), ("read", "serial-number", "-t", "bms")])
def test_a_user_learns_that_the_adapter_sends_nothing(
    adapter: Lawicel, words: tuple[str, ...]
) -> None:
    adapter.program.refuses = lambda: True
    bus = ("-i", "slcan", "-c", str(adapter.port), "--bus-kwargs", "sleep_after_open=0")
    with adapter.device(MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps)):
        run = run_flasher(*words, *bus, "--no-bundle", folder=adapter.port.parent)
    assert run.returncode == ExitCode.BUS
    assert "The adapter refused to send" in run.stderr
    assert "[E404]" in run.stderr


def test_a_user_learns_of_refused_frames(adapter: Lawicel) -> None:
    count = itertools.count(1)
    adapter.program.refuses = lambda: next(count) == 60
    run = flash(adapter, "--json", "--no-bundle")
    assert run.returncode == ExitCode.OK
    assert json.loads(run.stdout)["link"]["refused"] == 1
    assert "warning: 1 frame refused by the adapter; try --frame-gap 0.001" in run.stderr
