"""Distributions: every percentile is one of the values."""

from __future__ import annotations

from flasher.trace.figures import Distribution


def test_percentiles_are_values_that_were_measured() -> None:
    assert Distribution.of(number / 100 for number in range(100, 0, -1)) == Distribution(
        count=100, minimum_s=0.01, median_s=0.5, p95_s=0.95, p99_s=0.99, maximum_s=1.0
    )


def test_of_a_few_values_the_high_percentiles_are_the_greatest() -> None:
    assert Distribution.of([3.0, 1.0, 2.0]) == Distribution(3, 1.0, 2.0, 3.0, 3.0, 3.0)


def test_of_nothing_there_is_none() -> None:
    assert Distribution.of([]) is None
