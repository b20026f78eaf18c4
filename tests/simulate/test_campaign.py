"""Campaigns: sums of batches, canaries, what was reached."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from flasher.simulate import campaign
from flasher.simulate.campaign import Batch, Found, Result, batches, campaign_key, run_batch
from flasher.simulate.plan import Plan
from flasher.simulate.shrink import shrink


def summed(sizes: int) -> Result:
    return sum(
        (run_batch(each) for each in batches(0, 12, sizes) if not each.canary),
        Result(campaign_key()),
    )


@pytest.mark.slow
def test_the_sum_does_not_depend_on_the_size_of_the_batches() -> None:
    one, many = summed(12), summed(5)
    assert one.runs == many.runs == 12
    assert len(one.reached) > 20
    for name in ("endings", "tallies", "reached", "violations", "digest", "latest", "excused"):
        assert getattr(one, name) == getattr(many, name), name


def test_batches_cover_each_seed_once_and_have_canaries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "CANARY_EVERY", 20)
    all_of_them = [*batches(7, 45, 8)]
    runs = [each for each in all_of_them if not each.canary]
    seeds = [seed for each in runs for seed in range(each.first, each.first + each.count)]
    assert seeds == [*range(7, 52)]
    assert [each.first for each in all_of_them if each.canary] == [7, 27, 47]


def test_the_violations_of_the_lowest_seeds_are_kept_and_all_are_counted() -> None:
    def result(first: int) -> Result:
        found = tuple(Found(seed, "FALSE", "text", "plan") for seed in range(first, first + 15))
        return Result("key", violations=found, violation_count=15)

    forth, back = result(0) + result(100), result(100) + result(0)
    assert forth == back
    assert [each.seed for each in forth.violations] == [*range(15), *range(100, 105)]
    assert forth.violation_count == 30


def test_violations_of_one_seed_have_an_order_in_every_process() -> None:
    kinds = [f"KIND {number}" for number in range(15)]
    found = tuple(Found(1, kind, "text", "plan") for kind in reversed(kinds))
    result = Result("key", violations=found) + Result("key")
    assert [each.kind for each in result.violations] == sorted(kinds)


def test_results_of_two_campaigns_are_not_added() -> None:
    with pytest.raises(ValueError, match="two campaigns: one and other"):
        Result("one") + Result("other")


def test_a_batch_of_other_code_is_refused() -> None:
    with pytest.raises(ValueError, match="a batch of another"):
        run_batch(Batch("another", 0, 1))


@pytest.mark.slow
def test_a_canary_is_found_and_leaves_the_process_as_it_was() -> None:
    name = campaign.CANARIES[0]
    found = run_batch(Batch(campaign_key(), 0, 200, name))
    assert found.canaries_found == {name: 1}
    assert not found.is_blind
    assert run_batch(Batch(campaign_key(), 0, 20)).violation_count == 0


def test_a_campaign_without_a_canary_that_was_found_is_blind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaign, "swapped", lambda _codes: nullcontext())
    missed = run_batch(Batch(campaign_key(), 0, 1, campaign.CANARIES[0]))
    assert missed.canaries_missed == {campaign.CANARIES[0]: 1}
    assert missed.is_blind
    assert Result("key").is_blind


def test_shrinking_ends_when_it_is_over() -> None:
    plan = Plan.parse("job packets=3 ; mock ; @packet1 drop ; @packet2 drop ; @packet3 power")
    played: list[Plan] = []

    def is_bad(shorter: Plan, _kind: str) -> bool:
        played.append(shorter)
        return True

    assert shrink(plan, "LOST", is_bad=is_bad, is_over=lambda: len(played) == 1) == played[0]
    assert len([*played[0].events]) < 3
