"""What a run of a unit takes, tells and comes to. All of it can be sent from process to process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Protocol

from flasher.errors import FlasherError
from flasher.station.codes import Code
from flasher.station.records.model import Measurement, RunId, RunKind, RunState, StepState, WriteId
from flasher.station.steps import StepName, Verified

Texts = Mapping[str, str]


@dataclass(frozen=True)
class RunOrder:
    """A run that is claimed. What was `before` comes from the records of this unit's last runs,
    as far as they ended without a verdict.
    """

    run_id: RunId
    kind: RunKind
    serial: str
    day: date
    lot: str = ""
    known_before: Texts = field(default_factory=dict)
    """What must not change, as it was read first, by the name of its measurement."""
    flashed_before: frozenset[str] = frozenset()
    """Targets whose last flash, of this very image, was read back."""
    written_before: Texts = field(default_factory=dict)
    """What the unit's last PASS wrote, by target and item ("bms serial-number")."""


@dataclass(frozen=True)
class StepReport:
    """One try of a step, as it goes into the records."""

    step: StepName
    target: str
    try_number: int
    state: StepState
    duration_s: float
    code: str = ""
    text: str = ""
    measurements: tuple[Measurement, ...] = ()

    @property
    def name(self) -> str:
        """The name in the records: steps of one target name it, tries are counted by name."""
        return f"{self.step.value} {self.target}".strip()


@dataclass(frozen=True)
class RunResult:
    """What a run came to, before it is saved."""

    outcome: RunState
    code: str
    text: str
    duration_s: float
    verified: Mapping[str, Verified] = field(default_factory=dict)


class JournalError(FlasherError):
    """An act could not be noted on disk: it must not be done."""


class Journal(Protocol):
    """Notes that are on disk when a method returns. All raise JournalError when they are not."""

    def intent(self, target: str, what: str, value: str) -> WriteId:
        """Before an act that cannot be taken back."""
        ...

    def verified(self, write_id: WriteId, read_back: str | None) -> None:
        """After it; None where nothing could be read back."""
        ...

    def step(self, report: StepReport) -> None:
        """A try of a step ended."""
        ...


class PowerControl(Protocol):
    """Switches the unit off and on."""

    def begin_cycle(self) -> None:
        """Begin; returns at once. Raises BusError when the one before failed."""
        ...

    def check(self) -> None:
        """Raises BusError when a cycle failed."""
        ...


# -- what a run tells while it goes on ------------------------------------------------------------


@dataclass(frozen=True)
class StepBegan:
    """A try of a step begins."""

    step: StepName
    target: str
    try_number: int


@dataclass(frozen=True)
class Progress:
    """How far it is, as a share of 1, and how long it still takes at this pace."""

    step: StepName
    target: str
    share: float
    left_s: float | None


@dataclass(frozen=True)
class Prompt:
    """Somebody has to do something within the limit."""

    text: str
    limit_s: float | None = None


RunNote = StepBegan | Progress | Prompt
Tell = Callable[[RunNote], None]


class StepFailedError(Exception):
    """A try of a step failed; the run decides whether there is another one."""

    def __init__(self, code: Code, text: str, *, needs_rescue: bool = False) -> None:
        super().__init__(text)
        self.code = code
        self.text = text
        self.needs_rescue = needs_rescue


class CancelledError(Exception):
    """The run is to end here: a person, or the station's end."""


def write_key(target: str, item: str) -> str:
    """The name of something written, as `RunOrder.written_before` has it."""
    return f"{target} {item}"


def flash_value(version: str, sha256: str) -> str:
    """What the records say of a flash: enough to know the same image again."""
    return f"{version or 'no version'}, sha256 {sha256}"
