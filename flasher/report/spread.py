"""How times are spread, as numbers: a histogram of values, or a distribution on one line.

Pure layout like `chart`, and drawn by the same templates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from flasher.report.chart import AXIS_HEIGHT, LEFT, RIGHT, TOP, Frame, intervals_for
from flasher.report.scale import Axis, Tick, duration_text, linear_ticks, middle
from flasher.trace.figures import Distribution

_HISTOGRAM_HEIGHT: Final = 150
_BINS: Final = 20
_SPREAD_HEIGHT: Final = 54


class Bar(NamedTuple):
    """One bin of a histogram."""

    x: float
    y: float
    width: float
    height: float
    tip: str


@dataclass(frozen=True)
class Histogram:
    """How many values fall where; `x_axis` has the values, `y_ticks` the counts."""

    frame: Frame
    x_axis: Axis
    y_ticks: tuple[Tick, ...]
    bars: tuple[Bar, ...]
    description: str


def histogram(values: Sequence[float], width: float) -> Histogram:
    """How these times (in seconds) are spread, in bins of one width on paper: on a logarithmic axis
    they grow with the values. `width` is in CSS pixels. Raises ValueError for none.
    """
    if not values:
        raise ValueError("no values")
    bottom = TOP + _HISTOGRAM_HEIGHT
    frame = Frame(width, bottom + AXIS_HEIGHT, LEFT, TOP, width - RIGHT - 10, bottom)
    x_axis = Axis.over(values, frame.left, frame.right, intervals=intervals_for(width))
    bin_width = (frame.right - frame.left) / _BINS
    counts = [0] * _BINS
    for value in values:
        counts[min(_BINS - 1, int((x_axis.at(value) - frame.left) / bin_width))] += 1
    places = [place for place in linear_ticks(0, max(counts), 4) if place == int(place)]
    top_count = places[-1]
    y_ticks = tuple(
        Tick(place, round(bottom - place / top_count * _HISTOGRAM_HEIGHT, 1)) for place in places
    )
    bars = []
    for index, count in enumerate(counts):
        if count:
            tall = round(max(1.0, count / top_count * _HISTOGRAM_HEIGHT), 1)
            begin = frame.left + index * bin_width
            edges = (_value_at(x_axis, index / _BINS), _value_at(x_axis, (index + 1) / _BINS))
            tip = f"{duration_text(edges[0])} to {duration_text(edges[1])}: {count:,}"
            bars.append(Bar(round(begin + 1, 1), bottom - tall, round(bin_width - 2, 1), tall, tip))
    ordered = sorted(values)
    description = (
        f"{len(values):,} values from {duration_text(ordered[0])} to {duration_text(ordered[-1])}, "
        f"median {duration_text(middle(ordered))}."
    )
    return Histogram(frame, x_axis, y_ticks, tuple(bars), description)


def _value_at(axis: Axis, share: float) -> float:
    """The value at this share of the way along the axis."""
    if axis.is_log:
        return axis.low * math.pow(axis.high / axis.low, share)
    return axis.low + (axis.high - axis.low) * share


class Figure(NamedTuple):
    """A named value of a spread."""

    name: str
    value_s: float
    x: float


@dataclass(frozen=True)
class Spread:
    """A distribution on one line: from minimum to maximum, and what lies between."""

    frame: Frame
    x_axis: Axis
    figures: tuple[Figure, ...]
    """Minimum, median, p95, p99, maximum."""
    description: str


def spread(distribution: Distribution, width: float) -> Spread:
    """How a distribution lies on an axis of its own, `width` CSS pixels wide."""
    named = (
        ("minimum", distribution.minimum_s),
        ("median", distribution.median_s),
        ("95 %", distribution.p95_s),
        ("99 %", distribution.p99_s),
        ("maximum", distribution.maximum_s),
    )
    frame = Frame(width, _SPREAD_HEIGHT, 24, 6, width - 34, 26)
    values = [value for _, value in named]
    x_axis = Axis.over(
        values, frame.left, frame.right, from_zero=True, intervals=intervals_for(width)
    )
    figures = tuple(Figure(name, value, round(x_axis.at(value), 1)) for name, value in named)
    said = ", ".join(f"{name} {duration_text(value)}" for name, value in named)
    return Spread(frame, x_axis, figures, f"{distribution.count:,} values: {said}.")
