"""Chart layout: answer times by packet number, histograms, distributions on one line.

Pure functions; `templates/charts.html` draws their results. A chart has a width in CSS pixels, so
that its text has its full size on phones and desktops (`WIDTHS`). Long series are drawn as
stretches, so that a chart has a bounded size.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from statistics import median
from typing import Final, NamedTuple

from flasher.report.scale import Axis, Tick, duration_text, linear_ticks, slices, whole_ticks
from flasher.trace.figures import Distribution, Ranked

WIDTHS: Final = {"wide": 880, "narrow": 340}
"""Drawing width by class of the style sheet; a page contains both drawings and shows one."""
_DOTS_PER_WIDTH: Final = 0.5
"""Samples per pixel above which stretches show minimum, median and maximum."""
_STRETCH_WIDTH: Final = 6
_LEFT: Final = 58
_RIGHT: Final = 14
_TOP: Final = 12
_LATENCY_HEIGHT: Final = 200
_LANE_HEIGHT: Final = 18
_LANE_GAP: Final = 6
_Y_INTERVALS: Final = 7
_AXIS_HEIGHT: Final = 40
_HISTOGRAM_HEIGHT: Final = 150
_BINS: Final = 20
_SPREAD_HEIGHT: Final = 54


class ChartArea(NamedTuple):
    """Size of a drawing, and the area inside its axes, in CSS pixels."""

    width: float
    height: float
    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True)
class Sample:
    """Packet with its answer time in seconds (None without an answer), repetitions and NAKs."""

    number: int
    seconds: float | None
    repeated: int = 0
    naks: int = 0


class MarkKind(Enum):
    """Kind of a mark below the plot; the value is its name."""

    REPEATED = "repeated"
    NAK = "NAK"
    UNANSWERED = "no answer"

    @property
    def short(self) -> str:
        """Name that fits left of the plot."""
        return {"repeated": "again", "NAK": "NAK", "no answer": "silent"}[self.value]


class Mark(NamedTuple):
    """Mark of a packet, or of some packets in a stretch."""

    x: float
    kind: MarkKind
    tip: str


class Lane(NamedTuple):
    """Row of marks of one kind."""

    kind: MarkKind
    y: float
    marks: tuple[Mark, ...]


class Dot(NamedTuple):
    """Answer time of a packet."""

    x: float
    y: float
    tip: str


class Stretch(NamedTuple):
    """Answer times of consecutive packets: fastest, slowest and median."""

    x: float
    top: float
    height: float
    middle: float
    width: float
    tip: str


@dataclass(frozen=True)
class LatencyChart:
    """Chart of answer time over packet number."""

    frame: ChartArea
    x_ticks: tuple[Tick, ...]
    y_axis: Axis
    dots: tuple[Dot, ...]
    stretches: tuple[Stretch, ...]
    lanes: tuple[Lane, ...]
    per_stretch: int
    """Maximum number of packets in a stretch; 1 for a chart of dots."""
    description: str


def latency_chart(samples: Sequence[Sample], width: float) -> LatencyChart:
    """Lay out the answer times of packets, in order, `width` CSS pixels wide. Raises ValueError
    without packets.
    """
    if not samples:
        raise ValueError("no packets")
    plot_width = width - _LEFT - _RIGHT
    kinds = [kind for kind in MarkKind if any(_count(sample, kind) for sample in samples)]
    bottom = _TOP + _LATENCY_HEIGHT
    lanes_top = bottom + _LANE_GAP
    height = lanes_top + _LANE_HEIGHT * len(kinds) + _AXIS_HEIGHT
    frame = ChartArea(width, height, _LEFT, _TOP, width - _RIGHT, bottom)
    known = [sample.seconds for sample in samples if sample.seconds is not None]
    y_axis = Axis.over(known, bottom, _TOP, from_zero=True, intervals=_Y_INTERVALS)
    groups = slices(len(samples), len(samples))
    folded = len(samples) > plot_width * _DOTS_PER_WIDTH
    if folded:
        groups = slices(len(samples), int(plot_width // _STRETCH_WIDTH))
    place = _places(len(samples), frame)
    parts = [(place((begin + end - 1) / 2), samples[begin:end]) for begin, end in groups]
    return LatencyChart(
        frame=frame,
        x_ticks=tuple(_number_ticks(samples, frame)),
        y_axis=y_axis,
        dots=() if folded else tuple(_dots(parts, y_axis)),
        stretches=tuple(_stretches(parts, y_axis)) if folded else (),
        lanes=tuple(
            Lane(kind, lanes_top + _LANE_HEIGHT * (row + 0.5), tuple(_marks(parts, kind)))
            for row, kind in enumerate(kinds)
        ),
        per_stretch=max(end - begin for begin, end in groups),
        description=_describe(samples, known),
    )


def _places(count: int, frame: ChartArea) -> Callable[[float], float]:
    """Return a function from the index of a sample to its position."""
    begin, end = frame.left + 4, frame.right - 4
    if count == 1:
        return lambda _: (begin + end) / 2
    return lambda index: round(begin + index * (end - begin) / (count - 1), 1)


def _number_ticks(samples: Sequence[Sample], frame: ChartArea) -> Iterable[Tick]:
    """Yield ticks at round packet numbers, or at round counts of packets if numbers are missing."""
    begin, end, intervals = frame.left + 4, frame.right - 4, _intervals_for(frame.width)
    first, last = samples[0].number, samples[-1].number
    if last - first == len(samples) - 1:
        yield from whole_ticks(first, last, begin, end, intervals)
        return
    for tick in whole_ticks(0, len(samples) - 1, begin, end, intervals):
        yield Tick(samples[int(tick.value)].number, tick.at)


def _intervals_for(width: float) -> int:
    """Number of tick intervals that fit an axis of this width."""
    return max(2, int(width // 90))


def _count(sample: Sample, kind: MarkKind) -> int:
    match kind:
        case MarkKind.REPEATED:
            return sample.repeated
        case MarkKind.NAK:
            return sample.naks
        case MarkKind.UNANSWERED:
            return int(sample.seconds is None)


_Parts = Sequence[tuple[float, Sequence[Sample]]]


def _name(part: Sequence[Sample]) -> str:
    if len(part) == 1:
        return f"packet {part[0].number}"
    return f"packets {part[0].number} to {part[-1].number}"


def _dots(parts: _Parts, axis: Axis) -> Iterable[Dot]:
    for x, part in parts:
        seconds = part[0].seconds
        if seconds is not None:
            y = round(axis.at(seconds), 1)
            yield Dot(x, y, f"{_name(part)}: {duration_text(seconds)}")


def _stretches(parts: _Parts, axis: Axis) -> Iterable[Stretch]:
    for x, part in parts:
        known = sorted(sample.seconds for sample in part if sample.seconds is not None)
        if known:
            low, mid, high = known[0], median(known), known[-1]
            top = round(axis.at(high) - 1, 1)
            tip = (
                f"{_name(part)}: {duration_text(low)} to {duration_text(high)}, "
                f"median {duration_text(mid)}"
            )
            tall = round(axis.at(low) + 1 - top, 1)
            yield Stretch(x, top, tall, round(axis.at(mid), 1), _STRETCH_WIDTH - 2, tip)


def _marks(parts: _Parts, kind: MarkKind) -> Iterable[Mark]:
    for x, part in parts:
        count = sum(_count(sample, kind) for sample in part)
        if count:
            times = "" if count == 1 else f", {count} times"
            yield Mark(x, kind, f"{_name(part)}: {kind.value}{times}")


def _describe(samples: Sequence[Sample], known: Sequence[float]) -> str:
    summary = f"{len(samples):,} packets, {len(known):,} with an answer"
    if known:
        summary += (
            f": {duration_text(min(known))} to {duration_text(max(known))}, "
            f"median {duration_text(median(known))}"
        )
    repeated, naks = (
        sum(_count(sample, kind) for sample in samples)
        for kind in (MarkKind.REPEATED, MarkKind.NAK)
    )
    return f"{'; '.join((summary, f'{repeated:,} repetitions', f'{naks:,} NAKs'))}."


# -- distributions --------------------------------------------------------------------------------


class HistogramBar(NamedTuple):
    """Bar of a histogram."""

    x: float
    y: float
    width: float
    height: float
    tip: str


@dataclass(frozen=True)
class HistogramChart:
    """Histogram; `x_axis` has the values, `y_ticks` the counts."""

    frame: ChartArea
    x_axis: Axis
    y_ticks: tuple[Tick, ...]
    bars: tuple[HistogramBar, ...]
    description: str


def histogram(values: Iterable[float] | Mapping[float, int], width: float) -> HistogramChart:
    """Lay out a histogram of times in seconds (or of value counts), `width` CSS pixels wide. Bars
    have equal width: on a logarithmic axis bins grow with the values. Raises ValueError without
    values.
    """
    times = Counter(values)
    if not times:
        raise ValueError("no values")
    bottom = _TOP + _HISTOGRAM_HEIGHT
    frame = ChartArea(width, bottom + _AXIS_HEIGHT, _LEFT, _TOP, width - _RIGHT - 10, bottom)
    x_axis = Axis.over(times, frame.left, frame.right, intervals=_intervals_for(width))
    bin_width = (frame.right - frame.left) / _BINS
    counts = [0] * _BINS
    for value, count in times.items():
        counts[min(_BINS - 1, int((x_axis.at(value) - frame.left) / bin_width))] += count
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
            bars.append(
                HistogramBar(round(begin + 1, 1), bottom - tall, round(bin_width - 2, 1), tall, tip)
            )
    ordered = Ranked(times)
    description = (
        f"{len(ordered):,} values from {duration_text(ordered[0])} to"
        f" {duration_text(ordered[-1])}, median {duration_text(ordered.median)}."
    )
    return HistogramChart(frame, x_axis, y_ticks, tuple(bars), description)


def _value_at(axis: Axis, share: float) -> float:
    """Value at a share of the axis length."""
    if axis.is_log:
        return axis.low * math.pow(axis.high / axis.low, share)
    return axis.low + (axis.high - axis.low) * share


class Figure(NamedTuple):
    """Named value of a distribution."""

    name: str
    value_s: float
    x: float


@dataclass(frozen=True)
class Spread:
    """Distribution drawn on one line, from minimum to maximum."""

    frame: ChartArea
    x_axis: Axis
    figures: tuple[Figure, ...]
    """Minimum, median, p95, p99, maximum."""
    description: str


def spread(distribution: Distribution, width: float) -> Spread:
    """Lay out a distribution on its own axis, `width` CSS pixels wide."""
    named = (
        ("minimum", distribution.minimum_s),
        ("median", distribution.median_s),
        ("95 %", distribution.p95_s),
        ("99 %", distribution.p99_s),
        ("maximum", distribution.maximum_s),
    )
    frame = ChartArea(width, _SPREAD_HEIGHT, 24, 6, width - 34, 26)
    values = [value for _, value in named]
    x_axis = Axis.over(
        values, frame.left, frame.right, from_zero=True, intervals=_intervals_for(width)
    )
    figures = tuple(Figure(name, value, round(x_axis.at(value), 1)) for name, value in named)
    summary = ", ".join(f"{name} {duration_text(value)}" for name, value in named)
    return Spread(frame, x_axis, figures, f"{distribution.count:,} values: {summary}.")
