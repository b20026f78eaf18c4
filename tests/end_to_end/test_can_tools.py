"""One flash, recorded by flasher, candump, tshark and python-can at once; what each has written is
read by the others, and tells the same.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ExitCode
from flasher.trace.reader import read_trace
from tests.end_to_end.forks import Device, run
from tests.end_to_end.kernel import (
    GUEST_TIMEOUT,
    Candlelights,
    figure,
    needs_candlelight,
    on,
    root,
    start,
    wait_until,
)
from tests.firmware import VECTORS

pytestmark = [pytest.mark.kernel, GUEST_TIMEOUT, needs_candlelight]
SIZE_BYTES = 6_000
SAME_S = 0.001
"""Two recordings of one bus differ by less: the times at which USB hands frames over."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `own.log`, `candump.log`, `tshark.pcapng` and `logger.db` hold one flash on can2."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "image.bin").write_bytes(VECTORS + random.Random(28).randbytes(SIZE_BYTES - 16))
    bus = Candlelights()
    for channel in (bus.tool, bus.device):
        start(channel)
    with ExitStack() as stack:
        log = stack.enter_context((folder / "candump.log").open("w"))
        listeners = [
            subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT)
            for command, output in (
                (["candump", "-L", bus.tool], log),
                (["tshark", "-q", "-i", bus.tool, "-w", "tshark.pcapng"], subprocess.DEVNULL),
                (
                    [sys.executable, "-m", "can.logger", *on(bus.tool), "-f", "logger.db"],
                    subprocess.DEVNULL,
                ),
            )
        ]
        try:
            wait_until(lambda: bound_to(bus.tool) >= len(listeners), "the recorders", limit_s=500.0)
            with Device(*on(bus.device), folder=folder):
                done = bus.flasher(
                    "flash", "image.bin", "-t", "bms", "--trace-file", "own.log", folder=folder
                )
            assert done.end() == ExitCode.OK, done.reported
            time.sleep(6.0)  # python-can's logger writes after a quarter of a second without frames
        finally:
            for listener in listeners:
                listener.send_signal(signal.SIGINT)
                listener.wait()
    return folder


def bound_to(channel: str) -> int:
    """Programs that receive what this interface carries, other than flasher's."""
    lists = [Path(f"/proc/net/can/rcvlist_{kind}") for kind in ("all", "fil", "inv", "sff")]
    packets = Path("/proc/net/packet").read_text().splitlines()[1:]
    lines = [line for each in lists for line in each.read_text().splitlines()]
    heard = sum(line.split()[:1] == [channel] for line in lines)
    return heard + bool(packets)


def frames(path: Path) -> dict[int, list[bytes]]:
    """What was on the bus, by the id; error frames are no frames."""
    found: dict[int, list[bytes]] = {}
    for _, frame in read_trace(path):
        if not frame.is_error:
            found.setdefault(frame.can_id, []).append(frame.data)
    return found


def story(name: str, folder: Path) -> dict[str, Any]:
    """What `flasher explain` makes of it."""
    done = run("explain", "--json", name, folder=folder)
    assert done.end() == ExitCode.OK, done.reported
    printed = json.loads(done.stdout)["story"]
    assert isinstance(printed, dict)
    return printed


def words_of(printed: dict[str, Any]) -> tuple[object, ...]:
    """The description of an upgrade, without its times."""
    upgrade = printed["upgrades"][0]
    return (
        printed["verdict"]["cause"],
        [(packet["number"], packet["tries"], packet["naks"]) for packet in upgrade["packets"]],
        [phase["phase"] for phase in upgrade["phases"]],
    )


@pytest.mark.parametrize("name", ["candump.log", "tshark.pcapng", "logger.db"])
def test_what_others_recorded_is_what_flasher_recorded(folder: Path, name: str) -> None:
    assert frames(folder / name) == frames(folder / "own.log")
    assert words_of(story(name, folder)) == words_of(story("own.log", folder))


def test_a_log_names_the_interface_as_candump_does(folder: Path) -> None:
    names = {
        line.split()[1]
        for name in ("own.log", "candump.log")
        for line in (folder / name).read_text().splitlines()
    }
    assert len(names) == 1
    assert names.pop().startswith("can")


def test_figures_are_the_same_whether_stamps_are_of_the_hand_over_or_of_the_end(
    folder: Path,
) -> None:
    own, other = story("own.log", folder), story("candump.log", folder)
    ours, theirs = own["upgrades"][0]["link"], other["upgrades"][0]["link"]
    for name in ("host_turnaround", "device_answer"):
        own_s, other_s = ours[name]["median_s"], theirs[name]["median_s"]
        figure(f"{name}: {own_s * 1000:.2f} ms of ours, {other_s * 1000:.2f} ms of candump")
        assert own_s == pytest.approx(other_s, abs=SAME_S)
    assert ours["transfer_s"] == pytest.approx(theirs["transfer_s"], rel=0.02)
    assert ours["share_of_line_rate"] == pytest.approx(theirs["share_of_line_rate"], rel=0.02)


@pytest.mark.parametrize("name", ["own.log", "candump.log"])
def test_log2asc_and_back_lose_nothing(folder: Path, name: str) -> None:
    channel = (folder / name).read_text().split()[1]
    there, back = f"{name}.asc", f"{name}.asc.log"
    root(f"cd {folder} && log2asc -I {name} -O {there} {channel} && asc2log -I {there} -O {back}")
    for made in (there, back):
        assert frames(folder / made) == frames(folder / name)
        assert words_of(story(made, folder)) == words_of(story(name, folder))


def test_canplayer_plays_a_trace_that_another_flasher_understands(folder: Path) -> None:
    channel = (folder / "own.log").read_text().split()[1]
    with (folder / "played.log").open("w") as log:
        listener = subprocess.Popen(["candump", "-L", "vcan0"], stdout=log)
        try:
            wait_until(lambda: bound_to("vcan0") > 0, "candump")
            root(f"canplayer -I {folder}/own.log vcan0={channel}")
        finally:
            listener.terminate()
            listener.wait()
    assert frames(folder / "played.log") == frames(folder / "own.log")
    assert words_of(story("played.log", folder)) == words_of(story("own.log", folder))


@pytest.mark.parametrize("name", ["own.log", "candump.log", "tshark.pcapng"])
def test_tshark_names_the_messages_by_the_dissector(folder: Path, name: str) -> None:
    script = f"{name}.lua"
    run("export", "wireshark", "-o", script, folder=folder)
    shown = root(
        f"cd {folder} && tshark -X lua_script:{script} -r {name} -Y welling.message "
        "-T fields -e welling.message 2>/dev/null"
    ).splitlines()
    packets = len(story(name, folder)["upgrades"][0]["packets"])
    assert shown.count("packet") == packets == -(-SIZE_BYTES // 128)
    assert shown.count("ACK") == packets
    assert {"reset", "boot version", "update command", "request transfer", "complete"} <= {*shown}


def test_cantools_decodes_the_joined_messages(folder: Path) -> None:
    run("export", "dbc", "-o", "welling.dbc", folder=folder)
    run("export", "trace", "candump.log", "--joined", "-o", "joined.log", folder=folder)
    printed = root(f"cd {folder} && {sys.executable} -m cantools decode welling.dbc < joined.log")
    packets = -(-SIZE_BYTES // 128)
    assert printed.count("command: packet") == printed.count("command: ACK") == packets
    assert "update_command_size_bytes: 6000 B" in printed
