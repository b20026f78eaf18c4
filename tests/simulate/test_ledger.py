"""Ledgers: campaigns that go on, shards that are merged, files that are refused."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.simulate import campaign, ledger
from flasher.simulate.campaign import Batch, Result, batches
from flasher.simulate.ledger import Ledger, merge

from .quick import no_result, run_quickly, text_of

RUNS = 4100
"""Three canaries."""


def everything(count: int = 50) -> list[Batch]:
    return [*batches(0, RUNS, count)]


def all_at_once() -> Result:
    return sum(map(run_quickly, everything()), no_result())


def written(path: Path, some: Iterable[Batch]) -> Path:
    with Ledger(path, 0, RUNS) as opened:
        for each in some:
            opened.add(each, run_quickly(each))
    return path


def test_seven_shards_are_merged_to_what_one_process_counts(tmp_path: Path) -> None:
    shards = [
        written(tmp_path / f"{number}.jsonl", campaign.share(everything(), number, 7))
        for number in range(1, 8)
    ]
    merged = merge(shards)
    assert text_of(merged.result) == text_of(all_at_once())
    assert not merged.missing
    assert not merged.missing_canaries


def test_what_a_shard_did_not_do_is_missing_with_its_canary(tmp_path: Path) -> None:
    shards = [
        written(tmp_path / f"{number}.jsonl", campaign.share(everything(), number, 3))
        for number in (2, 3)
    ]
    merged = merge(shards)
    lost = [*campaign.share(everything(), 1, 3)]
    assert sum(end - first for first, end in merged.missing) + merged.result.runs == RUNS
    assert {first for first, _ in merged.missing} == {
        each.first for each in lost if not each.canary
    }
    assert merged.missing_canaries == [each.first for each in lost if each.canary]


@pytest.mark.parametrize("count", [50, 33])
def test_a_campaign_that_was_killed_goes_on_with_its_gaps(tmp_path: Path, count: int) -> None:
    path = tmp_path / "ledger.jsonl"
    for part in range(3):
        written(path, islice(everything(), part * 20, part * 20 + 11))
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])  # killed while it wrote its third line
    with Ledger(path, 0, RUNS) as again:
        assert "line 3: the last line was written in part" in again.notice
        for each in again.left(everything(count)):
            again.add(each, run_quickly(each))
        assert text_of(again.result) == text_of(all_at_once())
    merged = merge([path])
    assert text_of(merged.result) == text_of(all_at_once())
    assert not [*merged.missing, *merged.missing_canaries, *merged.notices]
    with Ledger(path, 0, RUNS) as done:
        assert not [*done.left(everything())]
        assert text_of(done.result) == text_of(all_at_once())


def test_a_longer_campaign_goes_on_after_a_shorter_one(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path, 0, 2000) as first:
        for each in batches(0, 2000, 500):
            first.add(each, run_quickly(each))
    with Ledger(path, 0, RUNS) as second:
        left = [*second.left(everything(500))]
        for each in left:
            second.add(each, run_quickly(each))
    assert min(each.first for each in left) == 2000
    assert text_of(merge([path]).result) == text_of(all_at_once())


def test_a_campaign_without_a_number_of_runs_misses_what_it_left_out(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    with Ledger(path, 0, None) as some:
        for each in everything()[:40]:
            if each.first != 100:
                some.add(each, run_quickly(each))
    merged = merge([path])
    assert (merged.missing, merged.missing_canaries) == ([(100, 150)], [])


def test_of_a_batch_that_was_stopped_its_first_runs_are_kept(tmp_path: Path) -> None:
    path, whole = tmp_path / "ledger.jsonl", Batch(campaign.campaign_key(), 100, 50)
    with Ledger(path, 100, 50) as stopped:
        stopped.add(whole, run_quickly(Batch(whole.campaign, 100, 20)))
        stopped.add(Batch(whole.campaign, 100, 50, campaign.CANARIES[0]), no_result())
    assert merge([path]).missing == [(120, 150)]
    with Ledger(path, 100, 50) as again:
        assert [(each.first, each.count) for each in again.left([whole])] == [(120, 30)]
    assert merge([path]).missing_canaries == [100]


def test_a_process_that_is_killed_loses_what_it_did_not_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "ledger.jsonl"
    for interval_s, kept in ((1000.0, 0), (0.0, 2)):
        monkeypatch.setattr(ledger, "WRITE_INTERVAL_S", interval_s)
        killed = Ledger(path, 0, RUNS)
        for each in everything()[1:3]:
            killed.add(each, run_quickly(each))
        killed.close()
        assert len(path.read_bytes().splitlines()) == kept


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda line: line[:-20], "it is not valid JSON"),
        (lambda line: bytes(len(line)), "it is not valid JSON"),
        (lambda line: b"[%s]" % line, "Input should be"),
        (lambda line: line.replace(b'"runs":10,', b'"runs":"10",', 1), "result.runs: Input"),
        (lambda line: line.replace(b'"runs":10,', b'"runs":9,'), "its seeds are not those"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, damage: object, why: str) -> None:
    assert callable(damage)
    path = tmp_path / "ledger.jsonl"
    for first in (0, 10, 20):
        written(path, [Batch(campaign.campaign_key(), first, 10)])
    lines = path.read_bytes().splitlines()
    lines[1] = damage(lines[1])
    path.write_bytes(b"".join(line + b"\n" for line in lines))
    for read in (lambda: merge([path]), lambda: Ledger(path, 0, RUNS)):
        with pytest.raises(UsageError, match="is damaged") as refused:
            read()
        assert str(path) in refused.value.what
        assert refused.value.where.startswith("line 2: ")
        assert why in refused.value.where
    assert path.read_bytes().count(b"\n") == 3


def test_a_ledger_of_other_code_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "ledger.jsonl", everything()[:3])
    document = json.loads(path.read_bytes())
    # Its results may have another form, too.
    path.write_text(json.dumps({**document, "campaign": "0123456789abcdef", "result": 1}) + "\n")
    for read in (lambda: merge([path]), lambda: Ledger(path, 0, RUNS)):
        with pytest.raises(UsageError, match="is of another campaign") as refused:
            read()
        assert f"0123456789abcdef; this is {campaign.campaign_key()}" in refused.value.where
        assert "begin with a new file" in refused.value.remedy


def test_runs_in_two_files_are_refused_with_both_names(tmp_path: Path) -> None:
    key = campaign.campaign_key()
    one = written(tmp_path / "one.jsonl", [Batch(key, 0, 20), Batch(key, 40, 20)])
    two = written(tmp_path / "two.jsonl", [Batch(key, 20, 21)])
    with pytest.raises(UsageError, match="the same runs: seeds 40 to 40") as refused:
        merge([one, two])
    assert "one.jsonl" in refused.value.where
    assert "two.jsonl" in refused.value.where
    canary = [each for each in everything() if each.canary][:1]
    three, four = (written(tmp_path / f"{name}.jsonl", canary) for name in ("three", "four"))
    with pytest.raises(UsageError, match="canary at seed 0") as refused:
        merge([three, four])
    assert "three.jsonl" in refused.value.where
    assert "four.jsonl" in refused.value.where


def test_two_programs_do_not_write_one_ledger(tmp_path: Path) -> None:
    with (
        Ledger(tmp_path / "ledger.jsonl", 0, RUNS),
        pytest.raises(UsageError, match="is in use"),
    ):
        Ledger(tmp_path / "ledger.jsonl", 0, RUNS)
    Ledger(tmp_path / "ledger.jsonl", 0, RUNS).close()


def test_files_that_are_no_ledger_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written"):
        Ledger(tmp_path / "missing" / "ledger.jsonl", 0, RUNS)
    with pytest.raises(UsageError, match="there is no file of this name"):
        merge([tmp_path / "missing.jsonl"])
    with pytest.raises(UsageError, match="contain no result"):
        merge([written(tmp_path / "empty.jsonl", [])])


def test_a_full_disk_is_an_error_and_what_was_written_before_counts(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    path = written(tmp_path / "ledger.jsonl", everything()[:3])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, before[1]))
    try:
        with pytest.raises(UsageError, match="cannot be written: File too large"):
            written(path, everything()[3:6])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    merged = merge([path])
    assert merged.result.runs == sum(map(run_quickly, everything()[:3]), no_result()).runs
    assert "line 2: the last line was written in part" in merged.notices[0]
    with Ledger(path, 0, RUNS) as again:
        assert len([*again.left(everything())]) == len(everything()) - 3


@pytest.mark.skipif(os.name == "nt", reason="no named pipes")
def test_a_pipe_is_no_ledger_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="cannot be written"):
        Ledger(tmp_path / "pipe", 0, RUNS)


def test_a_lock_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "ledger.jsonl.lock").mkdir()
    with pytest.raises(UsageError, match="cannot be written"):
        Ledger(tmp_path / "ledger.jsonl", 0, RUNS)


def test_shares_cover_each_batch_once() -> None:
    shares = [[*campaign.share(everything(), number, 4)] for number in range(1, 5)]
    assert {each for share in shares for each in share} == set(everything())
    assert sum(map(len, shares)) == len(everything())
