"""Coverage of a campaign: rows of the tables, faults in each phase, exit codes, readings R1 to R28.

What no run of a large campaign reaches is not tested by it. So the places that there are (`places`)
are compared with those that were reached; `UNREACHABLE` names the ones that nothing can reach. What
random plans seldom reach has a plan of its own in the corpus (`corpus.toml`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any, Final

from flasher.host import upgrade
from flasher.host.table import TABLE as HOST_TABLE
from flasher.mock import model
from flasher.mock.table import TABLE as DEVICE_TABLE
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.simulate import plan as plans
from flasher.simulate.oracle import DOCUMENTED

PHASES: Final = ("idle", "reset", "update", "packet", "end")
"""Last message that the host has begun when a fault happens."""
_LASTING: Final = (plans.Job, plans.Adapter, plans.Independent, plans.Mock, plans.Subject)
_READINGS: Final[Mapping[str, tuple[str, ...]]] = {
    "R2": ("host: awaiting request transfer, boot version",),
    "R4": ("host: transferring, ACK", "host: transferring, NAK"),
    "R6": ("host: ending, NAK", "exit code: 8"),
    "R7": (
        "device: transfer, end of transfer, packets missing",
        "device: transfer, end of transfer, image checksum wrong",
    ),
    "R10": (
        "device: transfer, packet stored last",
        "device: transfer, packet stored before",
        "host: settling, ACK",
        "host: settling, no answer to a copy came any more",
    ),
    "R11": (
        "host: transferring, boot version",
        "host: ending, boot version",
        "host: confirming, boot version",
    ),
    "R12": (
        "host: awaiting boot version, no boot version in time",
        "host: awaiting request transfer, no request transfer in time",
        "host: transferring, packet not answered",
        "host: ending, end of transfer not answered, or its announcements stopped",
        "device: transfer, pause too long",
    ),
    "R15": (
        "host: awaiting request transfer, general feedback",
        "host: transferring, general feedback",
        "host: ending, general feedback",
    ),
    "R16": ("host: transferring, request transfer", "host: settling, request transfer"),
    "R17": ("device: application, upgrade message for the running application",),
    "R18": ("device: announcing, reset that the bootloader ignores",),
    "R19": (
        "device: off, power on",
        "device: announcing, window over, application whole",
        "device: starting, start delay over",
    ),
    "R25": (
        "device: erasing, update command repeated",
        "device: transfer, update command repeated",
    ),
    "R27": (
        "host: watching the announcements, what one device does not send",
        "host: transferring, what one device does not send",
    ),
    "R28": ("host: transferring, boot version",),
}
"""Places that show together how flasher reads the documents; the player observes the others."""
_NOT_ASKED: Final = "an upgrade asks the device neither for this nor shows it"
DEVICE_PLACES: Final = "device: "
"""Places in the device model begin with this."""
READINGS: Final = "reading: "
UNREACHABLE: Final[Mapping[str, str]] = {
    **{
        f"device: {state.value}, {BootloaderEvent.POWER_ON.value}": (
            "a supply that is on is not switched on again"
        )
        for state in BootloaderState
        if state is not BootloaderState.OFF
    },
    "host: yielding to another tool, what one device does not send": (
        "the host does not judge answers that are for another tool"
    ),
    "reading: R5": _NOT_ASKED,
    "reading: R8": "the image of a plan is not read from a file, so it has no addresses",
    "reading: R13": _NOT_ASKED,
    "reading: R20": "the devices of a plan end their texts as the document asks",
    "reading: R21": _NOT_ASKED,
    "reading: R22": _NOT_ASKED,
    "reading: R23": "a battery switches off after 30 minutes without traffic, which no plan has",
    "reading: R24": _NOT_ASKED,
}
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
    found |= {reading_place(f"R{number}") for number in range(1, 29)}
    return found | {exit_place(code) for code in DOCUMENTED}


@cache
def reachable() -> frozenset[str]:
    """Return the places that a campaign has to reach."""
    return frozenset(places() - UNREACHABLE.keys())


def with_readings(reached: Iterable[str]) -> tuple[str, ...]:
    """Sort places, and add the readings that they show together."""
    found = {*reached}
    found |= {reading_place(name) for name, each in _READINGS.items() if found.issuperset(each)}
    return tuple(sorted(found))


def reading_place(name: str) -> str:
    return f"reading: {name}"


def fault_place(fault: str, phase: str) -> str:
    return f"fault: {fault}, {phase}"


def step_place(phase: str, step: str) -> str:
    return f"{phase}: {step}"


def exit_place(code: int) -> str:
    return f"exit code: {int(code)}"
