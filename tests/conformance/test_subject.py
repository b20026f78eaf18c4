"""`--subject`: a bootloader under test in its own process."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.cases import pw
from flasher.conformance.catalogue import Selection
from flasher.conformance.dut import Facts
from flasher.conformance.dut.device import CompiledDevice
from flasher.conformance.dut.pipes import ABI, FACTS, HEADER, PipeMessage
from flasher.conformance.dut.subject import open_subject
from flasher.conformance.explore import Explorer
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.results import CaseVerdict, RunReport
from flasher.conformance.runner import run
from flasher.conformance.subject import FlashCall, FlashEffect
from flasher.errors import UsageError
from tests.cli.conftest import Flasher

from . import wrong_bootloaders
from .bench import run_case

_HERE = "tests.peers.python_bootloader:PythonBootloader"
_FLAWS = "tests.conformance.wrong_bootloaders:"
_NULL = """
void *flasher_dut_about(void) { return 0; }
int flasher_dut_start, flasher_dut_receive, flasher_dut_tick, flasher_dut_next_frame;
"""


def _run(subject: str, *cases: str) -> RunReport:
    with open_subject(subject, "bms", None, good_image=None, second_image=None) as (
        device,
        profile,
    ):
        return run(device, profile, selection=Selection(cases))


def _failures(report: RunReport) -> str:
    return " / ".join(
        result.reason for result in report.results if result.verdict is CaseVerdict.FAIL
    )


@pytest.mark.slow
def test_a_bootloader_that_follows_the_document_passes() -> None:
    report = _run(_HERE, "RS-01", "TX-01", "EN-07", "BU-02")
    assert [result.verdict for result in report.results] == [CaseVerdict.PASS] * 4
    assert report.ok


def test_a_flash_that_fails_is_not_for_a_bootloader_of_the_older_interface() -> None:
    (result,) = _run(_HERE, "PW-04").results
    assert result.verdict is CaseVerdict.UNSUPPORTED
    assert result.reason == "needs flash memory that can be made to fail"


@pytest.mark.slow
def test_one_that_ignores_errors_of_its_flash_fails_and_one_that_compares_passes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pw, "_EFFECTS", {FlashCall.ERASE: (FlashEffect.ERROR,)})
    assert "flash erase 1 of" in _failures(_run(_FLAWS + "ClaimsToHandleErrors", "PW-04"))
    report = _run(_FLAWS + "HandlesErrors", "PW-04")
    assert report.ok, _failures(report)


@pytest.mark.slow
@pytest.mark.parametrize("cases", [("RS-01", "RS-05", "UP-04"), ("BU-02",)])
def test_idle_passes_in_its_own_process_change_nothing(
    cases: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same frames at the same times, with far fewer calls."""
    calls: list[int] = []
    called = CompiledDevice._call

    def call(self: CompiledDevice, kind: PipeMessage, *more: Any) -> None:
        calls[-1] += kind is PipeMessage.TICK
        called(self, kind, *more)

    monkeypatch.setattr(CompiledDevice, "_call", call)
    traces = []
    for is_alone in (True, False):
        if not is_alone:
            monkeypatch.setattr(CompiledDevice, "_quiet_until", lambda *_: 0.0)
        calls.append(0)
        report = _run(_FLAWS + "RunsEachMillisecond", *cases)
        assert report.ok
        traces.append([result.trace for result in report.results])
    assert traces[0] == traces[1]
    assert calls[0] < calls[1] / 2


@pytest.mark.slow
def test_the_passes_of_one_call_are_few_enough_for_the_watchdog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.conformance.dut.process.WATCHDOG_S", 0.2)
    subject = _FLAWS + "SaysNothingEachMillisecond"
    with open_subject(subject, "bms", None, good_image=None, second_image=None) as (device, _):
        assert device.port.receive(1500.0) is None
        assert device.port.now() == 1500.0


@pytest.mark.slow
def test_frames_in_the_controller_are_sent_while_the_processor_waits_for_the_flash() -> None:
    report = _run(_FLAWS + "ErasesForEach", "UP-05")
    assert _failures(report) == ""
    (result,) = report.results
    assert result.verdict is CaseVerdict.PASS


@pytest.mark.slow
def test_time_passes_for_one_that_polls_the_clock() -> None:
    assert _run(_FLAWS + "WaitsForTheClock", "EN-02").ok


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flaw", "case_id", "found"),
    [
        (
            "Raises",
            "EN-01",
            "ended with status 1 in flasher_dut_receive; its last log lines: about to",
        ),
        ("Raises", "EN-01", "ZeroDivisionError"),
        ("WritesTwice", "EN-01", "programmed without having been erased"),
        ("ReadsOutside", "EN-01", "flash_read at offset 0xFFF0: 32 bytes are outside the flash"),
        ("EndsAtOnce", "BR-01", "the bootloader ended with status 3 in flasher_dut_start"),
        ("StartsWhatIsTorn", "PW-01", "an incomplete application"),
        ("RecordsBeforeTheLastPacket", "PW-01", "an incomplete application"),
        ("CompactsAfterComplete", "PW-01", "in a row: expected application"),
        ("LosesComplete", "EN-01", "expected complete"),
        ("Restarts", "EN-01", "boot version"),
    ],
)
def test_what_a_chip_does_not_allow_is_a_finding(
    monkeypatch: pytest.MonkeyPatch, flaw: str, case_id: str, found: str
) -> None:
    monkeypatch.setattr(pw, "_OPERATIONS_MAX", 3)
    report = _run(_FLAWS + flaw, case_id)
    assert found in _failures(report) + report.not_upgradable + report.stopped


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case_id", "given"),
    [("PW-01", {}), ("RS-03", {"limits.erase_s": 0.5, "limits.start_s": 1.0})],
)
def test_a_device_may_be_deaf_between_its_bursts(
    monkeypatch: pytest.MonkeyPatch, case_id: str, given: dict[str, Value]
) -> None:
    monkeypatch.setattr(pw, "_OPERATIONS_MAX", 3)
    kind = _FLAWS + "ListensAfterItsBurst"
    with open_subject(kind, "bms", None, good_image=None, second_image=None) as (device, profile):
        judged_by = ConformanceProfile({**profile.given, **given})
        report = run(device, judged_by, selection=Selection((case_id,)))
    assert not _failures(report)
    assert report.ok


@pytest.mark.slow
def test_flash_operations_that_only_some_upgrades_have_are_not_tried_among_many(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pw, "_OPERATIONS_MAX", 3)
    (result,) = _run(_FLAWS + "WritesALog", "PW-01").results
    assert result.verdict is CaseVerdict.PASS_IN_PART
    assert "an upgrade has more than 3 flash operations" in result.reason


def test_half_a_message_before_a_power_cut_spoils_one_of_the_restart() -> None:
    kind = _FLAWS + "AnswersByFeedbackToo"
    with open_subject(kind, "bms", None, good_image=None, second_image=None) as (device, profile):
        steps = ["reset", "update=good", "packets=all", "cut=0"]
        explored = Explorer(device, profile).replay(steps)
    assert explored.finding is None


@pytest.mark.slow
def test_a_record_that_is_written_when_complete_has_left_is_lost_in_a_power_cut() -> None:
    def cut(bench: Bench) -> None:
        pw._cut_after_complete(bench, pw._upgrade(bench))

    flaw = _FLAWS + "RecordsAfterComplete"
    with open_subject(flaw, "bms", None, good_image=None, second_image=None) as (device, profile):
        report = run_case(cut, device=device, profile=profile)
    assert "just after complete: expected application" in _failures(report)


@pytest.mark.slow
def test_a_call_that_does_not_return_is_ended_and_is_a_finding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.conformance.dut.process.WATCHDOG_S", 0.2)
    report = _run(_FLAWS + "Hangs", "TX-06")
    found = _failures(report) + report.not_upgradable + report.stopped
    assert "did not return from flasher_dut_receive" in found


def test_a_pause_of_this_computer_is_not_blamed_on_the_bootloader(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever it takes, of a wait that it interrupts no more than one part is over."""

    class PausedPoll:
        def __init__(self) -> None:
            self._poll = select.poll()
            self.register, self.unregister = self._poll.register, self._poll.unregister
            self._is_paused = False

        def poll(self, timeout_ms: float) -> list[tuple[int, int]]:
            self._is_paused = not self._is_paused
            return [] if self._is_paused else self._poll.poll(timeout_ms)

    real = SimpleNamespace(**{**vars(select), "poll": PausedPoll})
    monkeypatch.setattr("flasher.conformance.dut.process.select", real)
    assert _run(_HERE, "TX-06").ok


@pytest.mark.slow
def test_a_second_call_that_does_not_return_is_ended_sooner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.conformance.dut.process.WATCHDOG_S", 0.4)
    monkeypatch.setattr("flasher.conformance.dut.process._AFTER_HANG_S", 0.1)
    report = _run(_FLAWS + "Hangs", "TX-06")
    assert "within 0.4 s of real time" in report.not_upgradable
    assert "within 0.1 s of real time" in _failures(report)


@pytest.mark.slow
def test_a_bootloader_that_prints_without_end_is_ended_before_the_disk_is_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.conformance.dut.process._FILE_MAX_SIZE", 100_000)
    report = _run(_FLAWS + "PrintsForEver", "EN-01")
    assert "ended by SIGXFSZ in flasher_dut_receive" in _failures(report)


@pytest.mark.slow
def test_a_crash_is_printed_whole_and_once(flasher: Flasher, tmp_path: Path) -> None:
    junit = tmp_path / "junit.xml"
    ran = flasher(
        *("conformance", "-t", "bms", "--subject", _FLAWS + "IsSanitized", "--junit", junit),
        *("--case", "EN-01", "--case", "EN-02"),
    )
    assert ran.code == 12
    lines = ran.out.splitlines()
    assert lines.count("    SUMMARY: message.c:70)") == 1
    assert lines[lines.index("    SUMMARY: message.c:70)") - 1].endswith("stack-buffer-overflow")
    assert junit.read_text("utf-8").count("\n  SUMMARY: message.c:70") == 2


@pytest.mark.slow
def test_the_report_of_a_sanitizer_is_printed_without_its_dump() -> None:
    report = _run(_FLAWS + "IsSanitized", "EN-01")
    found = _failures(report) + report.not_upgradable + report.stopped
    assert "stack-buffer-overflow | SUMMARY: message.c:70)" in found
    assert "Shadow" not in found


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["ReadsForEver", "LogsForEver"])
def test_a_call_that_asks_its_hardware_for_ever_is_ended_and_is_a_finding(flaw: str) -> None:
    report = _run(_FLAWS + flaw, "EN-01")
    text = _failures(report) + report.not_upgradable + report.stopped
    assert "16 times its flash in one call" in text


@pytest.mark.slow
def test_the_controller_takes_three_frames_and_asks_for_more_when_it_has_room() -> None:
    with open_subject(
        _FLAWS + "SendsWithoutEnd", "bms", None, good_image=None, second_image=None
    ) as (device, _):
        replies = []
        for off_bus_at in (0.05, 0.1):
            while (arrival := device.port.receive(off_bus_at)) is not None:
                replies.append(arrival)
            device.bus_off(0.01)
    assert max(arrival.frame.data[0] for arrival in replies) == 2  # it is asked while one has room
    times = [arrival.at for arrival in replies]
    gaps = [late - early for early, late in pairwise(times)]
    assert len(times) > 150
    assert [gap > 0.001 for gap in gaps].count(True) == 1  # back to back, except for the bus-off


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["EndsAtOnce", "SaysNothing"])
def test_no_message_names_wires_for_a_bootloader_on_the_computer(flaw: str) -> None:
    report = _run(_FLAWS + flaw, "BR-01")
    assert "could not be restored" in report.stopped
    assert "wiring" not in report.stopped + _failures(report)


@pytest.mark.slow
def test_signals_to_the_group_of_processes_are_for_the_suite() -> None:
    assert _run(_FLAWS + "EndsItsGroup", "EN-02").ok


def _children() -> set[str]:
    """Processes that this one has started, among them those of other tests in it."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def test_no_process_is_left() -> None:
    before = _children()
    with open_subject(_HERE, "bms", None, good_image=None, second_image=None) as (device, _):
        device.power(on=True)
        device.port.receive(0.01)
        assert len(_children() - before) == 1
    assert _children() <= before


@pytest.mark.parametrize(
    ("subject", "stated"),
    [
        ("missing", "There is no bootloader missing"),
        ("nowhere:make", "No module named 'nowhere'"),
        (_FLAWS + "nothing", "has no attribute 'nothing'"),
        (
            _FLAWS + "raises",
            f"RuntimeError: no hardware today ({wrong_bootloaders.__file__}, line ",
        ),
        (_FLAWS + "returns_nothing", "it returns None, which has no `facts`"),
        (_FLAWS + "NOT_CALLABLE", "'int' object is not callable"),
        ("README.md", "not a program or shared library"),
        (shutil.which("true") or "", "ended with status 0 in flasher_dut_about"),
    ],
)
def test_what_is_no_bootloader_is_reported_at_once(subject: str, stated: str) -> None:
    with pytest.raises(UsageError) as raised:
        _run(subject, "RS-01")
    assert stated in f"{raised.value} {raised.value.cause}"
    assert "Traceback" not in raised.value.cause


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "reported"),
    [
        ("import os; os._exit(3)", "does not start: the bootloader ended with status 3"),
        ("while True: pass", "does not start: its module was not loaded within 0.5 s"),
    ],
)
def test_a_module_that_does_not_load_is_refused(
    module: str, reported: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.conformance.dut.process._SPAWNER_S", 0.5)
    (tmp_path / "boot_module.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    before = _children()
    with pytest.raises(UsageError, match=reported):
        _run("boot_module:make", "RS-01")
    assert _children() <= before


def test_a_factory_is_not_to_be_built_from_c() -> None:
    with pytest.raises(UsageError) as raised:
        _run(_FLAWS + "raises", "RS-01")
    assert raised.value.remedy.startswith("Give a function without arguments")


def test_a_file_for_another_processor_is_refused(tmp_path: Path) -> None:
    program = tmp_path / "boot"
    program.write_bytes(b"\x7fELF for another one")
    program.chmod(0o755)
    with pytest.raises(UsageError) as raised:
        _run(str(program), "RS-01")
    assert raised.value.cause == "this computer cannot run it: Exec format error"


@pytest.mark.parametrize("numbers", [(0, 0, 0), (4096, 0, 8), (4096, 1024, 0)])
def test_sizes_of_nothing_are_refused(numbers: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="each must be a multiple of the next"):
        Facts(*numbers, application_offset=0, application_bytes=1024)


def test_what_is_written_to_the_pipe_and_is_no_message_is_reported(tmp_path: Path) -> None:
    program = tmp_path / "boot"
    program.write_text("#!/bin/sh\necho hello, I am a bootloader\nread line\n")
    program.chmod(0o755)
    with pytest.raises(UsageError, match="which is not a message"):
        _run(str(program), "RS-01")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    ("code", "stated"),
    [
        ("int another;", "undefined symbol: flasher_dut_about"),
        (_NULL, "flasher_dut_about returns NULL"),
    ],
)
def test_a_library_in_the_working_directory_states_what_it_lacks(
    code: str, stated: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("boot.c").write_text(code)
    subprocess.run(["cc", "-shared", "-fPIC", "boot.c", "-o", "boot.so"], check=True)
    with pytest.raises(UsageError) as raised:
        _run("boot.so", "RS-01")
    assert raised.value.cause.endswith(stated)


def test_a_program_of_another_version_of_the_header_is_refused(tmp_path: Path) -> None:
    program = tmp_path / "boot"
    facts = HEADER.pack(PipeMessage.FACTS.value, FACTS.size) + FACTS.pack(ABI + 1, *8 * [0])
    program.write_text(f"#!{sys.executable}\nimport os\nos.write(1, {facts!r})\nos.read(0, 1)\n")
    program.chmod(0o755)
    with pytest.raises(UsageError, match=f"version {ABI + 1} .* this flasher has version {ABI}"):
        _run(str(program), "RS-01")


_OF_ABI_1 = """
import os, struct, sys
def send(kind, data):
    os.write(1, struct.pack("<B3xI", ord(kind), len(data)) + data)
send("f", struct.pack("<9I", 1, 4096, 1024, 8, 0, 2048, 100, 10, 3))
os.read(0, 8 + 12)
send("e", struct.pack("<QI", 5, 0))
answer = os.read(0, 64)
send("l", repr(struct.unpack("<B3xIQ", answer)).encode())
os._exit(4)
"""


@pytest.mark.slow
def test_a_program_of_the_first_version_of_the_header_gets_its_answers(tmp_path: Path) -> None:
    program = tmp_path / "boot"
    program.write_text(f"#!{sys.executable}{_OF_ABI_1}")
    program.chmod(0o755)
    assert f"its last log lines: ({ord('k')}, 8, 105)" in _run(str(program), "RS-01").stopped


@pytest.mark.slow
def test_the_command_line_tests_it(flasher: Flasher) -> None:
    ran = flasher("conformance", "-t", "bms", "--subject", _HERE, "--case", "RS-01", "--json")
    assert ran.code == 0
    assert ran.document["report"]["subject"] == f"python bootloader ({_HERE})"


def test_the_mock_and_a_bootloader_exclude_each_other(flasher: Flasher) -> None:
    ran = flasher("conformance", "-t", "bms", "--subject", _HERE, "--mock")
    assert ran.code == 2
    assert "exclude each other" in ran.err


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_c_files_that_are_written_compile(flasher: Flasher, tmp_path: Path) -> None:
    assert flasher("conformance", "header", str(tmp_path)).code == 0
    strict = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
    subprocess.run(["cc", *strict, "-c", "flasher_dut_process.c"], cwd=tmp_path, check=True)
