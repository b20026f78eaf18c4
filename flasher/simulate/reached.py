"""Records what a campaign has reached: rows of the tables, faults in each phase, endings.

What no run of a large campaign reaches is not tested by it. So the places that there are (`places`)
are compared with those that were reached; `UNREACHABLE` names the ones that nothing can reach.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from flasher.host import upgrade
from flasher.host.table import TABLE as HOST_TABLE
from flasher.mock import model
from flasher.mock.table import TABLE as DEVICE_TABLE
from flasher.simulate import plan as plans
from flasher.simulate.oracle import DOCUMENTED

PHASES: Final = ("idle", "reset", "update", "packet", "end")
"""Last message that the host has begun when a fault happens."""
_LASTING: Final = (plans.Job, plans.Adapter, plans.Independent, plans.Mock)
UNREACHABLE: Final[Mapping[str, str]] = {}
"""Places that no plan reaches, with the reason."""


class _RecordingRow(dict[Any, Any]):
    """Row of a table that records the events that are looked up in it."""

    def __init__(self, row: Mapping[Any, Any], side: str, state: str, seen: set[str]) -> None:
        super().__init__(row)
        self._names = {event: _cell(side, state, event.value) for event in row}
        self._seen = seen

    def get(self, event: Any, default: Any = None) -> Any:
        self._seen.add(self._names.get(event, ""))
        return super().get(event, default)


def _cell(side: str, state: str, event: str) -> str:
    return f"{side}: {state}, {event}"


@contextmanager
def recorded_cells() -> Iterator[set[str]]:
    """Record the rows of the host's and the device model's tables that are used in the block."""
    seen: set[str] = set()
    for side, module, table in _tables():
        rows = {state: _RecordingRow(row, side, state.value, seen) for state, row in table.items()}
        vars(module)["TABLE"] = rows
    try:
        yield seen
    finally:
        for _, module, table in _tables():
            vars(module)["TABLE"] = table


def _tables() -> Iterator[tuple[str, Any, Mapping[Any, Mapping[Any, Any]]]]:
    yield "host", upgrade, HOST_TABLE
    yield "device", model, DEVICE_TABLE


def places() -> set[str]:
    """Return all that a campaign can reach, as it is named in `Verdict.reached`."""
    found = {
        _cell(side, state.value, event.value)
        for side, _, table in _tables()
        for state, row in table.items()
        for event in row
    }
    for clause in plans.CLAUSES.values():
        if not issubclass(clause, _LASTING):
            found |= {fault_place(clause.NAME, phase) for phase in PHASES}
    return found | {exit_place(code) for code in DOCUMENTED}


def fault_place(fault: str, phase: str) -> str:
    return f"fault: {fault}, {phase}"


def exit_place(code: int) -> str:
    return f"exit code: {int(code)}"
