"""Where the latency chart, the histogram and the spread put things."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.report.chart import (
    WIDTHS,
    MarkKind,
    Sample,
    histogram,
    latency_chart,
    spread,
)
from flasher.trace.figures import Distribution

WIDTH = WIDTHS["wide"]


def test_few_packets_have_a_dot_each_slower_ones_higher() -> None:
    chart = latency_chart([Sample(1, 0.001), Sample(2, 0.003), Sample(3, 0.002)], WIDTH)
    first, second, third = chart.dots
    assert first.x < second.x < third.x
    assert first.y > third.y > second.y
    assert second.tip == "packet 2: 3 ms"
    assert chart.stretches == ()
    assert chart.per_stretch == 1
    assert not chart.y_axis.is_log


def test_one_packet_is_in_the_middle() -> None:
    chart = latency_chart([Sample(7, 0.001)], WIDTH)
    assert chart.dots[0].x == (chart.frame.left + chart.frame.right) / 2
    assert [tick.value for tick in chart.x_ticks] == [7]


def test_no_packets_have_no_chart() -> None:
    with pytest.raises(ValueError, match="no packets"):
        latency_chart([], WIDTH)


def test_many_packets_are_drawn_as_stretches_from_fastest_to_slowest() -> None:
    samples = [Sample(number, 0.001 + number % 10 / 1000) for number in range(1, 10_001)]
    chart = latency_chart(samples, WIDTH)
    assert chart.dots == ()
    assert 100 <= len(chart.stretches) <= WIDTH / 6
    for stretch in chart.stretches:
        assert stretch.top < stretch.middle < stretch.top + stretch.height
    assert "median 5 ms" in chart.stretches[0].tip
    assert chart.per_stretch == -(-10_000 // len(chart.stretches))


def test_a_wide_range_makes_the_scale_logarithmic() -> None:
    chart = latency_chart([Sample(1, 0.001), Sample(2, 0.5)], WIDTH)
    assert chart.y_axis.is_log


def test_repetitions_naks_and_missing_answers_are_marked_in_lanes_under_the_plot() -> None:
    chart = latency_chart(
        [Sample(1, 0.001), Sample(2, 0.002, repeated=1, naks=2), Sample(3, None, repeated=4)], WIDTH
    )
    lanes = {lane.kind: lane for lane in chart.lanes}
    assert [mark.tip for mark in lanes[MarkKind.NAK].marks] == ["packet 2: NAK, 2 times"]
    assert [mark.tip for mark in lanes[MarkKind.REPEATED].marks] == [
        "packet 2: repeated",
        "packet 3: repeated, 4 times",
    ]
    assert [mark.tip for mark in lanes[MarkKind.UNANSWERED].marks] == ["packet 3: no answer"]
    assert len(chart.dots) == 2
    assert all(chart.frame.bottom < lane.y < chart.frame.height for lane in chart.lanes)


def test_a_healthy_transfer_has_no_lanes() -> None:
    assert latency_chart([Sample(1, 0.001)], WIDTH).lanes == ()


def test_a_transfer_without_any_answer_is_still_a_chart() -> None:
    chart = latency_chart([Sample(1, None), Sample(2, None)], WIDTH)
    assert chart.dots == ()
    assert chart.description == "2 packets, 0 with an answer; 0 repetitions; 0 NAKs."


def test_missing_packet_numbers_keep_the_labels_true() -> None:
    chart = latency_chart([Sample(number, 0.001) for number in (1, 2, 50, 51, 52)], WIDTH)
    place = {dot.tip: dot.x for dot in chart.dots}
    for tick in chart.x_ticks:
        assert place[f"packet {tick.value}: 1 ms"] == pytest.approx(tick.at, abs=0.11)


@pytest.mark.slow
@given(
    st.lists(st.one_of(st.none(), st.floats(1e-6, 20)), min_size=1, max_size=900),
    st.sampled_from(sorted(WIDTHS.values())),
)
def test_everything_lies_inside_of_the_plot(values: list[float | None], width: float) -> None:
    samples = [Sample(number, value) for number, value in enumerate(values, 1)]
    chart = latency_chart(samples, width)
    frame = chart.frame
    for dot in chart.dots:
        assert frame.left <= dot.x <= frame.right
        assert frame.top <= dot.y <= frame.bottom
    for bar in chart.stretches:
        assert frame.left <= bar.x <= frame.right
        assert frame.top - 1 <= bar.top <= bar.top + bar.height <= frame.bottom + 1.2
    assert len(chart.dots) + len(chart.stretches) <= width / 2


def test_a_histogram_counts_every_value_once() -> None:
    values = [0.001] * 30 + [0.002] * 10 + [0.0015] * 5
    chart = histogram(values, WIDTH)
    assert sum(int(bar.tip.rpartition(": ")[2]) for bar in chart.bars) == 45
    tallest = max(chart.bars, key=lambda bar: bar.height)
    assert tallest.tip.endswith(": 30")
    assert "45 values from 1 ms to 2 ms, median 1 ms" in chart.description
    assert all(tick.value == int(tick.value) for tick in chart.y_ticks)


def test_a_histogram_of_one_value_has_one_bar() -> None:
    chart = histogram([0.25], WIDTHS["narrow"])
    assert len(chart.bars) == 1
    assert chart.bars[0].tip.endswith(": 1")


def test_a_histogram_of_a_wide_range_has_bins_that_grow() -> None:
    chart = histogram([0.001, 0.01, 0.1, 1.0], WIDTH)
    assert chart.x_axis.is_log
    assert len(chart.bars) == 4


def test_no_values_have_no_histogram() -> None:
    with pytest.raises(ValueError, match="no values"):
        histogram([], WIDTH)


def test_a_spread_shows_a_distribution_in_order() -> None:
    found = Distribution.of([0.001 * number for number in range(1, 101)])
    assert found is not None
    drawn = spread(found, WIDTH)
    places = [figure.x for figure in drawn.figures]
    assert places == sorted(places)
    assert [figure.value_s for figure in drawn.figures] == pytest.approx(
        [0.001, 0.050, 0.095, 0.099, 0.1]
    )
    assert "100 values: minimum 1 ms, median 50 ms" in drawn.description
