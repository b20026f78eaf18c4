"""Counts good and bad units, first-pass yield and causes of failures of this hour and shift."""

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
    """Number of units whose last run in a period was a PASS (good), or was not (bad)."""

    good: int
    bad: int


@dataclass(frozen=True)
class ShiftFigures:
    """The figures in the footer of the operator page."""

    hour: Count
    shift: Count
    first_pass_share: float | None
    """Share of the shift's units that passed in their first run, 0 to 1; None without units."""
    causes: tuple[tuple[str, int], ...]
    """Codes of the shift's runs without a PASS with their counts, the most frequent first."""


@dataclass(frozen=True)
class EndedRun:
    """A run that ended; `at` has a time zone."""

    at: datetime
    serial: str
    outcome: RunState
    code: str


def shift_began(shifts: Iterable[time], now: datetime) -> datetime | None:
    """Start of the current shift. `shifts`: start times in the time zone of `now`."""
    starts = (
        datetime.combine(now.date() - timedelta(days=days), each, now.tzinfo)
        for each in shifts
        for days in (0, 1)
    )
    return max((start for start in starts if start <= now), default=None)


class ShiftCounts:
    """Counts the runs of the current shift, and forgets those of earlier ones. `shifts`: start
    times in the time zone of the moments that its methods get.
    """

    def __init__(
        self, shifts: Sequence[time] = DEFAULT_SHIFTS, runs: Iterable[EndedRun] = ()
    ) -> None:
        self._shifts = shifts
        self._runs = list(runs)

    def add(self, run: EndedRun) -> None:
        self._runs.append(run)

    def began(self, now: datetime) -> datetime:
        """Start of the current shift; `now` without shifts."""
        return shift_began(self._shifts, now) or now

    def output(self, now: datetime) -> ShiftFigures:
        """The figures at `now`, which has a time zone."""
        began = self.began(now)
        hour = now.replace(minute=0, second=0, microsecond=0)
        self._runs = runs = [run for run in self._runs if run.at >= min(began, hour)]
        shift = [run for run in runs if run.at >= began]
        causes = Counter(run.code for run in shift if run.outcome is not RunState.PASS)
        first: dict[str, bool] = {}
        for run in shift:
            if run.outcome in (RunState.PASS, RunState.FAIL):
                first.setdefault(run.serial, run.outcome is RunState.PASS)
        return ShiftFigures(
            _count(run for run in runs if run.at >= hour),
            _count(shift),
            sum(first.values()) / len(first) if first else None,
            tuple(causes.most_common(CAUSES_MAX)),
        )


def _count(runs: Iterable[EndedRun]) -> Count:
    last = {run.serial: run.outcome is RunState.PASS for run in runs}
    good = sum(last.values())
    return Count(good, len(last) - good)
