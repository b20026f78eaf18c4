"""Thousands of steps of a line with units that sleep, processes that die and a careless operator;
and the same steps with faults put into the line, each of which they have to find.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from flasher.station import line, scans
from flasher.station.events import SocketChanged
from flasher.station.line import Line
from flasher.station.messages import AdapterReady, PresenceChanged
from flasher.station.records.model import Admission, Order, RunResult, RunState
from flasher.station.socket import Binding, Occupancy, Socket, SocketPhase, Source
from tests.loops import each, sample
from tests.station.line_inputs import saved
from tests.station.line_world import Walk, World

pytestmark = pytest.mark.slow

STEPS = 100
Plant = Callable[[pytest.MonkeyPatch], None]


def walks(
    sockets: tuple[str, ...], steps: int, *, asks_plant: bool = False, first: int = 0
) -> Counter[str]:
    """Walk; what was seen. Raises AssertionError with the way to what must not be."""
    seen: Counter[str] = Counter()
    for seed in range(first, first + steps // STEPS):
        world = World(seed, sockets, asks_plant=asks_plant)
        try:
            Walk(world).go(STEPS)
        except AssertionError as error:
            story = "\n".join(world.story[-40:])
            raise AssertionError(f"seed {seed}: {error}\n{story}") from error
        seen += world.seen
    return seen


@each("sockets", [("A",), ("A", "B", "C")])
def test_no_label_runs_on_another_unit_and_nothing_blocks(sockets: tuple[str, ...]) -> None:
    steps = sample(3_000, 10_000)
    seen = walks(sockets, steps)
    assert seen["run"] > steps / 10
    if len(sockets) > 1:
        ways = ("named", "card", "reported by the unit")
        assert all(seen[way] > steps / 500 for way in ways), seen


def test_a_unit_that_is_exchanged_while_the_plant_is_asked_is_not_run() -> None:
    steps = sample(2_000, 5_000)
    assert walks(("A", "B", "C"), steps, asks_plant=True)["run"] > 0.06 * steps


def test_a_line_that_does_not_look_again_after_the_answer_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def answered(self: Line, order: Order, admission: Admission, now: float) -> None:
        socket = self.sockets[order.socket]
        socket.asked = ""
        if socket.phase is SocketPhase.REST and socket.can_work:
            socket.label = order.serial
            self._begin(socket, admission)
        self._go_on(now)

    monkeypatch.setattr(Line, "answered", answered)
    with pytest.raises(AssertionError, match="runs on the unit of"):
        walks(("A", "B", "C"), 5_000, asks_plant=True)


# -- faults that the steps have to find -----------------------------------------------------------


def handle(
    patch: pytest.MonkeyPatch, phase: SocketPhase, what: type, handler: Callable[..., None]
) -> None:
    """Put another handler into the line's table."""
    patch.setitem(Line._TABLE, phase, {**Line._TABLE[phase], what: handler})


def forget_a_removal(patch: pytest.MonkeyPatch) -> None:
    def unit(self: Line, socket: Socket, what: PresenceChanged, now: float) -> None:
        if what.is_there:
            Line._unit(self, socket, what, now)

    handle(patch, SocketPhase.REST, PresenceChanged, unit)


def show_pass_before_it_is_saved(patch: pytest.MonkeyPatch) -> None:
    def ended(self: Line, socket: Socket, what: Any, now: float) -> None:
        Line._ended(self, socket, what, now)
        Line._saved(self, socket, saved(socket.name, RunState.PASS, ""), now)
        socket.shown = socket.view(None, is_only=False)
        self._emit(SocketChanged(socket.name, *socket.shown))
        socket.phase = SocketPhase.SAVE

    handle(patch, SocketPhase.RUN, RunResult, ended)


def take_silence_for_an_empty_socket(patch: pytest.MonkeyPatch) -> None:
    real = Socket.fall_silent

    def fall_silent(self: Socket, *, is_certain: bool) -> bool:
        was_there = real(self, is_certain=is_certain)
        self.occupancy = Occupancy.EMPTY
        return was_there

    def ready(self: Line, socket: Socket, what: AdapterReady, now: float) -> None:
        was_last_there = socket.is_last_there  # else its unit has to say who it is, which helps
        Line._ready(self, socket, what, now)
        socket.is_last_there = was_last_there

    patch.setattr(Socket, "fall_silent", fall_silent)
    handle(patch, SocketPhase.REST, AdapterReady, ready)


def name_a_socket_of_which_nothing_is_known(patch: pytest.MonkeyPatch) -> None:
    def place(sockets: scans.Sockets, serial: str, source: Source) -> tuple[Socket, Binding] | None:
        try:
            found = scans.place(sockets, serial, source)
        except scans.Refused:
            found = None
        free = (e for e in sockets.values() if e.can_work and e.phase is SocketPhase.REST)
        unknown = next(
            (e for e in free if e.occupancy is not Occupancy.THERE and not e.label), None
        )
        return found or (None if unknown is None else (unknown, Binding.PROMPTED))

    patch.setattr(line, "place", place)


def take_who_wakes_for_the_unit_that_passed(patch: pytest.MonkeyPatch) -> None:
    real = Socket._is_new

    def is_new(self: Socket, before: Occupancy) -> bool:
        was_there = self.is_last_there
        found = real(self, before)
        self.is_last_there = was_there or self.is_last_there
        return found

    patch.setattr(Socket, "_is_new", is_new)


def keep_a_label_over_the_death_of_its_process(patch: pytest.MonkeyPatch) -> None:
    def drop(self: Line, socket: Socket, *_: object) -> None:
        if self.stopped is not None:
            socket.label = ""

    patch.setattr(Line, "_drop_label", drop)


def never_resume(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Line, "resumed", lambda *_, **__: None)


@pytest.mark.parametrize(
    ("plant", "first"),
    [
        (forget_a_removal, 2),
        (show_pass_before_it_is_saved, 0),
        (take_silence_for_an_empty_socket, 58),
        (name_a_socket_of_which_nothing_is_known, 0),
        (take_who_wakes_for_the_unit_that_passed, 6),
        (keep_a_label_over_the_death_of_its_process, 310),
        (never_resume, 4),
    ],
)
def test_a_fault_in_the_line_is_found(
    plant: Plant, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first walk on that finds it today: those before it take seconds."""
    plant(monkeypatch)
    with pytest.raises((AssertionError, KeyError)):
        walks(("A", "B", "C"), 50_000, first=sample(first, 0))
