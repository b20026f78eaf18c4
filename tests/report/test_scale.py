"""Ticks at round values, values at their places, times in words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.report.scale import (
    Axis,
    duration_text,
    linear_ticks,
    log_ticks,
    nice_step,
    share_percent,
    slices,
    wants_log,
    whole_ticks,
)
from tests.loops import each

positive = st.floats(min_value=1e-7, max_value=1e7)


@each(
    "span, intervals, step",
    [
        (10, 5, 2),
        (1, 5, 0.2),
        (7, 5, 2),
        (0.0123, 4, 0.005),
        (100, 10, 10),
        (99, 10, 10),
        (101, 10, 20),
    ],
)
def test_a_step_is_1_2_or_5_times_a_power_of_ten(span: float, intervals: int, step: float) -> None:
    assert nice_step(span, intervals) == pytest.approx(step)


@each("span, intervals", [(0, 5), (-1, 5), (1, 0)])
def test_there_is_no_step_of_nothing(span: float, intervals: int) -> None:
    with pytest.raises(ValueError, match="positive"):
        nice_step(span, intervals)


def test_linear_ticks_enclose_the_values() -> None:
    assert linear_ticks(0, 1) == [0, 0.2, 0.4, 0.6, 0.8, 1]
    assert linear_ticks(0.0013, 0.0047, 4) == [0.001, 0.002, 0.003, 0.004, 0.005]
    assert linear_ticks(-3, 3, 3) == [-4, -2, 0, 2, 4]


def test_a_single_value_has_an_axis_too() -> None:
    assert linear_ticks(0, 0) == [0, 0.2, 0.4, 0.6, 0.8, 1]
    ticks = linear_ticks(5, 5)
    assert ticks[0] <= 5 < ticks[-1]


def test_values_that_no_tick_could_distinguish_are_one_value() -> None:
    assert linear_ticks(1e7 - 1e-8, 1e7) == linear_ticks(1e7, 1e7)
    assert linear_ticks(0, 5e-324) == linear_ticks(5e-324, 5e-324) == linear_ticks(0, 0)
    assert not wants_log([5e-324, 1])


@pytest.mark.slow
@given(positive, positive)
def test_linear_ticks_hold_any_range_with_few_steps(one: float, other: float) -> None:
    low, high = min(one, other), max(one, other)
    ticks = linear_ticks(low, high, 5)
    assert ticks[0] <= low * (1 + 1e-6)
    assert ticks[-1] >= high * (1 - 1e-6)
    assert 2 <= len(ticks) <= 8
    assert ticks == sorted(set(ticks))


def test_log_ticks_are_1_2_5_over_few_decades_and_powers_over_many() -> None:
    assert log_ticks(0.0013, 0.08) == [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1]
    assert log_ticks(1e-5, 5) == [1e-5, 1e-4, 1e-3, 0.01, 0.1, 1, 10]
    assert log_ticks(0.002, 0.2, 3) == [0.001, 0.01, 0.1, 1]
    assert log_ticks(1e-6, 90, 3) == [1e-6, 1e-3, 1, 1000]
    assert log_ticks(1, 1) == [1, 2]


@each("low, high", [(0, 1), (-1, 1), (2, 1)])
def test_a_logarithm_needs_positive_values_in_order(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="logarithmic"):
        log_ticks(low, high)


@pytest.mark.slow
@given(positive, positive)
def test_log_ticks_hold_any_range(one: float, other: float) -> None:
    low, high = min(one, other), max(one, other)
    ticks = log_ticks(low, high, 4)
    assert ticks[0] <= low * (1 + 1e-6)
    assert ticks[-1] >= high * (1 - 1e-6)
    assert 2 <= len(ticks) <= 6
    assert ticks == sorted(set(ticks))


def test_a_wide_range_of_positive_values_wants_a_logarithm() -> None:
    assert wants_log([0.001, 0.5])
    assert not wants_log([0.001, 0.002])
    assert not wants_log([0, 1])
    assert not wants_log([])


@each("values", [[0.001, 0.002], [0.001, 0.9], [3.0], []])
def test_an_axis_puts_its_ends_at_its_ends_and_keeps_the_order(values: list[float]) -> None:
    axis = Axis.over(values, 200, 10)
    assert axis.at(axis.low) == pytest.approx(200)
    assert axis.at(axis.high) == pytest.approx(10)
    assert [tick.at for tick in axis.ticks] == sorted((t.at for t in axis.ticks), reverse=True)
    assert axis.at(axis.high * 10 + 1) == pytest.approx(10)
    assert axis.at(-5) == pytest.approx(200)


def test_equal_factors_are_equally_far_apart_on_a_logarithmic_axis() -> None:
    axis = Axis.over([0.001, 1], 0, 300)
    assert axis.is_log
    assert axis.at(0.01) == pytest.approx(100)
    assert axis.at(0.1) == pytest.approx(200)


def test_a_linear_axis_begins_at_zero_on_request() -> None:
    assert Axis.over([0.001, 0.002], 0, 100, from_zero=True).low == 0
    assert Axis.over([0.0015, 0.002], 0, 100).low > 0


def test_the_labels_of_an_axis_distinguish_neighbours() -> None:
    axis = Axis.over([0.00181, 0.00184], 0, 100)
    labels = [axis.duration_label(tick.value) for tick in axis.ticks]
    assert labels == ["1.81 ms", "1.82 ms", "1.83 ms", "1.84 ms"]
    axis = Axis.over([0, 0.9], 0, 100)
    labels = [axis.duration_label(tick.value) for tick in axis.ticks]
    assert labels == ["0", "0.2 s", "0.4 s", "0.6 s", "0.8 s", "1.0 s"]


@pytest.mark.slow
@given(st.lists(st.floats(0, 1000), min_size=2, max_size=9))
def test_no_two_ticks_have_one_label(values: list[float]) -> None:
    axis = Axis.over(values, 0, 100)
    labels = [axis.duration_label(tick.value) for tick in axis.ticks]
    assert len(set(labels)) == len(labels)


def test_packet_numbers_have_round_ticks_after_the_first() -> None:
    assert [tick.value for tick in whole_ticks(1, 613, 0, 100)] == [1, 200, 400, 600]
    assert [tick.value for tick in whole_ticks(1, 3, 0, 100)] == [1, 2, 3]
    assert [tick.value for tick in whole_ticks(95, 400, 0, 100, 3)] == [95, 200, 400]
    assert [tuple(tick) for tick in whole_ticks(7, 7, 0, 100)] == [(7, 50)]


@pytest.mark.slow
@given(st.integers(0, 5000), st.integers(1, 200))
def test_slices_are_all_of_it_in_nearly_equal_parts(count: int, most: int) -> None:
    parts = slices(count, most)
    assert [number for begin, end in parts for number in range(begin, end)] == list(range(count))
    sizes = {end - begin for begin, end in parts}
    assert len(parts) <= most
    assert not sizes or max(sizes) - min(sizes) <= 1


@each(
    "seconds, text",
    [
        (None, "\u2013"),
        (0, "0 s"),
        (0.00087, "870 \u00b5s"),
        (0.0009999, "1 ms"),
        (0.003124, "3.12 ms"),
        (0.5, "500 ms"),
        (0.9999, "1 s"),
        (41.26, "41.3 s"),
        (125.4, "2 min 05 s"),
        (-0.002, "-2 ms"),
    ],
)
def test_times_have_three_figures_and_a_unit(seconds: float | None, text: str) -> None:
    assert duration_text(seconds) == text


@each("whole", [1, 7, 34, 1000, 99_999])
def test_only_a_whole_share_is_100_percent(whole: int) -> None:
    assert share_percent(whole / whole) == 100
    assert share_percent((whole - 1) / whole) < 100
    assert share_percent(29 / 34) == 85.2
    assert [share_percent(tenths / 1000) for tenths in range(1001)] == [
        tenths / 10 for tenths in range(1001)
    ]
