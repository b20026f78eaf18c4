"""The same two processes over SocketCAN, wherever its interfaces exist.

`vcan0` has neither bit rate nor queue. A pair `vx0`/`vx1` that is limited to 250 kbit/s and a
transmit queue of ten frames behaves as a real adapter does: a packet of 18 frames does not fit.
`tests/socketcan_vm.sh` makes both and runs these tests; the limits leave room for an emulated CPU.
"""

from __future__ import annotations

import errno
import random
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import can
import pytest

from flasher.bus.adapter import open_adapter
from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from tests.cli.conftest import SAMPLES
from tests.end_to_end.processes import (
    FLASHER,
    MockProcess,
    clean_environment,
    lines_until,
    run_flasher,
    transfer,
)
from tests.firmware import VECTORS

QUEUE_FRAMES = 64
"""Longer than any transmit queue that counts as short here."""


def exists(*names: str) -> bool:
    try:
        return all(socket.if_nametoindex(name) for name in names)
    except (OSError, AttributeError):
        return False


pytestmark = [pytest.mark.socketcan, pytest.mark.timeout(240)]
needs_vcan = pytest.mark.skipif(not exists("vcan0"), reason="there is no interface vcan0")
needs_pair = pytest.mark.skipif(not exists("vx0", "vx1"), reason="there is no pair vx0/vx1")


def figure(text: str) -> None:
    """Something measured; `pytest -rP` shows it."""
    sys.stdout.write(f"{text}\n")


def on(channel: str) -> tuple[str, ...]:
    return ("-i", "socketcan", "-c", channel)


@needs_vcan
def test_images_of_every_edge_size_arrive_over_vcan(tmp_path: Path) -> None:
    sizes = (16, 127, 128, 129)
    data = random.Random(21)
    serving = ("-t", "bms", "--save-image", "out.bin", "--upgrades", str(len(sizes)))
    with MockProcess(*serving, *on("vcan0"), folder=tmp_path) as mock:
        for size_bytes in sizes:
            transfer(mock, tmp_path, VECTORS + data.randbytes(size_bytes - 16), *on("vcan0"))
        assert mock.end() == 0


@needs_vcan
def test_nobody_on_vcan_is_exit_code_5(tmp_path: Path) -> None:
    image = str(SAMPLES / "obc.bin")
    done = run_flasher("flash", image, "-t", "obc", *on("vcan0"), "--timeout", "1", folder=tmp_path)
    assert done.returncode == ExitCode.NO_ANSWER
    assert "this run erased nothing" in done.stderr


@needs_pair
def test_an_upgrade_over_a_line_with_a_short_transmit_queue(tmp_path: Path) -> None:
    image = VECTORS + random.Random(22).randbytes(19_984)
    serving = ("-t", "bms", "--save-image", "out.bin", "--upgrades", "1", *on("vx1"))
    with MockProcess(*serving, folder=tmp_path) as mock:
        done = transfer(mock, tmp_path, image, *on("vx0"))
        figure(done.stdout)
        assert mock.end() == 0


def fill_queue(channel: str) -> int:
    """Send frames as fast as they go; how many until the queue was full, or `QUEUE_FRAMES`."""
    raw_frame = struct.pack("=IB3x8s", 0x7FF, 8, bytes(8))
    with closing(socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)) as raw:
        raw.bind((channel,))
        for sent in range(QUEUE_FRAMES):
            try:
                raw.send(raw_frame)
            except OSError as error:
                if error.errno != errno.ENOBUFS:
                    raise
                return sent
    return QUEUE_FRAMES


@needs_pair
def test_a_full_queue_is_waited_for_and_no_frame_is_lost_or_swapped() -> None:
    accepted = fill_queue("vx0")
    if accepted == QUEUE_FRAMES:
        pytest.skip("vx0 has no short transmit queue")
    link = open_adapter(250_000, interface="socketcan", channel="vx0")
    with can.Bus(interface="socketcan", channel="vx1", ignore_config=True) as hearing:
        frames = [Frame(0x752, number.to_bytes(8, "big")) for number in range(200)]
        try:
            for frame in frames:
                link.send(frame)
        finally:
            link.close()
        heard: list[bytes] = []
        while len(heard) < len(frames) and (message := hearing.recv(5.0)) is not None:
            if message.arbitration_id == frames[0].can_id:
                heard.append(bytes(message.data))
    figure(f"the queue of vx0 took {accepted} frames at once")
    assert heard == [frame.data for frame in frames]


@contextmanager
def taken_down(channel: str) -> Iterator[None]:
    down = subprocess.run(
        ["ip", "link", "set", channel, "down"], capture_output=True, text=True, check=False
    )
    if down.returncode:
        pytest.skip(f"{channel} cannot be taken down: {down.stderr}")
    try:
        yield
    finally:
        subprocess.run(["ip", "link", "set", channel, "up"], check=True)


@needs_pair
def test_an_interface_that_goes_down_ends_the_upgrade_and_says_what_is_left(tmp_path: Path) -> None:
    """BU-05."""
    (tmp_path / "image.bin").write_bytes(VECTORS + random.Random(23).randbytes(59_984))
    with (
        MockProcess("-t", "bms", *on("vx1"), folder=tmp_path) as mock,
        subprocess.Popen(
            [*FLASHER, "flash", "-t", "bms", *on("vx0"), "image.bin"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            env=clean_environment(),
        ) as host,
    ):
        assert host.stderr is not None
        lines_until(host.stderr, "transferring ...")
        mock.wait_for("first of")
        with taken_down("vx0"):
            began = time.perf_counter()
            _, said = host.communicate()
            took_s = time.perf_counter() - began
        assert host.returncode == ExitCode.BUS
        assert "State of the device: its application is erased" in said
        assert "what to do:" in said
        figure(f"the host ended {took_s:.2f} s after vx0 went down")


@needs_pair
def test_ctrl_c_on_a_real_line_ends_cleanly_and_the_device_can_be_flashed_again(
    tmp_path: Path,
) -> None:
    image = VECTORS + random.Random(24).randbytes(5_984)
    (tmp_path / "image.bin").write_bytes(image)
    # A device that waits in its transfer for ever would need a power cycle first.
    impatient = ("--set", "pause_in_transfer=announces", "--set", "transfer_timeout_s=0.5")
    serving = ("-t", "bms", "--save-image", "out.bin", *impatient, *on("vx1"))
    with MockProcess(*serving, folder=tmp_path) as mock:
        with subprocess.Popen(
            [*FLASHER, "flash", "-t", "bms", *on("vx0"), "image.bin"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            env=clean_environment(),
        ) as host:
            assert host.stderr is not None
            lines_until(host.stderr, "transferring ...")
            host.send_signal(signal.SIGINT)
            _, said = host.communicate()
        assert host.returncode == ExitCode.INTERRUPTED
        assert "State of the device: its application is erased" in said
        transfer(mock, tmp_path, image, *on("vx0"))
