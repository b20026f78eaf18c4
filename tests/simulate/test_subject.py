"""Campaigns against a bootloader under test: the right one passes, each wrong one is found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flasher.cli.main import main
from flasher.conformance.dut import process
from flasher.errors import ExitCode, UsageError
from flasher.simulate import campaign
from flasher.simulate.campaign import Batch, Result, campaign_key, run_batch
from flasher.simulate.ledger import Ledger, merge
from flasher.simulate.plan import Plan
from flasher.simulate.play import Player, Verdict, play
from flasher.simulate.subject import SubjectBench, source_of
from tests.loops import each

from . import wrong_bootloaders

RIGHT = "tests.peers.python_bootloader:PythonBootloader"
JOB = "job packets=3 ; subject"
ERASES = 3
"""Flash operations before the first packet of `JOB`: the record, and a sector."""


@contextmanager
def bench_of(what: type | str) -> Iterator[SubjectBench]:
    bench = SubjectBench(
        what if isinstance(what, str) else f"{what.__module__}:{what.__name__}", "bms"
    )
    try:
        yield bench
    finally:
        bench.close()


def played(what: type | str, line: str) -> Verdict:
    with bench_of(what) as bench:
        return play(Plan.parse(line), bench=bench)


def found(what: type, line: str) -> str:
    (violation,) = played(what, line).violations
    return str(violation)


@pytest.mark.slow
def test_a_right_bootloader_is_upgraded_and_a_line_replays_the_run() -> None:
    with bench_of(RIGHT) as bench:
        verdict = play(Plan.parse(f"{JOB} ; @packet2 drop count=3"), bench=bench)
        assert (verdict.ending, verdict.left, verdict.violations) == ("completed", "new", ())
        assert verdict.is_good
        assert play(Plan.parse(verdict.plan), bench=bench) == verdict


@pytest.mark.slow
def test_a_bootloader_begins_as_in_the_plan() -> None:
    with bench_of(RIGHT) as bench:
        for device in (
            "application=none", "begins=boot", "drift=0.01", "version=V0r9r9_20200101"
        ):  # fmt: skip
            assert play(Plan.parse(f"{JOB} {device}"), bench=bench).is_good, device


@pytest.mark.slow
def test_a_power_cut_in_any_flash_operation_leaves_no_more_than_an_empty_device() -> None:
    lines: list[str] = []
    cuts = [f"{operation}+0.00003" for operation in range(1, ERASES + 4)]
    for operation in (2, ERASES + 2):  # also before and after one that erases, and one that writes
        cuts += [f"{operation}", f"{operation}+0.005"]
    with bench_of(RIGHT) as bench:
        for cut in cuts:
            plan = Plan.parse(f"{JOB} ; @flash{cut} power")
            verdict = Player(plan, bench=bench, log=lines.append).play()
            assert verdict.violations == (), plan
            assert verdict.left == "new", plan
    assert sum(line.endswith("power") for line in lines) == len(cuts)


@pytest.mark.slow
def test_flash_that_reports_errors_is_no_success() -> None:
    fault = "@end flash-fails count=9"
    assert played(wrong_bootloaders.ReportsErrors, f"{JOB} ; {fault}").is_good
    wrong = played(wrong_bootloaders.IgnoresErrors, f"{JOB} ; {fault}")
    assert "FALSE: success, and the device has none" in map(str, wrong.violations)


@pytest.mark.slow
def test_what_the_flash_holds_is_what_is_started_after_a_power_up() -> None:
    with bench_of(wrong_bootloaders.ForgetsTheRecord) as bench:
        verdict = play(Plan.parse("job packets=3 ; subject application=none"), bench=bench)
    assert {*map(str, verdict.violations)} == {
        "FALSE: success, and the device has none",
        "CORRUPT: the device runs an application that it does not have",
    }


@pytest.mark.slow
def test_a_start_of_half_an_image_is_found() -> None:
    plan = Plan.parse(f"{JOB} ; @flash2 restart")
    with bench_of(wrong_bootloaders.TrustsTheRecord) as bench:
        first, second = play(plan, bench=bench), play(plan, bench=bench)
    assert [*map(str, first.violations)] == [
        "SUBJECT: the bootloader started an incomplete application"
    ]
    assert second == first


@pytest.mark.slow
def test_a_crash_names_the_call_and_what_the_bootloader_printed() -> None:
    text = found(wrong_bootloaders.Crashes, "job packets=3 ; subject application=none")
    assert text.startswith("SUBJECT: the bootloader ended with status 1 in flasher_dut_receive")
    assert "ZeroDivisionError" in text


@pytest.mark.slow
def test_a_call_that_does_not_return_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "WATCHDOG_S", 0.3)
    text = found(wrong_bootloaders.Hangs, "job packets=3 ; subject application=none")
    assert "did not return from flasher_dut_receive" in text


@pytest.mark.slow
def test_a_bootloader_that_takes_no_application_is_a_finding_in_each_plan() -> None:
    text = found(wrong_bootloaders.Deaf, JOB)
    assert text.startswith("SUBJECT: its first upgrade, without faults, with -t bms, ends in ")


@pytest.mark.slow
def test_drawn_plans_have_the_bootloader_as_their_only_device() -> None:
    with bench_of(RIGHT) as bench:
        faults = 0
        for seed in range(40):
            plan = bench.drawn(seed)
            assert Plan.parse(str(plan)) == plan
            assert [device.NAME for device in plan.devices] == ["subject"]
            faults += any(each.when and each.when.what == "flash" for each in plan.clauses)
        assert faults > 10


@pytest.mark.slow
def test_random_plans_end_in_no_violation_with_a_right_bootloader() -> None:
    with bench_of(RIGHT) as bench:
        for seed in range(500, 506):
            verdict = play(bench.drawn(seed), bench=bench)
            assert verdict.violations == (), verdict


def test_the_key_of_a_campaign_depends_on_the_bootloader(tmp_path: Path) -> None:
    program = tmp_path / "boot"
    keys = {campaign_key(), campaign_key(RIGHT, "bms"), campaign_key(RIGHT, "wmc")}
    for content in (b"one", b"two"):
        program.write_bytes(content)
        keys.add(campaign_key(str(program), "bms"))
    assert len(keys) == 5
    with pytest.raises(ValueError, match="a batch of"):
        run_batch(Batch(campaign_key(), 0, 1, subject=RIGHT, target="bms"))


@pytest.mark.slow
def test_a_bootloader_that_is_built_again_during_a_batch_ends_the_campaign(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    batch = Batch(campaign_key(RIGHT, "bms"), 0, 1, subject=RIGHT, target="bms")
    assert run_batch(batch).runs == 1
    builds = iter([source_of(RIGHT), b"another one"])
    monkeypatch.setattr("flasher.simulate.subject.source_of", lambda _subject: next(builds))
    with pytest.raises(UsageError, match="was changed during the campaign"):
        run_batch(batch)


def test_ledgers_of_different_bootloaders_are_not_added_up(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.jsonl" for name in ("bms", "wmc", "again")]
    for first, (path, target) in enumerate(zip(paths, ("bms", "wmc", "bms"), strict=True)):
        batch = Batch(campaign_key(RIGHT, target), first, 1, subject=RIGHT, target=target)
        with Ledger(path, 0, 3, batch.campaign) as ledger:
            ledger.add(batch, Result(batch.campaign, runs=1))
    merged = merge([paths[0], paths[2]])
    assert (merged.result.runs, merged.missing) == (2, [(1, 2)])
    assert not any(place.startswith("device: ") for place in merged.result.never_reached)
    readers: list[Callable[[], object]] = [
        lambda: merge(paths),
        lambda: Ledger(paths[0], 0, 3),
        lambda: Ledger(paths[0], 0, 3, campaign_key(RIGHT, "wmc")),
    ]
    for read in readers:
        with pytest.raises(UsageError, match="is of another campaign"):
            read()


@pytest.mark.slow
def test_a_violation_is_shrunk_and_replayed_by_its_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(campaign, "CANARY_RUNS", 60)
    subject = "tests.simulate.wrong_bootloaders:TrustsTheRecord"
    some = ["--seed", "30", "--runs", "1"]  # which finds it
    assert main(["simulate", "--subject", subject, *some]) == ExitCode.PARTIAL
    line = next(each for each in capsys.readouterr().out.splitlines() if "replay: " in each)
    head, _, plan = line.partition(f"flasher simulate replay --subject {subject} ")
    assert head.endswith("replay: ")
    assert len(plan.split(" ; ")) <= 3, plan
    trace = tmp_path / "run.log"
    replay = ["simulate", "replay", "--subject", subject, plan.strip("'")]
    assert main([*replay, "--trace-file", str(trace), "--json"]) == ExitCode.PARTIAL
    assert json.loads(capsys.readouterr().out)["violations"][0]["kind"] == "SUBJECT"
    assert main(["explain", str(trace)]) in set(ExitCode)
    assert "BMS" in capsys.readouterr().out


@each(
    "arguments, why",
    [
        (["--subject", RIGHT, "--dask", "tcp://localhost:1"], "does not work with --dask"),
        (["-t", "bms"], "works with --subject only"),
        (["--subject", "no/file"], "There is no bootloader"),
        (["replay", JOB], "is a bootloader under test"),
        (["replay", "--subject", RIGHT, "job ; mock"], "is not the bootloader under test"),
        (["replay", "--subject", RIGHT, f"{JOB} ; subject"], "is not the bootloader under test"),
    ],
)
def test_what_does_not_fit_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: list[str], why: str
) -> None:
    assert main(["simulate", *arguments]) == ExitCode.USAGE
    assert why in capsys.readouterr().err
