"""`flasher adapters`, and which adapter a command uses when none is named.

What is plugged in is a substitute, at the edge where python-can, pyserial and Linux are asked.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from flasher.api import Connection, connect_mock
from flasher.bus.detect import DetectedAdapter, DetectionResult
from flasher.bus.inspect_interface import Interface, Unseen
from flasher.errors import ErrorCode, ExitCode
from tests.api.battery import Battery, wire_to
from tests.cli.conftest import SAMPLES, Flasher

BMS = SAMPLES / "bms.hex"
WMC = SAMPLES / "wmc.hex"
CAN0 = DetectedAdapter("socketcan", "can0", {"serial_number": "0042", "usb_path": "1-1.4"})
PCAN = DetectedAdapter("pcan", "PCAN_USBBUS1", {"device_name": "PCAN-USB"})
IXXAT = DetectedAdapter("ixxat", "0", {"unique_hardware_id": "HW 12"})
UP = Interface(
    "can0", is_can=True, is_up=True, kind="can", bitrate_bps=250_000, state_name="ERROR-ACTIVE"
)


@dataclass
class Machine:
    """A computer: what is plugged in, and the bus of each adapter that is opened."""

    detected: DetectionResult = field(default_factory=DetectionResult)
    ports: list[DetectedAdapter] | None = field(default_factory=list)
    interface: Interface | Unseen = UP
    wire: Connection = field(default_factory=lambda: wire_to(Battery()))
    opened: list[dict[str, Any]] = field(default_factory=list)
    asked: int = 0

    def look(self, *, on_network: bool = False) -> DetectionResult:
        self.asked += 1
        return self.detected

    @contextmanager
    def open(
        self,
        _dialect: object,
        *,
        holder: object,
        sends: bool = True,
        fallback: object = None,
        **bus: Any,
    ) -> Iterator[Connection]:
        assert sends == (holder is not None)
        self.opened.append(bus)
        yield self.wire


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    for place in ("flasher.cli.adapters", "flasher.cli.look.adapters"):
        monkeypatch.setattr(f"{place}.detect_adapters", machine.look)
        monkeypatch.setattr(f"{place}.slcan_ports", lambda: machine.ports)
    for place in ("flasher.cli.adapters", "flasher.bus.bit_rate"):
        monkeypatch.setattr(f"{place}.read_interface", lambda _name: machine.interface)
    monkeypatch.setattr("flasher.api.connect", machine.open)
    return machine


# -- what is there ---------------------------------------------------------------------------------


def test_each_adapter_is_listed_with_the_arguments_that_use_it(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [CAN0, PCAN, IXXAT]
    run = flasher("adapters")
    assert run.code == ExitCode.OK
    assert [" ".join(line.split()) for line in run.out.splitlines()[:3]] == [
        f"{CAN0.arguments} up, 250 kbit/s, error-active, serial number 0042",
        f"{PCAN.arguments} PCAN-USB",
        f"{IXXAT.arguments} serial number HW 12",
    ]
    listed = flasher("adapters", "--json").document["adapters"]
    assert listed[0]["arguments"] == ["-i", "socketcan", "-c", "can0"]
    assert (listed[0]["is_up"], listed[0]["bitrate_bps"]) == (True, 250_000)
    assert (listed[1]["is_up"], listed[1]["serial_number"]) == (None, None)
    assert listed[2]["arguments"][4:] == ["--bus-kwargs", "unique_hardware_id=HW 12"]


def test_an_interface_that_is_down_states_how_it_is_started(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [CAN0]
    machine.interface = Interface("can0", is_can=True, is_up=False)
    assert "down, `ip link set can0 up type can bitrate 250000" in flasher("adapters").out


def test_serial_ports_are_apart_since_what_is_at_them_is_unknown(
    flasher: Flasher, machine: Machine
) -> None:
    machine.ports = [DetectedAdapter("slcan", "/dev/ttyACM0", {"description": "CANable2 \x1b[2J"})]
    run = flasher("adapters")
    assert "no adapter found" in run.out
    assert "-i slcan -c /dev/ttyACM0  CANable2 \\x1b[2J" in run.out
    document = flasher("adapters", "--json").document
    assert document["adapters"] == []
    assert document["serial_ports"][0]["channel"] == "/dev/ttyACM0"


def test_what_cannot_be_seen_is_reported_with_its_reason(
    flasher: Flasher, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    machine.ports = None
    machine.detected.hung = ["kvaser"]
    machine.detected.failed = {"vector": "OSError: \x1b no driver"}
    machine.detected.not_loaded = ["ixxat", "etas"]
    machine.detected.cannot_tell = ["nican"]
    run = flasher("adapters", "--json")
    seen = {each["interface"]: each for each in run.document["not_seen"]}
    assert {name: seen[name]["why"] for name in ("kvaser", "vector", "ixxat", "nican")} == {
        "kvaser": "no_answer", "vector": "failed", "ixxat": "not_loaded", "nican": "cannot_tell",
    }  # fmt: skip
    assert seen["vector"]["text"] == "OSError: \\x1b no driver"
    assert seen["gs_usb"]["fix"] == f"{sys.executable} -m pip install 'python-can[gs-usb]'"
    assert seen["slcan"]["fix"] == f"{sys.executable} -m pip install 'python-can[serial]'"
    assert seen["socketcand"]["fix"] == "flasher adapters --network"
    assert not {"virtual", "udp_multicast", "socketcan"} & seen.keys()
    assert run.document["serial_ports"] is None
    assert "etas, ixxat" in flasher("adapters").out


def test_an_adapter_whose_channel_is_unknown_is_listed_and_never_chosen(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [DetectedAdapter("neovi", "", {"serial": "CY1234"})]
    assert "-i neovi -c CHANNEL --bus-kwargs serial=CY1234" in flasher("adapters").out
    assert flasher("info", "-t", "bms").code == ExitCode.BUS
    assert machine.opened == []


# -- which one is used -----------------------------------------------------------------------------

LOOKS = [
    ("info", "-t", "bms"),
    ("scan",),
    ("read", "history"),
    ("monitor", "--duration", "0.1"),
]


@pytest.mark.parametrize("words", LOOKS, ids=lambda words: words[0])
def test_the_only_adapter_is_used_to_look_and_named(
    flasher: Flasher, machine: Machine, words: tuple[str, ...]
) -> None:
    machine.detected.found = [CAN0]
    run = flasher(*words)
    assert run.code == ExitCode.OK
    assert run.err.startswith(
        "no adapter is named: using the only one found, -i socketcan -c can0\n"
    )
    assert machine.opened == [{"interface": "socketcan", "channel": "can0"}]
    assert machine.asked == 1


def test_what_distinguishes_the_adapter_from_others_is_opened_too(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [IXXAT]
    assert flasher("read", "history").code == ExitCode.OK
    assert machine.opened == [{"interface": "ixxat", "channel": "0", "unique_hardware_id": "HW 12"}]


@pytest.mark.parametrize(
    "words", [*LOOKS, ("flash", BMS, "-t", "bms"), ("write", "user-string-1", "x", "--yes")],
    ids=lambda words: words[0],
)  # fmt: skip
def test_of_several_none_is_chosen_and_all_are_listed_to_copy(
    flasher: Flasher, machine: Machine, words: tuple[str, ...]
) -> None:
    machine.detected.found = [CAN0, PCAN]
    run = flasher(*words, "--json")
    assert run.code == run.document["exit_code"] == ExitCode.USAGE
    assert run.document["error"]["code"] == ErrorCode.WHICH_ADAPTER
    listed = [line.strip() for line in run.document["error"]["remedy"].splitlines()[1:]]
    assert [line.partition("   ")[0] for line in listed] == [CAN0.arguments, PCAN.arguments]
    assert "up, 250 kbit/s" in listed[0]
    assert machine.opened == []


def test_without_any_the_next_step_is_named(flasher: Flasher, machine: Machine) -> None:
    machine.ports = [DetectedAdapter("slcan", "/dev/ttyACM0")]
    run = flasher("info", "-t", "bms", "--json")
    assert run.code == ExitCode.BUS
    assert run.document["error"]["code"] == ErrorCode.NO_ADAPTER
    assert "`flasher adapters`" in run.document["error"]["remedy"]
    assert "\n    -i slcan -c /dev/ttyACM0" in run.document["error"]["remedy"]


@pytest.mark.parametrize(
    ("words", "variables"),
    [
        (("-i", "pcan", "-c", "PCAN_USBBUS2"), {}),
        ((), {"interface": "pcan", "channel": "PCAN_USBBUS2"}),
        (("-c", "can7"), {}),
        ((), {"channel": "can7"}),
        (("--mock", "--mock-speed", "0"), {}),
    ],
)
def test_nothing_is_looked_for_where_an_adapter_or_half_of_one_is_named(
    flasher: Flasher,
    machine: Machine,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    variables: dict[str, str],
) -> None:
    machine.detected.found = [CAN0]
    monkeypatch.setattr("can.util.load_environment_config", lambda *_args: variables)
    assert flasher("read", "history", *words).code == ExitCode.OK
    assert machine.asked == 0
    assert all(bus.get("channel") != "can0" for bus in machine.opened)


def test_a_dry_run_needs_no_adapter_and_looks_for_none(flasher: Flasher, machine: Machine) -> None:
    assert flasher("flash", BMS, "-t", "bms", "--dry-run").code == ExitCode.OK
    assert machine.asked == 0


def test_the_bit_rate_that_is_refused_is_that_of_the_adapter_found(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [CAN0]
    machine.interface = Interface("can0", is_can=True, is_up=True, kind="can", bitrate_bps=500_000)
    run = flasher("flash", BMS, "-t", "bms")
    assert run.code == ExitCode.BUS
    assert "500 kbit/s (the kernel's setting of can0), not 250" in run.err
    assert machine.opened == []


# -- before a device is changed --------------------------------------------------------------------


@pytest.mark.parametrize("target", ["bms", "wmc"])
def test_flash_changes_nothing_where_the_device_does_not_answer(
    flasher: Flasher, machine: Machine, target: str
) -> None:
    machine.detected.found = [CAN0]
    deaf = Battery(silent=frozenset(range(0x10000)))
    machine.wire = wire_to(deaf)
    run = flasher("flash", SAMPLES / f"{target}.hex", "-t", target, "--json")
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert "nothing was changed" in run.document["error"]["what"]
    assert {command for command, _ in deaf.received} <= {0x3300}, "only its version is asked"
    if target == "wmc":
        assert machine.wire.link.health().frames_sent == 0
    words = shlex.split(run.document["error"]["command"])
    assert words[:6] == ["flasher", "flash", "-i", "socketcan", "-c", "can0"]
    assert words[6:9] == [str(SAMPLES / f"{target}.hex"), "-t", target]


def test_another_device_on_the_bus_is_not_the_one(flasher: Flasher, machine: Machine) -> None:
    machine.detected.found = [CAN0]
    machine.wire = wire_to(Battery())  # answers as BMS
    assert flasher("flash", WMC, "-t", "wmc").code == ExitCode.NO_ANSWER
    assert machine.wire.link.health().frames_sent == 0


def test_flash_goes_on_where_the_device_answers_and_reports_it(
    flasher: Flasher, machine: Machine, short_bms: Path
) -> None:
    machine.detected.found = [CAN0]
    with connect_mock("bms", speed=0) as wire:
        machine.wire = wire
        run = flasher("flash", short_bms, "-t", "bms")
    assert run.code == ExitCode.OK
    reported = run.err.index
    assert (
        reported("using the only one found") < reported("the BMS is there") < reported("resetting")
    )


def test_rescue_needs_no_word_before_the_announcement_that_it_waits_for(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [CAN0]
    machine.wire = wire_to()
    run = flasher("rescue", WMC, "-t", "wmc", "--wait", "5")
    assert run.code == ExitCode.NO_ANSWER
    assert "using the only one found" in run.err
    assert machine.wire.link.health().frames_sent == 0


def test_write_writes_nothing_where_the_battery_does_not_answer(
    flasher: Flasher, machine: Machine
) -> None:
    machine.detected.found = [CAN0]
    deaf = Battery(silent=frozenset(range(0x10000)))
    machine.wire = wire_to(deaf)
    assert flasher("write", "user-string-1", "x", "--yes").code == ExitCode.NO_ANSWER
    assert {command for command, _ in deaf.received} == {0x3300}
    machine.wire = wire_to(Battery())
    run = flasher("write", "user-string-1", "x", "--yes")
    assert run.code == ExitCode.OK
    assert "the BMS is there" in run.err


@pytest.mark.slow
@pytest.mark.parametrize("target", ["bms", "wmc"])
def test_a_named_adapter_asks_nothing_more_than_before(
    flasher: Flasher, machine: Machine, target: str
) -> None:
    with connect_mock(target, speed=0) as wire:
        machine.wire = wire
        run = flasher("flash", SAMPLES / f"{target}.hex", "-t", target, "-i", "pcan", "-c", "x")
    assert run.code == ExitCode.OK
    assert "listening for the" not in run.err


def test_rules_for_udev_are_no_list_of_the_network(flasher: Flasher) -> None:
    run = flasher("adapters", "--udev", "--network")
    assert run.code == ExitCode.USAGE
    assert "Leave one out." in run.err
