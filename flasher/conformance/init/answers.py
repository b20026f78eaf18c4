"""Derives values of profile keys from a device's answers and measured times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from math import ceil, floor, log10
from typing import Final, NamedTuple

from flasher.conformance.profile import profile_keys
from flasher.conformance.results import KeyAnswer

LONGEST: Final = 3
"""A limit is so many times the longest measured time."""
_ACCEPTED: Final = 0.9
_DEVIATION: Final = 2
MARGINS: Final = (
    f"limits are {LONGEST} times the longest measured time, gaps {_ACCEPTED:g} of the longest "
    f"accepted one, tolerances {_DEVIATION} times the largest deviation"
)
"""Margins of the written times, for people."""
_SHOWN: Final = 6
_LEAST_S: Final = 0.001
_EITHER: Final = "either"


class Trial(NamedTuple):
    """One stimulus, its answer, and the value of the key that it supports; "" when none fits."""

    value: str
    answer: str
    stimulus: str
    link: str = "to"
    """Word between answer and stimulus; "" when the answer comes last."""

    def __str__(self) -> str:
        if not self.link:
            return f"{self.stimulus} {self.answer}"
        return f"{self.answer} {self.link} {self.stimulus}"


Findings = Iterator[KeyAnswer | Trial | str]
"""Results of a question: answers, trials for its choice, or why all its keys stay open."""


def decide(key: str, trials: Sequence[Trial]) -> KeyAnswer:
    """The value on which all trials agree; `either` when they differ and the key allows it."""
    seen, values = _summary(trials), {trial.value for trial in trials}
    allowed = profile_keys()[key].choices
    if not values <= set(allowed):
        return KeyAnswer(key, None, f"no value of the key describes this: {seen}")
    if len(values) == 1:
        return KeyAnswer(key, values.pop(), seen)
    if _EITHER in allowed:
        return KeyAnswer(key, _EITHER, seen)
    return KeyAnswer(key, None, f"the answers differ: {seen}")


def _summary(trials: Sequence[Trial]) -> str:
    """List every answer to every stimulus with its count."""
    total = Counter(trial.stimulus for trial in trials)
    counts = Counter((str(trial), trial.stimulus) for trial in trials)
    found = [
        f"{text}, {count} of {total[stimulus]} times" for (text, stimulus), count in counts.items()
    ]
    more = len(found) - _SHOWN
    if more <= 0:
        return "; ".join(found)
    values = Counter(trial.value or "another answer" for trial in trials)
    summed = ", ".join(f"{value} {count} of {len(trials)} times" for value, count in values.items())
    return f"{summed}: {'; '.join(found[:_SHOWN])}; and {more} more"


def limit_answer(key: str, values_s: Sequence[float], least_s: float, unsure_s: float) -> KeyAnswer:
    """Derive a limit from measured times, with a margin."""
    if not values_s:
        return KeyAnswer(key, None, "never measured")
    longest_s = max(values_s)
    value = _rounded(max(LONGEST * longest_s + 2 * unsure_s, least_s), ceil)
    times = "once" if len(values_s) == 1 else f"{len(values_s)} times"
    return KeyAnswer(
        key,
        value,
        f"measured {times}, at most {longest_s * 1000:.1f} ms; the limit is {LONGEST} times that, "
        f"and at least {least_s:g} s",
    )


def gap_answer(key: str, longest_s: float, seen: str, unsure_s: float) -> KeyAnswer:
    """Derive a gap that the device has to accept from the longest accepted one, with a margin."""
    value = _rounded(max(_ACCEPTED * longest_s - 2 * unsure_s, _LEAST_S), floor)
    return KeyAnswer(key, value, f"{seen}; the gap is {_ACCEPTED:g} of the accepted one")


def pause_answer(key: str, values_s: Sequence[float], unsure_s: float) -> KeyAnswer:
    """Derive a pause that the device has to notice, and not before it, with a margin."""
    shortest_s, longest_s = min(values_s), max(values_s)
    off_s = longest_s - shortest_s + unsure_s
    digit = 10 if shortest_s >= 1 else 100
    value = max(floor((shortest_s - _DEVIATION * off_s) * digit + 1e-6), 1) / digit
    return KeyAnswer(
        key,
        value,
        f"a boot version after pauses of {shortest_s:.3f} to {longest_s:.3f} s; the shortest less "
        f"{_DEVIATION} times the deviation, rounded down",
    )


def tolerance_answer(key: str, off_s: float, least_s: float, seen: str) -> KeyAnswer:
    """Derive a tolerance from the largest deviation measured, with a margin."""
    value = _rounded(max(_DEVIATION * off_s, least_s), ceil)
    text = f"{seen}; {_DEVIATION} times the largest deviation, at least {least_s * 1000:g} ms"
    return KeyAnswer(key, value, text)


def _rounded(value: float, way: Callable[[float], int]) -> float:
    """Round `way` to two significant digits."""
    step = 10.0 ** (floor(log10(value)) - 1)
    return round(way(round(value / step, 6)) * step, 9)
