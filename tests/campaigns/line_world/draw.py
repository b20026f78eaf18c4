"""Draws stories: people who work as the screen says, are in a hurry, exchange units, and are
interrupted. What somebody does next is drawn when the time has come, from what is there then; what
was done is the story.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Generator, Iterator
from dataclasses import replace
from typing import Final

from flasher.station.events import SocketState
from flasher.station.records.model import StepName
from tests.campaigns.line_world import stories
from tests.campaigns.line_world.stories import Story
from tests.campaigns.line_world.world import HAND_S, Bay, World, label_of, last_look

Step = tuple[float, stories.Act | None]
"""Seconds to wait, and what is done then; None: nothing, only look again."""
_RECIPES: Final = {"writes": 10, "plain": 5, "held": 2, "bicycle": 2, "wmc": 2, "obc": 1}
_NUMBERS: Final = {"none": 5, "empty": 2.5, "maker": 4, "own": 2, "other": 1.5}
_NUMBERLESS: Final = ("empty", "new")
"""Number and application of a unit that runs the line's firmware, and reports no number."""
_UNTOLD: Final = ("none", "empty")
"""Numbers of units that are indistinguishable while the line writes none."""
_GAPS_S: Final = (HAND_S, 0.3, 0.3, 0.5, 1.0, 3.5)
"""From pulling a unit to putting another one in."""
_AFTER_FLASH: Final = (StepName.WRITE, StepName.RESTART, StepName.VERIFY)
_IN_HAND: Final = (SocketState.PASS, SocketState.FAIL, SocketState.RECHECK)


def setup_of(chance: random.Random) -> Story:
    """What there is."""
    sockets = chance.choice((1, 1, 2, 2, 3))
    bare = chance.choice((0.1, 0.1, 0.5))
    units, count = [], sockets + chance.choice((1, 2, 3))
    numbers = chance.choices(list(_NUMBERS), list(_NUMBERS.values()), k=count)
    way = chance.random()
    if way < 0.4:  # one of each
        numbers[: len(_NUMBERS)] = chance.sample(list(_NUMBERS), min(count, len(_NUMBERS)))
    elif way < 0.7:
        numbers[:2] = "maker", "empty"
    for label, number in enumerate(numbers, 1):
        is_new = chance.random() < {"other": 0.2, "empty": 0.8}.get(number, 0.5)
        firmware = "new" if is_new else "old"
        units.append(
            stories.UnitSetup(
                label=label,
                number=number,  # type: ignore[arg-type]
                application="none" if chance.random() < bare else firmware,  # type: ignore[arg-type]
                pace="slow" if chance.random() < 0.6 else "fast",
                answers=chance.random() > 0.04,
            )
        )
    people, pages = [], chance.choice((4, 12, 12))
    for name in ("jo", "al", "mo")[: chance.choice((1, 2, 2, 2, 3))]:
        source = chance.choices(("page", name, "mounted"), (pages, 4, 1))[0]
        people.append(stories.Person(name=name, source=source))
    recipe = chance.choices(list(_RECIPES), list(_RECIPES.values()))[0]
    line = stories.LineSetup(sockets=sockets, recipe=recipe)  # type: ignore[arg-type]
    return Story(line, units, people, [])


class Teller:
    """Draws what happens in a world."""

    def __init__(self, chance: random.Random, world: World) -> None:
        self.chance = chance
        self.world = world

    def acts(self) -> Iterator[stories.Act]:
        """Acts with their times, each drawn when the one before it is done."""
        yield from self._in_turn([self._opening()])
        people = [self._person(each.name) for each in self.world.setup.people]
        yield from self._in_turn([*people, self._fate()])

    def _in_turn(self, actors: list[Iterator[Step]]) -> Iterator[stories.Act]:
        upcoming = [
            (self.world.now + gap, act, actor)
            for actor in actors
            for gap, act in itertools.islice(actor, 1)
        ]
        while upcoming:
            index = min(range(len(upcoming)), key=lambda each: upcoming[each][0])
            moment, act, actor = upcoming.pop(index)
            if act is not None:
                yield replace(act, when=stories.at(moment))
            else:
                # A story holds acts alone: who does nothing sees what the station shows by itself.
                self.world.go_to(last_look(moment))
            for gap, following in itertools.islice(actor, 1):
                now = max(moment, self.world.now)
                upcoming.insert(index, (now + gap, following, actor))

    def _opening(self) -> Iterator[Step]:
        """What takes several things at once, while no one else is at the line."""
        people = [each.name for each in self.world.setup.people if each.source != "mounted"]
        if people and self.chance.random() < 0.9:
            scenes = [self._scan_at_once, self._lose_station, self._cancel_label]
            scenes += 2 * [self._abort_own]
            scenes += 2 * [self._go_on_in_an_outage, self._exchange_in_flash]
            scenes += 3 * [self._be_interrupted, self._take_out_again]
            # More often where they can do harm.
            numbers = {each.number for each in self.world.setup.units}
            recipe = self.world.setup.line.recipe
            if "other" in numbers:
                scenes += 3 * [self._scan_another_number]
            if recipe == "writes" and {"maker", "empty"} <= numbers:
                scenes += 6 * [self._exchange_for_numberless]
            if recipe == "plain":
                scenes += 4 * [self._go_on_in_an_outage]
            chosen = self.chance.sample(scenes, 4)
            if recipe == "plain":
                chosen.append(self._go_on_with_one_alike)
            for scene in chosen:
                yield from scene(self.chance.choice(people))
                yield 3.0, None

    # -- what is there ----------------------------------------------------------------------------

    def _pause(self) -> float:
        chance = self.chance
        return chance.choice(
            (
                chance.uniform(0.0, 0.01),
                chance.uniform(0.1, 0.6),
                chance.uniform(0.3, 1.5),
                chance.uniform(1.0, 4.0),
            )
        )

    def _on_table(self) -> list[int]:
        return [each for each in self.world.units if self.world.where(each) is None]

    def _fresh(self) -> list[Bay]:
        """Sockets with a unit that was not scanned."""
        return [
            bay
            for bay in self._bays(full=True, working=False)
            if bay.shown is not None
            and (bay.shown.state, bay.shown.serial) == (SocketState.SCAN, "")
            and label_of(self._number(bay)) not in self.world.passed
        ]

    def _bring(self, count: int) -> Generator[Step, None, list[Bay]]:
        """Have so many units in sockets that were not scanned, as far as there are."""
        units = [each for each in self._on_table() if label_of(each) not in self.world.passed]
        empty = self._bays(full=False)
        for unit, bay in list(zip(units, empty, strict=False))[
            : max(0, count - len(self._fresh()))
        ]:
            yield self._pause(), stories.Put(unit=unit, socket=bay.name)
        fresh, give_up_at = self._fresh(), self.world.now + 3.0
        while len(fresh) < count and self.world.now < give_up_at:
            yield 0.5, None
            fresh = self._fresh()
        return self.chance.sample(fresh, min(count, len(fresh)))

    def _number(self, bay: Bay) -> int:
        return next(n for n, unit in self.world.units.items() if unit is bay.unit)

    def _bays(self, *, full: bool, working: bool | None = None) -> list[Bay]:
        return [
            bay
            for bay in self.world.bays.values()
            if (bay.unit is not None) == full and working in (None, bool(bay.run))
        ]

    # -- people -----------------------------------------------------------------------------------

    def _person(self, name: str) -> Iterator[Step]:
        scenes = {
            self._serve: 8.0,
            self._exchange: 3.0,
            self._exchange_in_step: 3.0,
            self._exchange_complete: 6.0,
            self._swap: 2.0,
            self._clear: 5.0,
            self._take_out_again: 1.5,
            self._scan_at_once: 2.0,
            self._be_interrupted: 2.0,
            self._cancel: 0.6,
            self._free: 0.4,
            self._abort: 0.3,
        }
        while True:
            yield self._pause(), None
            if self._shares_card(name) and self.chance.random() < 0.5:
                yield from self._scan_beside(name)
            yield from self.chance.choices(list(scenes), list(scenes.values()))[0](name)

    def _shares_card(self, name: str) -> bool:
        """Somebody else has scanned a card at the same scanner or page."""
        people = self.world.people
        return any(
            each.card is not None and each.source == people[name].source
            for each in people.values()
            if each.name != name
        )

    def _scan_beside(self, name: str) -> Iterator[Step]:
        """Scan a unit, whatever waits."""
        waiting = [self._number(bay) for bay in self._bays(full=True, working=False)]
        if waiting:
            unit = self.chance.choice(waiting)
            yield 0.0, stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)

    def _serve(self, name: str) -> Iterator[Step]:
        """Bring a unit into a socket, and scan it."""
        chance, empty = self.chance, self._bays(full=False)
        waiting = [self._number(bay) for bay in self._bays(full=True, working=False)]
        units = self._on_table() if empty else []
        if waiting and (not units or chance.random() < 0.4):
            yield from self._scan(name, chance.choice(waiting))
        elif units:
            unit, socket = chance.choice(units), chance.choice(empty).name
            puts_first = chance.random() < 0.75
            if puts_first:
                yield self._pause(), stories.Put(unit=unit, socket=socket)
            yield from self._scan(name, unit, socket)
            if not puts_first:
                named = [
                    bay.name
                    for bay in self.world.bays.values()
                    if bay.shown is not None and bay.shown.serial == self.world.units[unit].label
                ]
                yield self._pause(), stories.Put(unit=unit, socket=(named or [socket])[0])

    def _scan(self, name: str, unit: int, socket: str = "") -> Iterator[Step]:
        card = stories.Card(by=name, unit=unit, socket=socket)
        label = stories.Label(by=name, unit=unit)
        way = self.chance.random()
        if way < 0.65:
            yield self._pause(), card
            if self.chance.random() < 0.15:
                yield from self._trouble(name, unit)
            if self.chance.random() < 0.04:
                yield 15.0, None
            yield self._pause(), label
        elif way < 0.8:
            yield self._pause(), label
            yield self._pause(), card
        else:
            yield self._pause(), label

    def _trouble(self, name: str, unit: int) -> Iterator[Step]:
        """Between the card of a unit and its label."""
        bay = self.world.where(unit)
        if bay is None or bay.unit is None or self.chance.random() < 0.4:
            yield from self._swap(name)
            return
        yield from self._put_another(bay)
        # Before the other one announces itself, or before anybody reads that the card was dropped.
        wait = self.chance.choice((self.chance.uniform(0.0, 0.15), self.chance.uniform(0.1, 0.9)))
        yield wait, stories.Label(by=name, unit=unit)

    def _exchange_in_step(self, name: str) -> Iterator[Step]:
        """Another unit into a socket, at a certain step of its run."""
        yield from self._keep_busy(name)
        step = self.chance.choice((StepName.IDENTIFY, StepName.FLASH, *_AFTER_FLASH))
        bay = yield from self._await(step)
        if bay is None:
            return
        # The step began up to 0.1 s ago.
        yield self.chance.choice((0.0, self.chance.uniform(0.0, 0.3))), None
        if bay.unit is not None:
            yield from self._put_another(bay)

    def _exchange_in_flash(self, name: str) -> Iterator[Step]:
        """Another unit into the socket of one that is being flashed."""
        for bay in (yield from self._bring(1)):
            unit = self._number(bay)
            yield self._pause(), stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)
            flashed = yield from self._await(StepName.FLASH)
            yield self.chance.choice((0.3, 1.0)) * self.chance.random(), None
            if flashed is bay and bay.unit is not None:
                yield from self._put_another(bay)

    def _exchange_for_numberless(self, name: str) -> Iterator[Step]:
        """A unit whose image is complete, for one that runs that firmware and reports no number
        where the first one reported its maker's.
        """
        table, empty = [self._setup(each) for each in self._on_table()], self._bays(full=False)
        answering = [each for each in table if each.answers and each.application != "none"]
        units = [each.label for each in answering if each.number == "maker"]
        others = [each for each in answering if (each.number, each.application) == _NUMBERLESS]
        if not (units and others and empty):
            return
        bay, unit = self.chance.choice(empty), self.chance.choice(units)
        yield self._pause(), stories.Put(unit=unit, socket=bay.name)
        yield 2.0, None
        yield self._pause(), stories.Card(by=name, unit=unit)
        yield self._pause(), stories.Label(by=name, unit=unit)
        if (yield from self._await(StepName.FLASH, is_complete=True)) is bay:
            # A slow unit confirms its image later.
            confirmed_s = 0.2 if self._setup(unit).pace == "slow" else 0.0
            yield confirmed_s + 0.1 * self.chance.random(), stories.Pull(unit=unit)
            other = self.chance.choice(others).label
            yield self.chance.choice(_GAPS_S), stories.Put(unit=other, socket=bay.name)

    def _keep_busy(self, name: str) -> Iterator[Step]:
        """Begin a run where none goes on."""
        if not self._bays(full=True, working=True):
            yield from self._serve(name)

    def _await(
        self, step: StepName, *, is_complete: bool = False
    ) -> Generator[Step, None, Bay | None]:
        """Wait for a step of a run: the socket in which it comes."""
        give_up_at = self.world.now + 10.0
        while self.world.now <= give_up_at:
            for bay in self.world.bays.values():
                if bay.is_working and bay.step is step and bay.is_complete >= is_complete:
                    return bay
            yield 0.03, None
        return None

    def _exchange_complete(self, name: str) -> Iterator[Step]:
        """A unit whose image is complete, for one that runs that firmware already."""
        new = {e.label for e in self.world.setup.units if e.application == "new"}
        if not new & {*self._on_table()}:
            return
        yield from self._keep_busy(name)
        bay = yield from self._await(StepName.FLASH, is_complete=True)
        others = [self._setup(each) for each in self._on_table() if each in new]
        if bay is not None and bay.unit is not None and others:
            unit = self._setup(self._number(bay))
            other = self._another(unit, others)
            wait = self.chance.choice((0.1, 0.4)) * self.chance.random()
            yield wait, stories.Pull(unit=unit.label)
            yield self.chance.choice(_GAPS_S), stories.Put(unit=other.label, socket=bay.name)

    def _another(
        self, unit: stories.UnitSetup, others: list[stories.UnitSetup]
    ) -> stories.UnitSetup:
        """Another unit, more often one that reports another number, or that it has none."""
        if self.chance.random() < 0.7:
            others = [each for each in others if each.number != unit.number] or others
        if self.chance.random() < 0.4:
            others = [each for each in others if each.number == "empty"] or others
        return self.chance.choice(others)

    def _take_out_again(self, name: str) -> Iterator[Step]:
        """Scan a unit, and take it out as its run begins."""
        for bay in (yield from self._bring(1)):
            unit = self._number(bay)
            # Often it has been there for some time.
            yield self.chance.choice((0.0, 3.0)), None
            yield self._pause(), stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)
            yield self.chance.uniform(0.0, 0.4), stories.Pull(unit=unit)
            # Before or after the station gives up.
            yield self.chance.choice((4.0, 12.0, 12.0)), stories.Put(unit=unit, socket=bay.name)

    def _scan_at_once(self, name: str) -> Iterator[Step]:
        """Two people at one page scan at once, each a unit of their own."""
        people = self.world.people
        others = [
            each.name
            for each in people.values()
            if each.name != name and each.source == people[name].source
        ]
        if len(self.world.bays) > 1 and others and people[name].source != "mounted":
            units = [self._number(each) for each in (yield from self._bring(2))]
            both = list(zip((name, self.chance.choice(others)), units, strict=False))
            for scan in (stories.Card, stories.Label):
                for by, unit in both:
                    yield self.chance.uniform(0.0, 1.0), scan(by=by, unit=unit)

    def _be_interrupted(self, name: str) -> Iterator[Step]:
        """Exchange the unit of a card that waits, also while its socket does not work."""
        bays = yield from self._bring(1)
        others = self._on_table()
        if not (bays and others):
            return
        bay, other = bays[0], self.chance.choice(others)
        unit = self._number(bay)
        yield self._pause(), stories.Card(by=name, unit=unit)
        kill = stories.KillWorker(socket=bay.name)
        unplug = stories.Unplug(socket=bay.name, seconds=2.0)
        way = self.chance.choice((None, None, kill, unplug))
        yield self._pause(), way
        yield self.chance.uniform(0.0, 0.3), stories.Pull(unit=unit)
        yield self.chance.choice((HAND_S, 0.3, 0.5)), stories.Put(unit=other, socket=bay.name)
        # Before the other one announces itself, or before anybody reads that the card was dropped.
        soon = self.chance.choice((self.chance.uniform(0.0, 0.1), self.chance.uniform(0.1, 0.9)))
        wait = self.chance.uniform(0.1, 3.0) if way is not None else soon
        yield wait, stories.Label(by=name, unit=unit)

    def _lose_station(self, name: str) -> Iterator[Step]:
        """The station dies in a run."""
        for bay in (yield from self._bring(1)):
            unit = self._number(bay)
            yield self._pause(), stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)
            yield self.chance.uniform(0.2, 1.5), stories.KillStation(seconds=1.0)
            yield 5.0, None

    def _go_on_with_one_alike(self, name: str) -> Iterator[Step]:
        yield from self._go_on_in_an_outage(name, is_identical=True)

    def _go_on_in_an_outage(self, name: str, *, is_identical: bool = False) -> Iterator[Step]:
        """A socket stops to work after a PASS, and somebody goes on with the next unit there.
        `is_untold`: with two indistinguishable units, if there are such.
        """
        bays = yield from self._bring(2)
        if is_identical:
            bays.sort(key=lambda bay: not self._is_identical(self._number(bay)))
        for bay in bays:
            unit = self._number(bay)
            yield self._pause(), stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)
            yield 0.5, None
            give_up_at = self.world.now + 15.0
            while bay.run and self.world.now < give_up_at:
                yield 0.5, None
            if label_of(unit) in self.world.passed:
                yield self._pause(), None
                yield from self._outage(bay.name, is_identical=is_identical)
                yield 12.0, None  # the next unit is not scanned at once
                return

    def _scan_another_number(self, name: str) -> Iterator[Step]:
        """Scan a unit that reports another number than its label."""
        odd = [e.label for e in self.world.setup.units if e.number == "other"]
        empty = self._bays(full=False)
        units = [each for each in self._on_table() if each in odd]
        if units and empty:
            unit, bay = self.chance.choice(units), self.chance.choice(empty)
            for act in (
                stories.Card(by=name, unit=unit, socket=bay.name),
                stories.Label(by=name, unit=unit),
                stories.Put(unit=unit, socket=bay.name),
            ):
                yield self._pause(), act

    def _setup(self, number: int) -> stories.UnitSetup:
        return next(each for each in self.world.setup.units if each.label == number)

    def _exchange(self, _name: str) -> Iterator[Step]:
        """Another unit into a socket that works."""
        working = self._bays(full=True, working=True)
        if not working:
            return
        bay = self.chance.choice(working)
        yield self.chance.choice((self.chance.uniform(0, 0.6), self.chance.uniform(0, 4.0))), None
        if bay.unit is not None:
            yield from self._put_another(bay)

    def _is_identical(self, number: int) -> bool:
        unit = self._setup(number)
        return unit.number in _UNTOLD and unit.application != "none"

    def _put_another(self, bay: Bay, *, is_identical: bool = False) -> Iterator[Step]:
        """`is_untold`: one indistinguishable from it, if there is one."""
        before = self._number(bay)
        yield 0.0, stories.Pull(unit=before)
        on_table = [each for each in self._on_table() if each != before]
        identical = [each for each in on_table if is_identical and self._is_identical(each)]
        others = [self._setup(each) for each in identical or on_table]
        unit = before
        if others and self.chance.random() < 0.9:
            unit = self._another(self._setup(before), others).label
        yield self.chance.choice(_GAPS_S), stories.Put(unit=unit, socket=bay.name)

    def _swap(self, _name: str) -> Iterator[Step]:
        """Two units change places, or one with a unit from the table."""
        full = self._bays(full=True)
        if not full:
            return
        one = self.chance.choice(full)
        unit = self._number(one)
        others = [bay for bay in full if bay is not one]
        gap = self.chance.choice(_GAPS_S)
        if others and self.chance.random() < 0.7:
            other = self.chance.choice(others)
            second = self._number(other)
            yield self._pause(), stories.Pull(unit=unit)
            yield 0.1, stories.Pull(unit=second)
            yield gap, stories.Put(unit=unit, socket=other.name)
            yield 0.1, stories.Put(unit=second, socket=one.name)
        else:
            table = self._on_table() or [unit]
            yield self._pause(), stories.Pull(unit=unit)
            yield gap, stories.Put(unit=self.chance.choice(table), socket=one.name)

    def _clear(self, _name: str) -> Iterator[Step]:
        """Take out what is done."""
        for bay in self._bays(full=True, working=False):
            if bay.shown is not None and bay.shown.state in _IN_HAND:
                yield self._pause(), stories.Pull(unit=self._number(bay))
                return

    def _cancel(self, name: str) -> Iterator[Step]:
        yield self._pause(), stories.Cancel(by=name)

    def _cancel_label(self, name: str) -> Iterator[Step]:
        """Scan a unit on the table, think better of it, and put the unit in."""
        units, empty = self._on_table(), self._bays(full=False)
        if units and empty:
            unit, socket = self.chance.choice(units), self.chance.choice(empty).name
            yield from self._scan(name, unit, socket)
            yield self._pause(), stories.Cancel(by=name)
            yield self._pause(), stories.Put(unit=unit, socket=socket)

    def _free(self, name: str) -> Iterator[Step]:
        empty = self._bays(full=False)
        if empty:
            yield self._pause(), stories.Free(by=name, socket=self.chance.choice(empty).name)

    def _abort_own(self, name: str) -> Iterator[Step]:
        """Begin a run, and abort it."""
        for bay in (yield from self._bring(1)):
            unit = self._number(bay)
            yield self._pause(), stories.Card(by=name, unit=unit)
            yield self._pause(), stories.Label(by=name, unit=unit)
            yield self._pause(), stories.Abort(by=name, socket=bay.name)

    def _abort(self, name: str) -> Iterator[Step]:
        working = self._bays(full=True, working=True)
        if working:
            yield self._pause(), stories.Abort(by=name, socket=self.chance.choice(working).name)

    # -- what befalls them ------------------------------------------------------------------------

    def _fate(self) -> Iterator[Step]:
        chance = self.chance
        while True:
            wait = chance.expovariate(1 / 25.0)
            socket = chance.choice(list(self.world.bays))
            seconds = round(chance.choice((0.05, 0.5, 2.0, 4.0)), 3)
            way = chance.random()
            if way < 0.12:
                yield wait, stories.Stall(socket=socket, seconds=seconds)
            elif way < 0.34:
                unit = chance.choice(list(self.world.units))
                yield wait, stories.Sleep(unit=unit, seconds=seconds)
            elif way < 0.54:
                yield wait, stories.Dip(socket=socket, seconds=seconds)
            elif way < 0.63:
                yield wait, stories.KillWorker(socket=socket)
            elif way < 0.7:
                yield wait, None
                yield from self._outage(socket)
            elif way < 0.8:
                yield wait, stories.Unplug(socket=socket, seconds=seconds)
            elif way < 0.86:
                yield wait, stories.FillDisk(seconds=4 * seconds)
                name = chance.choice(self.world.setup.people).name
                yield chance.uniform(0.0, 8 * seconds), stories.Resume(by=name)
            elif way < 0.9:
                yield wait, stories.KillPower(seconds=seconds)
            else:
                yield wait, stories.KillStation(seconds=1.0 + seconds)

    def _outage(self, socket: str, *, is_identical: bool = False) -> Iterator[Step]:
        """An adapter that is away, or a process that dies again and again, and a unit that is
        exchanged meanwhile.
        """
        bays = self.world.bays
        green = [e for e in bays.values() if e.shown and e.shown.state is SocketState.PASS]
        bay = self.chance.choice(green or [bays[socket]])
        if self.chance.random() < 0.5:
            yield 0.0, stories.Unplug(socket=bay.name, seconds=8.0)
            yield self.chance.uniform(0.0, 4.0), None
        else:
            yield 0.0, stories.KillWorker(socket=bay.name)
            yield 1.3, stories.KillWorker(socket=bay.name)
            yield 2.3, stories.KillWorker(socket=bay.name)
        if bay.unit is not None:
            yield from self._put_another(bay, is_identical=is_identical)
