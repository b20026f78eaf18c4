"""`flasher flash`: the main job, its words and its exit codes."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
import uuid
from pathlib import Path

import can
import pytest

from flasher.api import connect_mock
from flasher.bus.simulated import SimulatedLink
from flasher.errors import BusError, ExitCode
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.settings.device_model import set_option
from tests.cli.conftest import SAMPLES, Flasher

BMS = SAMPLES / "bms.hex"
OBC = SAMPLES / "obc.bin"
"""The small one, where the device does not matter."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sample", "target", "boot_version"),
    [
        ("bms.hex", "bms", "BMS"),
        ("wmc.s19", "wmc", "WMC"),
        ("wmc.hex", "mc", "WMC"),
        ("obc.bin", "obc", "PBU"),
        ("obc.elf", "PBU", "PBU"),
    ],
)
def test_each_sample_is_flashed_to_the_mock(
    flasher: Flasher, sample: str, target: str, boot_version: str
) -> None:
    run = flasher("flash", SAMPLES / sample, "-t", target, "--mock", "--mock-speed", "0")
    assert run.code == ExitCode.OK
    assert "transferred:" in run.out
    assert f"boot version: {boot_version} V1.0.0" in run.out
    assert "completed:    the device confirmed the complete image" in run.out
    running = "V1r0r4_20220512 (the application runs and names" if target == "bms" else "not asked"
    assert f"running:      {running}" in run.out
    assert "\r" not in run.err


class _Time:
    """Passes in sleeps, and a little whenever it is looked at."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def perf_counter(self) -> float:
        self.now_s += 1e-7
        return self.now_s

    def clock_gettime(self, _clock: int) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.slow
def test_the_paced_mock_takes_the_time_that_the_plan_states(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = _Time()
    monkeypatch.setattr("flasher.bus.link.time", real)
    speed = 20.0
    run = flasher(
        "flash", SAMPLES / "wmc.hex", "-t", "wmc", "--mock", "--mock-speed", speed, "--json"
    )
    wire_s = run.document["plan"]["wire_s"]
    transfer_s = run.document["outcome"]["statistics"]["transfer_s"]
    # The device writes its flash meanwhile; before and after, both ask and answer.
    assert wire_s <= transfer_s <= 1.2 * wire_s
    assert transfer_s <= real.now_s * speed <= 2.0 * transfer_s


@pytest.mark.slow
def test_json_is_one_document_with_the_exit_code_in_it(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms", "--mock", "--mock-speed", "0", "--json")
    document = run.document
    assert run.code == document["exit_code"] == 0
    assert document["ok"] is True
    assert document["outcome"]["ending"] == "completed"
    assert document["image"]["size_bytes"] == 78351
    assert document["plan"]["packets"] == 613


def test_json_of_a_failure_holds_the_error_and_its_code(flasher: Flasher) -> None:
    run = flasher("flash", SAMPLES / "bad" / "no_end.hex", "-t", "bms", "--mock", "--json")
    document = run.document
    assert run.code == document["exit_code"] == ExitCode.IMAGE
    assert document["ok"] is False
    assert document["error"]["what"]
    assert "error:" in run.err


def test_a_dry_run_prints_the_plan_and_opens_no_adapter(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms", "--dry-run", "-i", "socketcan", "-c", "none0")
    assert run.code == ExitCode.OK
    assert "613 packets" in run.out
    assert "nothing was sent" in run.out


def test_a_quiet_flash_prints_only_the_result(flasher: Flasher) -> None:
    run = flasher("-q", "flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0")
    assert run.err == ""
    assert "completed:" in run.out


@pytest.mark.parametrize("words", [("-v",), ("-vv",)])
def test_verbosity_is_taken_before_and_after_the_command(
    flasher: Flasher, words: tuple[str, ...]
) -> None:
    before = flasher(*words, "flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0")
    behind = flasher("flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0", *words)
    assert before.code == behind.code == ExitCode.OK


@pytest.mark.parametrize("suffix", [".asc", ".log", ".csv", ".blf"])
def test_the_trace_holds_every_frame_in_both_directions(
    flasher: Flasher, tmp_path: Path, suffix: str
) -> None:
    trace = tmp_path / f"upgrade{suffix}"
    run = flasher(
        "flash", SAMPLES / "obc.bin", "-t", "obc", "--mock", "--mock-speed", "0",
        "--trace-file", trace, "--json",
    )  # fmt: skip
    assert run.code == ExitCode.OK
    with can.LogReader(trace) as reader:
        messages = list(reader)
    ids = [message.arbitration_id for message in messages]
    assert set(ids) == {0x753, 0x735}
    # At most one more boot version than the plan has: the burst goes on while it is answered.
    assert len(ids) >= run.document["plan"]["frames"]
    times = [message.timestamp for message in messages]
    assert times == sorted(times)


def test_a_trace_that_fills_its_disk_does_not_stop_the_upgrade(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full:
        def __call__(self, _message: can.Message) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        def stop(self) -> None:
            pass

    monkeypatch.setattr("flasher.trace.recorder.can.Logger", lambda _path: Full())
    run = flasher(
        "flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0",
        "--trace-file", tmp_path / "upgrade.asc",
    )  # fmt: skip
    assert run.code == ExitCode.OK
    assert "completed:" in run.out
    assert "warning: the trace" in run.err
    assert "No space left" in run.err


def test_another_bit_rate_is_planned_with_and_pointed_out(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms", "--dry-run", "-b", "500000")
    assert "at 500 kbit/s (not the document's bit rate)" in run.out


def test_another_bit_rate_that_no_option_names_is_refused_and_nothing_is_opened(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("can.util.load_environment_config", lambda *_: {"bitrate": "500000"})
    monkeypatch.delattr("can.Bus")
    for command in (("flash", OBC, "-t", "obc"), ("info", "-t", "bms"), ("scan",), ("monitor",)):
        run = flasher(*command, "-i", "virtual", "-c", "a")
        assert run.code == ExitCode.BUS, run.err
        assert "500 kbit/s (CAN_BITRATE), not 250 kbit/s (the dialect's)" in run.err


@pytest.mark.parametrize("rate", ["0", "-1", "10", "3000000", "fast", "250k"])
def test_what_is_no_bit_rate_is_wrong_usage(flasher: Flasher, rate: str) -> None:
    run = flasher("flash", OBC, "-t", "obc", "-i", "virtual", f"--bitrate={rate}")
    assert run.code == ExitCode.USAGE
    assert rate in run.err


@pytest.mark.parametrize("gap", [("--frame-gap", "0.081"), ("--packet-gap", "10.1")], ids=" ".join)
def test_a_gap_that_no_upgrade_survives_is_wrong_usage(
    flasher: Flasher, gap: tuple[str, str]
) -> None:
    run = flasher("flash", OBC, "-t", "obc", "--mock", *gap)
    assert run.code == ExitCode.USAGE
    assert f"Choose a shorter {gap[0]}" in run.err


@pytest.mark.parametrize("words", [("flash", "--json"), ("--json", "flash", "--nonsense")])
def test_wrong_usage_is_a_json_document_too(flasher: Flasher, words: tuple[str, ...]) -> None:
    run = flasher(*words)
    assert run.code == run.document["exit_code"] == ExitCode.USAGE
    assert run.document["error"]["kind"] == "UsageError"


@pytest.mark.parametrize("speed", ["0.01", "-1", "nan"])
def test_a_mock_so_slow_that_nothing_moves_is_refused(flasher: Flasher, speed: str) -> None:
    run = flasher("flash", OBC, "-t", "obc", "--mock", "--mock-speed", speed)
    assert run.code == ExitCode.USAGE


def test_a_trace_of_an_unknown_kind_is_wrong_usage(flasher: Flasher, tmp_path: Path) -> None:
    run = flasher("flash", OBC, "-t", "obc", "--mock", "--trace-file", tmp_path / "upgrade.xyz")
    assert run.code == ExitCode.USAGE
    assert ".asc" in run.err


def test_a_trace_that_cannot_be_written_is_wrong_usage(flasher: Flasher, tmp_path: Path) -> None:
    run = flasher(
        "flash", OBC, "-t", "obc", "--mock", "--trace-file", tmp_path / "no" / "upgrade.asc"
    )
    assert run.code == ExitCode.USAGE
    assert "[E202]" in run.err


# -- what goes wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sample", sorted(path.name for path in (SAMPLES / "bad").iterdir() if path.is_file())
)
def test_every_bad_sample_is_rejected_with_one_message(flasher: Flasher, sample: str) -> None:
    run = flasher("flash", SAMPLES / "bad" / sample, "-t", "bms", "--mock")
    assert run.code == ExitCode.IMAGE
    assert run.err.count("error:") == 1
    assert "Traceback" not in run.err
    assert "what to do:" in run.err
    assert run.out == ""


@pytest.mark.parametrize(
    "words",
    [
        ("flash", "nowhere.hex", "-t", "bms", "--mock"),
        ("flash", BMS, "-t", "cdl", "--mock"),
        ("flash", BMS, "--mock"),
        ("flash", OBC, "-t", "obc", "--mock", "--retries", "0"),
        ("flash", OBC, "-t", "obc", "--mock", "--timeout", "-1"),
        ("flash", OBC, "-t", "obc", "--mock", "--range", "5"),
        ("flash", OBC, "-t", "obc", "--mock", "--base", "12x"),
        ("flash", OBC, "-t", "obc", "--mock", "--no-such-option"),
        ("flash", OBC, "-t", "obc", "--mock", "--dialect", "motinova"),
        ("flash", BMS, "-t", "bms", "-i", "no_such_interface", "-c", "0"),
        ("flash",),
        ("no-such-command",),
        (),
    ],
)
def test_wrong_usage_is_exit_code_2(flasher: Flasher, words: tuple[str | Path, ...]) -> None:
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "Traceback" not in run.err


def test_an_unknown_interface_names_the_known_ones(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms", "-i", "no_such_interface", "-c", "0")
    assert "socketcan" in run.err


def test_no_adapter_configured_is_exit_code_4_and_names_the_fix(flasher: Flasher) -> None:
    run = flasher("flash", BMS, "-t", "bms")
    assert run.code == ExitCode.BUS
    assert "`flasher adapters`" in run.err


def test_an_adapter_that_cannot_be_opened_is_exit_code_4_and_names_the_fix(
    flasher: Flasher,
) -> None:
    run = flasher("flash", BMS, "-t", "bms", "-i", "socketcan", "-c", "nocan7")
    assert run.code == ExitCode.BUS
    assert "nocan7" in run.err
    assert "what to do:" in run.err


@pytest.mark.slow
def test_a_silent_bus_is_exit_code_5_in_bounded_time(flasher: Flasher) -> None:
    began = time.perf_counter()
    run = flasher(
        "flash", BMS, "-t", "bms", "-i", "virtual", "-c", uuid.uuid4().hex, "--timeout", "0.2"
    )
    assert run.code == ExitCode.NO_ANSWER
    assert time.perf_counter() - began < 3.0
    assert "State of the device: this run erased nothing" in run.err


def test_an_adapter_that_fails_in_the_middle_states_how_far_it_came_and_what_is_left(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """BU-05."""
    sent = 0

    def send(_link: SimulatedLink, _frame: Frame) -> None:
        nonlocal sent
        sent += 1
        if sent > 200:
            raise BusError("The adapter failed while sending: unplugged.", where="socketcan can0")
        real_send(_link, _frame)

    real_send = SimulatedLink.send
    monkeypatch.setattr(SimulatedLink, "send", send)
    run = flasher("flash", BMS, "-t", "bms", "--mock", "--mock-speed", "0", "--attempts", "1")
    assert run.code == ExitCode.BUS
    assert "transferring, packet 11 of 613; socketcan can0" in run.err
    assert "State of the device: its application is erased" in run.err


def test_filters_do_not_disturb_the_json_on_stdout(flasher: Flasher) -> None:
    run = flasher(
        "flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0", "--json",
        "--filter", "725:7FF", "--filter", "720:7FF",
    )  # fmt: skip
    assert run.document["ok"] is True


def test_a_bug_is_exit_code_1_and_is_called_a_bug(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_args: object, **_options: object) -> None:
        raise ZeroDivisionError("injected")

    monkeypatch.setattr("flasher.api.Device.upgrade", broken)
    run = flasher("flash", OBC, "-t", "obc", "--mock")
    assert run.code == ExitCode.INTERNAL
    assert "a bug in flasher" in run.err
    assert "injected" in run.err


@pytest.mark.parametrize(
    ("option", "code"),
    [
        ("boot_version=V9.9.9", ExitCode.OK),
        ("boot_version=hello!", ExitCode.WRONG_DEVICE),
        ("image_checksum=crc32", ExitCode.REFUSED),
    ],
)
def test_the_devices_choices_decide_the_exit_code(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, option: str, code: ExitCode
) -> None:
    key, _, value = option.partition("=")
    profile = set_option(DeviceProfile(), key, value)
    monkeypatch.setattr(
        "flasher.api.connect_mock",
        lambda *where, **how: connect_mock(*where, **{**how, "profile": profile}),
    )
    run = flasher("flash", OBC, "-t", "obc", "--mock", "--mock-speed", "0")
    assert run.code == code


# -- as a process ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_help_is_quick_and_importing_flasher_loads_no_command_line_and_no_can() -> None:
    code = (
        "import sys, flasher; "
        "bad = [m for m in sys.modules if m == 'can' or m.startswith(('can.', 'flasher.cli'))]; "
        "sys.exit(repr(bad) if bad else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=20)
    before = os.times()
    done = subprocess.run(
        [sys.executable, "-m", "flasher", "--help"],
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    )
    assert "exit codes:" in done.stdout
    # Processor time, which a busy machine does not lengthen much; 0.15 s on an idle one.
    after = os.times()
    took_s = after.children_user + after.children_system
    assert took_s - before.children_user - before.children_system < 1.0
