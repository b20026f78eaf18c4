"""A small world around a `Line`: units that sleep, processes that die, records that fail, and an
operator who knows only what the screen says. A seed reproduces every step.

What must never be: a run that touches a unit other than the label's; PASS shown that is not saved,
or over a unit that did not pass; an operator for whom nothing on the screen works any more.
"""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from flasher.station import line
from flasher.station.events import (
    OperatorPrompted,
    ScanRefused,
    SocketChanged,
    SocketState,
    StationEvent,
)
from flasher.station.line import Line
from flasher.station.messages import AdapterDown, AdapterReady, PresenceChanged
from flasher.station.records.model import Admission, Order, RunState
from flasher.station.scans import Refused
from flasher.station.socket import Binding, Socket
from tests.station.line_inputs import RESULT, begun, saved

SOCKETS: Final = ("A", "B", "C")
_LABEL: Final = re.compile(r"W[0-9]{4}")
_SCAN: Final = re.compile(r"(?:scan|Scan) (SOCKET|FREE) (\w+)")
_MEANT: Final = re.compile(r"^(Put|Connect|Take) |says that it is W[0-9]{4}\. Put")
_PUT: Final = re.compile(r"Put (W[0-9]{4}) into socket (\w+)\.")


def check_serial(text: str) -> None:
    if not _LABEL.fullmatch(text):
        raise ValueError("not of this recipe")


@dataclass
class Unit:
    """`stored`: the serial number that it says; some products have no place for one."""

    label: str
    stored: str = ""
    stores: bool = True
    is_asleep: bool = False
    has_passed: bool = False


@dataclass
class Bay:
    """A socket as it really is, and its process."""

    unit: Unit | None = None
    works: bool = True
    noted: tuple[bool, str | None] | None = None
    """The last report of its process on the unit; None since the process or a run began."""
    run: str = ""
    """The label that its process works on."""
    differs_since: float | None = None
    """Since when the last report of its process is outdated."""


@dataclass
class World:
    """`make` makes the line: a faulty one may be put in."""

    seed: int
    sockets: tuple[str, ...] = SOCKETS
    make: Callable[..., Line] = Line
    asks_plant: bool = False
    """A plant is asked before each run; it answers after up to 15 s."""
    now: float = 0.0
    story: list[str] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)
    """How often labels got their sockets in each way."""

    def __post_init__(self) -> None:
        self.way = ""
        self.chance = random.Random(self.seed)
        self.bays = {name: Bay() for name in self.sockets}
        self.table: list[Unit] = []
        self.made = 0
        self.supply()
        self.runs: dict[str, RunState] = {}
        """The last run of each label that is on disk."""
        self.open: dict[str, tuple[str, RunState]] = {}
        """Ends that are not on disk yet, by socket."""
        self.disk_works = True
        self.shown: dict[str, SocketChanged] = {}
        self.heard: list[StationEvent] = []
        """What the screen showed since the operator last looked."""
        self.in_hand: Unit | None = None
        self.start()

    def supply(self) -> None:
        """New units on the table; some come back from the field, with their serial numbers."""
        while len(self.table) < 5:
            self.made += 1
            unit = Unit(f"W{self.made:04}", stores=self.chance.random() < 0.6)
            if unit.stores and self.chance.random() < 0.3:
                unit.stored = unit.label
            self.table.append(unit)

    # -- the station ------------------------------------------------------------------------------

    def start(self) -> None:
        """A station begins: what ran before is interrupted."""
        interrupted = {name: bay.run for name, bay in self.bays.items() if bay.run}
        interrupted |= {name: label for name, (label, _) in self.open.items()}
        self.open.clear()
        more = {"asks_plant": True} if self.asks_plant else {}
        self.asked: list[tuple[float, Order]] = []
        """What the plant will answer, and when."""
        self.line = self.make(
            [Socket(name) for name in self.sockets], check_serial, operator="jo", **more
        )
        for name, label in interrupted.items():
            self.line.sockets[name].interrupted = label
            self.runs[label] = RunState.INTERRUPTED
        self.shown.clear()
        for bay in self.bays.values():
            bay.works, bay.noted, bay.run = False, None, ""
        self.tick()

    def tick(self, seconds: float = 0.0) -> None:
        """A process sees within 1.5 s what has changed."""
        until = self.now + seconds
        while self.now < until:
            self.now = min(self.now + 0.5, until)
            for name, bay in self.bays.items():
                if not bay.works or bay.run or bay.noted == self.truth(bay):
                    bay.differs_since = None
                elif bay.differs_since is None:
                    bay.differs_since = self.now
                elif self.now - bay.differs_since >= 0.5:
                    self.settle(name)
            self.answer()
        self.line.tick(self.now)
        self.write_planned()

    def answer(self) -> None:
        """The plant answers what is due."""
        due = [each for each in self.asked if each[0] <= self.now]
        for each in due:
            self.asked.remove(each)
            self.note(f"the plant answers for {each[1].serial}")
            self.way = self.way or "card"
            self.line.answered(each[1], Admission(), self.now)
            self.write_planned()

    def note(self, what: object) -> None:
        """For whoever looks for the cause of a failure."""
        self.story.append(f"{self.now:7.1f}  {what}")

    def feed(self, name: str, what: line.SocketInput) -> None:
        self.note(f"{name} {what}")
        self.way = "named" if self.line.sockets[name].binding is Binding.PROMPTED else "card"
        self.line.feed(name, what, self.now)
        self.write_planned()

    def scan(self, text: str) -> None:
        self.note(f"scan {text}")
        is_card = text.startswith("SOCKET") or any(
            each.card for each in self.line._waiting.values()
        )
        holder = next((s for s in self.line.sockets.values() if s.own == text), None)
        self.way = "card" if is_card or holder is None else "reported by the unit"
        self.line.scan(text, self.now)
        self.write_planned()

    def write_planned(self) -> None:
        while effects := self.line.take():
            for effect in effects:
                match effect:
                    case Order(serial, socket):
                        self.claim(socket, serial)
                    case line.AskPlant(order):
                        self.asked.append((self.now + self.chance.uniform(0.0, 15.0), order))
                    case line.SaveAgain(sockets):
                        saved = [self.save(name) for name in sockets]
                        self.line.resumed(self.now, all_saved=all(saved))
                    case (
                        line.AbortRun()
                        | line.CheckPin()
                        | line.DoCommand()
                        | line.Audit()
                        | line.DropAdmission()
                    ):
                        pass
                    case _:
                        self.look(effect)

    def claim(self, socket: str, label: str) -> None:
        if not self.disk_works:
            self.line.feed(socket, line.NotSaved("full", "Make room."), self.now)
        elif self.runs.get(label) is RunState.PASS:
            what = Refused("DUPLICATE", "It has passed before.", "Put it aside.")
            self.line.feed(socket, what, self.now)
        else:
            bay = self.bays[socket]
            assert not bay.run
            bay.run = label
            self.seen["run"] += 1
            self.seen[self.way] += 1
            self.line.feed(socket, begun(socket, label), self.now)
            unit = bay.unit
            if unit is not None and not unit.is_asleep and not self.says_other(unit, label):
                assert unit.label == label, f"{label} runs on the unit of {unit.label}"

    @staticmethod
    def says_other(unit: Unit, label: str) -> bool:
        """The run itself finds out: the unit says that it is another one, and stays as it is."""
        return unit.stored not in ("", label)

    def end_run(self, name: str, outcome: RunState) -> None:
        bay = self.bays[name]
        label, unit = bay.run, bay.unit
        bay.run, bay.noted = "", None
        if unit is None or unit.is_asleep or self.says_other(unit, label):
            outcome = RunState.ERROR
        elif outcome is RunState.PASS:
            assert unit.label == label
            unit.has_passed = True
            unit.stored = label if unit.stores else ""
        self.open[name] = (label, outcome)
        self.feed(name, RESULT)
        self.save(name)
        self.write_planned()

    def save(self, name: str) -> bool:
        if not self.disk_works:
            self.line.feed(name, line.NotSaved("full", "Make room."), self.now)
            return False
        label, outcome = self.open.pop(name)
        self.runs[label] = outcome
        self.line.feed(name, saved(name, outcome, "Scan the unit again."), self.now)
        return True

    # -- the sockets' processes -------------------------------------------------------------------

    def settle(self, name: str) -> None:
        """A process says what it has seen, as `Presence` does."""
        bay = self.bays[name]
        if not bay.works:
            bay.works = True
            self.feed(name, AdapterReady(sees_units=True))
        if bay.run:
            return
        sees = self.truth(bay)
        if bay.noted == sees:
            return
        bay.noted = sees
        self.feed(name, PresenceChanged(is_there=sees[0], how="traffic", serial=sees[1]))

    @staticmethod
    def truth(bay: Bay) -> tuple[bool, str | None]:
        unit = bay.unit
        return (False, None) if unit is None or unit.is_asleep else (True, unit.stored)

    def lose_process(self, name: str) -> None:
        bay = self.bays[name]
        bay.works = False
        if bay.run:
            self.end_run(name, RunState.ERROR)
        bay.noted = None
        self.feed(name, AdapterDown("its process ended"))

    # -- what is looked at ------------------------------------------------------------------------

    def look(self, event: StationEvent) -> None:
        self.heard.append(event)
        self.note(f"    {event}")
        if not isinstance(event, SocketChanged):
            return
        self.shown[event.socket] = event
        if event.state is SocketState.PASS:
            saved = self.runs.get(event.serial)
            # At the very moment of saving the records are a step ahead of the screen.
            assert saved is RunState.PASS, f"PASS of {event.serial} is shown and not saved"

    def check_green(self) -> None:
        """PASS is shown over no other unit that is detected."""
        for name, event in self.shown.items():
            unit, noted = self.bays[name].unit, self.bays[name].noted
            if event.state is SocketState.PASS and unit is not None and noted and noted[0]:
                assert unit.has_passed, f"{name} shows PASS over the unit of {unit.label}"


@dataclass
class Operator:
    """Somebody who takes units from the table, and does what the screen says."""

    world: World
    done: set[str] = field(default_factory=set)

    @property
    def _chance(self) -> random.Random:
        return self.world.chance

    def free_bay(self) -> str:
        """A socket in which the operator sees no unit, after some work where there is none."""
        for make_room in (self.clear, self.finish, self.clear):
            empty = [n for n, bay in self.world.bays.items() if bay.unit is None and not bay.run]
            if empty:
                return self._chance.choice(empty)
            make_room()
        return self.world.sockets[0]

    def put(self, unit: Unit, name: str) -> None:
        """Into the socket; a unit that is in it is taken out first, and stays out for a while."""
        world = self.world
        shown = world.shown.get(name)
        if shown is not None and shown.serial != unit.label and _MEANT.search(shown.text):
            world.scan("CANCEL")  # the screen wants another one
        self.take_out(name)
        world.note(f"{unit} into {name}")
        if unit in world.table:
            world.table.remove(unit)
        for other, bay in world.bays.items():
            if bay.unit is unit:
                self.take_out(other)
                world.table.remove(unit)
        world.bays[name].unit = unit

    def take_out(self, name: str) -> None:
        bay = self.world.bays[name]
        if bay.unit is not None:
            self.world.note(f"{bay.unit} out of {name}")
            self.world.table.append(bay.unit)
            bay.unit = None
            self.world.tick(3.0)
            self.world.settle(name)

    def serve(self, unit: Unit, steps: int = 30, *, may_leave: bool = False) -> bool:
        """Bring one unit to a run, by what the screen says; False when nothing works, or where the
        operator is called away.
        """
        world = self.world
        self.begin_anew()
        is_only = len(world.sockets) == 1  # nothing but the unit in it tells what a label is for
        if is_only:
            self.finish()
        if is_only or self._chance.random() < 0.3:
            name = self.free_bay()
            unit.is_asleep = False  # it is switched on when it is put in
            self.put(unit, name)
            world.settle(name)
        text = unit.label
        if self._chance.random() < 0.2:
            where = next((n for n, bay in world.bays.items() if bay.unit is unit), None)
            name = where or self.free_bay()
            if where is None and self._chance.random() < 0.5:
                self.put(unit, name)
            world.scan(f"SOCKET {name}")
        for _ in range(steps):
            world.heard.clear()
            world.scan(text)
            if self.runs(unit):
                return True
            if may_leave and self._chance.random() < 0.2:
                return False
            text = self.follow(unit) or unit.label
            if self.runs(unit) or world.runs.get(unit.label) is RunState.PASS:
                return True
            world.tick(0.5)
        return False

    def begin_anew(self) -> None:
        """What the screen still wants is not what comes next."""
        world = self.world
        wants = any("in this socket" in shown.text for shown in world.shown.values())
        if any(each.label for each in world.line._waiting.values()) or wants:
            world.scan("CANCEL")

    def runs(self, unit: Unit) -> bool:
        return any(bay.run == unit.label for bay in self.world.bays.values())

    def follow(self, unit: Unit) -> str:
        """Do what was asked last; what to scan next, where it is not the label."""
        reported = [e for e in self.world.heard if isinstance(e, ScanRefused | OperatorPrompted)]
        for event in reversed(reported):
            refused = isinstance(event, ScanRefused)
            text = event.remedy if isinstance(event, ScanRefused) else event.text
            code = event.code if isinstance(event, ScanRefused) else ""
            next_scan = self.obey(unit, code, text) if refused else None
            if next_scan is None:
                next_scan = self.bring(unit, text)
            if next_scan is not None:
                return next_scan
        self.wait()
        return ""

    def obey(self, unit: Unit, code: str, remedy: str) -> str | None:
        """After a refusal: what to scan, empty for the label; None: it says where the unit goes."""
        found = _SCAN.search(remedy)
        match code:
            case "LABEL_WAITS":
                return "CANCEL"
            case "LINE_STOPPED":
                self.world.disk_works = True
                return "RESUME"
            case "TAKE_OUT" if found is not None:
                self.take_out(found[2])
                return f"FREE {found[2]}"
            case "SOCKET_BUSY" | "UNIT_RUNNING":
                self.wait()
                self.finish()
                return ""
            case "WRONG_UNIT" | "DUPLICATE":
                self.clear()
                return ""
            case "STARTING" | "FORGOTTEN" | "UNIT_CHANGED" | "NO_SOCKET":
                self.wait()
                return ""
        return None

    def bring(self, unit: Unit, text: str) -> str | None:
        """Put the unit where the screen wants it; what to scan next."""
        world = self.world
        where = next((n for n, bay in world.bays.items() if bay.unit is unit), None)
        put = _PUT.search(text)
        if put is not None and put[1] == unit.label and not world.bays[put[2]].run:
            world.tick(2.0)  # the way to the socket
            self.put(unit, put[2])
            world.settle(put[2])
            world.tick(4.0)
            return ""
        if "card of the socket" in text or _SCAN.search(text) is not None:
            name = where or self.free_bay()
            if world.bays[name].unit is not unit:
                self.put(unit, name)
            return f"SOCKET {name}"
        if text.startswith(("Take", "Connect")):
            name = where or self.free_bay()
            self.put(unit, name)
            world.settle(name)
            world.tick(4.0)
            return ""
        return None

    def wait(self) -> None:
        self.world.tick(3.0)
        for name in self.world.sockets:
            self.world.settle(name)

    def finish(self) -> None:
        """All runs that go on come to their end."""
        for name, bay in self.world.bays.items():
            if bay.run:
                self.world.end_run(name, self._chance.choice((RunState.PASS, RunState.FAIL)))

    def clear(self) -> None:
        """Take every unit out that does not run."""
        for name, bay in self.world.bays.items():
            if not bay.run:
                self.take_out(name)


@dataclass
class Walk:
    """Random acts of units, processes, records and an operator who is not always careful."""

    world: World

    def __post_init__(self) -> None:
        self.operator = Operator(self.world)
        self.chance = self.world.chance

    def some(self) -> tuple[str, Bay]:
        name = self.chance.choice(self.world.sockets)
        return name, self.world.bays[name]

    def settle(self) -> None:
        self.world.settle(self.some()[0])

    def insert(self) -> None:
        """A unit is put into a socket without any scan, where the screen wants no other one."""
        world, (name, bay) = self.world, self.some()
        shown = world.shown.get(name)
        is_meant = shown is not None and _MEANT.search(shown.text)
        if bay.unit is None and not bay.run and world.table and not is_meant:
            bay.unit = world.table.pop(self.chance.randrange(len(world.table)))
            bay.unit.is_asleep = False
            world.note(f"{bay.unit} into {name} by somebody")

    def remove(self) -> None:
        name, bay = self.some()
        if not bay.run:
            self.operator.take_out(name)

    def sleep(self) -> None:
        _, bay = self.some()
        unit = bay.unit
        # A unit is put in awake: it falls asleep after it was detected.
        if unit is not None and (unit.is_asleep or (bay.noted and bay.noted[0])):
            unit.is_asleep = not unit.is_asleep
            self.world.note(f"{unit}")

    def serve(self) -> None:
        world = self.world
        units = [*world.table, *(b.unit for b in world.bays.values() if b.unit and not b.run)]
        self.operator.serve(self.chance.choice(units), self.chance.randrange(1, 6), may_leave=True)
        if self.chance.random() < 0.5:
            world.scan("CANCEL")

    def stray_scan(self) -> None:
        """Any card, or the label of a unit that is in a socket, without the card of it."""
        labels = [bay.unit.label for bay in self.world.bays.values() if bay.unit]
        text = self.chance.choice(("CANCEL", "RESUME", "HELLO", *labels))
        if text in labels:
            self.operator.begin_anew()
        self.world.scan(text)
        if text in labels:
            self.world.scan("CANCEL")

    def end(self) -> None:
        name, bay = self.some()
        if bay.run:
            ends = (RunState.PASS, RunState.PASS, RunState.FAIL)
            self.world.end_run(name, self.chance.choice(ends))

    def lose_process(self) -> None:
        self.world.lose_process(self.some()[0])

    def break_disk(self) -> None:
        self.world.disk_works = self.chance.random() < 0.7

    def let_time_pass(self) -> None:
        self.world.tick(self.chance.choice((0.2, 1.0, 5.0, 30.0)))

    def go(self, steps: int) -> None:
        """Raises AssertionError for what must never be."""
        weights = {
            self.settle: 6,
            self.serve: 5,
            self.end: 6,
            self.insert: 2,
            self.remove: 3,
            self.sleep: 4,
            self.stray_scan: 2,
            self.lose_process: 1,
            self.break_disk: 1,
            self.let_time_pass: 2,
        }
        world = self.world
        for step in range(steps):
            world.table = [unit for unit in world.table if not unit.has_passed]
            world.supply()
            self.chance.choices(list(weights), list(weights.values()))[0]()
            world.check_green()
            if step % 60 == 59 and self.chance.random() < 0.5:
                world.start()
        self.go_home()

    def go_home(self) -> None:
        """Without faults, every unit that is left comes to its run by what the screen says."""
        world, operator = self.world, self.operator
        world.disk_works = True
        for unit in [*world.table, *(b.unit for b in world.bays.values() if b.unit)]:
            unit.is_asleep = False
        operator.wait()
        operator.finish()
        for unit in world.table[:3]:
            if world.runs.get(unit.label) is not RunState.PASS:
                assert operator.serve(unit), f"nothing works for {unit.label}"
                operator.finish()
                operator.wait()
