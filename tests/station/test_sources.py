"""Scans of several sources, and units that change places between the scans: no run is begun on a
unit with another paper label, and from every state a way of scans leads on.
"""

from __future__ import annotations

import itertools
import random
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import pytest

from flasher.protocol.contents import VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import BMS, Mode
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split
from flasher.station.events import ScanRefused, SocketState, StationEvent
from flasher.station.line import Line
from flasher.station.messages import AdapterDown, AdapterReady
from flasher.station.presence import Presence
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Order, RunState
from flasher.station.socket import Socket, Source
from tests.loops import each, sample
from tests.station.line_inputs import RESULT, begun, saved
from tests.station.unit_bench import UnitBench

STEP_S: Final = 0.05
ONE, TWO = Source("scanner left"), Source("page 2")
GAPS_S: Final = (0.3, 0.5, 1.0, 3.5)
STARTS_AFTER_S: Final = 0.5
"""From power to the application."""


def check_serial(text: str) -> None:
    if not text.startswith("W"):
        raise ValueError("not of this recipe")


@dataclass
class Unit:
    """A battery with a paper label: it answers with `own`, and has an application or none."""

    label: str
    own: str = ""
    has_application: bool = True
    power_at: float = 0.0
    reported: int = 0
    """Announcements since its power came."""

    def put_in(self, now: float) -> None:
        self.power_at, self.reported = now, 0

    def frames(self, now: float) -> list[Message]:
        """What it sends in this step."""
        age = now - self.power_at
        if age < STARTS_AFTER_S or not self.has_application:
            due = int(age / 0.05)
            self.reported, announces = (
                due,
                due > self.reported and (due <= 4 or not self.has_application),
            )
            return [BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)] if announces else []
        if round(age / STEP_S) % 5:
            return []
        texts = ("BM36", self.own, "V1r2r0", "V1r0r0")
        content = VersionInformation(*(WireText(encode_text(text, 16)) for text in texts))
        return [Message(0x720, Mode.REPORT, 0x1540, content.data())]


@dataclass
class Floor:
    """A line whose sockets watch units, on virtual time."""

    recipe: LoadedRecipe
    names: str = "AB"
    now: float = 100.0
    events: list[StationEvent] = field(default_factory=list)
    runs: list[tuple[str, str]] = field(default_factory=list)
    """Label and socket of each."""

    def __post_init__(self) -> None:
        self.units: dict[str, Unit] = {}
        self.presences = {
            name: Presence([each.profile for each in self.recipe.targets]) for name in self.names
        }
        self.line = Line([Socket(name) for name in self.names], check_serial, operator="jo")
        self.busy: dict[str, str] = {}
        for name in self.names:
            self.line.feed(name, AdapterReady(sees_units=True), self.now)
        self.go_on(2.5)

    def go_on(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            for name, presence in self.presences.items():
                unit = self.units.get(name)
                for message in unit.frames(self.now) if unit else ():
                    for frame in split(message.can_id, encode(message)):
                        presence(frame, sent=False, now=self.now)
                if name in self.busy:
                    continue
                change = presence.change(self.now)
                if change is not None:
                    self.line.feed(name, change, self.now)
            self.line.tick(self.now)
            self.perform_effects()

    def perform_effects(self) -> None:
        while effects := self.line.take():
            for effect in effects:
                if isinstance(effect, Order):
                    unit = self.units.get(effect.socket)
                    assert unit is None or unit.label == effect.serial, (
                        f"{effect.serial} runs on the unit of {unit.label}"
                    )
                    self.runs.append((effect.serial, effect.socket))
                    self.busy[effect.socket] = effect.serial
                    self.line.feed(effect.socket, begun(effect.socket, effect.serial), self.now)
                elif isinstance(effect, StationEvent):
                    self.events.append(effect)

    def end_run(self, name: str, outcome: RunState = RunState.PASS) -> None:
        del self.busy[name]
        self.presences[name].begin()
        self.line.feed(name, RESULT, self.now)
        self.line.feed(name, saved(name, outcome, "Take it out."), self.now)
        self.perform_effects()

    def fail(self, name: str, outage_s: float) -> None:
        """The process of a socket ends, and another one begins."""
        self.line.feed(name, AdapterDown("its process ended"), self.now)
        self.go_on(outage_s)
        self.presences[name].begin()
        self.line.feed(name, AdapterReady(sees_units=True), self.now)

    def scan(self, text: str, source: Source = ONE) -> None:
        self.line.scan(text, self.now, source)
        self.perform_effects()
        self.go_on(0.2)

    def put(self, unit: Unit, name: str) -> None:
        self.units[name] = unit
        unit.put_in(self.now)

    def put_all(self, *units: Unit) -> None:
        for name, unit in zip(self.names, units, strict=False):
            self.put(unit, name)
        self.go_on(3.0)

    def change_places(self, gap_s: float) -> None:
        """The units of A and B; both sockets are empty for a while."""
        a, b = self.units.pop("A"), self.units.pop("B")
        self.go_on(gap_s)
        self.put(b, "A")
        self.put(a, "B")
        self.go_on(2.5)

    def refused(self) -> list[ScanRefused]:
        return [event for event in self.events if isinstance(event, ScanRefused)]

    def state(self, name: str) -> SocketState:
        return self.line.sockets[name].state

    def text(self, name: str) -> str:
        shown = self.line.sockets[name].shown
        return "" if shown is None else shown[2]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> LoadedRecipe:
    return UnitBench(tmp_path_factory.mktemp("recipe")).recipe


def pair(own: tuple[str, str] = ("", "")) -> tuple[Unit, Unit]:
    return Unit("W1", own[0]), Unit("W2", own[1])


# -- two people at once ---------------------------------------------------------------------------

CARDS, LABELS = ("SOCKET A", "SOCKET B"), ("W1", "W2")


def test_two_people_at_one_source_never_get_each_others_unit(recipe: LoadedRecipe) -> None:
    """Both cards before both labels, and the other way round, in all orders."""
    for first, second in ((CARDS, LABELS), (LABELS, CARDS)):
        for one, two in itertools.product(
            itertools.permutations(first), itertools.permutations(second)
        ):
            floor = Floor(recipe)
            floor.put_all(*pair())
            for text in (*one, *two):
                floor.scan(text)
            floor.scan("CANCEL")
            left = {"A": "W1", "B": "W2"}
            for label, socket in floor.runs:
                assert left.pop(socket) == label
            for name, label in left.items():
                floor.scan(f"SOCKET {name}")
                floor.scan(label)
            assert sorted(floor.runs) == [("W1", "A"), ("W2", "B")], (one, two)


@pytest.mark.slow
def test_two_people_at_two_sources_disturb_each_other_in_no_order(recipe: LoadedRecipe) -> None:
    scans = [("SOCKET A", ONE), ("W1", ONE), ("SOCKET B", TWO), ("W2", TWO)]
    for order in itertools.permutations(scans):
        floor = Floor(recipe)
        floor.put_all(*pair())
        for text, source in order:
            floor.scan(text, source)
        assert sorted(floor.runs) == [("W1", "A"), ("W2", "B")], order
        assert floor.refused() == []


def test_two_units_that_are_put_in_after_their_scans(recipe: LoadedRecipe) -> None:
    scans = [("SOCKET A", ONE), ("W1", ONE), ("SOCKET B", TWO), ("W2", TWO)]
    for order in itertools.permutations(scans):
        if order.index(scans[0]) > order.index(scans[1]):
            continue  # a label alone goes where the station says
        if order.index(scans[2]) > order.index(scans[3]):
            continue
        floor = Floor(recipe)
        for text, source in order:
            floor.scan(text, source)
        floor.put_all(*pair())
        assert sorted(floor.runs) == [("W1", "A"), ("W2", "B")], order


def test_a_second_card_is_refused_and_the_message_names_what_waits(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.scan("SOCKET B")
    refused = floor.refused()[-1]
    assert (refused.text, refused.code, refused.source) == ("SOCKET B", "CARD_WAITS", ONE.name)
    assert "SOCKET A waits, and something else" in refused.reason
    floor.scan("W2")
    assert floor.refused()[-1].text == "W2"
    assert floor.runs == [], "it is not known for which of the two it was meant"
    floor.scan("SOCKET A")
    floor.scan("W1")
    assert floor.runs == [("W1", "A")], "the same card again says which counts"


def test_cancel_ends_the_wait_of_its_own_source_alone(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A", ONE)
    floor.scan("SOCKET B", TWO)
    floor.scan("CANCEL", ONE)
    floor.scan("W2", TWO)
    assert floor.runs == [("W2", "B")]
    floor.scan("SOCKET A", ONE)
    floor.scan("CANCEL", TWO)
    refused = floor.refused()[-1]
    assert (refused.code, refused.source) == ("NOTHING_WAITS", TWO.name)
    assert "SOCKET A waits" in refused.reason
    assert ONE.name in refused.reason
    floor.scan("W1", ONE)
    assert floor.runs[1:] == [("W1", "A")]


def test_a_socket_whose_card_waits_elsewhere_is_not_taken(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A", ONE)
    floor.scan("SOCKET A", TWO)
    assert floor.refused()[-1].code == "CARD_WAITS"
    floor.scan("W2", TWO)
    assert floor.refused()[-1].code == "NO_SOCKET"
    floor.scan("W1", ONE)
    assert floor.runs == [("W1", "A")]


def test_a_label_is_where_it_was_scanned_last(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("W1", ONE)
    floor.scan("W1", TWO)
    dropped = floor.refused()[-1]
    assert (dropped.text, dropped.source, dropped.reason) == (
        "W1", ONE.name, "It was scanned elsewhere.",
    )  # fmt: skip
    floor.scan("SOCKET A", TWO)
    assert floor.runs == [("W1", "A")]


def test_a_label_of_another_source_can_be_freed_everywhere(recipe: LoadedRecipe) -> None:
    """Its page is closed, so that CANCEL cannot be scanned there."""
    floor = Floor(recipe)
    floor.scan("FREE A")
    floor.scan("W1", TWO)
    floor.scan("W2", ONE)
    refused = floor.refused()[-1]
    assert refused.code == "LABEL_WAITS"
    assert refused.remedy.endswith("Or scan FREE A.")
    floor.scan("FREE A", ONE)
    assert (floor.refused()[-1].text, floor.refused()[-1].source) == ("W1", TWO.name)
    floor.scan("W2", ONE)
    floor.go_on(3.0)
    floor.put(Unit("W2"), "A")
    floor.go_on(4.0)
    assert floor.runs == [("W2", "A")]


# -- a card dies with its unit --------------------------------------------------------------------


@pytest.mark.slow
@each("own", [("", ""), ("M1", "M2"), ("W1", "W2")])
def test_a_card_does_not_live_longer_than_its_unit(
    recipe: LoadedRecipe, own: tuple[str, str]
) -> None:
    for gap_s, name, label in itertools.product(GAPS_S, "AB", LABELS):
        floor = Floor(recipe)
        floor.put_all(*pair(own))
        floor.scan(f"SOCKET {name}")
        floor.change_places(gap_s)
        dropped = floor.refused()[-1]
        assert (dropped.text, dropped.socket, dropped.source) == (f"SOCKET {name}", name, ONE.name)
        assert dropped.code == ("UNIT_CHANGED" if gap_s < 2.0 else "FORGOTTEN")
        if gap_s < 2.0:
            assert floor.text(name).startswith("The unit was exchanged")
        floor.scan(label)
        assert floor.runs == []
        assert floor.refused()[-1].code == "NO_SOCKET"
        where = "B" if label == "W1" else "A"
        floor.scan(f"SOCKET {where}")
        floor.scan(label)
        assert floor.runs == [(label, where)], (gap_s, name, label)


def test_no_label_of_two_counts_alone_after_their_card_was_dropped(recipe: LoadedRecipe) -> None:
    """Two people at one page scanned the card, and the unit is exchanged: both are asked for it."""
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.change_places(0.5)
    for label in ("W1", "W2"):
        floor.scan(label)
        assert floor.refused()[-1].code == "NO_SOCKET"
        assert floor.refused()[-1].text == label
    floor.scan("W2")  # by the other one, or read twice
    assert floor.runs == []
    floor.scan("SOCKET A")
    floor.scan("W2")
    assert floor.runs == [("W2", "A")]


@pytest.mark.slow
def test_a_dropped_card_is_forgotten_in_the_end(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.change_places(0.5)
    floor.go_on(121.0)
    floor.scan("W1")
    assert floor.refused()[-1].text == "SOCKET A", "W1 was not refused"
    floor.scan("SOCKET B")
    assert floor.runs == [("W1", "B")]


def test_what_was_dropped_is_shown_for_a_while(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.change_places(0.5)
    reported = "The unit was exchanged, or had no power. Check which unit it is, then scan again."
    assert floor.text("A").startswith(reported)
    floor.go_on(15.0)
    assert floor.text("A") == "Scan the label of the unit and SOCKET A."
    floor.scan("SOCKET A")
    floor.units.pop("A")
    floor.go_on(2.5)
    assert floor.text("A").startswith("Its unit stopped sending.")
    floor.go_on(15.0)
    assert floor.state("A") is SocketState.SILENT


def test_a_label_for_an_empty_socket_goes_on_waiting(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.scan("SOCKET A")
    floor.go_on(5.0)
    floor.scan("W1")
    floor.go_on(10.0)
    assert floor.refused() == []
    floor.put(Unit("W1"), "A")
    floor.go_on(3.0)
    assert floor.runs == [("W1", "A")]


def test_green_goes_with_its_unit_however_fast_the_next_one_is(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.scan("W1")
    floor.end_run("A")
    floor.go_on(2.0)
    assert floor.state("A") is SocketState.PASS
    floor.change_places(0.3)
    assert floor.state("A") is SocketState.SCAN
    assert floor.text("A").startswith("It was off or silent after PASS of W1")


def test_green_does_not_come_back_to_an_empty_socket(recipe: LoadedRecipe) -> None:
    """Its process ends, and what is in it is not known for a while."""
    floor = Floor(recipe)
    floor.put_all(*pair(("W1", "W2")))
    floor.scan("W1")
    floor.end_run("A")
    floor.go_on(2.0)
    assert floor.state("A") is SocketState.PASS
    unit = floor.units.pop("A")
    floor.go_on(3.0)
    assert floor.state("A") is SocketState.EMPTY
    floor.line.feed("A", AdapterDown("its process ended"), floor.now)
    floor.perform_effects()
    assert floor.state("A") is SocketState.ERROR
    floor.presences["A"].begin()
    floor.line.feed("A", AdapterReady(sees_units=True), floor.now)
    floor.put(unit, "A")
    floor.go_on(3.0)
    assert floor.state("A") is SocketState.PASS, "it is back, and says who it is"


@each("outage_s", [0.1, 1.0, 2.9])
@each("own", ["", "W1"])
def test_green_outlives_an_outage_only_with_a_unit_that_states_who_it_is(
    recipe: LoadedRecipe, own: str, outage_s: float
) -> None:
    """However short: another one may be there, whose announcement was missed."""
    floor = Floor(recipe)
    floor.put_all(*pair((own, "")))
    floor.scan("SOCKET A")
    floor.scan("W1")
    floor.end_run("A")
    floor.go_on(2.0)
    assert floor.state("A") is SocketState.PASS
    floor.fail("A", outage_s)
    floor.go_on(3.0)
    if own:
        assert floor.state("A") is SocketState.PASS
    else:
        assert floor.state("A") is SocketState.SCAN
        assert floor.text("A").startswith("It was off or silent after PASS of W1")


@each("put_after_s", [0.1, 1.0, 1.9])
@each("outcome", [RunState.ERROR, RunState.FAIL])
def test_a_card_is_not_for_a_unit_that_comes_before_anything_was_received(
    recipe: LoadedRecipe, outcome: RunState, put_after_s: float
) -> None:
    """The unit of the last run waits for packets, and says nothing."""
    floor = Floor(recipe)
    floor.put_all(*pair())
    floor.scan("SOCKET A")
    floor.scan("W1")
    floor.units.pop("A")
    floor.end_run("A", outcome)
    floor.fail("A", 1.0)
    floor.scan("SOCKET A")
    floor.go_on(put_after_s - 0.2)
    floor.put(Unit("W3"), "A")
    floor.go_on(0.3)
    floor.scan("W1")
    assert floor.runs == [("W1", "A")], "of the first run"
    assert floor.refused()[0].code == "UNIT_CHANGED"
    floor.scan("FREE A")
    floor.scan("SOCKET A")
    floor.scan("W3")
    assert floor.runs[1:] == [("W3", "A")]


def test_nothing_begins_before_it_is_known_whether_a_unit_is_there(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe, "A")
    floor.put_all(Unit("W1"))
    floor.scan("SOCKET A")
    floor.scan("W1")
    floor.units.pop("A")
    floor.end_run("A", RunState.ERROR)
    for text in ("SOCKET A", "W1"):
        floor.scan(text)
    assert len(floor.runs) == 1
    floor.go_on(2.0)
    assert len(floor.runs) == 2, "its bootloader may sit there, and say nothing"


def test_a_unit_that_is_switched_off_and_on_is_known_by_its_number(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(*pair(("W1", "W2")))
    floor.scan("W1")
    floor.end_run("A")
    floor.go_on(2.0)
    floor.units["A"].put_in(floor.now)
    floor.go_on(2.0)
    assert floor.state("A") is SocketState.PASS


# -- units without an application -----------------------------------------------------------------


@each("sockets", ["A", "AB"])
def test_a_unit_in_its_bootloader_needs_the_card(recipe: LoadedRecipe, sockets: str) -> None:
    for is_first in (True, False):
        floor = Floor(recipe, sockets)
        if is_first:
            floor.put_all(Unit("W1", has_application=False))
            assert floor.text("A").endswith("SOCKET A.")
        floor.scan("W1")
        floor.go_on(3.0)  # a person needs a moment
        if not is_first:
            floor.put_all(Unit("W1", has_application=False))
        floor.go_on(4.0)
        assert floor.runs == []
        if floor.refused():
            assert floor.refused()[-1].code == "NOT_IDENTIFIED"
            assert floor.refused()[-1].remedy == "Scan SOCKET A, then the label."
            floor.scan("SOCKET A")
            floor.scan("W1")
        else:
            floor.scan("SOCKET A")
        assert floor.runs == [("W1", "A")]


def test_a_bootloader_that_goes_on_announcing_is_no_arrival(recipe: LoadedRecipe) -> None:
    floor = Floor(recipe)
    floor.put_all(Unit("W1", has_application=False), Unit("W2", has_application=False))
    floor.scan("SOCKET A")
    floor.go_on(10.0)
    assert floor.refused() == []
    floor.scan("SOCKET A")
    floor.change_places(0.3)
    assert floor.refused()[-1].code == "UNIT_CHANGED"
    floor.scan("W1")
    floor.scan("SOCKET B")
    floor.scan("W1")
    assert floor.runs == [("W1", "B")]


# -- anything in any order ------------------------------------------------------------------------


def steps(floor: Floor, chance: random.Random, count: int) -> Iterable[str]:
    """People at two sources, each with a socket and its unit, who are interrupted by each other,
    and change units at any time. Yields what each of them does.
    """
    units = {name: Unit(f"W{at + 1}") for at, name in enumerate(floor.names)}
    table: deque[Unit] = deque(Unit(f"W{at}") for at in range(5, 9))
    floor.put_all(*units.values())
    for _ in range(count):
        source, name = chance.choice((ONE, TWO)), chance.choice(floor.names)
        match chance.randrange(7):
            case 0 | 1 if name in floor.units and name not in floor.busy:
                # Who scans card and label does so for the unit that is in the socket.
                label = floor.units[name].label
                yield f"{source.name}: SOCKET {name}, {label}"
                floor.scan(f"SOCKET {name}", source)
                floor.go_on(chance.choice((0.0, 0.5)))
                if chance.random() < 0.4:
                    yield from exchange(floor, chance, table, name)
                    label = chance.choice((label, floor.units[name].label))
                floor.scan(label, source)
            case 2 if name not in floor.busy:
                yield from exchange(floor, chance, table, name)
            case 3 if name in floor.busy:
                yield f"the run in {name} ends"
                floor.end_run(name, chance.choice((RunState.PASS, RunState.FAIL)))
                floor.go_on(3.0)
                yield from exchange(floor, chance, table, name)
            case 4:
                yield f"{source.name}: SOCKET {name}"
                floor.scan(f"SOCKET {name}", source)
            case 5:
                yield f"{source.name}: CANCEL"
                floor.scan("CANCEL", source)
            case _:
                floor.go_on(chance.choice((0.5, 4.0, 16.0)))


def exchange(floor: Floor, chance: random.Random, table: deque[Unit], name: str) -> Iterable[str]:
    gap_s = chance.choice(GAPS_S)
    table.append(floor.units.pop(name))
    floor.go_on(gap_s)
    floor.put(table.popleft(), name)
    yield f"{floor.units[name].label} into {name} after {gap_s} s"
    floor.go_on(chance.choice((1.0, 3.0)))


@pytest.mark.slow
def test_no_run_is_begun_on_another_unit_and_nothing_blocks(recipe: LoadedRecipe) -> None:
    runs = 0
    seeds = sample(8, 30)
    for seed in range(seeds):
        floor, chance = Floor(recipe), random.Random(seed)
        story: list[str] = []
        try:
            story.extend(steps(floor, chance, 40))
            for name in tuple(floor.busy):
                floor.end_run(name, RunState.FAIL)
            floor.go_on(3.0)
            for source in (ONE, TWO):
                floor.scan("CANCEL", source)
            for name in floor.names:
                before = len(floor.runs)
                for text in (f"FREE {name}", f"SOCKET {name}", floor.units[name].label):
                    floor.scan(text)
                assert len(floor.runs) == before + 1, f"nothing works for {name}"
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}\n" + "\n".join(story[-20:])) from error
        runs += len(floor.runs)
    assert runs > 3 * seeds
