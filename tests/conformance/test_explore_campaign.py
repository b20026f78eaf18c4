"""Campaigns of walks: a sum of seeds that does not depend on breaks, parts and processes."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.conformance.bench_options import BenchOptions
from flasher.errors import UsageError
from flasher.simulate import walks
from flasher.simulate.campaign import Batch, Result
from flasher.simulate.ledger import Ledger
from flasher.simulate.walks import run_walks, walk_batches, walks_key
from flasher.simulate.workers import run_alone
from tests.cli.conftest import Flasher
from tests.simulate.quick import KILLER, run_killing, text_of

MOCK = BenchOptions("bms", is_mock=True)
RIGHT = "tests.peers.python_bootloader:PythonBootloader"
EXPLORE = ("conformance", "explore", "-t", "bms")
WRONG = (*EXPLORE, "--mock", "--variant", "accepts-skipped-number", "--keep-going")
"""Of the walks from seed 1 on, that of seed 25 is the first one to find something."""


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walks, "_BATCH", 3)


def whole(options: BenchOptions, runs: int) -> Result:
    results = [run_walks(batch) for batch in walk_batches(options, 1, runs)]
    return sum(results[1:], results[0])


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_campaign_that_was_stopped_and_goes_on_is_the_same_as_one_at_a_stretch(
    tmp_path: Path,
) -> None:
    key, polls = walks_key(MOCK), 0

    def is_stopped() -> bool:
        nonlocal polls
        polls += 1
        return polls % 9 == 0  # somewhere in the canary, and in batches

    taken = 0
    for _ in range(3):
        with Ledger(tmp_path / "walks.jsonl", 1, 8, key) as ledger:
            for batch in ledger.left(walk_batches(MOCK, 1, 8)):
                result = run_walks(batch, is_stopped)
                ledger.add(batch, result)
                taken += result.runs
    assert (taken, ledger.result.runs) == (8, 8)
    assert text_of(replace(ledger.result, canary_runs=0)) == text_of(
        replace(whole(MOCK, 8), canary_runs=0)
    )


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_two_parts_merged_are_the_whole(flasher: Flasher, tmp_path: Path) -> None:
    for part in ("1/2", "2/2"):
        ledger = tmp_path / f"{part[0]}.jsonl"
        ran = flasher(*EXPLORE, "--mock", "--runs", "8", "--shard", part, "--ledger", ledger)
        assert ran.code == 0
    merged = flasher("simulate", "merge", *sorted(tmp_path.glob("*.jsonl")), "--json")
    assert (merged.code, merged.document["missing"]) == (0, [])
    assert merged.document["result"]["canaries_found"] == {"accepts-early-end": 1}
    expected = json.loads(text_of(whole(BenchOptions("bms", is_mock=True), 8)))
    assert {**merged.document["result"], "cpu_s": 0.0} == expected


@pytest.mark.slow
def test_a_wrong_device_is_found_with_the_same_line_on_one_and_two_processes(
    flasher: Flasher,
) -> None:
    some = ("--seed", "22", "--runs", "8")
    lines = []
    for jobs in ("1", "2"):
        ran = flasher(*WRONG, *some, "--jobs", jobs)
        assert ran.code == 12
        assert "\ncanaries found: 1\nVIOLATION ack: " in ran.out
        lines.append(next(line for line in ran.out.splitlines() if "replay: " in line))
    assert lines[0] == lines[1]
    where, _, line = lines[0].partition("; replay: ")
    assert where == "  seed 25"
    words = shlex.split(line)
    assert "--keep-going" not in words
    again = flasher(*words[1:], "--json")
    assert again.code == 12
    assert again.document["finding"]["rule"] == "ack"
    assert len(again.document["finding"]["steps"]) == 3
    words.remove("accepts-skipped-number")
    words.remove("--variant")
    assert flasher(*words[1:]).code == 0


@pytest.mark.slow
def test_a_compiled_or_python_bootloader_that_takes_no_upgrade_is_found_by_its_seed(
    flasher: Flasher,
) -> None:
    ran = flasher(*EXPLORE, "--subject", RIGHT, "--runs", "2")
    assert ran.code == 0
    bad = flasher(*EXPLORE, "--mock", "--variant", "big-endian-numbers", "--runs", "1")
    assert bad.code == 12
    (line,) = (line for line in bad.out.splitlines() if "replay: " in line)
    words = shlex.split(line.partition("replay: ")[2])
    assert words[-4:] == ["--runs", "1", "--seed", "1"]
    assert flasher(*words[1:]).code == 12


@pytest.mark.slow
def test_a_ledger_of_the_other_command_or_device_is_refused(
    flasher: Flasher, tmp_path: Path
) -> None:
    of_walks, of_upgrades = tmp_path / "walks.jsonl", tmp_path / "upgrades.jsonl"
    key = walks_key(MOCK)
    for path, batch in (
        (of_walks, Batch(key, 0, 1)),
        (of_upgrades, Batch(key.partition("+")[0], 0, 1)),
    ):
        with Ledger(path, 0, 1, batch.campaign) as ledger:
            ledger.add(batch, Result(batch.campaign, runs=1))
    kept = of_walks.read_bytes(), of_upgrades.read_bytes()
    ran = flasher(*EXPLORE, "--mock", "--runs", "1", "--ledger", of_upgrades)
    assert ran.code == 2
    assert "it is of `flasher simulate`, this is `flasher conformance explore`" in ran.err
    ran = flasher("simulate", "--runs", "1", "--ledger", of_walks)
    assert ran.code == 2
    assert "it is of `flasher conformance explore`, this is `flasher simulate`" in ran.err
    ran = flasher("simulate", "merge", of_walks, of_upgrades)
    assert ran.code == 2
    assert "is of another campaign" in ran.err
    ran = flasher(*EXPLORE, "--mock", "--set", "bad_packet=silence", "--ledger", of_walks)
    assert ran.code == 2
    assert "the device under test, its profile or an image was changed" in ran.err
    assert kept == (of_walks.read_bytes(), of_upgrades.read_bytes())


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("-i", "virtual", "-c", "x", "--good-image", "README.md"), "needs --mock or --subject"),
        (("--mock", "--steps", "5"), "--steps does not work in a campaign"),
        (("--mock", "--replay", "reset"), "--replay does not work in a campaign"),
        (("--mock", "--trace-file", "x.log"), "--trace-file does not work in a campaign"),
        (("--mock", "--seed", "2026-11-28"), "is a number, not '2026-11-28'"),
        (("--mock", "--variant", "missing"), "missing"),
    ],
)
def test_what_does_not_fit_a_campaign_is_refused(
    flasher: Flasher, arguments: tuple[str, ...], why: str
) -> None:
    ran = flasher(*EXPLORE, *arguments, "--runs", "3")
    assert ran.code == 2
    assert why in ran.err


def test_a_campaign_that_misses_its_canary_is_blind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walks, "CANARY", "record-erased-last")  # which few walks find
    canary, *_ = walk_batches(MOCK, 1, 1)
    assert run_walks(replace(canary, count=1)).is_blind


def test_a_profile_that_is_changed_meanwhile_ends_the_campaign(tmp_path: Path) -> None:
    profile = tmp_path / "profile.toml"
    profile.write_text("[device]\nbuffer_bytes = 0\n")
    _, batch = walk_batches(replace(MOCK, profile=str(profile)), 1, 1)
    assert run_walks(batch).runs == 1
    profile.write_text("[device]\nbuffer_bytes = 256\n")
    with pytest.raises(UsageError, match="was changed during the campaign"):
        run_walks(batch)


@pytest.mark.slow
def test_a_walk_that_ends_its_process_is_a_violation_with_its_seed() -> None:
    _, batch = walk_batches(MOCK, KILLER, 1)
    (found,) = run_alone(batch, run_one=run_killing).violations
    assert (found.kind, found.seed, found.plan) == ("KILLED", KILLER, "")
