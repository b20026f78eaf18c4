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
from tests.end_to_end.forks import Device, Forked, run
from tests.end_to_end.kernel import GUEST_TIMEOUT, figure, on, root
from tests.firmware import VECTORS

QUEUE_FRAMES = 64
"""Longer than any transmit queue that counts as short here."""


def exists(*names: str) -> bool:
    try:
        return all(socket.if_nametoindex(name) for name in names)
    except (OSError, AttributeError):
        return False


pytestmark = [pytest.mark.kernel, GUEST_TIMEOUT]
needs_vcan = pytest.mark.skipif(not exists("vcan0"), reason="there is no interface vcan0")
needs_pair = pytest.mark.skipif(not exists("vx0", "vx1"), reason="there is no pair vx0/vx1")


def transfer(device: Device, folder: Path, image: bytes, channel: str) -> Forked:
    """Flash `image` and see that the device stored the same bytes."""
    (folder / "image.bin").write_bytes(image)
    done = run("flash", "-t", "bms", *on(channel), "image.bin", folder=folder)
    assert done.end() == ExitCode.OK, done.reported
    device.until("image:")
    assert (folder / "out.bin").read_bytes() == image
    return done


@needs_vcan
def test_images_of_every_edge_size_arrive_over_vcan(tmp_path: Path) -> None:
    sizes = (16, 127, 128, 129)
    data = random.Random(21)
    with Device("--upgrades", str(len(sizes)), *on("vcan0"), folder=tmp_path) as device:
        for size_bytes in sizes:
            transfer(device, tmp_path, VECTORS + data.randbytes(size_bytes - 16), "vcan0")
        assert device.end() == 0


@needs_vcan
def test_no_device_on_vcan_is_exit_code_5(tmp_path: Path) -> None:
    image = str(SAMPLES / "obc.bin")
    done = run("flash", image, "-t", "obc", *on("vcan0"), "--timeout", "1", folder=tmp_path)
    assert done.end() == ExitCode.NO_ANSWER, done.reported
    assert "this run erased nothing" in done.stderr


@needs_pair
def test_an_upgrade_over_a_line_with_a_short_transmit_queue(tmp_path: Path) -> None:
    image = VECTORS + random.Random(22).randbytes(19_984)
    with Device("--upgrades", "1", *on("vx1"), folder=tmp_path) as device:
        done = transfer(device, tmp_path, image, "vx0")
        figure(done.stdout)
        assert device.end() == 0


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
        root(f"ip link set {channel} up")


@needs_pair
def test_an_interface_that_goes_down_ends_the_upgrade_and_states_what_is_left(
    tmp_path: Path,
) -> None:
    """BU-05."""
    (tmp_path / "image.bin").write_bytes(VECTORS + random.Random(23).randbytes(59_984))
    with (
        Device(*on("vx1"), folder=tmp_path) as device,
        Forked("flash", "-t", "bms", *on("vx0"), "image.bin", folder=tmp_path) as host,
    ):
        host.until("transferring ...")
        device.until("first of")
        with taken_down("vx0"):
            began = time.perf_counter()
            assert host.end() == ExitCode.BUS
            took_s = time.perf_counter() - began
        assert "State of the device: its application is erased" in host.stderr
        assert "what to do:" in host.stderr
        figure(f"the host ended {took_s:.2f} s after vx0 went down")


@needs_pair
def test_ctrl_c_on_a_real_line_ends_cleanly_and_the_device_can_be_flashed_again(
    tmp_path: Path,
) -> None:
    image = VECTORS + random.Random(24).randbytes(5_984)
    (tmp_path / "image.bin").write_bytes(image)
    # A device that waits in its transfer for ever would need a power cycle first.
    impatient = ("--set", "pause_in_transfer=announces", "--set", "transfer_timeout_s=0.5")
    with Device(*impatient, *on("vx1"), folder=tmp_path) as device:
        with Forked("flash", "-t", "bms", *on("vx0"), "image.bin", folder=tmp_path) as host:
            host.until("transferring ...")
            host.signal(signal.SIGINT)
            assert host.end() == ExitCode.INTERRUPTED
        assert "State of the device: its application is erased" in host.stderr
        transfer(device, tmp_path, image, "vx0")
