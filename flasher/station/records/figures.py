"""The figures of many runs: yield, failures by cause, times."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, Final

from flasher.station.records.model import Figures, RunState

_JUDGED: Final = (RunState.PASS.value, RunState.FAIL.value)
"""Runs that say something about the unit; the others are about the station."""


def figures_of(rows: Iterable[Any]) -> Figures:
    """The figures of runs in the order in which they began."""
    first: dict[int, str] = {}
    last: dict[int, str] = {}
    by_state: dict[str, int] = defaultdict(int)
    failures: dict[str, int] = defaultdict(int)
    durations_s: list[float] = []
    virtual_runs = 0
    for unit_id, state, code, duration_s, is_virtual in rows:
        virtual_runs += bool(is_virtual)
        by_state[state] += 1
        if state in _JUDGED:
            first.setdefault(unit_id, state)
            last[unit_id] = state
        if state == RunState.PASS.value:
            durations_s.append(duration_s)
        elif state != RunState.RUNNING.value:
            failures[code] += 1
    passed = RunState.PASS.value
    return Figures(
        runs=sum(by_state.values()),
        units=len(last),
        passed=sum(state == passed for state in last.values()),
        first_passed=sum(state == passed for state in first.values()),
        by_state=dict(by_state),
        virtual_runs=virtual_runs,
        failures=dict(sorted(failures.items(), key=lambda item: (-item[1], item[0]))),
        duration_median_s=statistics.median(durations_s) if durations_s else None,
        duration_longest_s=max(durations_s, default=None),
    )
