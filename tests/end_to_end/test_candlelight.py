"""flasher on candleLight adapters: the kernel's driver gs_usb, a bus with exact bit times."""

from __future__ import annotations

import json
import random
import re
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from flasher.trace.recorder import Recorder
from tests.end_to_end.forks import Device, Forked, run
from tests.end_to_end.kernel import (
    GUEST_TIMEOUT,
    Candlelights,
    background,
    figure,
    needs_candlelight,
    on,
    root,
    start,
    state_of,
    wait_until,
)
from tests.end_to_end.test_foreign_traffic import CANOPEN, NEIGHBOURS, OTHER_KINDS, UDS, XCP
from tests.firmware import VECTORS

pytestmark = [pytest.mark.kernel, GUEST_TIMEOUT, needs_candlelight]
IMAGE = VECTORS + random.Random(25).randbytes(19_984)
IMPATIENT = ("--set", "pause_in_transfer=announces", "--set", "transfer_timeout_s=2")
"""A device that waits in its transfer for ever would need a power cycle."""


@pytest.fixture
def bus(tmp_path: Path) -> Candlelights:
    """Both adapters plugged in and started, and an image in the folder."""
    (tmp_path / "image.bin").write_bytes(IMAGE)
    adapters = Candlelights()
    start(adapters.tool)
    start(adapters.device)
    return adapters


@pytest.fixture
def device(bus: Candlelights, tmp_path: Path) -> Iterator[Device]:
    with Device(*on(bus.device), *IMPATIENT, folder=tmp_path) as serving:
        yield serving


def flashing(bus: Candlelights, folder: Path, *arguments: str) -> Forked:
    """A flash that has begun to transfer."""
    host = Forked("flash", "image.bin", "-t", "bms", *on(bus.tool), *arguments, folder=folder)
    host.until("transferring ...")
    return host


def check_flash(bus: Candlelights, folder: Path, *arguments: str) -> Forked:
    """A flash that has to succeed, and that the device stored."""
    (folder / "out.bin").unlink(missing_ok=True)
    done = bus.flasher("flash", "image.bin", "-t", "bms", *arguments, folder=folder)
    assert done.end() == ExitCode.OK, done.reported
    assert (folder / "out.bin").read_bytes() == IMAGE
    return done


# -- an ordinary bus ------------------------------------------------------------------------------


@pytest.mark.usefixtures("device")
def test_a_flash_uses_most_of_the_line(bus: Candlelights, tmp_path: Path) -> None:
    done = check_flash(bus, tmp_path)
    share = re.search(r"(\d+)% of a 250 kbit/s line", done.reported)
    assert share is not None, done.reported
    figure(f"{share[0]}")
    assert int(share[1]) > 40


# -- adapters that go and come --------------------------------------------------------------------


@pytest.mark.usefixtures("device")
def test_an_adapter_that_is_put_back_in_a_transfer_goes_on(
    bus: Candlelights, tmp_path: Path
) -> None:
    """BU-05."""
    with flashing(bus, tmp_path) as host:
        bus.unplug(0)
        bus.plug(0)
        start(bus.tool)
        assert host.end() == ExitCode.OK, host.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE
    assert "error: can." not in host.stderr, "python-can's own line is no error of this command"


@pytest.mark.usefixtures("device")
def test_an_adapter_that_stays_away_ends_the_flash_and_the_same_command_brings_the_image_in(
    bus: Candlelights, tmp_path: Path
) -> None:
    with flashing(bus, tmp_path) as host:
        bus.unplug(0)
        assert host.end() == ExitCode.BUS, host.reported
    assert "State of the device: its application is erased" in host.stderr
    assert "Traceback" not in host.reported
    assert "error: can." not in host.stderr
    bus.plug(0)
    start(bus.tool)
    check_flash(bus, tmp_path)


@pytest.fixture
def in_order(bus: Candlelights) -> None:
    """The tool's adapter has the first name."""
    bus.plug_in_again(0, 1)
    start(bus.tool)
    start(bus.device)


@pytest.mark.usefixtures("in_order", "device")
def test_adapters_that_exchange_their_names_in_a_transfer_go_on_where_they_were(
    bus: Candlelights, tmp_path: Path
) -> None:
    names = bus.tool, bus.device
    with flashing(bus, tmp_path) as host:
        bus.plug_in_again(1, 0)
        assert (bus.device, bus.tool) == names
        start(bus.device)
        start(bus.tool)
        assert host.end() == ExitCode.OK, host.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE


@pytest.mark.usefixtures("in_order", "device")
def test_another_adapter_of_the_same_name_is_not_gone_on_with(
    bus: Candlelights, tmp_path: Path
) -> None:
    tool = bus.tool
    with flashing(bus, tmp_path) as host:
        bus.plug_in_again(1)
        assert bus.device == tool
        start(bus.device)
        assert host.end() == ExitCode.BUS, host.reported
    assert f"{tool} is the name of another adapter now" in host.stderr
    bus.plug(0)
    start(bus.tool)
    check_flash(bus, tmp_path)


@pytest.mark.usefixtures("device")
def test_an_interface_that_was_taken_down_in_a_transfer_goes_on_when_it_is_up(
    bus: Candlelights, tmp_path: Path
) -> None:
    with flashing(bus, tmp_path) as host:
        root(f"ip link set {bus.tool} down")
        host.until("for the adapter")
        root(f"ip link set {bus.tool} up")
        assert host.end() == ExitCode.OK, host.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE


@pytest.mark.usefixtures("device")
def test_an_interface_that_stays_down_ends_the_flash_with_the_command_that_starts_it(
    bus: Candlelights, tmp_path: Path
) -> None:
    with flashing(bus, tmp_path) as host:
        root(f"ip link set {bus.tool} down")
        assert host.end() == ExitCode.BUS, host.reported
    command = f"ip link set {bus.tool} up type can bitrate 250000"
    assert f"`{command}`" in host.stderr, host.reported
    root(command)
    check_flash(bus, tmp_path)


def test_the_device_model_outlives_its_adapter(
    bus: Candlelights, device: Device, tmp_path: Path
) -> None:
    bus.unplug(1)
    bus.plug(1)
    start(bus.device)
    device.until("is back")
    check_flash(bus, tmp_path)


# -- bus-off --------------------------------------------------------------------------------------


@pytest.mark.usefixtures("device")
def test_a_controller_that_is_bus_off_is_refused_at_the_opening(
    bus: Candlelights, tmp_path: Path
) -> None:
    bus.leave_bus()
    done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
    assert done.end() == ExitCode.BUS
    assert "[E406]" in done.stderr
    restart = f"ip link set {bus.tool} down; ip link set {bus.tool} up"
    assert f"`{restart}` (as root)" in done.stderr
    root(restart)
    check_flash(bus, tmp_path)


@pytest.mark.usefixtures("device")
def test_bus_off_in_a_transfer_ends_it_as_bus_off(bus: Candlelights, tmp_path: Path) -> None:
    """BU-02."""
    with flashing(bus, tmp_path) as host:
        bus.short(300)
        assert host.end() == ExitCode.BUS, host.reported
    assert "[E406]" in host.stderr
    assert "its application is erased" in host.stderr
    start(bus.device)
    start(bus.tool)
    check_flash(bus, tmp_path)


@pytest.mark.usefixtures("device")
def test_bus_off_that_somebody_ends_in_time_does_not_end_a_transfer(
    bus: Candlelights, tmp_path: Path
) -> None:
    """BU-02, with a device whose adapter left the bus too."""
    with flashing(bus, tmp_path) as host:
        bus.short(300)
        wait_until(lambda: state_of(bus.tool) == "BUS-OFF", "bus-off")
        bus.short(0)
        start(bus.device)
        start(bus.tool)
        assert host.end() == ExitCode.OK, host.reported
    assert (tmp_path / "out.bin").read_bytes() == IMAGE


# -- a bus that cannot work -----------------------------------------------------------------------


def test_no_node_acknowledges(bus: Candlelights, tmp_path: Path) -> None:
    root(f"ip link set {bus.device} down")
    done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
    assert done.end() == ExitCode.BUS
    assert "[E405]" in done.stderr
    assert "erased nothing" in done.stderr


def test_a_device_at_another_bit_rate(bus: Candlelights, tmp_path: Path) -> None:
    start(bus.device, bitrate_bps=500_000)
    done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
    assert done.end() == ExitCode.BUS, done.reported
    assert "erased nothing" in done.stderr


def test_a_kernel_that_is_set_to_another_bit_rate_is_refused(
    bus: Candlelights, tmp_path: Path
) -> None:
    start(bus.tool, bitrate_bps=500_000)
    done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
    assert done.end() == ExitCode.BUS
    assert "[E408]" in done.stderr


@pytest.mark.usefixtures("device")
def test_an_interface_that_only_listens_is_refused_for_sending_and_not_for_listening(
    bus: Candlelights, tmp_path: Path
) -> None:
    start(bus.tool, "listen-only on")
    done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
    assert done.end() == ExitCode.BUS, done.reported
    assert "only listens" in done.stderr
    assert "resetting" not in done.reported
    looked = bus.flasher("doctor", folder=tmp_path)
    assert looked.end() == ExitCode.BUS
    assert "listens without acknowledging" in looked.stdout
    assert bus.flasher("monitor", "--duration", "0.5", folder=tmp_path).end() == ExitCode.OK


# -- other traffic --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("can_id", "gap_ms", "load"),
    [("100", 0.62, 0.8), ("7FF", 0.0, 0.95)],
    ids=["80 % of higher priority", "all that is left, of lower priority"],
)
@pytest.mark.usefixtures("device")
def test_a_flash_beside_noise(
    bus: Candlelights, tmp_path: Path, can_id: str, gap_ms: float, load: float
) -> None:
    noise = f"cangen {bus.device} -I {can_id} -L 8 -D r -g {gap_ms} -p 10"
    with background(noise):
        check_flash(bus, tmp_path, "--trace-file", "noise.log")
    printed = run("explain", "--json", "noise.log", folder=tmp_path)
    seen = json.loads(printed.stdout)["story"]["bus"]["load"]
    figure(f"bus load: {seen:.0%}")
    assert seen > load


@pytest.mark.usefixtures("device")
def test_a_flash_beside_another_tools_iso_tp(bus: Candlelights, tmp_path: Path) -> None:
    """Between two programs on the same two adapters, through the kernel's own sockets."""
    payload = " ".join(f"{number & 0xFF:02X}" for number in range(200))
    sending = f"while echo '{payload}' | isotpsend -s 7E0 -d 7E8 {bus.device}; do sleep 0.05; done"
    with (
        (tmp_path / "isotp.txt").open("w") as came,
        background(f"isotprecv -s 7E8 -d 7E0 -l {bus.tool}", output=came),
        background(f"sh -c {shlex.quote(sending)}"),
    ):
        check_flash(bus, tmp_path)
    lines = (tmp_path / "isotp.txt").read_text().splitlines()[:-1]  # the last one may be half done
    figure(f"{len(lines)} messages of 200 bytes by ISO-TP meanwhile")
    assert len(lines) > 3
    assert {line.strip() for line in lines} == {payload}


def played(frames: Iterable[Frame], folder: Path) -> str:
    """A program that sends these frames over and over, one every 4 ms."""
    with Recorder(folder / "played.log") as recorder:
        for number, frame in enumerate(frames):
            recorder(frame, sent=True, now=number * 0.004)
    return f"canplayer -I {folder / 'played.log'} -l i"


@pytest.mark.usefixtures("device")
def test_a_flash_beside_other_protocols_and_other_kinds_of_frames(
    bus: Candlelights, tmp_path: Path
) -> None:
    others = (*CANOPEN, *XCP, *UDS, *OTHER_KINDS, *NEIGHBOURS) * 5
    with background(f"{played(others, tmp_path)} {bus.device}=can0"):
        check_flash(bus, tmp_path)


@pytest.mark.usefixtures("device")
def test_hostile_frames_on_the_devices_own_id_end_nothing_badly(
    bus: Candlelights, tmp_path: Path
) -> None:
    """Pieces of every answer, and bytes of none: whatever the flash ends as, it says so, and the
    same command succeeds when they are gone.
    """
    chance = random.Random(29)
    pieces = ["55AA0C04C202", "55AA0C04C302FFFF", "55AA0CFF", "F0", "55", "55AA0C04C502", ""]
    hostile = [
        Frame(0x725, bytes.fromhex(chance.choice(pieces)) or chance.randbytes(chance.randrange(9)))
        for _ in range(500)
    ]
    with background(f"{played(hostile, tmp_path)} {bus.device}=can0"):
        ended = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path).end()
    figure(f"exit code {ended} beside them")
    assert ended in set(ExitCode) - {ExitCode.INTERNAL, ExitCode.USAGE, ExitCode.IMAGE}
    check_flash(bus, tmp_path)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("where", ["tool", "device"])
def test_a_second_tool_is_refused_from_the_wire_and_from_the_same_interface(
    bus: Candlelights, tmp_path: Path, where: str
) -> None:
    """CO-03."""
    with background(f"cangen {getattr(bus, where)} -I 752 -L 8 -D r -g 5"):
        done = bus.flasher("flash", "image.bin", "-t", "bms", folder=tmp_path)
        assert done.end() == ExitCode.BUS, done.reported
    assert "[E407]" in done.stderr
    assert "erased nothing" in done.stderr
    check_flash(bus, tmp_path)
