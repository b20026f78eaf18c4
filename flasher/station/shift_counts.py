"""Counts passed and failed units, first-pass yield and failure causes of the hour and shift."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from typing import Final, NamedTuple

from flasher.station.records.model import (
    CLOCK_TOLERANCE,
    RunKind,
    RunRecord,
    RunState,
    Units,
    UnitTally,
    local_moment,
)

DEFAULT_SHIFTS: Final = (time(6), time(14), time(22))
CAUSES_MAX: Final = 3


class Count(NamedTuple):
    """Number of units by their last run in a period: a PASS (good), or none (bad)."""

    good: int
    bad: int


@dataclass(frozen=True)
class ShiftFigures:
    """Figures in the footer of the operator page."""

    hour: Count
    shift: Count
    first_pass_share: float | None
    """First-pass yield of the shift, from 0 to 1; None without units."""
    causes: tuple[tuple[str, int], ...]
    """Number of the shift's runs without a PASS, by code, most frequent first."""


def shift_began(shifts: Iterable[time], now: datetime) -> datetime | None:
    """Start of the current shift. `shifts`: start times in the time zone of this computer, whose
    offset may have changed since the shift began.
    """
    today = now.astimezone().date()
    starts = (
        local_moment(datetime.combine(today - timedelta(days=days), each))
        for each in shifts
        for days in (0, 1)
    )
    return max((start for start in starts if start <= now), default=None)


class ShiftCounts:
    """Counts the runs of the current shift. `shifts`: as for `shift_began`."""

    def __init__(self, shifts: Sequence[time] = DEFAULT_SHIFTS) -> None:
        self._shifts = shifts
        self._runs: list[RunRecord] = []

    def add(self, run: RunRecord) -> None:
        """Count a run, unless it is one of a golden unit."""
        if run.kind is not RunKind.GOLDEN:
            self._runs.append(run)

    def began(self, now: datetime) -> datetime:
        """Start of the current shift; `now` if there are no shifts."""
        return shift_began(self._shifts, now) or now

    def output(self, now: datetime) -> ShiftFigures:
        """Figures at `now`, which has a time zone."""
        began = self.began(now)
        hour = now.replace(minute=0, second=0, microsecond=0)
        # A later run is one of a clock that was ahead.
        end = now + CLOCK_TOLERANCE
        self._runs = runs = [run for run in self._runs if min(began, hour) <= _at(run) <= end]
        shift = [run for run in runs if _at(run) >= began]
        causes = Counter(run.code for run in shift if run.state is not RunState.PASS)
        judged = _units(run for run in shift if run.state in (RunState.PASS, RunState.FAIL))
        return ShiftFigures(
            _count(run for run in runs if _at(run) >= hour),
            _count(shift),
            judged.first_pass_share,
            tuple(causes.most_common(CAUSES_MAX)),
        )


def _count(runs: Iterable[RunRecord]) -> Count:
    units = _units(runs)
    return Count(units.passed, units.units - units.passed)


def _units(runs: Iterable[RunRecord]) -> Units:
    """Units of these runs, which are in order."""
    tally = UnitTally()
    for run in runs:
        tally.add(run.serial, is_passed=run.state is RunState.PASS)
    return tally.units


def _at(run: RunRecord) -> datetime:
    return run.ended_at or run.begun_at
