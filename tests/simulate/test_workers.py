"""Campaigns on several processes: the same sums as in one, processes that die, a stop."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.simulate import workers
from flasher.simulate.campaign import Batch, Found, Result, batches, campaign_key, run_batch
from flasher.simulate.draw import drawn
from flasher.simulate.workers import Pace, RunBatch, run, run_alone

from .quick import (
    FOLDER,
    KILLER,
    Unloadable,
    no_result,
    run_endlessly,
    run_failing,
    run_killing,
    run_killing_once,
    run_quickly,
    run_slowly,
    text_of,
)

pytestmark = pytest.mark.slow


def never() -> bool:
    return False


def on_workers(some: list[Batch], run_one: RunBatch, jobs: int = 2) -> Result:
    results: list[tuple[Batch, Result]] = []
    run(
        some,
        jobs,
        on_result=lambda *each: results.append(each),
        is_stopped=never,
        run_one=run_one,
    )
    for batch, result in results:
        assert batch.canary or batch.count == result.runs
    seeds = [
        seed
        for batch, _ in results
        if not batch.canary
        for seed in range(batch.first, batch.first + batch.count)
    ]
    assert len(seeds) == len(set(seeds))
    return sum((result for _, result in results), no_result())


def without_canaries(runs: int, count: int) -> list[Batch]:
    return [each for each in batches(0, runs, count) if not each.canary]


def expected(runs: int) -> Result:
    """What the runs count up to when one of them ends its process."""
    key, plan = campaign_key(), drawn(KILLER)
    before = run_quickly(Batch(key, 0, KILLER))
    after = run_quickly(Batch(key, KILLER + 1, runs - KILLER - 1))
    text = "the run ended its process: exit code 3"
    killed = (Found(KILLER, "KILLED", text, str(plan)),)
    return before + after + Result(key, runs=1, violations=killed, violation_count=1)


def test_two_workers_count_what_one_process_does() -> None:
    some = without_canaries(12, 12)
    assert text_of(on_workers(some, run_batch)) == text_of(sum(map(run_batch, some), no_result()))


def test_the_run_that_ends_its_process_is_a_violation_and_all_others_count() -> None:
    found = on_workers([*batches(0, 120, 20)], run_killing)
    assert found.violation_count == expected(120).violation_count
    assert found.violations == expected(120).violations
    assert (found.runs, found.endings["killed"]) == (120, 1)
    assert sum(found.canaries_found.values()) == 1
    one, other = found.reached, expected(120).reached
    assert one == other
    # Its tally has the faults of its plan.
    assert {name for name, each in found.tallies.items() if each.runs == 1} == {
        each.NAME for each in drawn(KILLER).events
    }


def test_a_run_whose_process_was_killed_from_outside_is_not_blamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    some = without_canaries(60, 20)
    found = on_workers(some, run_killing_once)
    assert (tmp_path / "killed").exists()
    assert text_of(found) == text_of(sum(map(run_quickly, some), no_result()))


def test_workers_that_are_killed_change_nothing() -> None:
    some, results, killed = without_canaries(120, 120), [no_result()], list[int | None]()

    def kill_both(_batch: Batch, result: Result) -> None:
        results.append(result)
        # Each once: one that is killed twice while it starts ends the campaign.
        alive = multiprocessing.active_children()
        if not killed and len(alive) == 2:
            for each in alive:
                killed.append(each.pid)
                each.kill()

    run(some, 2, on_result=kill_both, is_stopped=never, run_one=run_slowly)
    assert len(set(killed)) == 2
    assert text_of(sum(results[1:], results[0])) == text_of(
        sum(map(run_quickly, some), no_result())
    )


def test_a_run_without_an_end_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_RUN_S", 0.2)
    found = run_alone(Batch(campaign_key(), KILLER, 2), never, run_endlessly)
    assert [(each.seed, each.text) for each in found.violations if each.kind == "KILLED"] == [
        (KILLER, "the run took more than 0.2 s of CPU time")
    ]
    assert found.runs == 2


def test_each_run_of_a_batch_has_the_time_limit_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workers, "_RUN_S", 0.2)
    batch = Batch(campaign_key(), KILLER, 1000)
    with workers.BatchProcess(run_endlessly) as worker, pytest.raises(EOFError):
        worker.run_once(batch, never)
    assert worker.exit_code == -signal.SIGPROF


def test_an_error_of_a_process_ends_the_campaign() -> None:
    with pytest.raises(FileNotFoundError):
        run(
            without_canaries(100_000, 100_000),
            2,
            on_result=lambda *_: None,
            is_stopped=never,
            run_one=run_failing,
        )


def test_a_process_that_does_not_start_blames_no_run() -> None:
    with pytest.raises(UsageError, match="did not start: exit code 4"):
        run(
            without_canaries(20, 20),
            1,
            on_result=lambda *_: pytest.fail("nothing has run"),
            is_stopped=never,
            run_one=Unloadable(),
        )


def test_alone_a_stopped_batch_has_its_first_runs() -> None:
    batch, polls = Batch(campaign_key(), 0, 100_000), iter(range(1000))
    some = run_alone(batch, lambda: next(polls) > 40, run_quickly)
    assert 0 < some.runs < 100
    assert text_of(some) == text_of(run_quickly(replace(batch, count=some.runs)))


def test_a_canary_that_ends_its_process_was_found() -> None:
    some = run_alone(Batch(campaign_key(), KILLER - 2, 9, "canary"), run_one=run_killing_canary)
    assert some.canaries_found == {"canary": 1}
    assert not some.violation_count
    none = run_alone(Batch(campaign_key(), 0, 3, "canary"), run_one=run_killing_canary)
    assert (none.canaries_missed, none.canaries_found) == ({"canary": 1}, {})


def run_killing_canary(batch: Batch, _is_stopped: object = None) -> Result:
    if batch.first == KILLER:
        os.kill(os.getpid(), signal.SIGSEGV)
    return Result(batch.campaign, canaries_missed={batch.canary: 1}, canary_runs=1)


def test_a_stop_ends_the_workers_at_once_and_their_runs_count() -> None:
    results: list[tuple[Batch, Result]] = []
    run(
        without_canaries(100_000, 100_000),
        2,
        on_result=lambda *each: results.append(each),
        is_stopped=lambda: bool(results),
    )
    stopped = [(batch, result) for batch, result in results if result.runs < batch.count]
    assert stopped
    assert sum(result.runs for _, result in results) < 100


def test_batches_are_cut_to_the_time_they_are_aimed_at() -> None:
    pace = Pace()
    parts = pace.cut([Batch("key", 0, 500), Batch("key", 500, 1000, "canary")])
    first = next(parts)
    pace.add(Result("key", runs=first.count, cpu_s=first.count * 0.02))
    second = next(parts)
    assert (second.first, second.count) == (first.count, 50)
    pace.aimed_s = 15.0
    rest = [*parts]
    assert [(each.count, each.canary) for each in rest] == [
        (500 - first.count - 50, ""),
        (1000, "canary"),
    ]
