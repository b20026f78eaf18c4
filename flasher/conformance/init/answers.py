"""Derives values of profile keys from a device's answers and measured times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from math import ceil, floor, log10
from typing import Final, NamedTuple

from flasher.conformance.profile import profile_keys
from flasher.conformance.results import KeyAnswer

MARGIN: Final = 3
"""Factor between the longest measured time and the limit."""
_SHOWN: Final = 6
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
    value = rounded_up(max(MARGIN * longest_s + 2 * unsure_s, least_s))
    times = "once" if len(values_s) == 1 else f"{len(values_s)} times"
    return KeyAnswer(
        key,
        value,
        f"measured {times}, at most {longest_s * 1000:.1f} ms; the limit is {MARGIN} times that, "
        f"and at least {least_s:g} s",
    )


def rounded_up(value: float) -> float:
    """Round up to two significant digits."""
    step = 10.0 ** (floor(log10(value)) - 1)
    return round(ceil(round(value / step, 6)) * step, 9)
