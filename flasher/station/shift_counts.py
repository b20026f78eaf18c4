"""Counts of this hour and this shift: good and bad units, first-pass yield, causes of failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from typing import Final, NamedTuple

from flasher.station.records.model import RunState

DEFAULT_SHIFTS: Final = (time(6), time(14), time(22))
CAUSES_MAX: Final = 3


class Count(NamedTuple):
    """Units whose last run in a time was a PASS, and those whose last was not."""

    good: int
    bad: int


@dataclass(frozen=True)
class Output:
    """What a footer shows."""

    hour: Count
    shift: Count
    first_pass_share: float | None
    """Of the shift: units passed at their first run, as a share of 1; None without units."""
    causes: tuple[tuple[str, int], ...]
    """Codes of runs of the shift that were no PASS, the most frequent first."""


@dataclass(frozen=True)
class EndedRun:
    """A run that ended; `at` has a time zone."""

    at: datetime
    serial: str
    outcome: RunState
    code: str


def shift_began(shifts: Iterable[time], now: datetime) -> datetime | None:
    """When the shift began that goes on; `shifts`: when each begins, in the time zone of `now`."""
    starts = (
        datetime.combine(now.date() - timedelta(days=days), each, now.tzinfo)
        for each in shifts
        for days in (0, 1)
    )
    return max((start for start in starts if start <= now), default=None)


class ShiftCounts:
    """Runs of the shift that goes on; those of the shift before are forgotten. `shifts`: when each
    begins, in the local time of the moments that are given.
    """

    def __init__(
        self, shifts: Sequence[time] = DEFAULT_SHIFTS, runs: Iterable[EndedRun] = ()
    ) -> None:
        self._shifts = shifts
        self._runs = list(runs)

    def add(self, run: EndedRun) -> None:
        self._runs.append(run)

    def began(self, now: datetime) -> datetime:
        """When the shift began that goes on."""
        return shift_began(self._shifts, now) or now

    def output(self, now: datetime) -> Output:
        """The figures at this moment, which has a time zone."""
        began = self.began(now)
        hour = now.replace(minute=0, second=0, microsecond=0)
        self._runs = runs = [run for run in self._runs if run.at >= min(began, hour)]
        shift = [run for run in runs if run.at >= began]
        causes = Counter(run.code for run in shift if run.outcome is not RunState.PASS)
        first: dict[str, bool] = {}
        for run in shift:
            if run.outcome in (RunState.PASS, RunState.FAIL):
                first.setdefault(run.serial, run.outcome is RunState.PASS)
        return Output(
            _count(run for run in runs if run.at >= hour),
            _count(shift),
            sum(first.values()) / len(first) if first else None,
            tuple(causes.most_common(CAUSES_MAX)),
        )


def _count(runs: Iterable[EndedRun]) -> Count:
    last = {run.serial: run.outcome is RunState.PASS for run in runs}
    good = sum(last.values())
    return Count(good, len(last) - good)
