"""Every command that flasher prints about an interface of Linux is typed as printed, has to
succeed, and has to help.
"""

from __future__ import annotations

import random
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from tests.end_to_end.forks import Device, Forked, run
from tests.end_to_end.kernel import (
    GUEST_TIMEOUT,
    Candlelights,
    Pair,
    background,
    figure,
    needs_candlelight,
    needs_sja1000,
    on,
    root,
    shell,
    sja1000_pair,
    start,
)
from tests.firmware import VECTORS

pytestmark = [pytest.mark.kernel, GUEST_TIMEOUT]
PROGRAMS = ("ip", "dmesg", "flasher")
QUOTED = re.compile(r"`([^`]+)`")
NAMED = re.compile(r"\bflasher ([a-z]+(?:-[a-z]+)*)\b")
OK, BUS = ExitCode.OK, ExitCode.BUS
NO_COMMAND = {"waits"}
"""What `flasher` itself does in a sentence."""
HOW_IT_ENDS = {"monitor": "--duration 1"}
"""What a command that goes on until Ctrl-C is given besides."""


def commands_in(printed: str) -> list[str]:
    """Commands in quotes, or alone in a line, in the order of the text."""
    found: list[str] = []
    for line in printed.splitlines():
        candidates = QUOTED.findall(line) or [line.strip()]
        if line.startswith(("warning", "note")):
            candidates = QUOTED.findall(line)
        found += [each for each in candidates if each.partition(" ")[0] in PROGRAMS]
    return found


class Reader:
    """Somebody who types what is printed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def types(self, command: str, code: int = OK) -> Forked | None:
        """One command, which has to end so."""
        words = shlex.split(command)
        figure(f"$ {command}")
        if words[0] != "flasher":
            done = shell(command)
            assert done.returncode == code, f"{command}: {done.stderr}"
            return None
        words += HOW_IT_ENDS.get(words[1], "").split()
        ran = run(*words[1:], folder=self._folder)
        assert ran.end() == code, f"{command}: {ran.reported}"
        return ran

    def obeys(self, done: Forked, *, but: dict[str, int] | None = None) -> list[str]:
        """All commands that were printed; `but` are exit codes of commands that begin so. What is
        only mentioned has to exist.
        """
        for name in sorted({*NAMED.findall(done.reported)} - NO_COMMAND):
            self.types(f"flasher {name} --help")
        printed = commands_in(done.reported)
        for command in printed:
            codes = [code for begin, code in (but or {}).items() if command.startswith(begin)]
            self.types(command, codes[0] if codes else OK)
        return printed


@pytest.fixture
def reader(tmp_path: Path) -> Reader:
    (tmp_path / "image.bin").write_bytes(VECTORS + random.Random(26).randbytes(4_080))
    return Reader(tmp_path)


@pytest.fixture(
    params=[
        pytest.param("gs_usb", marks=needs_candlelight),
        pytest.param("sja1000", marks=needs_sja1000),
    ]
)
def bus(request: pytest.FixtureRequest) -> Pair:
    """Adapters that are both started, each kind with its own driver."""
    pair = Candlelights() if request.param == "gs_usb" else sja1000_pair()
    for channel in (pair.tool, pair.device):
        start(channel)
    return pair


@pytest.fixture
def device(bus: Pair, tmp_path: Path) -> Iterator[Device]:
    with Device(*on(bus.device), folder=tmp_path) as serving:
        yield serving


FLASH = ("flash", "image.bin", "-t", "bms", "--frame-gap", "0.002")
"""Emulated SJA1000 controllers are overrun by frames that take no time."""


def check_good(bus: Pair, tmp_path: Path) -> None:
    """What was printed has helped: doctor finds no problem, and a flash succeeds."""
    looked = bus.flasher("doctor", folder=tmp_path)
    assert looked.end() == OK, looked.reported
    done = bus.flasher(*FLASH, folder=tmp_path)
    assert done.end() == OK, done.reported


# -- interfaces that are set up wrongly ------------------------------------------------------------


def down(bus: Pair) -> None:
    root(f"ip link set {bus.tool} down")


def never_set_up(bus: Pair) -> None:
    """As after it was plugged in: no bit rate yet."""
    if not isinstance(bus, Candlelights):
        pytest.skip("an SJA1000 cannot be plugged in anew")
    bus.unplug(0)
    bus.plug(0)


def listen_only(bus: Pair) -> None:
    start(bus.tool, "listen-only on")


def at_another_rate(bus: Pair) -> None:
    start(bus.tool, bitrate_bps=500_000)


def loopback(bus: Pair) -> None:
    start(bus.tool, "loopback on")


def one_shot(bus: Pair) -> None:
    start(bus.tool, "one-shot on")


REFUSED = (down, never_set_up, listen_only, at_another_rate)
"""What no upgrade begins on."""


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("spoil", REFUSED)
def test_what_flash_prints_helps(
    bus: Pair, reader: Reader, tmp_path: Path, spoil: Callable[[Pair], None]
) -> None:
    spoil(bus)
    done = bus.flasher(*FLASH, folder=tmp_path)
    assert done.end() == BUS, done.reported
    assert reader.obeys(done), done.reported
    check_good(bus, tmp_path)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("spoil", [*REFUSED, loopback, one_shot])
def test_what_doctor_prints_helps(
    bus: Pair, reader: Reader, tmp_path: Path, spoil: Callable[[Pair], None]
) -> None:
    spoil(bus)
    done = bus.flasher("doctor", folder=tmp_path)
    assert (done.end() == OK) == (spoil is one_shot), done.reported
    printed = reader.obeys(done)
    assert any(command.startswith("ip link set") for command in printed), done.reported
    check_good(bus, tmp_path)
    again = bus.flasher("doctor", folder=tmp_path)
    assert not any(command.startswith("ip") for command in commands_in(again.reported)), (
        again.reported
    )


@pytest.mark.usefixtures("device")
def test_what_doctor_prints_on_a_good_bus_succeeds(
    bus: Pair, reader: Reader, tmp_path: Path
) -> None:
    """A warning that the bus is silent, and on one driver that it stays off after bus-off."""
    done = bus.flasher("doctor", folder=tmp_path)
    assert done.end() == OK
    printed = reader.obeys(done)
    assert f"flasher scan -i socketcan -c {bus.tool}" in printed
    assert any("restart-ms" in command for command in printed) != isinstance(bus, Candlelights)
    check_good(bus, tmp_path)


# -- a bus that does not work ----------------------------------------------------------------------


@needs_candlelight
@pytest.mark.parametrize("command", ["doctor", "flash", "info"])
def test_bus_off_ends_by_what_is_printed(reader: Reader, tmp_path: Path, command: str) -> None:
    bus = Candlelights()
    for channel in (bus.tool, bus.device):
        start(channel)
    with Device(*on(bus.device), folder=tmp_path):
        bus.leave_bus()
        arguments = {"flash": FLASH, "doctor": ("doctor",), "info": ("info", "-t", "bms")}[command]
        done = bus.flasher(*arguments, folder=tmp_path)
        assert done.end() == BUS, done.reported
        assert any(each.startswith("ip link set") for each in reader.obeys(done)), done.reported
        check_good(bus, tmp_path)


@needs_candlelight
def test_what_is_printed_after_a_lost_adapter_finishes_the_upgrade(
    reader: Reader, tmp_path: Path
) -> None:
    bus = Candlelights()
    for channel in (bus.tool, bus.device):
        start(channel)
    impatient = ("--set", "pause_in_transfer=announces", "--set", "transfer_timeout_s=2")
    (tmp_path / "image.bin").write_bytes(VECTORS + random.Random(27).randbytes(9_984))
    with Device(*impatient, *on(bus.device), folder=tmp_path):
        with Forked(*FLASH, *on(bus.tool), folder=tmp_path) as host:
            host.until("transferring ...")
            bus.unplug(0)
            assert host.end() == BUS, host.reported
        bus.plug(0)
        printed = reader.obeys(host)
        assert any(command.startswith("flasher") for command in printed), host.reported
        assert (tmp_path / "out.bin").read_bytes() == (tmp_path / "image.bin").read_bytes()


@needs_candlelight
def test_what_is_printed_when_no_node_acknowledges_succeeds(reader: Reader, tmp_path: Path) -> None:
    bus = Candlelights()
    start(bus.tool)
    root(f"ip link set {bus.device} down")
    done = bus.flasher(*FLASH, folder=tmp_path)
    assert done.end() == BUS
    reader.obeys(done)
    looked = bus.flasher("doctor", folder=tmp_path)
    reader.obeys(looked, but={"flasher scan": BUS, "flasher doctor": BUS})


@needs_candlelight
def test_what_doctor_prints_on_a_full_bus_succeeds(reader: Reader, tmp_path: Path) -> None:
    bus = Candlelights()
    for channel in (bus.tool, bus.device):
        start(channel)
    with background(f"cangen {bus.device} -I 7FF -L 8 -D r -g 0 -p 10"):
        done = bus.flasher("doctor", folder=tmp_path)
        printed = reader.obeys(done)
    assert f"flasher monitor -i socketcan -c {bus.tool}" in printed, done.reported


# -- no interface, or too many ---------------------------------------------------------------------


@needs_candlelight  # commands of root are run: in a guest only
@pytest.mark.parametrize("channel", ["can77", "vcan77"])
def test_what_is_printed_of_a_missing_interface_succeeds(
    reader: Reader, tmp_path: Path, channel: str
) -> None:
    for command in (FLASH, ("doctor",)):
        root(f"ip link delete {channel} 2>/dev/null || true")
        done = run(*command, *on(channel), folder=tmp_path)
        assert done.end() == BUS
        # It cannot be plugged in here.
        assert reader.obeys(done, but={f"ip link set {channel} up type can": 1}), done.reported
    if channel.startswith("vcan"):
        assert run("doctor", *on(channel), folder=tmp_path).end() == OK
        root(f"ip link delete {channel}")


@needs_candlelight  # commands of root are run: in a guest only
@pytest.mark.usefixtures("bus")
def test_what_is_printed_where_nothing_is_named_succeeds(reader: Reader, tmp_path: Path) -> None:
    for arguments in (("doctor",), ("adapters",), ("info", "-t", "bms")):
        done = run(*arguments, folder=tmp_path)
        reader.obeys(done)
        for named in re.findall(r"-i socketcan -c (\w+)", done.reported):
            reader.types(f"flasher monitor -i socketcan -c {named}")
