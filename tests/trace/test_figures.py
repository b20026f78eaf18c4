"""Distributions: every percentile is one of the values."""

from __future__ import annotations

import random
from collections import Counter
from statistics import median

import pytest

from flasher.trace.figures import Distribution, Ranked


def test_percentiles_are_values_that_were_measured() -> None:
    assert Distribution.of(number / 100 for number in range(100, 0, -1)) == Distribution(
        count=100, minimum_s=0.01, median_s=0.5, p95_s=0.95, p99_s=0.99, maximum_s=1.0
    )


def test_of_a_few_values_the_high_percentiles_are_the_greatest() -> None:
    assert Distribution.of([3.0, 1.0, 2.0]) == Distribution(3, 1.0, 2.0, 3.0, 3.0, 3.0)


def test_of_nothing_there_is_none() -> None:
    assert Distribution.of([]) is None


@pytest.mark.parametrize("size", [1, 2, 3, 8, 21])
def test_values_by_how_often_they_came_are_ranked_as_each_of_them(size: int) -> None:
    chance = random.Random(size)
    values = [chance.choice((0.1, 0.25, 0.3, 7.0)) for _ in range(size)]
    ranked = Ranked(Counter(values))
    assert [ranked[rank] for rank in range(len(ranked))] == sorted(values)
    assert (ranked[-1], ranked.median) == (max(values), median(values))
    assert Distribution.of(Counter(values)) == Distribution.of(values)
