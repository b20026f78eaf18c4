"""What counts as an adapter on a real bus: the kernel's word, not a name."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import can
import pytest

from flasher.bus import inspect_interface
from flasher.bus.adapter import CanLink
from flasher.bus.link import VirtualClock
from flasher.bus.physical import is_physical
from flasher.bus.simulated import SimulatedBus
from tests.bus.test_inspect_interface import CAN0, VCAN0
from tests.loops import each


@pytest.fixture
def terminal() -> Iterator[str]:
    """A pseudo terminal."""
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def kernel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, kind: str | None) -> None:
    """A computer with one interface; its `ip` tells this kind, or is missing."""
    (tmp_path / name).mkdir()
    (tmp_path / name / "type").write_text("280\n")
    (tmp_path / name / "flags").write_text("0x1\n")

    def ip(command: Sequence[str]) -> str:
        if kind is None:
            raise FileNotFoundError("ip")
        if command[-1] != name:
            raise subprocess.CalledProcessError(1, command)
        return json.dumps([{**(CAN0 if kind == "can" else VCAN0), "linkinfo": {"info_kind": kind}}])

    monkeypatch.setattr(inspect_interface, "SYSFS", tmp_path)
    monkeypatch.setattr(inspect_interface, "_run", ip)
    monkeypatch.setattr(inspect_interface.look_up, "__kwdefaults__", {"sysfs": tmp_path})
    monkeypatch.setattr(
        inspect_interface.read_interface, "__kwdefaults__", {"run": None, "sysfs": tmp_path}
    )


@pytest.mark.parametrize(
    ("name", "kind", "physical"),
    [
        ("can0", "can", True),
        ("vcan0", "vcan", False),
        ("vxcan0", "vxcan", False),
        ("vcan1", "can", True),  # renamed
        ("can3", "vcan", False),  # renamed
        ("slcan0", "slcan", True),
        ("can4", "", True),
        ("vcan2", None, True),  # there is no `ip`: unknown
    ],
)
def test_the_kernel_reports_what_a_network_interface_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, kind: str | None, physical: bool
) -> None:
    kernel(monkeypatch, tmp_path, name, kind)
    assert is_physical("socketcan", name) is physical
    assert is_physical("socketcan", "vcan9"), "it does not exist"
    assert is_physical("socketcan", ""), "all interfaces"


@each(
    "interface, channel, physical",
    [
        ("virtual", "x", False),
        ("udp_multicast", "239.74.163.2", False),
        ("pcan", "PCAN_USBBUS1", True),
        ("gs_usb", "0", True),
        ("socketcand", "can0", True),  # another computer's
        ("a_plugin", "vcan0", True),
        ("slcan", "/dev/null", True),
        ("slcan", "COM3", True),
        ("slcan", "/dev/ttyUSB0@115200", True),
        ("slcan", "socket://127.0.0.1:2000", True),
        ("slcan", "", True),
        ("slcan", "\0", True),
    ],
)
def test_others_are_reported_by_their_back_end(
    interface: str, channel: str, physical: bool
) -> None:
    assert is_physical(interface, channel) is physical


@pytest.mark.skipif(not Path("/dev/pts").exists(), reason="Linux has them there")
@each("interface", ["slcan", "serial", "robotell", "seeedstudio"])
def test_a_serial_adapter_at_a_pseudo_terminal_is_none(
    interface: str, terminal: str, tmp_path: Path
) -> None:
    named, chained = tmp_path / f"ttyACM0-{interface}", tmp_path / f"can0-{interface}"
    named.symlink_to(terminal)
    chained.symlink_to(named)
    for port in (terminal, f"{terminal}@115200", str(named), str(chained)):
        assert not is_physical(interface, port), port
    assert is_physical("pcan", terminal)
    assert is_physical(interface, str(tmp_path)), "a folder"


def test_a_file_that_is_called_so_is_no_pseudo_terminal(tmp_path: Path) -> None:
    """A name decides nothing."""
    port = tmp_path / "dev" / "pts" / "3"
    port.parent.mkdir(parents=True)
    port.write_bytes(b"")
    assert is_physical("slcan", str(port))


def test_links_distinguish_it() -> None:
    assert not SimulatedBus(250_000, VirtualClock()).link().is_physical
    with can.Bus("physical", interface="virtual", ignore_config=True) as bus:
        assert not CanLink(bus, "virtual", "physical").is_physical
        assert CanLink(bus, "pcan", "PCAN_USBBUS1").is_physical
