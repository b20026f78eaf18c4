"""The command `flasher conformance`: summary, selection, report files, exit codes."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import pytest

from flasher.cli.bench.conformance import conformance, exit_code
from flasher.cli.framework import Option
from flasher.conformance.bench import Bench
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.cases import rs
from flasher.conformance.catalogue import CASES, NOT_IMPLEMENTED, QUICK
from flasher.conformance.clauses import CLAUSES
from flasher.conformance.mock import MockSubject
from flasher.conformance.profile import ConformanceProfile, load_profile, profile_keys
from flasher.conformance.simulated import SimulatedPort
from flasher.errors import BusError, ExitCode
from pytest_flasher import BENCH_OPTIONS
from tests.cli.conftest import SAMPLES, Flasher
from tests.report.pages import Page, assert_self_contained

from .bench import PROFILE, fails_once, passes_once, run_case

MOCK = ("conformance", "-t", "bms", "--mock")
WRONG = (*MOCK, "--variant", "announces-three-times", "--case", "RS-01", "--case", "RS-04")


@pytest.mark.slow
def test_a_device_that_follows_the_protocol_passes(flasher: Flasher) -> None:
    run = flasher(*MOCK, "--group", "rs")
    assert run.code == 0
    assert "RS  reset and boot version  5 pass" in run.out
    assert "good image at the end: flashed and verified" in run.out
    assert run.out.splitlines()[-1].startswith("passed: 5 pass;")
    assert run.err == ""


def test_a_failure_has_one_line_with_expected_got_and_a_command_that_repeats_it(
    flasher: Flasher,
) -> None:
    run = flasher(*WRONG, "--seed", "a b", "--junit", "/dev/null")
    assert run.code == 12
    (line,) = (line for line in run.out.splitlines() if line.startswith("FAIL RS-01"))
    keys = "(profile: device.versions = 4, limits.version_spacing_s = 0.05)"
    assert f"expected boot version {keys}; got nothing within" in line
    command = shlex.split(line.partition("replay: ")[2])
    assert command[:2] == ["flasher", "conformance"]
    assert "--junit" not in command
    again = flasher(*command[1:])
    assert again.code == 12
    assert line in again.out
    assert "RS-04" not in again.out


@pytest.mark.slow
def test_the_replay_has_what_is_about_the_bench_and_nothing_about_the_run(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    @contextmanager
    def mock_instead(_options: object) -> Iterator[tuple[MockSubject, ConformanceProfile]]:
        yield MockSubject(), PROFILE

    monkeypatch.setattr("flasher.cli.bench.conformance_bench.open_bench", mock_instead)
    monkeypatch.chdir(tmp_path)
    words = shlex.split(
        "conformance -t bms --profile 'my p.toml' --case RS-04 -i socketcan --seed 9 --repeat 2 "
        "--json --html=a.html -v --strict --bus-kwargs a=1 --trace-dir t -c can0 --good-image ok"
    )
    results = flasher(*words).document["report"]["results"]
    command = shlex.split(results[0]["replay"])
    assert command[-4:] == ["--case", "RS-04", "--seed", "9"]
    assert command[:2] == ["flasher", "conformance"]
    assert sorted(command[2:-4]) == sorted(
        shlex.split(
            "-t bms --profile 'my p.toml' --good-image ok -i socketcan --strict --bus-kwargs a=1 "
            "-c can0"
        )
    )
    assert results[1]["replay"] == f"{results[0]['replay']} --repeat 2"


def test_the_list_shows_what_can_be_run_and_what_cannot(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(NOT_IMPLEMENTED, "BU-99", "needs an injector")
    run = flasher("conformance", "--list", "--case", "RS-05", "--case", "bu-99")
    assert run.code == 0
    assert "RS-05  power-up" in run.out
    assert "BU-99  cannot be run: needs an injector" in run.out
    everything, quick = (
        flasher("conformance", "--list", *words, "--json").document["cases"]
        for words in ((), ("--quick",))
    )
    assert [case["id"] for case in quick] == list(QUICK)
    assert not any("long" in case["requires"] for case in quick)
    assert len(quick) < len(everything)
    assert all(case["title"] for case in everything)


@pytest.mark.slow
def test_a_quick_run_takes_less_than_a_minute_on_the_bus(flasher: Flasher) -> None:
    report = flasher(*MOCK, "--quick", "--json").document["report"]
    assert report["passed"]
    assert report["duration_s"] < 60
    assert len(report["results"]) == len(QUICK)


def test_a_repeated_run_has_every_case_several_times(flasher: Flasher) -> None:
    run = flasher(*MOCK, "--case", "RS-04", "--repeat", "3", "--json")
    results = run.document["report"]["results"]
    assert [result["repeat"] for result in results] == [1, 2, 3]
    assert results[2]["replay"].endswith("--case RS-04 --seed 1 --repeat 3")


def test_verbose_reports_every_case_on_both_streams(flasher: Flasher) -> None:
    run = flasher(*MOCK, "--case", "RS-04", "-v")
    assert f"pass          RS-04  {CASES['RS-04'].title}" in run.out
    assert "RS-04 pass (0 left)" in run.err


def test_a_terminal_shows_which_case_runs_and_what_fails_at_once(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    run = flasher(*WRONG)
    assert f"RS-04 {CASES['RS-04'].title}" in run.err
    assert "after RS-01" in run.err
    assert "RS-01 fail: expected boot version (profile: device.versions = 4" in run.err
    assert "; got nothing within 0.2 s (1 left)" in run.err
    assert "0/2 " in run.err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_a_file_that_cannot_be_written_keeps_no_other_one_from_it(
    flasher: Flasher, tmp_path: Path
) -> None:
    report, html = tmp_path / "report.json", tmp_path / "report.html"
    run = flasher(*WRONG, "--junit", "/dev/full", "--json-report", report, "--html", html)
    assert run.code == 2
    assert "/dev/full cannot be written: No space left on device." in run.err
    assert "FAIL RS-01" in run.out
    assert json.loads(report.read_text())["results"]
    assert html.exists()


def test_traces_that_cannot_be_written_keep_no_report_from_it(
    flasher: Flasher, tmp_path: Path
) -> None:
    traces, report = tmp_path / "traces", tmp_path / "report.json"
    first = flasher(*WRONG, "--trace-dir", traces, "--json-report", report)
    assert first.code == 12
    (one, *_) = traces.iterdir()
    one.unlink()
    one.mkdir()
    run = flasher(*WRONG, "--trace-dir", traces, "--json-report", report)
    assert run.code == 2
    assert "--trace-dir" in run.err
    written = {each["trace_file"] for each in json.loads(report.read_text())["results"]}
    assert one.name not in written


@pytest.mark.parametrize("option", ["--html", "--json-report"])
def test_no_file_of_the_command_is_written_over(
    option: str, flasher: Flasher, tmp_path: Path
) -> None:
    image = tmp_path / "good.bin"
    image.write_bytes(b"what runs")
    run = flasher(*MOCK, "--good-image", image, option, image, "--case", "RS-01")
    assert run.code == 2
    assert "is a file of the command itself" in run.err
    run = flasher(*MOCK, "--junit", tmp_path / "a", option, tmp_path / "a", "--case", "RS-01")
    assert run.code == 2
    assert not (tmp_path / "a").exists()
    assert image.read_bytes() == b"what runs"


def test_a_comparison_is_not_written_over_a_report(flasher: Flasher, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert flasher(*MOCK, "--case", "RS-01", "--json-report", report).code == 0
    before = report.read_bytes()
    run = flasher("conformance", "compare", report, report, "--html", report)
    assert run.code == 2
    assert report.read_bytes() == before


def test_a_walk_reports_before_it_begins_that_its_trace_cannot_be_written(
    flasher: Flasher, tmp_path: Path
) -> None:
    walk = ("conformance", "explore", "-t", "bms", "--mock", "--steps", "3")
    run = flasher(*walk, "--trace-file", tmp_path / "nowhere" / "walk.log")
    assert run.code == 2
    assert run.out == ""


def test_all_files_are_written_with_what_they_are_for(flasher: Flasher, tmp_path: Path) -> None:
    names = {"--junit": "a.xml", "--json-report": "a.json", "--html": "a.html"}
    words = [word for option, name in names.items() for word in (option, str(tmp_path / name))]
    run = flasher(*WRONG, *words, "--trace-dir", str(tmp_path / "new" / "traces"))
    assert run.code == 12
    assert (tmp_path / "a.xml").read_text().startswith("<?xml")
    assert (tmp_path / "a.html").read_text().startswith("<!DOCTYPE html>")
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["counts"]["fail"] == 1
    (trace,) = (tmp_path / "new" / "traces").iterdir()
    assert trace.name == "RS-01.log"
    assert document["results"][0]["trace_file"] == "RS-01.log"
    printed = flasher("explain", trace)
    assert printed.code == 0
    assert "boot version" in flasher("explain", trace, "--all").out


@pytest.mark.slow
def test_the_matrix_has_each_clause_with_its_cases_and_what_was_not_judged(
    flasher: Flasher, tmp_path: Path
) -> None:
    table, page = tmp_path / "clauses.csv", tmp_path / "clauses.html"
    for path in (table, page):
        assert flasher(*WRONG, "--case", "UP-03", "--matrix", path).code == 12
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["clause"] for row in rows)) == list(CLAUSES)
    verdicts = {(row["clause"], row["case"]): row["verdict"] for row in rows}
    assert verdicts["Welling 5.1, figure 2 (begin)", "RS-01"] == "fail"
    assert verdicts["R17", "UP-03"] == "pass"
    assert verdicts["Welling 5.2, table 9 (C502)", "EN-01"] == "not selected"
    reasons = {row["case"]: row["reason"] for row in rows}
    assert "expected" in reasons["RS-01"]
    assert reasons["UP-03"] == ""
    html = page.read_text("utf-8")
    assert_self_contained(Page(html))
    assert f" of {len(CLAUSES)} clauses were judged in this run." in html


def test_a_case_that_failed_is_run_again_with_its_seed(flasher: Flasher, tmp_path: Path) -> None:
    report = tmp_path / "a.json"
    first = flasher(*WRONG, "--case", "UP-03", "--seed", "7", "--json-report", report)
    assert first.code == 12
    again = flasher("--json", *WRONG[:6], "--rerun-failed", report)
    assert again.code == 12
    document = again.document["report"]
    assert [result["id"] for result in document["results"]] == ["RS-01"]
    assert document["seed"] == "7"


def test_cases_that_failed_are_selected_by_the_report_alone(
    flasher: Flasher, tmp_path: Path
) -> None:
    report = tmp_path / "a.json"
    assert flasher(*MOCK, "--case", "RS-01", "--json-report", report).code == 0
    none = flasher(*MOCK, "--rerun-failed", report)
    assert none.code == 2
    assert "there is nothing to run again" in none.err
    other = flasher("conformance", "-t", "wmc", "--mock", "--rerun-failed", report)
    assert other.code == 2
    assert "is about the target bms, not wmc" in other.err
    for words in (("--case", "RS-01"), ("--quick",), ("--seed", "1")):
        both = flasher(*MOCK, "--rerun-failed", report, *words)
        assert both.code == 2
        assert "selects the cases and the seed itself" in both.err


@pytest.mark.parametrize(
    ("words", "code", "reported"),
    [
        ((), 2, "-t/--target is required"),
        (("-t", "bms", "--mock", "--matrix", "clauses.pdf"), 2, "ends in .csv or .html"),
        (("-t", "bms"), 2, "good image is required"),
        (("-t", "bms", "--mock", "--case", "RS-1"), 2, "Did you mean RS-0"),
        (("-t", "bms", "--mock", "--group", "QQ"), 2, "There is no group"),
        (("-t", "bms", "--mock", "--power-cmd", "relay {on|off}"), 2, "without --mock only"),
        (("-t", "bms", "--variant", "no-crc-check"), 2, "with --mock only"),
        (("-t", "bms", "--mock", "--variant", "no-such"), 2, "variant"),
        (("-t", "bms", "--mock", "--set", "window_s"), 2, "write KEY=VALUE"),
        (("-t", "bms", "--mock", "--profile", "no-such.toml"), 2, "cannot be read"),
        (("-t", "bms", "--mock", "--html", "no-such-folder/a.html"), 2, "cannot be written"),
        (("-t", "bms", "--mock", "--repeat", "0"), 2, "must be 1 or more"),
        (("-t", "bms", "--mock", "--good-image", "no-such.hex"), 2, "no-such.hex"),
        (
            ("-t", "bms", "-i", "no-such-backend", "--good-image", str(SAMPLES / "bms.bin")),
            2,
            "no-such-backend",
        ),
    ],
)
def test_wrong_usage_is_reported_before_anything_is_done(
    flasher: Flasher, words: tuple[str, ...], code: int, reported: str
) -> None:
    run = flasher("conformance", *words)
    assert run.code == code
    assert reported in run.err
    assert "Traceback" not in run.err
    assert run.out == ""


def test_a_second_image_that_is_not_smaller_is_refused(flasher: Flasher) -> None:
    image = str(SAMPLES / "bms.bin")
    run = flasher(*MOCK, "--good-image", image, "--second-image", image)
    assert run.code == 2
    assert "second image has to be smaller" in run.err


def test_a_good_image_that_the_profile_does_not_allow_is_refused(
    flasher: Flasher, tmp_path: Path
) -> None:
    profile = tmp_path / "p.toml"
    profile.write_text("[device]\nlargest_image_bytes = 1000\n")
    run = flasher(*MOCK, "--profile", profile)
    assert run.code == 2
    assert "the profile allows 1,000" in run.err


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        (("-i", "socketcan"), True),
        (("-i", "socketcan", "--bus-kwargs", "receive_own_messages=False"), False),
        (("-i", "pcan"), None),
    ],
)
def test_the_echo_of_own_frames_is_asked_for_where_there_is_one(
    flasher: Flasher,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    asked: bool | None,
) -> None:
    given: dict[str, object] = {}

    def connect(_dialect: object, **bus: object) -> None:
        given.update(bus)
        raise BusError("not today")

    monkeypatch.setattr("flasher.api.connect", connect)
    run = flasher("conformance", "-t", "bms", "--good-image", SAMPLES / "bms.bin", *words)
    assert run.code == ExitCode.BUS
    assert given.get("receive_own_messages") is asked


# -- how a run ends -------------------------------------------------------------------------------


def test_an_interrupt_ends_the_run_with_a_report_of_what_was_run(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_at(monkeypatch, "RS-02")
    run = flasher(*MOCK, "--group", "RS")
    assert run.code == ExitCode.INTERRUPTED
    assert "stopping: the device gets its good image back" in run.err
    assert "RS  reset and boot version  1 pass, 4 not run" in run.out
    assert "good image at the end: flashed and verified" in run.out


def test_a_second_interrupt_ends_at_once(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_at(monkeypatch, "RS-02", times=2)
    run = flasher(*MOCK, "--group", "RS")
    assert run.code == ExitCode.INTERRUPTED
    assert "Interrupted at once" in run.err
    assert run.out == ""


def interrupt_at(monkeypatch: pytest.MonkeyPatch, case_id: str, times: int = 1) -> None:
    def interrupted(bench: Bench) -> None:
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
        bench.wait(1.0)
        rs.reset_again(bench)

    case = CASES[case_id]
    changed = type(case)(**{**vars(case), "run": interrupted})
    monkeypatch.setitem(CASES, case_id, changed)


def test_an_adapter_that_fails_gives_its_exit_code_and_the_report(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = SimulatedPort.send

    def send(port: SimulatedPort, frame: object) -> None:
        if port.now() > 3.0:
            raise BusError("The adapter was unplugged.")
        sound(port, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(SimulatedPort, "send", send)
    run = flasher(*MOCK, "--group", "RS")
    assert run.code == ExitCode.BUS
    assert "the run is not complete" in run.err
    assert "adapter" in run.err
    assert "not run" in run.out


def test_the_exit_code_states_how_a_run_ended() -> None:
    assert exit_code(run_case(passes_once), was_stopped=False) is ExitCode.OK
    assert exit_code(run_case(fails_once), was_stopped=False) is ExitCode.PARTIAL
    # Stopped after the last case, so nothing is missing.
    assert exit_code(run_case(passes_once), was_stopped=True) is ExitCode.OK


# -- the profile ----------------------------------------------------------------------------------


def test_the_profile_that_is_printed_is_a_profile_with_every_key(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "p.toml"
    path.write_text(flasher("conformance", "profile").out)
    assert load_profile(path).given == {}
    for key in profile_keys():
        assert f"# {key.rpartition('.')[2]} = " in path.read_text()
    keys = flasher("conformance", "profile", "--json").document["keys"]
    assert [key["key"] for key in keys] == list(profile_keys())


def test_the_profile_of_the_mock_is_what_the_mock_is_judged_by(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "p.toml"
    choice = ("--set", "repeated_packet=nak_next")
    path.write_text(flasher("conformance", "profile", "--mock", *choice).out)
    assert load_profile(path).choice("tx_02") == "nak_next"
    run = flasher(*MOCK, *choice, "--profile", path, "--case", "UP-04")
    assert run.code == 0


def test_command_line_pytest_and_bench_have_the_same_options() -> None:
    panels = ("device", "device under test", "without hardware")
    own = [each for each in conformance.params if isinstance(each, Option) and each.panel in panels]
    assert {each.name for each in own} == {each.name for each in fields(BenchOptions)} - {
        "bus",
        "fallback",
    }
    others = {"--interface", "--channel", "--bitrate", "--bus-kwarg", "--seed"}
    assert {name.replace("--btl-", "--") for name in BENCH_OPTIONS} - others == {
        each.opts[-1] for each in own
    }
