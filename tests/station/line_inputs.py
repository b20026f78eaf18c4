"""What a station feeds back to its line about a run."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from flasher.station.events import RunEnded, RunStarted
from flasher.station.records.model import RunId, RunKind, RunRecord, RunResult, RunState, Verified

RESULT: Final = RunResult(RunState.PASS, "OK", "", 1.0)
"""The line does not look at it: only what is saved counts."""
_RUN: Final = RunId(1), RunKind.PRODUCTION
_BEGAN: Final = datetime(2026, 5, 17, 9, tzinfo=UTC)
RECORD: Final = RunRecord(
    RunId(1), "W2605001", "BAT-36", None, RunKind.PRODUCTION, False, RunState.PASS, "OK", "",
    _BEGAN, _BEGAN + timedelta(seconds=1), 1.0, "line-2", "A", "Li", "Battery", "4", "0" * 64,
    Verified.VERSION, "0" * 64, "",
)  # fmt: skip
"""A run as a station reads it from its records."""


def begun(socket: str, serial: str) -> RunStarted:
    return RunStarted(socket, serial, *_RUN)


def saved(socket: str, outcome: RunState, action: str = "", **others: Any) -> RunEnded:
    return RunEnded(replace(RECORD, socket=socket, state=outcome, **others), action)
