"""`flasher doctor`: what it finds, how bad it calls it, and the command that it names."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import pytest

from flasher.api import Connection
from flasher.bus.detect import DetectedAdapter, DetectionResult
from flasher.bus.inspect_interface import Interface, Unseen
from flasher.bus.simulated import SimulatedLink
from flasher.cli.look import doctor
from flasher.cli.look.doctor import bus_words
from flasher.cli.look.findings import Finding, Severity, TrafficCounter
from flasher.errors import ExitCode
from flasher.protocol.bittime import fixed_bits
from flasher.protocol.frame import Frame
from tests.api.battery import ANSWERS, Battery, wire_to
from tests.bus.test_adapter import FakeBus, error_message, message
from tests.cli.conftest import Flasher, Run
from tests.loops import each

MOCK = ("--mock", "--mock-speed", "0")
SILENT = frozenset(ANSWERS)
CAN0 = Interface(
    "can0",
    is_can=True,
    is_up=True,
    has_carrier=True,
    kind="can",
    bitrate_bps=250_000,
    state_name="ERROR-ACTIVE",
    tx_errors=0,
    rx_errors=0,
    restart_ms=100,
    queue_frames=128,
)


def found(run: Run) -> dict[str, tuple[str, list[str]]]:
    """What was found, with its severity and commands, of a run with --json."""
    return {each["what"]: (each["severity"], each["fix"]) for each in run.document["findings"]}


def one(run: Run, words: str) -> tuple[str, list[str]]:
    matches = [value for what, value in found(run).items() if words in what]
    assert len(matches) == 1, found(run)
    return matches[0]


# -- traffic, on a simulated bus ------------------------------------------------------------------


def listen(flasher: Flasher, monkeypatch: pytest.MonkeyPatch, wire: Connection, *more: str) -> Run:
    @contextmanager
    def opened(*_arguments: object, **_options: object) -> Iterator[Connection]:
        yield wire

    monkeypatch.setattr("flasher.api.connect_mock", opened)
    return flasher("doctor", *MOCK, "--json", *more)


def saying(*messages: tuple[int, int, bytes], damages: bool = False) -> Connection:
    return wire_to(*(Battery(silent=SILENT, repeats=(m,), damages=damages) for m in messages))


def test_the_mock_is_a_healthy_bus(flasher: Flasher) -> None:
    run = flasher("doctor", *MOCK)
    assert run.code == ExitCode.OK
    assert "PROBLEM" not in run.out
    assert "WARNING" not in run.out
    assert "from BMS, OBC, WMC" in run.out


def test_it_never_sends_a_frame(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    battery = Battery()
    wire = wire_to(battery)
    listen(flasher, monkeypatch, wire)
    assert battery.received == []
    assert wire.link.health().frames_sent == 0


def test_the_figures_are_in_the_json(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    run = listen(flasher, monkeypatch, saying((0x720, 0x1308, b"SHUTDOWN")), "--listen", "2")
    # 19 bytes are 3 frames, every 200 ms from the beginning.
    traffic = run.document["traffic"]
    assert traffic["frames"] == pytest.approx(30, abs=3)
    assert traffic["frames_per_s"] == traffic["frames"] / 2
    assert 0 < traffic["bus_load"] < 0.02
    assert (traffic["nodes"], traffic["foreign_frames"]) == (["bms"], 0)
    assert run.document["health"] == {
        "state": "active", "tx_errors": None, "rx_errors": None, "error_frames": 0, "unreadable": 0
    }  # fmt: skip


def test_a_silent_bus_is_no_problem_by_itself(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = listen(flasher, monkeypatch, wire_to())
    assert run.code == ExitCode.OK
    severity, fix = one(run, "silent for 1 s")
    assert severity == "warning"
    assert fix == ["flasher scan --mock"]


def test_a_second_tool_is_a_problem(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    run = listen(flasher, monkeypatch, saying((0x752, 0x3300, b"")))
    assert run.code == ExitCode.BUS
    assert one(run, "another tool sends as CDL")[0] == "problem"
    assert "another tool" in run.document["error"]["what"]
    assert "close the other tool" in run.err


@pytest.mark.parametrize(
    ("reported", "words", "severity", "fix"),
    [
        (
            (0x720, 0x1308, b"SHUTDOWN"),
            "the BMS sent the command SHUTDOWN",
            "warning",
            "press the key",
        ),
        (
            (0x710, 0x1808, b"SHUTDOWN"),
            "the WMC sent the command SHUTDOWN",
            "warning",
            "press the key",
        ),
        ((0x725, 0xC109, b"BMSV1.2.3"), "in its bootloader (BMS V1.2.3)", "note", "flasher flash"),
        ((0x740, 0x1305, b"READY"), "speaks motinova, not welling", "warning", "motinova"),
        ((0x123, 0x6603, b"abc"), "from no node of the system; ", "warning", None),
    ],
)
def test_what_is_sent_on_the_bus(
    flasher: Flasher,
    monkeypatch: pytest.MonkeyPatch,
    reported: tuple[int, int, bytes],
    words: str,
    severity: str,
    fix: str | None,
) -> None:
    run = listen(flasher, monkeypatch, saying(reported))
    assert run.code == ExitCode.OK
    how_bad, commands = one(run, words)
    assert how_bad == severity
    assert (fix is None) == (not commands)
    assert fix is None or fix in commands[0]


def test_damaged_messages_are_noted(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    run = listen(flasher, monkeypatch, saying((0x710, 0x1305, b"READY"), damages=True))
    assert one(run, "made no message")[0] == "note"


def test_a_controller_that_is_bus_off_is_a_problem(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = wire_to()
    assert isinstance(wire.link, SimulatedLink)
    wire.link._bus.bus_off()
    run = listen(flasher, monkeypatch, wire)
    assert run.code == ExitCode.BUS
    assert one(run, "the controller is bus-off")[0] == "problem"
    assert run.document["health"]["state"] == "bus_off"


def test_an_adapter_that_fails_meanwhile_is_a_finding(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = wire_to()
    assert isinstance(wire.link, SimulatedLink)
    wire.link._bus.unplug()
    run = listen(flasher, monkeypatch, wire)
    assert run.code == ExitCode.BUS
    assert one(run, "failed while receiving: no such device (it was unplugged)")[0] == "problem"


def test_the_load_counts_extended_frames_and_not_error_frames() -> None:
    long_, error = TrafficCounter(), TrafficCounter()
    long_(Frame(0x18DA0123, b"12345678", is_extended=True), sent=False, now=0.0)
    error(Frame(0x204, bytes(8), is_error=True), sent=False, now=0.0)
    assert long_.bits == fixed_bits(8) + 20
    assert (error.bits, error.frames, error.error_frames) == (0, 0, 1)


# -- adapters, through python-can -----------------------------------------------------------------


class Doctor:
    """Runs the command with substitutes for the machine: what is plugged in, what Linux says."""

    def __init__(self, flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
        self._flasher = flasher
        self.detected = DetectionResult()
        self.interface: Interface | Unseen = CAN0
        self.failure: Exception | None = None
        self.asked: list[str] = []
        self.is_interrupted = False
        self.opened: list[dict[str, Any]] = []
        self.inbox: list[can.Message | Exception | None] = []
        monkeypatch.setattr("flasher.cli.look.doctor.Detection", self._detection)
        monkeypatch.setattr("can.Bus", self._open)
        monkeypatch.setattr("can.util.CONFIG_FILES", [])
        for name in ("flasher.bus.inspect_interface", "flasher.bus.adapter", "flasher.bus.opening"):
            monkeypatch.setattr(f"{name}.read_interface", lambda _name: self.interface)

    @contextmanager
    def _detection(self, names: Iterable[str]) -> Iterator[Doctor]:
        self.asked = list(names)
        yield self

    def collect(self, cancelled: Callable[[], bool]) -> DetectionResult:
        if self.is_interrupted:
            signal.raise_signal(signal.SIGINT)
            assert cancelled()
        return self.detected

    def _open(self, **config: Any) -> can.BusABC:
        self.opened.append(config)
        if self.failure is not None:
            raise self.failure
        bus = FakeBus()
        bus.inbox.extend([None, *self.inbox])  # nothing is stale when it begins
        return bus

    def __call__(self, *arguments: str) -> Run:
        return self._flasher("doctor", "--json", "--listen", "0.01", *arguments)


@pytest.fixture
def examine(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> Doctor:
    return Doctor(flasher, monkeypatch)


ON_CAN0 = ("-i", "socketcan", "-c", "can0")


def test_the_only_adapter_is_looked_at_where_none_is_named(examine: Doctor) -> None:
    examine.detected = DetectionResult(
        [DetectedAdapter("pcan", "PCAN_USBBUS1", {"device": 5})], ["kvaser"], {}
    )
    run = examine()
    assert run.code == ExitCode.OK
    assert "using the only one found, -i pcan -c PCAN_USBBUS1" in run.err
    assert one(run, "detected pcan PCAN_USBBUS1 device=5")[0] == "ok"
    assert one(run, "no answer in time from the back ends kvaser")[0] == "note"
    assert one(run, "pcan PCAN_USBBUS1 opens and listens")[0] == "ok"
    assert [config["channel"] for config in examine.opened] == ["PCAN_USBBUS1"]


def test_of_several_none_is_opened_and_how_to_choose_is_reported(examine: Doctor) -> None:
    examine.detected = DetectionResult(
        [DetectedAdapter("pcan", "PCAN_USBBUS1"), DetectedAdapter("kvaser", "0")]
    )
    run = examine()
    assert run.code == ExitCode.BUS
    severity, fix = one(run, "no adapter is chosen")
    assert severity == "problem"
    assert fix == ["flasher doctor -i pcan -c PCAN_USBBUS1", "flasher doctor -i kvaser -c 0"]
    assert run.document["adapters"][0] == {"interface": "pcan", "channel": "PCAN_USBBUS1"}
    assert run.document["traffic"] is None
    assert examine.opened == []


def test_half_an_adapter_that_is_named_is_not_completed_by_a_guess(examine: Doctor) -> None:
    examine.detected = DetectionResult([DetectedAdapter("pcan", "PCAN_USBBUS1")])
    assert one(examine("-c", "can0"), "no adapter is chosen")[0] == "problem"
    assert examine.opened == []


def test_servers_on_the_network_are_waited_for_only_when_nothing_is_chosen(
    examine: Doctor,
) -> None:
    examine()
    assert "socketcand" in examine.asked
    examine(*ON_CAN0)
    assert "socketcand" not in examine.asked


def test_a_good_interface_has_no_problem(examine: Doctor) -> None:
    examine.inbox = [message(0x720, b"\x55\xaa")]
    run = examine(*ON_CAN0)
    assert run.code == ExitCode.OK
    severities = {severity for severity, _ in found(run).values()}
    assert severities <= {"ok", "note"}
    assert one(run, "can0 runs at 250 kbit/s")[0] == "ok"
    assert one(run, "error counters: transmit 0, receive 0")[0] == "ok"


AGAIN = ["ip link set can0 down", "ip link set can0 type can {}", "ip link set can0 up"]


@pytest.mark.parametrize(
    ("change", "words", "severity", "fix"),
    [
        ({"bitrate_bps": 500_000}, "runs at 500 kbit/s", "problem", "bitrate 250000"),
        (
            {"modes": frozenset({"LISTEN-ONLY"})},
            "nothing can be sent",
            "problem",
            "listen-only off",
        ),
        ({"modes": frozenset({"LOOPBACK"})}, "itself only", "problem", "loopback off"),
        ({"modes": frozenset({"ONE-SHOT"})}, "is lost", "warning", "one-shot off"),
        ({"modes": frozenset({"PRESUME-ACK"})}, "counts as sent", "warning", "presume-ack off"),
        (
            {"restart_ms": 0, "driver": "sja1000"},
            "stays off the bus",
            "warning",
            "restart-ms 100",
        ),
    ],
)
def test_each_wrong_setting_has_its_commands(
    examine: Doctor, change: dict[str, Any], words: str, severity: str, fix: str
) -> None:
    examine.interface = replace(CAN0, **change)
    run = examine(*ON_CAN0)
    assert run.code == (ExitCode.BUS if severity == "problem" else ExitCode.OK)
    assert one(run, words) == (severity, [line.format(fix) for line in AGAIN])


@pytest.mark.parametrize("driver", ["gs_usb", "slcan", ""])
def test_a_restart_that_the_driver_does_not_have_is_not_recommended(
    examine: Doctor, driver: str
) -> None:
    examine.interface = replace(CAN0, restart_ms=0, driver=driver)
    assert one(examine(*ON_CAN0), "stays off the bus") == ("note", [])


def test_an_interface_that_only_listens_acknowledges_nothing(examine: Doctor) -> None:
    examine.interface = replace(CAN0, modes=frozenset({"LISTEN-ONLY"}))
    run = examine(*ON_CAN0)
    assert one(run, "can0 opens and")[0] == "ok"
    assert "listens without acknowledging" in one_text(run, "can0 opens and")
    assert run.document["traffic"]["listen_only"]


@each("bitrate_bps, severity", [(250_500, "ok"), (249_377, "ok"), (252_000, "problem")])
def test_a_bit_rate_is_as_good_for_doctor_as_for_the_other_commands(
    examine: Doctor, bitrate_bps: int, severity: str
) -> None:
    """The kernel reports the one that the controller's clock can reach."""
    examine.interface = replace(CAN0, bitrate_bps=bitrate_bps)
    assert one(examine(*ON_CAN0), f"runs at {bitrate_bps / 1000:g} kbit/s")[0] == severity


def test_settings_that_are_fine_are_noted_without_a_command(examine: Doctor) -> None:
    examine.interface = replace(CAN0, queue_frames=10, modes=frozenset({"FD"}))
    run = examine(*ON_CAN0)
    assert run.code == ExitCode.OK
    assert one(run, "holds 10 frames, a packet has 18") == ("note", [])
    assert one(run, "takes CAN FD") == ("note", [])


@pytest.mark.parametrize(
    ("seen", "words", "fix"),
    [
        (Unseen.MISSING, "no interface can0 exists", "ip -brief link show type can"),
        (replace(CAN0, is_can=False), "not a CAN interface", "ip -brief link show type can"),
        (
            replace(CAN0, is_up=False, has_carrier=None, bitrate_bps=None),
            "can0 is down",
            "ip link set can0 up type can bitrate 250000",
        ),
    ],
)
def test_an_interface_that_cannot_be_used(
    examine: Doctor,
    monkeypatch: pytest.MonkeyPatch,
    seen: Interface | Unseen,
    words: str,
    fix: str,
) -> None:
    examine.interface = seen
    monkeypatch.setattr("flasher.cli.look.findings.kernel_has_can", lambda: True)
    run = examine(*ON_CAN0)
    assert run.code == ExitCode.BUS
    problems = [(w, c) for w, (severity, c) in found(run).items() if severity == "problem"]
    assert examine.opened == []
    assert len(problems) == 1
    assert words in problems[0][0]
    assert problems[0][1][0] == fix


def test_a_kernel_without_can_is_named(examine: Doctor, monkeypatch: pytest.MonkeyPatch) -> None:
    examine.interface = Unseen.MISSING
    monkeypatch.setattr("flasher.cli.look.findings.kernel_has_can", lambda: False)
    run = examine("-i", "socketcan", "-c", "vcan0")
    assert run.code == ExitCode.BUS
    assert one(run, "this system's kernel has no CAN") == ("problem", ["flasher adapters"])


def test_socketcan_without_a_channel_is_not_opened(examine: Doctor) -> None:
    run = examine("-i", "socketcan")
    assert run.code == ExitCode.BUS
    assert "flasher doctor -i socketcan -c can0" in one(run, "no channel is named")[1]
    assert examine.opened == []


def test_a_virtual_interface_needs_no_bit_rate(examine: Doctor) -> None:
    examine.interface = Interface("vcan0", is_can=True, is_up=True, kind="vcan")
    run = examine("-i", "socketcan", "-c", "vcan0")
    assert run.code == ExitCode.OK
    assert one(run, "vcan0 is virtual")[0] == "note"
    examine.interface = replace(examine.interface, is_up=False)
    assert one(examine("-i", "socketcan", "-c", "vcan0"), "vcan0 is down")[1] == [
        "ip link set vcan0 up"
    ]


@pytest.mark.parametrize(
    ("state", "frames", "code"),
    [("BUS-OFF", 0, 4), ("ERROR-PASSIVE", 0, 4), ("ERROR-PASSIVE", 1, 0), ("ERROR-WARNING", 1, 0)],
)
def test_the_state_of_the_controller(examine: Doctor, state: str, frames: int, code: int) -> None:
    examine.interface = replace(CAN0, state_name=state, tx_errors=136)
    examine.inbox = [message(0x720, b"\x01")] * frames
    run = examine(*ON_CAN0)
    assert run.code == code
    severity, fix = one(run, "error counters: transmit 136")
    assert (severity == "problem") == (code == ExitCode.BUS)
    if state == "BUS-OFF":
        assert fix == ["ip link set can0 down", "ip link set can0 up"]


def test_error_frames_and_nothing_else_are_a_wrong_bit_rate_or_a_device_alone(
    examine: Doctor,
) -> None:
    examine.inbox = [error_message(0x088, "00 00 04 00 00 00 00 00")] * 3
    run = examine(*ON_CAN0)
    assert run.code == ExitCode.BUS
    severity, fix = one(run, "3 error frames and nothing else")
    assert severity == "problem"
    assert fix == ["flasher doctor --dialect motinova -i socketcan -c can0"]
    assert "stuff error" in run.out
    assert run.document["traffic"]["foreign_frames"] == 0
    assert "alone there" in one_text(examine("-i", "slcan", "-c", "ttyACM0"), "and nothing else")


def one_text(run: Run, words: str) -> str:
    return next(what for what in found(run) if words in what)


def test_some_error_frames_among_the_traffic_are_a_warning(examine: Doctor) -> None:
    examine.inbox = [message(0x720, b"\x01"), error_message(0x088, "00 00 04 00 00 00 00 00")]
    run = examine(*ON_CAN0)
    assert run.code == ExitCode.OK
    assert one(run, "1 error frame among 1 frames")[0] == "warning"


@pytest.mark.parametrize(("frames", "severity"), [(0, "problem"), (1, "warning")])
def test_what_is_no_frame_is_counted(examine: Doctor, frames: int, severity: str) -> None:
    bad = ValueError("invalid literal for int() with base 16")
    examine.inbox = [message(0x720, b"\x01")] * frames + [bad, bad]
    run = examine("-i", "slcan", "-c", "ttyACM0")
    assert one(run, "2 times the adapter delivered unreadable frames")[0] == severity
    assert run.document["health"]["unreadable"] == 2
    assert not any("the bus was silent" in what for what in found(run))


def test_the_adapter_is_opened_silent_where_it_can_be(examine: Doctor) -> None:
    run = examine("-i", "pcan", "-c", "PCAN_USBBUS1")
    assert examine.opened[0]["state"] is can.BusState.PASSIVE
    assert one(run, "listens without acknowledging")[0] == "ok"
    assert run.document["traffic"]["listen_only"] is True
    assert examine(*ON_CAN0).document["traffic"]["listen_only"] is False


def test_an_adapter_that_does_not_open_states_why(examine: Doctor) -> None:
    examine.failure = PermissionError(13, "Permission denied")
    run = examine("-i", "slcan", "-c", "/dev/ttyACM0")
    assert run.code == ExitCode.BUS
    severity, fix = one(run, "this user may not use the adapter")
    assert severity == "problem"
    assert "dialout" in fix[0]


def test_a_missing_package_is_named_with_its_command(
    examine: Doctor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    run = examine("-i", "gs_usb", "-c", "0")
    assert one(run, "the package 'gs_usb'")[1] == [
        f"{sys.executable} -m pip install 'python-can[gs-usb]'"
    ]
    assert not [what for what in found(examine(*ON_CAN0)) if "the package" in what]


def test_another_bit_rate_than_the_dialects_is_pointed_out(examine: Doctor) -> None:
    run = examine(*ON_CAN0, "-b", "500000")
    assert one(run, "500 kbit/s is configured, welling runs at 250")[1] == ["-b 250000"]
    assert run.document["bitrate_bps"] == 500_000


def test_what_configures_python_can_besides_the_command_line_is_reported(
    examine: Doctor, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "can.conf"
    file.write_text("[default]\n")
    monkeypatch.setattr("can.util.CONFIG_FILES", [str(file), str(tmp_path / "none")])
    monkeypatch.setenv("CAN_CHANNEL", "can\x1b9")
    run = examine(*ON_CAN0)
    assert one(run, f"{file} is in effect")[0] == "note"
    assert one(run, "CAN_CHANNEL=can\\x1b9 is set")[0] == "note"
    assert one(run, f"python-can {can.__version__}")[0] == "ok"


def test_ctrl_c_while_it_looks_for_adapters_ends_it(examine: Doctor) -> None:
    examine.is_interrupted = True
    run = examine()
    assert run.code == ExitCode.INTERRUPTED
    assert run.document["error"]["what"] == "Interrupted by the user."


def test_wrong_usage_is_exit_2(examine: Doctor) -> None:
    assert examine("--listen", "-1").code == ExitCode.USAGE
    assert examine("-i", "udp_multicast", "-c", "x", "--bus-kwargs", "port=x").code == 2


# -- output ---------------------------------------------------------------------------------------


def test_a_line_a_finding_with_its_commands_below() -> None:
    findings = [
        Finding(Severity.OK, "bus", "fine"),
        Finding(Severity.PROBLEM, "adapter", "down", ("do this", "then that")),
    ]
    assert doctor.lines(findings, is_coloured=False) == [
        "ok       bus: fine",
        "PROBLEM  adapter: down",
        "             do this",
        "             then that",
    ]
    assert doctor.lines(findings, is_coloured=True)[1] == "\x1b[1;31mPROBLEM\x1b[0m  adapter: down"


def test_it_is_over_when_it_has_listened(flasher: Flasher) -> None:
    began = time.perf_counter()
    flasher("doctor", "--mock", "--listen", "0.1")
    assert time.perf_counter() - began < 5.0


@each(
    "given, words",
    [
        ({}, "-i pcan -c 'a b'"),
        ({"interface": "pcan", "channel": "a b"}, "-i pcan -c 'a b'"),
        ({"bitrate": 125_000, "port": 43210}, "-i pcan -c 'a b' -b 125000 --bus-kwargs port=43210"),
        ({"app_name": "CAN alyzer"}, "-i pcan -c 'a b' --bus-kwargs 'app_name=CAN alyzer'"),
        ({"timing": object(), "can_filters": [], "fd": True}, "-i pcan -c 'a b'"),
    ],
)
def test_the_commands_that_are_named_choose_the_same_bus(given: dict[str, Any], words: str) -> None:
    assert bus_words("pcan", "a b", given) == words


def test_the_arguments_of_the_back_end_are_in_the_command_that_is_named(examine: Doctor) -> None:
    severity, fix = one(examine(*ON_CAN0, "--bus-kwargs", "port=43210"), "the bus was silent")
    assert (severity, fix) == (
        "warning",
        ["flasher scan -i socketcan -c can0 --bus-kwargs port=43210"],
    )


def test_it_states_where_it_listens(flasher: Flasher) -> None:
    reported = flasher("doctor", *MOCK, "--listen", "0.5").err
    assert reported == "listening for 0.5 s on the built-in mock ...\n"
