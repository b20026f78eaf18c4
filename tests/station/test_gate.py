"""The gate answers within its time limit, whatever the plant does."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from flasher.station.gate import HUNG_MAX, Gate
from flasher.station.records.errors import RecordError
from flasher.station.records.model import (
    Admission,
    Answer,
    Elsewhere,
    ElsewhereState,
    Order,
    RunId,
)
from tests.station.factory import FakeClock

ORDER = Order("W2605002", "A", "jo")
OTHER = Elsewhere(ElsewhereState.PASSED, "line-3", "B", "2026-05-17T09:00:00.000000Z", 7)


class _Claims:
    def __init__(self) -> None:
        self.answer: Elsewhere | RecordError | None = None
        self.asked: list[str] = []
        self.released: list[str] = []
        self.runs_released: set[RunId] = set()

    def claim(self, token: str, order: Order, part: str) -> Elsewhere | None:
        self.asked.append(token)
        if isinstance(self.answer, RecordError):
            raise self.answer
        return self.answer

    def clock_offset_s(self) -> float | None:
        return 0.25

    def ended(self, token: str) -> None:
        pass

    def dropped(self, token: str) -> None:
        self.released.append(token)

    def take_released(self) -> set[RunId]:
        found, self.runs_released = self.runs_released, set()
        return found

    def close(self) -> None:
        pass


class _Question:
    time_limit_s = 2.0

    def __init__(self) -> None:
        self.answer = Answer(may_begin=True, text="yes")

    def ask(self, _order: Order, _recipe: object) -> Answer:
        return self.answer

    def silence(self) -> Answer:
        return Answer(may_begin=False, text="no answer", is_answered=False)


class World:
    def __init__(self, *, claims: bool = True, question: bool = False) -> None:
        self.clock = FakeClock()
        self.threads: list[Callable[[], None]] = []
        self.claims, self.question = _Claims(), _Question()
        self.woken = 0
        recipe: Any = SimpleNamespace(
            part="BAT-36",
            golden=SimpleNamespace(serial_numbers=("W2605001",)),
            plant=SimpleNamespace(time_limit_s=3.0),
        )
        self.gate = Gate(
            recipe,
            self.claims if claims else None,
            self.question if question else None,  # type: ignore[arg-type]
            self.clock.monotonic_s,
            start=self.threads.append,
        )
        self.gate.wake = self._wake

    def _wake(self) -> None:
        self.woken += 1

    def work(self) -> None:
        while self.threads:
            self.threads.pop(0)()

    def taken(self) -> list[Admission]:
        return [admission for _, admission in self.gate.take()]


def test_an_answer_is_taken_when_it_is_there() -> None:
    world = World()
    world.claims.answer = OTHER
    world.gate.ask(ORDER)
    assert world.taken() == []
    world.clock.go_on(1.0)
    world.work()
    assert world.woken == 1
    (admission,) = world.taken()
    assert (admission.elsewhere, admission.unchecked) == (OTHER, "")
    assert (admission.clock_offset_s, admission.duration_s) == (0.25, 1.0)
    assert world.taken() == []


def test_no_answer_within_the_limit_is_an_answer_and_a_late_claim_is_released() -> None:
    world = World()
    world.gate.ask(ORDER)
    late = world.threads.pop()
    world.clock.go_on(3.4)
    assert world.taken() == []
    world.clock.go_on(0.2)
    (admission,) = world.taken()
    assert admission.doubt == "no answer within 3 s"
    late()
    assert world.taken() == []
    assert not world.claims.asked  # it is not even asked for any more


def test_a_claim_that_is_granted_after_the_limit_is_released() -> None:
    world = World()
    world.gate.ask(ORDER)

    def granted(token: str, _order: Order, _part: str) -> None:
        world.clock.go_on(4.0)
        assert world.taken()[0].doubt
        world.claims.asked.append(token)

    world.claims.claim = granted  # type: ignore[assignment]
    world.work()
    assert world.claims.released == world.claims.asked != []


def test_a_fault_is_the_reason() -> None:
    world = World()
    world.claims.answer = RecordError("The server is away.", cause="refused")
    world.gate.ask(ORDER)
    world.work()
    assert world.taken()[0].doubt == "The server is away"


def test_a_bug_in_a_thread_is_an_answer_too() -> None:
    world = World()
    world.claims.claim = lambda *_: 1 / 0  # type: ignore[assignment,method-assign]
    world.gate.ask(ORDER)
    world.work()
    assert world.taken()[0].doubt


def test_a_unit_that_may_not_be_here_is_not_claimed() -> None:
    world = World(question=True)
    world.question.answer = Answer(may_begin=False, text="no: its test is missing")
    world.gate.ask(ORDER)
    world.work()
    (admission,) = world.taken()
    assert admission.answer == world.question.answer
    assert not world.claims.asked


def test_a_question_that_hangs_is_silence() -> None:
    world = World(claims=False, question=True)
    world.gate.ask(ORDER)
    world.clock.go_on(2.6)
    (admission,) = world.taken()
    assert admission.answer == world.question.silence()
    assert (admission.claim, admission.doubt) == ("", "")


def test_a_golden_unit_is_not_asked_about() -> None:
    world = World(question=True)
    world.gate.ask(Order("W2605001", "A", "jo"))
    (admission,) = world.taken()
    assert (admission.claim, admission.answer) == ("", None)
    assert not world.threads


def test_hung_threads_do_not_grow_in_number() -> None:
    world = World()
    for _ in range(HUNG_MAX + 5):
        world.gate.ask(ORDER)
        world.clock.go_on(4.0)
        assert len(world.taken()) == 1
    assert len(world.threads) == HUNG_MAX
    world.work()
    world.gate.ask(ORDER)
    world.work()
    assert not world.taken()[0].doubt


def test_what_no_one_waits_for_is_released_at_the_end() -> None:
    world = World()
    world.gate.ask(ORDER)
    world.gate.close()
    assert len(world.claims.released) == 1


@pytest.mark.parametrize("claims", [False, True])
def test_an_admission_without_a_claim_releases_nothing(claims: bool) -> None:
    world = World(claims=claims)
    world.gate.dropped(None)
    world.gate.dropped(Admission())
    world.gate.ended(Admission())
    assert not world.claims.released
