"""What Linux tells about an interface: the JSON of `ip` in its real shape, and /sys."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from flasher.bus.health import ControllerState
from flasher.bus.inspect_interface import Interface, Unseen, look_up, read_interface
from tests.loops import each

CAN0: dict[str, Any] = {
    "ifindex": 5,
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
    "mtu": 16,
    "qdisc": "pfifo_fast",
    "operstate": "UP",
    "linkmode": "DEFAULT",
    "group": "default",
    "txqlen": 10,
    "link_type": "can",
    "promiscuity": 0,
    "linkinfo": {
        "info_kind": "can",
        "info_data": {
            "ctrlmode": ["LISTEN-ONLY", "BERR-REPORTING"],
            "state": "ERROR-PASSIVE",
            "berr_counter": {"tx": 128, "rx": 3},
            "restart_ms": 100,
            "bittiming": {
                "bitrate": 250000,
                "sample_point": "0.875",
                "tq": 250,
                "prop_seg": 6,
                "phase_seg1": 7,
                "phase_seg2": 2,
                "sjw": 1,
                "brp": 2,
            },
            "bittiming_const": {"name": "sja1000", "brp": {"min": 1, "max": 64}, "brp_inc": 1},
            "clock": 8000000,
        },
    },
}
VCAN0: dict[str, Any] = {
    "ifname": "vcan0",
    "flags": ["NOARP", "UP", "LOWER_UP"],
    "operstate": "UNKNOWN",
    "txqlen": 1000,
    "link_type": "can",
    "linkinfo": {"info_kind": "vcan"},
}


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """/sys/class/net with an interface `can0` that is up."""
    make(tmp_path, "can0")
    return tmp_path


def make(sysfs: Path, name: str, **files: str) -> None:
    folder = sysfs / name
    folder.mkdir()
    content = {"flags": "0x400c1", "type": "280", "carrier": "1", "tx_queue_len": "10"} | files
    for file, text in content.items():
        (folder / file).write_text(f"{text}\n")


def says(*links: dict[str, Any]) -> Any:
    def run(command: Sequence[str]) -> str:
        assert command[:6] == ("ip", "-details", "-json", "link", "show", "dev")
        return json.dumps(links)

    return run


def test_everything_that_ip_reports_is_used(sysfs: Path) -> None:
    assert read_interface("can0", run=says(CAN0), sysfs=sysfs) == Interface(
        name="can0",
        is_can=True,
        is_up=True,
        has_carrier=True,
        kind="can",
        bitrate_bps=250_000,
        state_name="ERROR-PASSIVE",
        tx_errors=128,
        rx_errors=3,
        restart_ms=100,
        queue_frames=10,
        modes=frozenset({"LISTEN-ONLY", "BERR-REPORTING"}),
        driver="sja1000",
    )


def test_an_interface_that_was_just_started_has_a_carrier(sysfs: Path) -> None:
    """The kernel clears NO-CARRIER up to a second later."""
    link = CAN0 | {"flags": ["NO-CARRIER", "NOARP", "UP", "LOWER_UP", "ECHO"], "operstate": "DOWN"}
    seen = read_interface("can0", run=says(link), sysfs=sysfs)
    assert isinstance(seen, Interface)
    assert seen.has_carrier


@each(
    "word, state",
    [
        ("ERROR-ACTIVE", ControllerState.ACTIVE),
        ("ERROR-WARNING", ControllerState.ACTIVE),
        ("ERROR-PASSIVE", ControllerState.PASSIVE),
        ("BUS-OFF", ControllerState.BUS_OFF),
        ("STOPPED", ControllerState.UNKNOWN),
        ("?", ControllerState.UNKNOWN),
    ],
)
def test_states_of_the_controller(word: str, state: ControllerState) -> None:
    assert Interface("can0", is_can=True, is_up=True, state_name=word).state is state


def test_a_virtual_interface_has_no_bit_rate_and_no_state(sysfs: Path) -> None:
    make(sysfs, "vcan0")
    seen = read_interface("vcan0", run=says(VCAN0), sysfs=sysfs)
    assert isinstance(seen, Interface)
    assert (seen.kind, seen.bitrate_bps, seen.restart_ms) == ("vcan", None, None)
    assert seen.state is ControllerState.UNKNOWN


def test_bus_off_takes_the_carrier_away(sysfs: Path) -> None:
    link = CAN0 | {"flags": ["NO-CARRIER", "NOARP", "UP", "ECHO"]}
    seen = read_interface("can0", run=says(link), sysfs=sysfs)
    assert isinstance(seen, Interface)
    assert seen.has_carrier is False


@pytest.mark.parametrize(
    "answer",
    [
        FileNotFoundError("ip"),
        subprocess.CalledProcessError(255, "ip"),
        subprocess.TimeoutExpired("ip", 2.0),
        "Option -json is unknown",
        "[]",
        "[[]]",
        '[{"ifname": "can0"}]',
        '[{"ifname": "can0", "flags": null, "linkinfo": 3}]',
    ],
)
def test_without_a_usable_ip_the_files_of_sys_have_to_do(
    sysfs: Path, answer: str | Exception
) -> None:
    def run(_command: Sequence[str]) -> str:
        if isinstance(answer, Exception):
            raise answer
        return answer

    assert read_interface("can0", run=run, sysfs=sysfs) == Interface(
        "can0", is_can=True, is_up=True, has_carrier=True, queue_frames=10
    )


@pytest.mark.parametrize("name", ["can7", "", "..", "a/b", "../can0", "x" * 16, "can 0"])
def test_an_interface_that_is_not_there_is_not_asked_for(sysfs: Path, name: str) -> None:
    def run(_command: Sequence[str]) -> str:
        raise AssertionError("nothing to ask")

    assert read_interface(name, run=run, sysfs=sysfs) is Unseen.MISSING


def test_a_system_without_sys_gives_no_answer(tmp_path: Path) -> None:
    assert look_up("can0", sysfs=tmp_path / "none") is Unseen.CANNOT_TELL


def test_down_and_other_kinds_of_interface(sysfs: Path) -> None:
    make(sysfs, "can1", flags="0x40080")
    make(sysfs, "eth0", type="1")
    (sysfs / "can1" / "carrier").unlink()
    down, other = look_up("can1", sysfs=sysfs), look_up("eth0", sysfs=sysfs)
    assert isinstance(down, Interface)
    assert (down.is_up, down.has_carrier) == (False, None)
    assert isinstance(other, Interface)
    assert not other.is_can
