"""Places of a campaign: the corpus reaches all that a campaign can reach, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.simulate.campaign import (
    CORPUS_SEEDS,
    Batch,
    Result,
    campaign_key,
    corpus_batch,
    run_batch,
)
from flasher.simulate.corpus import corpus
from flasher.simulate.ledger import Ledger
from flasher.simulate.plan import Plan
from flasher.simulate.play import play
from flasher.simulate.reached import UNREACHABLE, places, reachable, recorded_cells, with_readings
from flasher.simulate.workers import Pace, run_alone


@pytest.mark.slow
def test_the_corpus_reaches_each_place_that_a_campaign_can_reach() -> None:
    found = run_batch(corpus_batch())
    assert found.never_reached == []
    assert not UNREACHABLE.keys() & {*found.reached}
    assert (found.violation_count, found.excused) == (0, 0)
    assert (found.corpus_runs, found.runs, found.tallies) == (len(corpus()), 0, {})


@pytest.mark.slow
def test_each_plan_of_the_corpus_reaches_its_place() -> None:
    for place, plan in corpus().items():
        with recorded_cells() as cells:
            verdict = play(plan)
        reached = with_readings({*cells, *verdict.reached, f"exit code: {verdict.exit_code}"})
        assert place in reached, plan


@pytest.mark.slow
def test_random_plans_reach_no_place_that_is_called_unreachable() -> None:
    found = run_batch(Batch(campaign_key(), 0, 30))
    assert found.runs == 30
    assert not UNREACHABLE.keys() & {*found.reached}


def test_only_places_are_unreachable_each_with_its_reason() -> None:
    assert UNREACHABLE.keys() <= places()
    assert all(UNREACHABLE.values())
    assert reachable() | UNREACHABLE.keys() == places()


def test_a_reading_is_reached_by_all_its_places_in_whatever_batches() -> None:
    nak, code = "host: ending, NAK", "exit code: 8"
    one, other = Result("key", reached=(nak,)), Result("key", reached=(code,))
    assert "reading: R6" not in with_readings([nak])
    assert (one + other).reached == (other + one).reached == (code, nak, "reading: R6")


def test_readings_that_a_good_run_shows() -> None:
    def readings(text: str) -> set[str]:
        reached = play(Plan.parse(text)).reached
        return {each.partition(": ")[2] for each in reached if each.startswith("reading")}

    assert readings("job packets=3 ; mock") == {"R1", "R9"}
    assert readings("job packets=3 short=0 ; mock application=none") == {"R14"}
    assert readings("job packets=3 target=wmc") == {"R3", "R9"}
    assert readings("job packets=3 target=wmc ; @packet2 restart") == {"R9"}
    waits = "job packets=3 ; independent session=0.0 ; @packet2 kill"
    assert readings(waits) == {"R1", "R9", "R26"}
    assert readings("job packets=3 ; @packet2 interrupt") == set()


def test_a_ledger_has_the_corpus_once_and_whole(tmp_path: Path) -> None:
    path, batch = tmp_path / "done.jsonl", corpus_batch()
    done = Result(campaign_key(), corpus_runs=batch.count, reached=("exit code: 0",))
    with Ledger(path, 0, 10) as opened:
        opened.add(batch, replace(done, corpus_runs=batch.count - 1))
    with Ledger(path, 0, 10) as opened:
        assert [*opened.left([batch])] == [batch]
        opened.add(batch, done)
    with Ledger(path, 0, 10) as opened:
        assert [*opened.left([batch])] == []
        assert opened.result == done


def kill(_batch: Batch, _is_stopped: object = None) -> Result:
    raise SystemExit(3)


@pytest.mark.slow
def test_a_plan_of_the_corpus_that_ends_its_process_is_a_violation() -> None:
    found = run_alone(replace(corpus_batch(), first=1, count=1), run_one=kill)
    assert (found.runs, found.corpus_runs, found.violation_count) == (0, 1, 1)
    (one,) = found.violations
    assert (one.seed, one.plan) == (1 - CORPUS_SEEDS, str([*corpus().values()][1]))


def test_the_corpus_is_not_cut() -> None:
    assert [*Pace().cut([corpus_batch()])] == [corpus_batch()]
