"""What a device answered, and what a profile says by it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Final, NamedTuple

from flasher.conformance.profile import Value, profile_keys

MARGIN: Final = 3
"""A limit is so many times the longest time that was measured, or its least value."""
_SHOWN: Final = 6
_EITHER: Final = "either"


@dataclass(frozen=True)
class KeyAnswer:
    """What is written for a key of the profile; `value` is None where it stays open. `seen` says
    what was seen, or why it stays open.
    """

    key: str
    value: Value | None
    seen: str


class Trial(NamedTuple):
    """One stimulus, its answer, and the value of the key that has it; "" for an answer that no
    value describes.
    """

    value: str
    answer: str
    stimulus: str
    link: str = "to"
    """Stands between answer and stimulus; "" where the answer stands behind."""

    def __str__(self) -> str:
        if not self.link:
            return f"{self.stimulus} {self.answer}"
        return f"{self.answer} {self.link} {self.stimulus}"


Findings = Iterator[KeyAnswer | Trial | str]
"""What a question finds: answers, trials for its choice, or why all of its keys stay open."""


def decide(key: str, trials: Sequence[Trial]) -> KeyAnswer:
    """The value that all trials agree in; where they differ, `either` if the key has it."""
    seen, values = _summary(trials), {trial.value for trial in trials}
    allowed = profile_keys()[key].choices
    if not values <= set(allowed):
        return KeyAnswer(key, None, f"no value describes this: {seen}")
    if len(values) == 1:
        return KeyAnswer(key, values.pop(), seen)
    if _EITHER in allowed:
        return KeyAnswer(key, _EITHER, seen)
    return KeyAnswer(key, None, f"it differs: {seen}")


def _summary(trials: Sequence[Trial]) -> str:
    """Every answer to every stimulus, with how often it came."""
    total = Counter(trial.stimulus for trial in trials)
    counts = Counter((str(trial), trial.stimulus) for trial in trials)
    found = [
        f"{said}, {count} of {total[stimulus]} times" for (said, stimulus), count in counts.items()
    ]
    more = len(found) - _SHOWN
    if more <= 0:
        return "; ".join(found)
    values = Counter(trial.value or "another answer" for trial in trials)
    summed = ", ".join(f"{value} {count} of {len(trials)} times" for value, count in values.items())
    return f"{summed}: {'; '.join(found[:_SHOWN])}; and {more} more"


def limit_answer(key: str, values_s: Sequence[float], least_s: float, unsure_s: float) -> KeyAnswer:
    """A limit from what was measured: with a margin, so never shorter than what it took."""
    if not values_s:
        return KeyAnswer(key, None, "it was never measured")
    longest_s = max(values_s)
    value = rounded_up(max(MARGIN * longest_s + 2 * unsure_s, least_s))
    times = "once" if len(values_s) == 1 else f"{len(values_s)} times"
    return KeyAnswer(
        key,
        value,
        f"measured {times}, at most {longest_s * 1000:.1f} ms; the limit is {MARGIN} times that, "
        f"and {least_s:g} s at the least",
    )


def rounded_up(value: float) -> float:
    """With two digits, never less."""
    step = 10.0 ** (floor(log10(value)) - 1)
    return round(ceil(round(value / step, 6)) * step, 9)
