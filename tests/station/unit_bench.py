"""A unit in a socket, in no time at all: simulated bus, virtual clock, a journal that can fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from flasher.api import Connection
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import Disturbance, SimulatedBus
from flasher.mock.faults import FaultInjector
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.engine import Tap
from flasher.protocol.spec import BMS, WELLING, Target
from flasher.station.events import StepEnded
from flasher.station.messages import JournalError, JournalWrite, RunEvent
from flasher.station.power import PowerControl
from flasher.station.records.model import (
    Claim,
    Measurement,
    RunId,
    RunKind,
    RunResult,
    Signature,
    StepName,
    StepState,
    WriteId,
)
from flasher.station.unit_run import UnitRun
from flasher.station.worker import IDLE_S
from tests.station.factory import DAY, SERIAL, USUAL, make_recipe

WRITES = """
[[write]]
target = "bms"
item = "serial-number"
values = ["{serial}"]
manufacturer = true

[[write]]
target = "bms"
item = "user-string-1"
values = ["made {date}"]
"""
NEW_UNIT = DeviceProfile(serial_number="NONE", application_area_bytes=8192)


@dataclass(frozen=True)
class Report(StepEnded):
    """A try of a step, as it was recorded."""

    measurements: tuple[Measurement, ...] = ()


@dataclass
class Notes:
    """A journal in a list; `fails_at` is the number of the note that cannot be saved."""

    rows: list[tuple[str, ...]] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    fails_at: int | None = None
    on_note: Callable[[], None] = lambda: None

    def _note(self, *row: str) -> None:
        if self.fails_at is not None and len(self.rows) >= self.fails_at:
            raise JournalError("RECORD NOT SAVED: the disk is full.")
        self.rows.append(row)
        self.on_note()

    def intent(self, target: str, what: str, value: str) -> JournalWrite:
        self._note("intent", target, what)
        return JournalWrite(target, what, value, WriteId(len(self.rows)))

    def verified(self, write: JournalWrite, read_back: str | None) -> None:
        self._note("verified", str(read_back))

    def step(self, ended: StepEnded, measurements: Sequence[Measurement] = ()) -> None:
        self._note("step", ended.name, ended.state.value, ended.code)
        self.reports.append(Report(**vars(ended), measurements=tuple(measurements)))


class UnitBench:
    """One unit and its run."""

    def __init__(
        self,
        folder: Path,
        text: str = USUAL + WRITES,
        profile: DeviceProfile = NEW_UNIT,
        targets: Sequence[Target] = (BMS,),
        disturbance: Disturbance | None = None,
    ) -> None:
        self.recipe = make_recipe(folder, text)
        self.clock = VirtualClock()
        self.bus = SimulatedBus(WELLING.bitrate_bps, self.clock, disturbance)
        self.units: dict[Target, FaultInjector] = {}
        for target in targets:
            self.put(MockDevice(target, bitrate_bps=WELLING.bitrate_bps, profile=profile))
        self.connection = Connection(self.bus.link(), self.clock, "a simulated bus")
        self.journal = Notes()
        self.notes: list[RunEvent] = []
        self.is_cancelled: Callable[[], bool] = lambda: False
        self.power: PowerControl | None = None
        self.taps: Sequence[Tap] = ()

    def put(self, device: MockDevice) -> None:
        """Put a device on the bus, in place of one for the same target."""
        if device.target in self.units:
            self.bus.detach(self.units[device.target])
        self.units[device.target] = FaultInjector(device)
        self.bus.attach(self.units[device.target])

    @property
    def device(self) -> MockDevice:
        """The only unit, or the first."""
        return next(iter(self.units.values())).device

    def run(
        self,
        kind: RunKind = RunKind.PRODUCTION,
        serial: str = SERIAL,
        *,
        known_before: Mapping[str, str] | None = None,
        flashed_before: frozenset[str] = frozenset(),
        written_before: Mapping[str, str] | None = None,
        has_card: bool = True,
        signatures: Mapping[str, Signature] | None = None,
        counters_before: Mapping[str, int] | None = None,
    ) -> RunResult:
        claim = Claim(
            RunId(1),
            kind,
            serial,
            DAY,
            "",
            known_before or {},
            flashed_before,
            written_before or {},
            has_card=has_card,
            signatures=signatures or {},
            counters_before=counters_before or {},
        )
        self.unit_run = UnitRun(
            claim,
            self.recipe,
            self.connection,
            self.journal,
            taps=self.taps,
            send_progress=self.notes.append,
            cancelled=self._is_cancelled,
            power=self.power,
        )
        return self.unit_run.run()

    def save_slowly(self, seconds: float, *, listens: bool) -> None:
        """Let the records take their time for each note; while it `listens`, the run hears what
        comes, as the process of a socket does, else the computer stalls.
        """

        def save() -> None:
            until = self.clock.now() + seconds
            while self.clock.now() < until:
                self.bus.advance(min(until, self.clock.now() + IDLE_S))
                if listens:
                    self.unit_run.listen_meanwhile()

        self.journal.on_note = save

    def _is_cancelled(self) -> bool:
        return self.is_cancelled()

    def step(self, name: StepName, target: str = "") -> Report:
        """The last try of a step."""
        found = [r for r in self.journal.reports if (r.step, r.target) == (name, target)]
        return found[-1]

    @property
    def passed_steps(self) -> list[str]:
        return [r.name for r in self.journal.reports if r.state is StepState.PASS]
