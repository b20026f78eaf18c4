"""Stations that run one unit in virtual time, in any order of events, with the product's own gate
and claims. The plant's database is a model here; `test_claims` compares it with PostgreSQL.

    world = World(seed=7)
    world.run()          # raises AssertionError if two runs passed without a mark
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any
from uuid import UUID

from flasher.plant import claims
from flasher.plant.claims import LEASE_S, PlantClaims, _Own
from flasher.plant.forwarder import ENTER
from flasher.station.gate import Gate
from flasher.station.records.errors import RecordError
from flasher.station.records.model import Admission, ElsewhereState, Order, RunId
from tests.station.factory import FakeClock

PART, SERIAL = "BAT-36", "W2605002"
BEGIN = datetime(2026, 5, 17, 9, tzinfo=UTC)


@dataclass
class Claimed:
    station: str
    serial: str
    at: datetime
    expires_at: datetime
    takeover: str


@dataclass
class Centre:
    """The rules of `claim_functions`, for one part."""

    clock: FakeClock
    claims: dict[str, Claimed] = field(default_factory=dict)
    passed: list[tuple[str, str, int]] = field(default_factory=list)
    """Station, serial number and run of each PASS that arrived."""
    takeovers: dict[str, str] = field(default_factory=dict)
    """The last takeover of a station."""
    released: set[str] = field(default_factory=set)
    """Claims that the owner of the database released: their runs are marked when they arrive."""

    def claim(
        self, station: str, token: str, serial: str, lease_s: float, takeover: str = ""
    ) -> str | None:
        """State of the unit elsewhere."""
        now = self.clock.now
        if self.takeovers.get(station, takeover) != takeover:
            raise RecordError("The plant refuses this station's audit trail, taken-over.")
        others = [
            each
            for each in self.claims.values()
            if each.serial == serial and not self.is_own(each, station, takeover)
        ]
        if any(each.expires_at > now for each in others):
            return "running"
        expires_at = now + timedelta(seconds=lease_s)
        self.claims[token] = Claimed(station, serial, now, expires_at, takeover)
        if any(s == serial and name != station for name, s, _ in self.passed):
            return "passed"
        return "unknown" if others else None

    def is_own(self, claim: Claimed, station: str, takeover: str) -> bool:
        return (claim.station, claim.takeover) == (station, takeover)

    def renew(self, station: str, tokens: list[str], lease_s: float) -> None:
        for token in tokens:
            if token in self.claims and self.claims[token].station == station:
                self.claims[token].expires_at = self.clock.now + timedelta(seconds=lease_s)

    def release(self, station: str, tokens: list[str]) -> None:
        for token in tokens:
            if token in self.claims and self.claims[token].station == station:
                del self.claims[token]

    def release_expired(self) -> None:
        """What the owner of the database does for stations that do not return."""
        for token, each in list(self.claims.items()):
            if each.expires_at <= self.clock.now:
                del self.claims[token]
                self.released.add(token)

    def end(self, station: str, token: str, serial: str, run: int, *, is_pass: bool) -> None:
        """The end of a run arrives."""
        self.release(station, [token])
        if is_pass:
            self.passed.append((station, serial, run))


@dataclass
class Run:
    number: int
    claim: str
    is_marked: bool
    state: str = "RUNNING"
    is_sent: bool = False


class _Link:
    """A station's connection to the model, in the shape of `Central` and its connection."""

    def __init__(self, centre: Centre, station: str) -> None:
        self.centre, self.station = centre, station
        self.is_up = True
        self.loses_answer = False

    @contextmanager
    def writing(self) -> Iterator[_Link]:
        if not self.is_up:
            raise RecordError("The plant's database cannot be written: it is away.")
        yield self
        if self.loses_answer:
            self.loses_answer = False
            raise RecordError("The plant's database cannot be written: the connection broke.")

    def execute(self, statement: Any, values: Any = None) -> Any:
        centre, station = self.centre, self.station
        if statement is claims._CLAIM:
            names = ("token", "serial", "lease_s", "takeover")
            state = centre.claim(station, *(values[name] for name in names))
            row = {"state": state, "station": "other", "socket": "A", "at": BEGIN, "run": 1}
            return SimpleNamespace(mappings=lambda: SimpleNamespace(one=lambda: row))
        if statement is ENTER:
            head = (UUID(int=0), 0, "", centre.clock.now)
            return SimpleNamespace(one=lambda: head)
        if statement is claims._RENEW:
            centre.renew(station, values["tokens"], values["lease_s"])
        elif statement is claims._RELEASE:
            centre.release(station, values["tokens"])
        elif statement is claims._CLAIMS:
            own = [
                SimpleNamespace(token=token, part=PART, serial=each.serial, takeover=each.takeover)
                for token, each in centre.claims.items()
                if each.station == station
            ]
            return SimpleNamespace(all=lambda: own)
        elif statement is claims._STATES_RELEASED:
            return SimpleNamespace(scalar_one=lambda: True)
        elif statement is claims._RELEASED:
            return SimpleNamespace(all=list)
        elif statement is claims._NOW:
            return SimpleNamespace(scalar_one=lambda: centre.clock.now)
        return None

    def close(self) -> None:
        pass


class _Claims(PlantClaims):
    def __init__(self, station: Station, link: _Link) -> None:
        self._of = station
        super().__init__(link, None, station.name, station.clock, is_kept=False)  # type: ignore[arg-type]

    def _read(self) -> _Own:
        known = frozenset({self._of.takeover, *self._of.brought})
        return _Own("", self._of.takeover, known)

    def _recorded(self, part: str, serial: str) -> dict[str, RunId]:
        return {run.claim: RunId(run.number) for run in self._of.runs}


class Station:
    """A PC that runs as a station whose recipe refuses duplicates, and allows what cannot be
    checked with a mark.
    """

    claims_of: type[_Claims] = _Claims

    def __init__(self, world: World, name: str, *, blocks: bool, takeover: str = "") -> None:
        self.name, self.clock, self.blocks = name, world.clock, blocks
        self.takeover = takeover
        self.link = _Link(world.centre, name)
        self.runs: list[Run] = []
        self.brought: dict[str, list[Run]] = {}
        """Runs of PCs that were taken over and brought in, by their takeover."""
        self.is_gone = False
        self._recipe: Any = SimpleNamespace(
            part=PART, golden=None, plant=SimpleNamespace(time_limit_s=3.0)
        )
        self.start()

    def start(self) -> None:
        """A new process; runs of the last one are interrupted."""
        for run in self.runs:
            if run.state == "RUNNING":
                run.state = "INTERRUPTED"
        self._threads: list[Callable[[], None]] = []
        self.admission: Admission | None = None
        self.claims = self.claims_of(self, self.link)
        self.gate = Gate(
            self._recipe, self.claims, None, self.clock.monotonic_s, start=self._threads.append
        )
        self.is_asking = False

    @property
    def active(self) -> Run | None:
        return next((run for run in self.runs if run.state == "RUNNING"), None)

    # -- events -----------------------------------------------------------------------------------

    def ask(self) -> None:
        # Not the last run alone: `bring_in` names a unit that passed at the other PC and ran here.
        has_passed = any(run.state == "PASS" for run in self.runs)
        if not (has_passed or self.is_asking or self.active or self.admission):
            self.gate.ask(Order(SERIAL, "A", "jo"))
            self.is_asking = True

    def answer(self) -> None:
        """The oldest question reaches the database, perhaps after the station gave up."""
        if self._threads:
            self._threads.pop(0)()

    def take(self) -> None:
        for _, admission in self.gate.take():
            self.admission, self.is_asking = admission, False

    def begin(self) -> None:
        admission, self.admission = self.admission, None
        if admission is None:
            return
        other = admission.elsewhere
        is_refused = other is not None and other.state is not ElsewhereState.UNKNOWN
        if is_refused or (admission.doubt and self.blocks):
            self.gate.dropped(admission)
            return
        self.runs.append(Run(len(self.runs) + 1, admission.claim, bool(admission.doubt)))
        self._begun = admission

    def attempt(self) -> None:
        """All of it at once, as it is when nothing is slow."""
        for each in (self.ask, self.answer, self.take, self.begin):
            each()

    def end(self, *, is_pass: bool) -> None:
        if run := self.active:
            run.state = "PASS" if is_pass else "FAIL"
            self.gate.ended(self._begun)

    def send(self, centre: Centre) -> None:
        """The oldest run that has ended and was not sent."""
        run = next((each for each in self.runs if not each.is_sent), None)
        if centre.takeovers.get(self.name, self.takeover) != self.takeover:
            return
        if self.link.is_up and run is not None and run.state != "RUNNING":
            run.is_sent = True
            is_pass = run.state == "PASS"
            centre.end(self.name, run.claim, SERIAL, run.number, is_pass=is_pass)

    def spare(self, world: World, takeover: str) -> Station:
        """A spare PC that takes the station over, with what the plant has of it."""
        made = type(self)(world, self.name, blocks=self.blocks, takeover=takeover)
        made.runs = [run for run in self.runs if run.is_sent]
        made.brought = {
            of: runs for of, runs in self.brought.items() if all(run.is_sent for run in runs)
        }
        made.start()
        world.centre.takeovers[self.name] = takeover
        return made

    def bring_in(self, other: Station) -> None:
        """Bring in what another PC ran as this station. Both are ended before."""
        other.start()
        other.is_gone = True
        runs = [run for run in other.runs if run not in self.runs]
        self.runs = [*runs, *self.runs]
        self.brought[other.takeover] = runs
        self.start()


class World:
    def __init__(
        self, seed: int, centre: type[Centre] = Centre, station: type[Station] = Station
    ) -> None:
        self.random = random.Random(seed)
        self.releases = seed % 3 == 0
        """True in a plant whose owner releases claims, which hides other mistakes."""
        self.clock = FakeClock(BEGIN)
        self.centre = centre(self.clock)
        count = self.random.choice((1, 2, 2, 3))
        self.stations = [
            station(self, f"line-{number}", blocks=self.random.random() < 0.2)
            for number in range(count)
        ]
        self.log: list[str] = []

    def take_over(self, station: Station) -> None:
        """A spare PC goes on as the station, which may still run, and may be taken over itself."""
        if self.newest(station) is station:
            self.stations.append(station.spare(self, f"takeover {len(self.stations)}"))

    def newest(self, station: Station) -> Station:
        """The PC that took the station over last."""
        return [each for each in self.stations if each.name == station.name][-1]

    def bring_in(self, station: Station) -> None:
        newest = self.newest(station)
        if newest is not station:
            newest.bring_in(station)

    def step(self) -> None:
        station = self.random.choice([each for each in self.stations if not each.is_gone])
        events: list[tuple[int, str, Callable[[], None]]] = [
            (6, "attempt", station.attempt),
            (3, "ask", station.ask),
            (4, "answer", station.answer),
            (4, "take", station.take),
            (4, "begin", station.begin),
            (4, "pass", lambda: station.end(is_pass=True)),
            (2, "fail", lambda: station.end(is_pass=False)),
            (5, "send", lambda: station.send(self.centre)),
            (4, "tend", station.claims.tend),
            (1, "die", station.start),
            (2, "take over", lambda: self.take_over(station)),
            (2, "bring in", lambda: self.bring_in(station)),
            (1, "server away", lambda: setattr(station.link, "is_up", False)),
            (2, "server back", lambda: setattr(station.link, "is_up", True)),
            (1, "answer lost", lambda: setattr(station.link, "loses_answer", True)),
            (2, "a second", lambda: self.clock.go_on(1.0)),
            (2, "time limit", lambda: self.clock.go_on(4.0)),
            (2, "lease", lambda: self.clock.go_on(LEASE_S + 1)),
        ]
        if self.releases:
            events.append((1, "release", self.centre.release_expired))
        _, name, act = self.random.choices(events, [weight for weight, _, _ in events])[0]
        self.log.append(f"{station.name} {station.takeover}: {name}")
        act()
        self.check()

    def check(self) -> None:
        passed = {
            run.claim: f"{station.name} run {run.number}"
            for station in self.stations
            for run in station.runs
            if run.state == "PASS" and not run.is_marked and run.claim not in self.centre.released
        }
        assert len(passed) <= 1, (passed, self.log)

    def run(self, steps: int = 60) -> None:
        for _ in range(steps):
            self.step()

    def settle(self) -> None:
        """Everything works again, every PC that was taken over is brought in, every station is
        started, and everything is sent.
        """
        for station in self.stations:
            if not station.is_gone:
                self.bring_in(station)
        for station in [each for each in self.stations if not each.is_gone]:
            station.link.is_up, station.link.loses_answer = True, False
            while station._threads:
                station.answer()
            station.take()
            station.begin()
            station.end(is_pass=False)
            station.start()
            station.claims.tend()
            for _ in station.runs:
                station.send(self.centre)
        self.check()
