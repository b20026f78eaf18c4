"""The world of a story: sockets with their processes, the station, units, people, and an oracle
that looks into each unit.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from math import inf
from typing import Any, Final, NoReturn

from sqlalchemy import event

from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import BMS, OBC, WELLING, WMC, Command
from flasher.station.config import SocketConfig
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OperatorPrompted,
    Progressed,
    RunEnded,
    RunStarted,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    SocketState,
    StationEvent,
    StepStarted,
    WorkerFailed,
)
from flasher.station.messages import FromWorker, WorkerSetup
from flasher.station.presence import SILENCE_S
from flasher.station.records.errors import RecordError
from flasher.station.records.model import RunFilter, RunResult, RunState, StepName
from flasher.station.socket import Source
from flasher.station.station import Station
from tests.campaigns.line_world import stories
from tests.campaigns.line_world.again import empty_folder, same_engine
from tests.campaigns.line_world.clockwork import PaperUnit, Process, SocketBus
from tests.campaigns.line_world.promises import Promises, Violation
from tests.campaigns.line_world.undetectable import Exchanges, Pulled
from tests.station.factory import (
    BMS_VERSION,
    HEAD,
    IMAGES,
    SERIAL_NUMBER,
    USUAL,
    Bench,
    FakeClock,
    target_table,
)
from tests.station.unit_bench import WRITES

WINDOW_S: Final = 0.1
"""The station looks at its processes at least so often, at multiples of this time: so a story is
played as it was drawn.
"""
HAND_S: Final = 0.25
"""The fastest hand takes so long from pulling a unit to putting another one in, as the station
assumes.
"""
CALM_S: Final = 3.0
"""After this time a unit that was put in runs its application, or announces itself for good."""
GREEN_S: Final = 5.0
"""A tile that is green for a unit which is not in its socket has to change within this time."""
NONE: Final = "NONE"
"""What a new unit has for a serial number, where the recipe writes one."""
_RECIPES: Final = {
    "writes": USUAL + WRITES,
    "plain": USUAL,
    "held": HEAD + 'after_restart = "continue"\n' + SERIAL_NUMBER + target_table(BMS) + WRITES,
    "bicycle": USUAL + target_table(WMC) + WRITES,
    "wmc": HEAD + SERIAL_NUMBER + target_table(WMC),
    "obc": HEAD + SERIAL_NUMBER + target_table(OBC),
}
_TARGETS: Final = {"bicycle": (BMS, WMC), "wmc": (WMC,), "obc": (OBC,)}
"""What a unit consists of; the battery alone for the other recipes."""
_FLASHES: Final = (Command.UPDATE, Command.PACKET, Command.END_OF_TRANSFER)
_ANNOUNCES_S: Final = 0.3
"""So long after its power came a unit announces itself for the first time, or sooner."""
OLD_VERSION: Final = DeviceProfile().factory_version
_SLOW: Final = {"erase_time_s": 0.5, "program_time_s": 0.25}
_AGAIN_S: Final = 1.0
"""After this time a station that could not start is started again."""
_READY_S: Final = 3.0
"""On the way home; twice this time is more than `GREEN_S`."""
_RUN_LIMIT_S: Final = 150.0
_TRIES: Final = 4
NOTICE_S: Final = 1.0
"""Before this time no person has read the answer to a card that was scanned before."""
STUCK: Final = "STUCK"
"""The kind of a violation: no screen says what to scan."""
CAREFUL: Final = "careful"
"""Who brings each unit home; not a person of a story."""
_SCAN_LABEL: Final = "Scan the label of the unit that is in this socket"
"""A tile says so while its card waits for a label."""
_FINAL: Final = ("DUPLICATE", "JUST_PASSED", "WRONG_UNIT")
"""Refusals after which a unit is not for this line: it has passed, or says that it is another."""


def label_of(number: int) -> str:
    return f"W2605{number:03}"


@dataclass
class Bay:
    """A socket as it is, and what is known of its run."""

    name: str
    bus: SocketBus
    process: Process | None = None
    unit: PaperUnit | None = None
    changed_at: float = 0.0
    """Since when the same unit is in it, and the station runs."""
    blind_until: float = float("-inf")
    """Its process stalls, or has no adapter."""
    unobserved_until: float = float("-inf")
    """The same, when that takes so long that a unit can be exchanged."""
    emptied_at: float = float("-inf")
    disturbed_at: float = 0.0
    """When a hand, a failure or sleep last touched its unit or its process."""
    spoke_at: float = float("-inf")
    """When the unit in it sent something last."""
    has_spoken: bool = False
    """The unit sent something since then."""
    run: str = ""
    """The label of the run that the station works on."""
    run_at: float = 0.0
    began_in_transfer: bool = False
    """When the run began, its unit waited in a transfer that another run had left."""
    step: StepName | None = None
    """The step that its process began last."""
    is_complete: bool = False
    """Its last packet was acknowledged."""
    is_working: bool = False
    """The process works on a run."""
    put_at: float = 0.0
    """When a unit was put in last."""
    card_at: float = inf
    """When its card, which waits for a label, was accepted first."""
    label_at: float = float("-inf")
    """When a label for it was accepted last."""
    commanded_at: dict[int, float] = field(default_factory=dict)
    """When the run sent each command first."""
    unseen: str = ""
    """The label that passed with another unit, undetectably."""
    heard: dict[str, None] = field(default_factory=dict)
    """Labels of the units that sent something in the run."""
    shown: SocketChanged | None = None

    @property
    def awaits_label(self) -> bool:
        """Its card was scanned, and its tile asks for the label."""
        return self.shown is not None and self.shown.text.startswith(_SCAN_LABEL)

    def blind(self, until: float, seconds: float) -> None:
        """It is unobserved until then, for so long."""
        self.blind_until = max(self.blind_until, until)
        if seconds > HAND_S:
            self.unobserved_until = max(self.unobserved_until, until)


@dataclass
class PersonAtWork:
    """What somebody believes."""

    name: str
    source: str
    card: tuple[str, int, bool] | None = None
    """The socket whose card was accepted, for which unit, and whether it was in it."""
    label: int | None = None
    """The unit whose label was accepted, and waits for a card."""
    notices_at: float = inf
    """When somebody sees that the card does not wait any more."""


@dataclass(frozen=True)
class _Stored:
    """What a unit holds that lasts."""

    number: str
    operations: int


class World:
    """One line. `do` carries out an act at its time; everything raises Violation."""

    def __init__(self, setup: stories.Story, log: Callable[[str], None] | None = None) -> None:
        self.now = 0.0
        self._write = log
        self.seen: Counter[str] = Counter()
        self.exchanges = Exchanges()
        self.setup = setup
        self._closing = ExitStack()
        folder = self._closing.enter_context(empty_folder())
        with same_engine():
            self.bench = Bench(folder)
        if setup.line.recipe != "plain":
            self.bench.use(_RECIPES[setup.line.recipe])
        self.bays = {name: Bay(name, SocketBus()) for name in stories.SOCKETS[: setup.line.sockets]}
        for bay in self.bays.values():
            bay.bus.on_command = partial(self._note_command, bay)
        none = NONE if setup.line.writes else ""
        self.units = {each.label: _make(each, none, setup.line) for each in setup.units}
        self._allowed = {
            number: {unit.label, _stored(unit).number} for number, unit in self.units.items()
        }
        self._stored = {number: _stored(unit) for number, unit in self.units.items()}
        self.passed: set[str] = set()
        """Labels whose PASS was shown."""
        people = (*setup.people, stories.Person(name=CAREFUL, source=CAREFUL))
        self.people = {each.name: PersonAtWork(each.name, each.source) for each in people}
        self.promises = Promises(self._reported_number)
        self.station: Station | None = None
        self._station_at: float | None = None
        """When a station that died is started again."""
        self._answers: list[StationEvent] = []
        self._power_at: dict[str, float] = {}
        self._room_at: float | None = None
        """When there is room on the disk again; None while there is."""
        self.is_stopped = False
        """The line begins no run until RESUME is scanned."""
        self._pulled_at: dict[int, float] = {}
        self._last_end = ""
        self._scanning: tuple[str, str] | None = None
        self._begin_station()

    def close(self) -> None:
        for bay in self.bays.values():
            if bay.process is not None:
                bay.process.kill()
        self.station = None
        if self._room_at is not None:
            self._room_at = None
            self._change_disk()
        self.bench.store.close()
        self._closing.close()

    def __enter__(self) -> World:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _log(self, indent: str, line: Callable[[], str]) -> None:
        """Show a line, which is made only where somebody reads it."""
        if self._write is not None:
            self._write(f"{self.now:9.4f}{indent}{line()}".rstrip())

    # -- time -------------------------------------------------------------------------------------

    def go_to(self, moment: float) -> None:
        """Let time pass up to this moment."""
        while self.now < moment:
            due = [
                each
                for each in (self._station_at, self._room_at, *self._power_at.values())
                if each is not None
            ]
            horizon = min(moment, _next_look(self.now), *due)
            for bay in self.bays.values():
                if bay.process is None:
                    bay.bus.idle(horizon)
                    continue
                bay.process.go_on(horizon)
                if bay.process.has_asked:
                    horizon = max(self.now, min(horizon, bay.bus.clock.now()))
            self.now = horizon
            self._set_clock()
            self._come_back()
            self.turn()

    def _set_clock(self) -> None:
        """Not by adding, of which the sum depends on the steps."""
        clock, began = self.bench.clock, FakeClock()
        clock.seconds = began.seconds + self.now
        clock.now = began.now + timedelta(seconds=self.now)

    def _come_back(self) -> None:
        for name, moment in list(self._power_at.items()):
            if moment <= self.now and self._are_level():
                del self._power_at[name]
                self._switch_on(self.bays[name])
        if self._room_at is not None and self._room_at <= self.now:
            self._room_at = None
            self._change_disk()
        if self._station_at is not None and self._station_at <= self.now and self._are_level():
            self._station_at = None
            self._begin_station()

    def _are_level(self) -> bool:
        """True when no bus is earlier than the others."""
        return all(bay.bus.clock.now() >= self.now for bay in self.bays.values())

    def turn(self) -> None:
        """A turn of the station, and a look at all units."""
        if self.station is not None:
            try:
                self.station.turn(0.0)
            except Exception as error:
                raise Violation("CRASH", f"the station ended with {error!r}") from error
            self.promises.look(self.now, lambda name: self.bays[name].shown)
        self._look()

    # -- the station ------------------------------------------------------------------------------

    def _begin_station(self) -> None:
        for bay in self.bays.values():
            if bay.process is not None:
                bay.process.kill()
            bay.process, bay.run, bay.is_working, bay.shown = None, "", False, None
            bay.changed_at = self.now
        setups = [
            WorkerSetup(
                name,
                self.bench.recipe.path,
                {},
                SocketConfig(name=name, interface="virtual", channel=name),
            )
            for name in self.bays
        ]
        self.station = Station(
            self.bench.store,
            self.bench.recipe,
            setups,
            operator="jo",
            on_event=self._take,
            clock=self.bench.clock,
            launch=self._launch,
        )
        self.station.timer = lambda: 0.0  # a slow computer of the world is no stall in it
        try:
            self.station.start()
        except RecordError:
            # Nothing can be saved: the station reports it, and is started again.
            self.station, self._station_at = None, self.now + _AGAIN_S
        else:
            self.promises.restarted(self.now)

    def _launch(self, setup: WorkerSetup) -> Process:
        bay = self.bays[setup.socket]
        bay.is_working = False
        bay.changed_at = bay.disturbed_at = self.now
        bay.process = Process(
            setup, self.bench.recipe, bay.bus, lambda message: self._sent(bay, message)
        )
        return bay.process

    def _sent(self, bay: Bay, message: FromWorker) -> None:
        """What the process of a socket tells, at its own time."""
        match message:
            case StepStarted(step=StepName.CONNECT, try_number=1):
                bay.is_working, bay.heard, bay.step = True, {}, message.step
                bay.commanded_at = {}
            case StepStarted():
                bay.step, bay.is_complete = message.step, False
            case Progressed(step=StepName.FLASH, share=1.0):
                bay.is_complete = True
            case RunResult():
                bay.is_working = False

    def _take(self, event: StationEvent) -> None:
        """An event of the station. `Station.tell` swallows what is raised here."""
        try:
            self._judge(event)
        except Violation as violation:
            self._found = self._found or violation

    _found: Violation | None = None

    def _judge(self, event: StationEvent) -> None:
        self._log("      ", partial(_shown, event))
        self.promises.hear(event, lambda socket: self.bays[socket].unit)
        match event:
            case ScanAccepted() | ScanRefused() | OperatorPrompted():
                self._read(event)
            case SocketChanged():
                self.bays[event.socket].shown = event
                if event.state is SocketState.PASS and event.serial not in self.passed:
                    raise Violation("GREEN", f"PASS of {event.serial} is shown, and not saved")
            case LineStopped() | LineResumed():
                self.is_stopped = isinstance(event, LineStopped)
            case RunStarted():
                bay = self.bays[event.socket]
                bay.run, bay.run_at = event.serial, self.now
                bay.began_in_transfer = bay.unit is not None and bay.unit.is_in_transfer
                self.seen["runs"] += 1
                for person in self.people.values():
                    if person.label is not None and label_of(person.label) == event.serial:
                        person.label = None
            case RunEnded():
                self._end(self.bays[event.socket], event)
            case WorkerFailed() if "sent nothing" in event.reason:
                raise Violation("CRASH", f"the process of {event.socket} hangs: {event.reason}")

    def _read(self, event: ScanAccepted | ScanRefused | OperatorPrompted) -> None:
        """The answer to a scan."""
        self._answers.append(event)
        if isinstance(event, ScanRefused) and (event.text, event.source) != self._scanning:
            self._forget(event.text, event.source)
        if isinstance(event, ScanAccepted) and event.socket:
            bay = self.bays[event.socket]
            if event.meaning == "label":
                bay.label_at = self.now
                for person in self.people.values():
                    if person.source == event.source:
                        person.card = None  # the screen says that it was used
            elif not bay.awaits_label:
                bay.card_at = self.now  # the same card, scanned again, does not begin another wait

    def _forget(self, text: str, source: str) -> None:
        """It is reported at a source that a scan does not wait any more."""
        for person in self.people.values():
            if person.source != source:
                continue
            if person.card is not None and text == f"SOCKET {person.card[0]}":
                person.notices_at = self.now + NOTICE_S
            if person.label is not None and text == label_of(person.label):
                person.label = None

    # -- acts -------------------------------------------------------------------------------------

    def do(self, act: stories.Act) -> bool:
        """Carry out an act at its time; False where no honest person would, or nothing is there."""
        self.go_to(stories.time_of(act))
        for person in self.people.values():
            if self.now >= person.notices_at:
                person.card, person.notices_at = None, inf
        is_done = self._ACTS[type(act)](self, act)
        if is_done:
            self.seen["acts"] += 1
            self._log("  ", lambda: " ".join(str(act).split()[1:]))
        self.turn()
        return is_done

    def _put(self, act: stories.Put) -> bool:
        bay, unit = self.bays.get(act.socket), self.units.get(act.unit)
        if bay is None or unit is None or bay.unit is not None or self.where(act.unit) is not None:
            return False
        moved_s = self.now - max(bay.emptied_at, self._pulled_at.get(act.unit, -HAND_S))
        if self.awaits_another(bay, act.unit) or round(moved_s, 6) < HAND_S or self._holds(bay):
            return False
        engine = unit.engine
        is_new = engine.profile.factory_version == BMS_VERSION
        is_new = is_new or engine.stored_image == IMAGES[BMS].data
        if self.setup.line.tells:
            known = self.promises.numbers_known(bay.name, bay.step if bay.is_working else None)
            number = _stored(unit).number
            is_other = number.startswith("W") and number != bay.run
            is_alike = number in known if known else not is_other
            self.exchanges.put(
                bay.name,
                unit.label,
                self.now,
                is_new=is_new,
                is_alike=is_alike,
                unobserved_until_s=bay.unobserved_until,
            )
        bay.unit, bay.changed_at, bay.has_spoken = unit, self.now, False
        bay.spoke_at = float("-inf")
        bay.put_at = self.now
        bay.disturbed_at = (
            self.now if bay.process is None else max(self.now, bay.process.stalled_until)
        )
        self.promises.put(bay.name, unit)

        def sent(now: float) -> None:
            bay.has_spoken, bay.spoke_at = True, now
            if bay.is_working:
                bay.heard[unit.label] = None

        unit.on_sent = sent
        bay.bus.put(unit)
        if act.socket not in self._power_at:
            unit.power_on(self.now)
        return True

    def _holds(self, bay: Bay) -> bool:
        """The fixture is closed, with the unit in it."""
        return self.setup.line.recipe == "held" and (bool(bay.run) or bay.is_working)

    @staticmethod
    def awaits_another(bay: Bay, unit: int) -> bool:
        """The tile says that another unit has to come here."""
        shown = bay.shown
        return (
            shown is not None
            and shown.state is SocketState.SCAN
            and shown.serial not in ("", label_of(unit))
        )

    def _pull(self, act: stories.Pull) -> bool:
        bay = self.where(act.unit)
        if bay is None or bay.unit is None:
            return False
        if self._holds(bay):
            return False
        if self.setup.line.tells:
            self.promises.pulled(bay.name, bay.unit, was_calm=_is_calm(bay))
        else:
            self.promises.touched(bay.name)
        unit, bay.unit, bay.changed_at = bay.unit, None, self.now
        bay.emptied_at = bay.disturbed_at = self._pulled_at[act.unit] = self.now
        awaited_at = bay.run_at if bay.run else self.now
        pulled = Pulled(
            unit.label,
            self.now,
            unit.last_word,
            bay.step if bay.is_working else None,
            was_silent=bay.spoke_at < awaited_at - SILENCE_S,
            sent_at_s=unit.sent_at,
        )
        was_noticed = bay.has_spoken or not bay.is_working or bay.put_at < bay.run_at
        if was_noticed:  # else the run received the unit before it
            self.exchanges.pull(bay.name, pulled)
        bay.bus.pull(unit)
        unit.on_sent = lambda _now: None
        unit.sleeps_until = float("-inf")
        unit.power_cut(self.now)
        return True

    def _setup_of(self, unit: int) -> stories.UnitSetup:
        return next(each for each in self.setup.units if each.label == unit)

    def _reported_number(self, unit: PaperUnit) -> str | None:
        """What a unit answers that it is; None when it answers nothing."""
        number = next(number for number, each in self.units.items() if each is unit)
        return _stored(unit).number if self._setup_of(number).answers else None

    def where(self, unit: int) -> Bay | None:
        """The socket that a unit is in."""
        found = self.units.get(unit)
        return next((bay for bay in self.bays.values() if found and bay.unit is found), None)

    def _card(self, act: stories.Card) -> bool:
        person, unit = self.people.get(act.by), self.units.get(act.unit)
        bay = self.where(act.unit)
        is_in = bay is not None
        if bay is None:
            bay = self.bays.get(act.socket)
        if self.station is None or person is None or unit is None or bay is None:
            return False
        if person.source == "mounted" or (not is_in and bay.unit is not None):
            return False
        if person.label not in (None, act.unit):
            return False
        sharing = self._sharing(person)
        if any(each.label is not None or each.notices_at < inf for each in sharing):
            return False  # the screen says whose card is awaited, or whose was dropped just now
        if self._scan(f"SOCKET {bay.name}", person):
            person.card = (bay.name, act.unit, is_in) if bay.awaits_label else None
            person.notices_at = inf
            person.label = None
        return True

    def _sharing(self, person: PersonAtWork) -> list[PersonAtWork]:
        """Others at the same source."""
        return [
            each
            for each in self.people.values()
            if each is not person and each.source == person.source
        ]

    def _label(self, act: stories.Label) -> bool:
        person, unit = self.people.get(act.by), self.units.get(act.unit)
        if self.station is None or person is None or unit is None:
            return False
        bay = self.where(act.unit)
        if person.source == "mounted":
            if bay is not None:
                self._scan(unit.label, person, bay.name)
            return bay is not None
        if person.card is not None:
            return self._label_after_card(person, act.unit, person.card)
        if any(each.card is not None or each.label is not None for each in self._sharing(person)):
            return False  # the screen says that something else is awaited
        if len(self.bays) == 1 and self.bays["A"].unit not in (None, unit):
            return False
        before = len(self._answers)
        if self._scan(unit.label, person):
            self._await_card(person, act.unit, before)
        return True

    def _label_after_card(
        self, person: PersonAtWork, number: int, card: tuple[str, int, bool]
    ) -> bool:
        """Who has scanned the card of a unit scans its label, and does not look again whether it is
        still there.
        """
        socket, meant, was_in = card
        unit, bay = self.units[number], self.where(number)
        is_elsewhere = bay is not None and bay.name != socket
        is_taken = self.bays[socket].unit not in (None, unit)
        if meant != number or (not was_in and (is_elsewhere or is_taken)):
            return False
        person.card = None
        before = len(self._answers)
        if not self._scan(unit.label, person):
            if self._says_card_waits(before):
                person.card = card
                return True
            for each in self._sharing(person):  # the screen shows that no card waits any more
                if each.card is not None and each.card[0] == socket:
                    each.notices_at = min(each.notices_at, self.now + NOTICE_S)
        else:
            self._await_card(person, number, before)
        return True

    def _await_card(self, person: PersonAtWork, number: int, before: int) -> None:
        """The label that a person has scanned may wait for a card, and the screen says so."""
        accepted = [each for each in self._answers[before:] if isinstance(each, ScanAccepted)]
        if accepted and not accepted[-1].socket:
            person.label = number

    def _says_card_waits(self, before: int) -> bool:
        refused = [each for each in self._answers[before:] if isinstance(each, ScanRefused)]
        return any(each.code in ("CARD_WAITS", "LABEL_WAITS") for each in refused)

    def _cancel(self, act: stories.Cancel) -> bool:
        person = self.people.get(act.by)
        if self.station is None or person is None:
            return False
        person.card = person.label = None
        self._scan("CANCEL", person)
        return True

    def _free(self, act: stories.Free) -> bool:
        person, bay = self.people.get(act.by), self.bays.get(act.socket)
        if self.station is None or person is None or bay is None or bay.unit is not None:
            return False
        self._scan(f"FREE {bay.name}", person)
        return True

    def _abort(self, act: stories.Abort) -> bool:
        person, bay = self.people.get(act.by), self.bays.get(act.socket)
        if self.station is None or person is None or bay is None:
            return False
        self._scan(f"ABORT {bay.name}", person)
        return True

    def _scan(self, text: str, person: PersonAtWork, mounted: str = "") -> bool:
        """Scan, and read the answer: True when it was accepted."""
        if self.station is None:
            return False
        self.seen["scans"] += 1
        self._log("    ", lambda: f"scan {text} by {person.name}")
        before = len(self._answers)
        name = f"scanner {mounted}" if mounted else person.source
        self._scanning = text, name
        self.station.submit(text, Source(name, mounted))
        self.turn()
        self._scanning = None
        reported = self._answers[before:]
        if text == "CANCEL":
            for each in self._sharing(person):
                each.card = each.label = None
        return any(isinstance(each, ScanAccepted) and each.text == text for each in reported)

    def _sleep(self, act: stories.Sleep) -> bool:
        unit, bay = self.units.get(act.unit), self.where(act.unit)
        if unit is None or bay is None:
            return False
        unit.sleeps_until = self.now + act.seconds
        self.promises.touched(bay.name)
        bay.disturbed_at = unit.sleeps_until
        return True

    def _dip(self, act: stories.Dip) -> bool:
        bay = self.bays.get(act.socket)
        if bay is None or act.socket in self._power_at:
            return False
        if bay.unit is not None:
            bay.bus.pull(bay.unit)
            bay.unit.power_cut(self.now)
            bay.bus.put(bay.unit)
        self.promises.touched(bay.name)
        self._power_at[act.socket] = bay.disturbed_at = self.now + act.seconds
        return True

    def _switch_on(self, bay: Bay) -> None:
        bay.disturbed_at = max(bay.disturbed_at, self.now)
        if bay.unit is not None:
            bay.unit.power_on(self.now)

    def _stall(self, act: stories.Stall) -> bool:
        bay = self.bays.get(act.socket)
        if bay is None or bay.process is None or bay.process.is_over:
            return False
        bay.process.stalled_until = self.now + act.seconds
        bay.blind(bay.process.stalled_until, act.seconds)
        if bay.disturbed_at > self.now - CALM_S:
            bay.disturbed_at = bay.process.stalled_until  # it hears what came before only then
        self.promises.touched(bay.name)
        return True

    def _kill_worker(self, act: stories.KillWorker) -> bool:
        bay = self.bays.get(act.socket)
        if self.station is None or bay is None or bay.process is None or bay.process.is_over:
            return False
        bay.process.kill()
        bay.is_working = False
        self.promises.touched(bay.name)
        return True

    def _kill_power(self, act: stories.KillPower) -> bool:
        if self._power_at or not self._kill_station(stories.KillStation(seconds=act.seconds)):
            return False
        for name, bay in self.bays.items():
            if bay.process is not None:
                bay.process.kill()
                bay.is_working = False
            self._dip(stories.Dip(socket=name, seconds=act.seconds))
        return True

    def _unplug(self, act: stories.Unplug) -> bool:
        bay = self.bays.get(act.socket)
        if bay is None or not bay.bus.faults.is_plugged:
            return False
        bay.bus.unplug(back_after_s=act.seconds)
        bay.blind(self.now + act.seconds, act.seconds)
        self.promises.touched(bay.name)
        bay.disturbed_at = max(bay.disturbed_at, self.now + act.seconds)
        return True

    def _fill_disk(self, act: stories.FillDisk) -> bool:
        if self._room_at is not None:
            return False
        self._room_at = self.now + act.seconds
        self._change_disk()
        return True

    def _change_disk(self) -> None:
        """What the database has for a statement that writes."""
        engine = self.bench.store.database.engine
        change = event.remove if self._room_at is None else event.listen
        change(engine, "do_execute", _find_no_room)

    def _resume(self, act: stories.Resume) -> bool:
        person = self.people.get(act.by)
        if self.station is None or person is None or not self.is_stopped:
            return False
        self._scan("RESUME", person)
        return True

    def _kill_station(self, act: stories.KillStation) -> bool:
        if self.station is None:
            return False
        self.is_stopped = False
        self.station = None
        self.promises.died()
        for bay in self.bays.values():
            if bay.process is not None:
                bay.process.lose_station()
            bay.shown = None
        for person in self.people.values():
            person.card = person.label = None
        self._station_at = self.now + act.seconds
        return True

    _ACTS: Final[dict[type, Callable[[World, Any], bool]]] = {
        stories.Put: _put,
        stories.Pull: _pull,
        stories.Card: _card,
        stories.Label: _label,
        stories.Cancel: _cancel,
        stories.Free: _free,
        stories.Abort: _abort,
        stories.Look: lambda _world, _act: True,
        stories.Sleep: _sleep,
        stories.Dip: _dip,
        stories.Stall: _stall,
        stories.KillWorker: _kill_worker,
        stories.KillStation: _kill_station,
        stories.KillPower: _kill_power,
        stories.Unplug: _unplug,
        stories.FillDisk: _fill_disk,
        stories.Resume: _resume,
    }

    # -- the oracle -------------------------------------------------------------------------------

    def _note_command(self, bay: Bay, command: int, now: float) -> None:
        bay.commanded_at.setdefault(command, now)
        if command in _FLASHES:
            self.promises.flashes(bay.name)

    def _end(self, bay: Bay, event: RunEnded) -> None:
        bay.run, run = "", event.run
        self._last_end = f"{run.state.value} {run.code}"
        self.seen[self._last_end] += 1
        if run.code == "INTERNAL":
            raise Violation("CRASH", f"the run of {event.serial} ended with a bug: {run.text}")
        if run.code == "UNIT_CHANGED" and _is_calm(bay) and not _has_given_up(bay, self.now):
            raise Violation(
                "ACCUSED",
                f"{event.serial} in {bay.name} was not touched, and is reported as another"
                f" unit: {run.text}",
            )
        if run.state is not RunState.PASS:
            return
        self.passed.add(event.serial)
        heard = list(bay.heard)
        if heard != [event.serial] and (way := self._unseen(bay)):
            self.seen[f"undetectable: {way}"] += 1
            bay.unseen = event.serial
            return
        if heard != [event.serial]:
            raise Violation(
                "FALSE PASS",
                f"PASS of {event.serial} in {bay.name}, and its run received {_words(heard)}",
                bay.name,
            )
        unit = next(each for each in self.units.values() if each.label == event.serial)
        stored = _stored(unit)
        if any(part.engine.stored_image != IMAGES[part.engine.target].data for part in unit.parts):
            raise Violation("FALSE PASS", f"PASS of {event.serial}, which has another image")
        if self.setup.line.writes and stored.number != event.serial:
            raise Violation(
                "FALSE PASS", f"PASS of {event.serial}, which says that it is {stored.number}"
            )

    def _unseen(self, bay: Bay) -> str:
        """How a unit was exchanged undetectably; empty where it could be detected. A unit without
        an identity only announces itself, when its power comes and when it restarts.
        """
        if self.setup.line.tells:
            return ""
        if bay.card_at <= bay.put_at <= bay.label_at:
            return "exchanged between its card and its label"
        announced_at = bay.put_at + _ANNOUNCES_S
        if announced_at >= bay.commanded_at.get(Command.END_OF_TRANSFER, inf):
            return "exchanged when its image was complete"
        update_at = bay.commanded_at.get(Command.UPDATE, inf)
        if bay.put_at <= update_at and announced_at >= min(bay.commanded_at.values(), default=inf):
            return "exchanged in the restart before its flash"
        return ""

    def _look(self) -> None:
        """Look at every unit and every tile."""
        if self._found is not None:
            raise self._found
        for number, unit in self.units.items():
            if unit.has_not_changed():
                continue
            before, after = self._stored[number], _stored(unit)
            if after == before:
                continue
            self._stored[number] = after
            bay = self.where(number)
            label, socket = ("", "") if bay is None else (bay.run, bay.name)
            if after.number not in self._allowed[number]:
                raise Violation(
                    "NUMBER",
                    f"the unit with the label {unit.label} now says that it is {after.number}",
                    socket,
                )
            is_own = before.number.startswith("W")
            if is_own and label not in ("", before.number, unit.label):
                raise Violation(
                    "TOUCHED",
                    f"unit {unit.label}, which says that it is {before.number}, was flashed or"
                    f" written under the label {label}",
                    socket,
                )
        for bay in self.bays.values():
            self._look_at_green(bay)

    def _look_at_green(self, bay: Bay) -> None:
        shown = bay.shown
        if shown is None or shown.state is not SocketState.PASS or self.station is None:
            return
        if self.now - max(bay.changed_at, bay.blind_until) < GREEN_S or shown.serial == bay.unseen:
            return
        unit = bay.unit
        if unit is None and self.setup.line.writes:
            raise Violation("GREEN", f"{bay.name} is empty and shows PASS of {shown.serial}")
        if unit is not None and unit.label != shown.serial and bay.has_spoken:
            raise Violation(
                "GREEN",
                f"{bay.name} shows PASS of {shown.serial} over unit {unit.label}, for"
                f" {self.now - bay.changed_at:.1f} s",
            )

    # -- no unit is stuck -------------------------------------------------------------------------

    def way_home(self) -> Iterator[stories.Act]:
        """Nothing else happens any more, and a careful person brings each unit to a finished run:
        what that takes, each act drawn when the one before it is done.
        """
        self._wait(0.5)
        while self.station is None or self._power_at or self._room_at is not None:
            self._wait(1.0)
        while not all(bay.bus.faults.is_plugged for bay in self.bays.values()):
            self._wait(1.0)
        if self.is_stopped:
            yield stories.Resume(when=stories.at(self.now), by=CAREFUL)
            if self.is_stopped:
                raise Violation(STUCK, "there is room on the disk, and RESUME does not go on")
        for unit in self.units.values():
            unit.sleeps_until = float("-inf")
        for number in self.units:
            if label_of(number) not in self.passed:
                yield from self._bring_home(number)
        self._look_at_records()

    def _look_at_records(self) -> None:
        """Every PASS that was shown is in the records."""
        rows = self.bench.store.read.table(RunFilter(state=RunState.PASS))
        lost = self.passed - {run.serial for run in rows}
        if lost:
            raise Violation("LOST", f"PASS of {_words(sorted(lost))} was shown, and is not saved")

    def end_of_runs(self) -> Iterator[stories.Act]:
        """The beginning of the way home, without an act."""
        self._wait(0.5)
        self._await_ends()
        return iter(())

    def _wait(self, seconds: float) -> None:
        self.go_to(round(self.now + seconds, 6))

    def _bring_home(self, number: int) -> Iterator[stories.Act]:
        label, reported = label_of(number), ""
        for attempt in range(_TRIES):
            self._await_ends()
            yield from self._empty()
            self._wait(_READY_S)
            now = stories.at(self.now)
            for each in self.bays.values():
                if attempt or self.awaits_another(each, number):
                    yield stories.Free(when=now, by=CAREFUL, socket=each.name)
            bay = self.bays[list(self.bays)[attempt % len(self.bays)]]
            yield stories.Put(when=now, unit=number, socket=bay.name)
            if self.where(number) is None:
                self._stuck(number, f"{bay.name} waits for another unit")
            self._wait(_READY_S)
            before, runs = len(self._answers), self.seen["runs"]
            yield stories.Card(when=stories.at(self.now), by=CAREFUL, unit=number)
            self._wait(1.0)
            yield stories.Label(when=stories.at(self.now), by=CAREFUL, unit=number)
            give_up_at = self.now + 30.0
            while self.seen["runs"] == runs and self.now < give_up_at:
                self._wait(0.5)
            refusals = [e for e in self._answers[before:] if isinstance(e, ScanRefused)]
            if any(each.code in _FINAL for each in refusals):
                return
            reported = "; ".join(f"{e.code} {e.reason} {e.remedy}" for e in refusals)
            if self.seen["runs"] > runs:
                self._await_ends()
                if label in self.passed or not self._has_to_pass(number):
                    return
                reported = f"its run ended with {self._last_end}"
        self._stuck(number, reported)

    def _empty(self) -> Iterator[stories.Act]:
        """Nothing waits for a scan, and no unit is in a socket."""
        now = stories.at(self.now)
        for person in self.people.values():
            person.card = person.label = None
            if person.source != "mounted":
                yield stories.Cancel(when=now, by=person.name)
        for unit in self.units:
            if self.where(unit) is not None:
                yield stories.Pull(when=now, unit=unit)

    def _has_to_pass(self, number: int) -> bool:
        """A good unit passes, whatever befell it before."""
        unit = self._setup_of(number)
        writes = self.setup.line.writes
        numbers = ("none", "empty", "own", "maker") if writes else ("none", "empty", "own")
        if not self.setup.line.tells:
            return True
        return unit.answers and unit.number in numbers

    def _stuck(self, number: int, reported: str) -> NoReturn:
        raise Violation(STUCK, f"no way of scans leads {label_of(number)} to its end: {reported}")

    def _await_ends(self) -> None:
        give_up_at = self.now + _RUN_LIMIT_S
        while any(bay.run or bay.is_working for bay in self.bays.values()):
            if self.now >= give_up_at:
                running = [f"{bay.run} in {bay.name}" for bay in self.bays.values() if bay.run]
                raise Violation(STUCK, f"no end of the run of {_words(running)}")
            self._wait(0.5)


def _find_no_room(_cursor: object, statement: str, _values: object, _context: object) -> None:
    if statement.startswith(("INSERT", "UPDATE", "DELETE")):
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorcode = sqlite3.SQLITE_FULL
        raise error


def _make(setup: stories.UnitSetup, none: str, line: stories.LineSetup) -> PaperUnit:
    """A unit that lies on the table, without power; `none` is what a new one has for a number."""
    numbers = {
        "none": none,
        "empty": "",
        "own": label_of(setup.label),
        "maker": f"MK{setup.label:05}",
        "other": label_of(900 + setup.label),
    }
    profile = DeviceProfile(
        serial_number=numbers[setup.number],
        application_area_bytes=8192,
        silent_queries="none" if setup.answers else "752:3300",
        factory_version=BMS_VERSION if setup.application == "new" else OLD_VERSION,
        **(_SLOW if setup.pace == "slow" else {}),  # type: ignore[arg-type]
    )
    devices = [
        MockDevice(
            target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=profile,
            has_application=setup.application != "none",
        )
        for target in _TARGETS.get(line.recipe, (BMS,))
    ]
    for device in devices:
        device.power_cut(0.0)
    return PaperUnit(devices, label_of(setup.label))


def _is_calm(bay: Bay) -> bool:
    """Nothing was touched for some time before the run."""
    return bay.disturbed_at < bay.run_at - CALM_S


def _has_given_up(bay: Bay, now: float) -> bool:
    """Its unit waited in a transfer that another run had left, and was silent for as long as one
    that was pulled, or has announced itself since, as one does that is switched on.
    """
    if not bay.began_in_transfer or bay.unit is None:
        return False
    return bay.unit.gave_up_at >= bay.run_at or bay.spoke_at <= now - SILENCE_S


def _stored(unit: PaperUnit) -> _Stored:
    number, operations = unit.memory
    return _Stored(str(getattr(number, "serial_number", "")), operations)


def last_look(moment: float) -> float:
    """When the station looked at its processes last, if nothing else happened."""
    return max(each for each in _looks(moment) if each <= moment)


def _next_look(moment: float) -> float:
    return min(each for each in _looks(moment) if each > moment)


def _looks(moment: float) -> list[float]:
    """Those around a moment, each always the same number."""
    nearest = round(moment / WINDOW_S)
    return [round(each * WINDOW_S, 6) for each in (nearest - 1, nearest, nearest + 1)]


def _words(labels: list[str]) -> str:
    return " and ".join(labels) or "no unit"


def _shown(event: StationEvent) -> str:
    words = {
        name: value
        for name, value in vars(event).items()
        if value not in ("", (), None) and name not in ("at", "run_id", "audit")
    }
    return f"{type(event).__name__} " + " ".join(f"{name}={value}" for name, value in words.items())
