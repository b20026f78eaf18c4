"""`flasher simulate`: campaigns, replay, ledgers, sweeps."""

from __future__ import annotations

import html
import json
import re
import signal
from contextlib import nullcontext
from io import StringIO
from pathlib import Path

import pytest

from flasher.cli.bench import simulate as command
from flasher.cli.main import main
from flasher.errors import ExitCode
from flasher.simulate import campaign, planting
from flasher.simulate.campaign import Batch, Result, campaign_key, corpus_batch
from flasher.simulate.corpus import corpus
from flasher.simulate.planting import swapped, upgrade_bugs
from flasher.simulate.reached import reachable
from tests.loops import each

LOST = "job packets=3 ; independent erase=0.05 ; @packet2 power"


def planted(name: str) -> planting.Codes:
    return next(bug for bug in upgrade_bugs() if bug.name == name).codes()


def part_of_corpus(count: int) -> Batch:
    return Batch(campaign_key(), 0, count, is_corpus=True)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A canary is found in the first runs of a campaign, which has no corpus."""
    monkeypatch.setattr(command, "corpus_batch", lambda: part_of_corpus(0))
    monkeypatch.setattr(campaign, "CANARIES", ("last-program-unit-lost",))
    monkeypatch.setattr(command, "_BATCH", 3)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_campaign_prints_what_happened_and_what_was_reached(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["simulate", "--runs", "6"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert out.startswith("6 runs, ")
    assert " places reached\n" in out
    assert out.endswith("canaries found: 1\nno violation in 6 runs\n")


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_violation_ends_the_campaign_with_the_shortest_plan_and_its_replay(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(campaign, "CANARIES", ("one-packet-more-for-whole-sizes",))
    monkeypatch.setattr(campaign, "swapped", lambda _codes: nullcontext())
    with swapped(planted("last-program-unit-lost")):
        page = tmp_path / "campaign.html"
        assert main(["simulate", "--runs", "40", "--html", str(page)]) == ExitCode.PARTIAL
        out = capsys.readouterr().out
        assert "VIOLATION FALSE: success, and the device has " in out
        line = next(each for each in out.splitlines() if "replay: " in each)
        plan = line.partition("replay ")[2].strip("'")
        assert len(plan.split(" ; ")) <= 2, plan
        text = html.unescape(page.read_text("utf-8"))
        assert re.search(r"[1-9]\d* violations? in \d+ upgrades", text)
        assert f"<pre>{line.partition('replay: ')[2]}</pre>" in text
        assert re.search(r'<td class="keep">[\w-]+</td><td class="number">\d+</td>', text)
        assert main(["simulate", "replay", plan]) == ExitCode.PARTIAL
    assert main(["simulate", "replay", plan]) == ExitCode.OK


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_strict_needs_every_place_and_lists_what_no_run_reached(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "corpus_batch", corpus_batch)
    assert main(["simulate", "--runs", "1", "--strict"]) == ExitCode.OK
    out = capsys.readouterr().out
    assert f"\n{len(corpus())} plans of the corpus played\n" in out
    assert f"\n{len(reachable())} of {len(reachable())} places reached\n" in out
    assert "never" not in out
    monkeypatch.setattr(command, "corpus_batch", lambda: part_of_corpus(2))
    assert main(["simulate", "--runs", "1"]) == ExitCode.OK
    capsys.readouterr()
    assert main(["simulate", "--runs", "1", "--strict"]) == ExitCode.PARTIAL
    out = capsys.readouterr().out
    lines = [line for line in out.splitlines() if line.startswith("  never: ")]
    assert "  never: reading: R10; R11; R12; " in out
    assert sum(line.startswith("  never: host: settling: ") for line in lines) == 1
    assert max(map(len, out.splitlines())) < 80


def test_a_replay_is_the_same_each_time_and_leaves_a_trace(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    trace = tmp_path / "run.log"
    assert main(["simulate", "replay", LOST, "--trace-file", str(trace)]) == ExitCode.OK
    first = capsys.readouterr().out
    assert main(["simulate", "replay", LOST]) == ExitCode.OK
    assert capsys.readouterr().out == first
    assert "in the device's flash: new" in first
    assert main(["explain", str(trace)]) == ExitCode.OK
    assert "verdict: completed" in capsys.readouterr().out


def test_what_is_no_plan_is_refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["simulate", "replay", "job packets=many"]) == ExitCode.USAGE
    assert "The plan cannot be read: " in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", StringIO(""))
    assert main(["simulate", "replay", "-"]) == ExitCode.USAGE
    assert "The plan cannot be read: it is empty." in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", StringIO("job;" * 300_000))
    assert main(["simulate", "replay", "-"]) == ExitCode.USAGE
    assert "more than 1,000,000 characters" in capsys.readouterr().err


@each("count", ["0", "1025", "100000000"])
def test_a_number_of_processes_that_no_computer_has_is_refused(count: str) -> None:
    assert main(["simulate", "--jobs", count]) == ExitCode.USAGE


@each("text", ["0/3", "4/3", "3", "a/b"])
def test_what_is_no_shard_is_refused(text: str) -> None:
    assert main(["simulate", "--shard", text]) == ExitCode.USAGE


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_shards_with_ledgers_add_up_to_the_whole_campaign(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = [tmp_path / f"{number}.jsonl" for number in (1, 2)]
    for number, file in enumerate(files, 1):
        args = ["simulate", "--runs", "9", "--shard", f"{number}/2", "--ledger", str(file)]
        assert main(args) == ExitCode.OK
    assert main(["simulate", "--runs", "9", "--json"]) == ExitCode.OK
    whole = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert main(["simulate", "merge", *map(str, files), "--json"]) == ExitCode.OK
    merged = json.loads(capsys.readouterr().out.splitlines()[-1])["result"]
    for key in merged.keys() - {"cpu_s"}:
        assert merged[key] == whole[key], key
    # A canary that is in another part is not missed in this one.
    assert main(["simulate", "--runs", "9", "--shard", "2/2"]) == ExitCode.OK
    assert "no canary in this part" in capsys.readouterr().out
    page = tmp_path / "merged.html"
    assert main(["simulate", "merge", str(files[0]), "--html", str(page)]) == ExitCode.PARTIAL
    assert "MISSING: seeds " in capsys.readouterr().out
    assert "MISSING: seeds " in page.read_text("utf-8")
    assert main(["simulate", "merge", str(files[1])]) == ExitCode.PARTIAL
    assert "MISSING: 1 of the canaries, the first at seed 0" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_campaign_goes_on_where_its_ledger_ends(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    args = ["simulate", "--ledger", str(tmp_path / "done.jsonl"), "--json", "--runs"]
    assert main([*args, "3"]) == ExitCode.OK
    assert main([*args, "6"]) == ExitCode.OK
    captured = capsys.readouterr()
    assert json.loads(captured.out.splitlines()[-1])["runs"] == 6
    assert "3 runs found in the ledger" in captured.err


def test_the_page_of_a_stopped_campaign_shows_that_it_was_stopped(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run_batch(batch: Batch, *_: object) -> Result:
        found = {batch.canary: 1} if batch.canary else {}
        if not (batch.canary or batch.is_corpus):
            signal.raise_signal(signal.SIGINT)
        return Result(campaign_key(), runs=0 if found else batch.count, canaries_found=found)

    monkeypatch.setattr(command, "run_batch", run_batch)
    monkeypatch.setattr(command, "corpus_batch", lambda: part_of_corpus(0))
    page = tmp_path / "page.html"
    words = ["simulate", "--runs", "500", "--html", str(page)]
    assert main(words) == ExitCode.INTERRUPTED
    assert "STOPPED before its end" in page.read_text("utf-8")
    assert ">failed<" in page.read_text("utf-8")


def test_a_blind_campaign_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_batch(batch: Batch, *_: object) -> Result:
        missed = {batch.canary: 1} if batch.canary else {}
        return Result(campaign_key(), runs=batch.count, canaries_missed=missed)

    monkeypatch.setattr(command, "run_batch", run_batch)
    assert main(["simulate", "--runs", "5"]) == ExitCode.PARTIAL
    assert "BLIND: the planted mistake " in capsys.readouterr().out


def test_a_campaign_that_tried_nothing_fails(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_batch(batch: Batch, *_: object) -> Result:
        found = {batch.canary: 1} if batch.canary else {}
        return Result(campaign_key(), canaries_found=found)

    monkeypatch.setattr(command, "run_batch", run_batch)
    assert main(["simulate", "--runs", "5"]) == ExitCode.PARTIAL
    assert "NOTHING TRIED: " in capsys.readouterr().out


@pytest.mark.slow
def test_parts_of_the_sweep_are_listed_and_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "sweep", "--list"]) == ExitCode.OK
    assert capsys.readouterr().out.startswith("frames ")
    assert main(["simulate", "sweep", "limits", "--every", "100"]) == ExitCode.OK
    assert "limits: 5 of 5 cases" in capsys.readouterr().out
    assert main(["simulate", "sweep", "nonsense"]) == ExitCode.USAGE
    assert "The sweep has no part nonsense." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "option"),
    [
        ("simulate --runs 5 sweep limits", "--runs"),
        ("--json simulate --runs 5 sweep --list", "--runs"),
        ("conformance --quick init", "--quick"),
    ],
)
def test_an_option_before_an_action_is_refused(
    capsys: pytest.CaptureFixture[str], line: str, option: str
) -> None:
    assert main(line.split()) == ExitCode.USAGE
    captured = capsys.readouterr()
    assert f"{option} before the action " in captured.out + captured.err


def test_an_option_of_the_output_comes_before_an_action(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["simulate", "--json", "sweep", "--list"]) == ExitCode.OK
    assert capsys.readouterr().out.startswith("{")


def test_a_sweep_logs_no_upgrade(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "sweep", "limits", "--every", "100", "-vv"]) == ExitCode.OK
    assert "host:" not in capsys.readouterr().err


def test_a_replay_of_a_bootloader_names_it_as_far_as_it_is_known() -> None:
    assert command.replay_line("job ; subject", "./boot").endswith(
        "replay --subject ./boot 'job ; subject'"
    )
    assert "--subject BOOTLOADER" in command.replay_line("job ; subject")
    assert "--subject" not in command.replay_line("job ; mock")
