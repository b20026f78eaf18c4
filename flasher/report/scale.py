"""Chart axes: ticks, labels and positions.

Pure functions; lengths on paper are in units of the drawing, values in units of the caller.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

LOG_RANGE: Final = 30.0
"""Ratio of largest to smallest value above which a scale is logarithmic."""
_STEPS: Final = (1, 2, 5, 10)
"""Round tick distances, times a power of ten."""
_ROUNDING: Final = 1e-9
_UNITS: Final = (("s", 1.0), ("ms", 1e-3), ("\N{MICRO SIGN}s", 1e-6))
_ZERO_BELOW: Final = 1e-12
"""Smaller values count as 0: no clock measures them."""
_EQUAL_WITHIN: Final = 1e-6
"""Values closer than this share count as equal: no tick could separate them."""


class Tick(NamedTuple):
    """Tick of an axis: its value and position."""

    value: float
    at: float


def nice_step(span: float, intervals: int) -> float:
    """Return the smallest of 1, 2 or 5 times a power of ten that divides `span` into at most
    `intervals`. Raises ValueError unless both are positive.
    """
    if span <= 0 or intervals <= 0:
        raise ValueError("span and intervals must be positive")
    raw = span / intervals
    magnitude = 10.0 ** math.floor(math.log10(raw))
    for step in _STEPS:
        if step * magnitude >= raw * (1 - _ROUNDING):
            return step * magnitude
    return _STEPS[-1] * magnitude * 10  # only by rounding


def linear_ticks(low: float, high: float, intervals: int = 5) -> list[float]:
    """Return at least two round values, from at or below `low` to at or above `high`."""
    if high - low <= max(_EQUAL_WITHIN * max(abs(low), abs(high)), _ZERO_BELOW):
        high = low + (abs(low) if abs(low) > _ZERO_BELOW else 1.0)
    step = nice_step(high - low, intervals)
    first = math.floor(low / step + _ROUNDING)
    last = math.ceil(high / step - _ROUNDING)
    return [_clean(number * step) for number in range(first, last + 1)]


def log_ticks(low: float, high: float, intervals: int = 9) -> list[float]:
    """Return 1, 2, 5 times the powers of ten around `low` to `high`; for more than `intervals` only
    the powers, or every second, third, ... of them.

    Raises ValueError unless 0 < low <= high.
    """
    if not 0 < low <= high:
        raise ValueError("a logarithmic scale needs 0 < low <= high")
    first = math.floor(math.log10(low) + _ROUNDING)
    last = max(first + 1, math.ceil(math.log10(high) - _ROUNDING))
    fine = [_clean(step * 10.0**power) for power in range(first, last) for step in (1, 2, 5)]
    fine.append(_clean(10.0**last))
    begin = max(tick for tick in fine[:-1] if tick <= low * (1 + _ROUNDING))
    end = min(tick for tick in fine if tick >= high * (1 - _ROUNDING) and tick > begin)
    kept = [tick for tick in fine if begin <= tick <= end]
    if len(kept) - 1 <= intervals:
        return kept
    stride = -(-(last - first) // max(1, intervals))
    return [_clean(10.0**power) for power in range(first, last + stride, stride)]


def wants_log(values: Iterable[float]) -> bool:
    """True if all values are positive and a linear axis would hide the small ones."""
    kept = list(values)
    return bool(kept) and min(kept) > _ZERO_BELOW and max(kept) / min(kept) > LOG_RANGE


@dataclass(frozen=True)
class Axis:
    """Axis that maps values to positions from `begin` to `end`, which may be less than `begin`."""

    low: float
    high: float
    begin: float
    end: float
    is_log: bool
    ticks: tuple[Tick, ...]

    @classmethod
    def over(
        cls,
        values: Iterable[float],
        begin: float,
        end: float,
        *,
        from_zero: bool = False,
        intervals: int = 5,
    ) -> Axis:
        """Create an axis for `values`, logarithmic if their range needs it. `from_zero` starts a
        linear one at 0. Without values it goes from 0 to 1.
        """
        kept = list(values) or [0.0, 1.0]
        is_log = wants_log(kept)
        low, high = min(kept), max(kept)
        if is_log:
            places = log_ticks(low, high, intervals)
        else:
            places = linear_ticks(min(low, 0.0) if from_zero else low, high, intervals)
        bare = cls(places[0], places[-1], begin, end, is_log, ())
        ticks = tuple(Tick(value, round(bare.at(value), 1)) for value in places)
        return cls(bare.low, bare.high, begin, end, is_log, ticks)

    def at(self, value: float) -> float:
        """Position of `value`; values outside map to the nearer end."""
        value = min(max(value, self.low), self.high)
        if self.is_log:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.begin + share * (self.end - self.begin)

    def duration_label(self, seconds: float) -> str:
        """Label of a tick on a time axis; on a linear axis all labels have one unit and enough
        decimals to differ.
        """
        if self.is_log or len(self.ticks) < 2 or self.high < 0:
            return duration_text(seconds)
        if seconds == 0:
            return "0"
        unit, size = next(((name, size) for name, size in _UNITS if self.high >= size), _UNITS[-1])
        step = (self.ticks[1].value - self.ticks[0].value) / size
        decimals = max(0, -math.floor(math.log10(step) + _ROUNDING))
        return f"{seconds / size:.{decimals}f} {unit}"


def whole_ticks(first: int, last: int, begin: float, end: float, intervals: int = 6) -> list[Tick]:
    """Return ticks at whole numbers from `first` to `last`, such as packet numbers, always with
    `first`.
    """
    if last <= first:
        return [Tick(first, (begin + end) / 2)]
    step = max(1, round(nice_step(last - first, intervals)))
    numbers = [first, *range((first // step + 1) * step, last + 1, step)]
    if len(numbers) > 2 and numbers[1] - first < step / 2:
        del numbers[1]
    scale = (end - begin) / (last - first)
    return [Tick(number, round(begin + (number - first) * scale, 1)) for number in numbers]


def slices(count: int, most: int) -> list[tuple[int, int]]:
    """Divide `count` things into at most `most` stretches of similar length; return begin and end
    (exclusive) of each.
    """
    parts = min(count, most)
    return [(count * part // parts, count * (part + 1) // parts) for part in range(parts)]


def share_percent(share: float) -> float:
    """Convert a share from 0 to 1 to percent, rounded down to one decimal: 100 only for 1."""
    return math.floor(share * 1000 + _ROUNDING) / 10


def share_text(share: float | None) -> str:
    """Format a share as `share_percent`, without a decimal that is 0."""
    return "-" if share is None else f"{share_percent(share):g} %"


def figure_text(value: float) -> str:
    """Format a mean or a deviation: five significant digits, more for a large whole number."""
    return f"{value:,.0f}" if abs(value) >= 99_999.5 else f"{value:,.5g}"


def duration_text(seconds: float | None) -> str:
    """Format a duration with three digits and a unit: 870 µs, 3.12 ms, 41.3 s, 2 min 05 s."""
    if seconds is None:
        return "\N{EN DASH}"
    size = abs(seconds)
    if size >= 120:
        minutes, rest = divmod(round(size), 60)
        return f"{'-' if seconds < 0 else ''}{minutes} min {rest:02} s"
    if size == 0:
        return "0 s"
    if size >= 0.9995:
        return f"{_three_digits(seconds)} s"
    if size >= 0.0009995:
        return f"{_three_digits(seconds * 1e3)} ms"
    return f"{_three_digits(seconds * 1e6)} \N{MICRO SIGN}s"


def _three_digits(value: float) -> str:
    """Format `value` with three digits, without trailing zeros."""
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _clean(value: float) -> float:
    """Round to 12 digits, so that 0.1 + 0.2 is 0.3."""
    return float(f"{value:.12g}")
