"""A plant is asked before a run begins, and the unit may change meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from flasher.cli.station.records import certificate
from flasher.station.certificate_check import check_certificate
from flasher.station.events import OperatorPrompted, RunEnded, ScanRefused, SocketState
from flasher.station.gate import Gate
from flasher.station.label_printer import LabelPrinter
from flasher.station.recipe_offers import Offers
from flasher.station.records.errors import Refusal
from flasher.station.records.model import (
    RELEASED_MARK,
    Answer,
    AuditEvent,
    Elsewhere,
    ElsewhereState,
    RunState,
    StepState,
)
from tests.station.factory import SERIAL, USUAL, Bench
from tests.station.line_bench import LineBench
from tests.station.test_gate import _Claims, _Question

THERE = "2026-05-17T08:00:00.000000Z"


class Plant:
    """A station whose plant answers when the test says so."""

    def __init__(
        self,
        bench: Bench,
        *,
        question: bool = False,
        needs_golden: bool = False,
        labels: LabelPrinter | None = None,
    ) -> None:
        self.claims, self.question = _Claims(), _Question()
        self.threads: list[Callable[[], None]] = []
        gate = Gate(
            bench.recipe.recipe,
            self.claims,
            self.question if question else None,  # type: ignore[arg-type]
            bench.clock.monotonic_s,
            start=self.threads.append,
        )
        self.line = LineBench(bench, gate=gate, needs_golden=needs_golden, labels=labels)

    def answer(self) -> None:
        self.threads.pop(0)()
        self.line.turn()

    def scan(self) -> None:
        self.line.scan(SERIAL)
        self.line.arrive("A")


@pytest.fixture
def plant(bench: Bench) -> Plant:
    return Plant(bench)


def test_the_run_begins_with_the_answer_which_is_recorded(plant: Plant) -> None:
    plant.scan()
    line = plant.line
    assert line.state("A") is SocketState.STARTING
    assert line.text("A") == "The plant is asked about this unit."
    plant.answer()
    assert line.state("A") is SocketState.RUNNING
    line.work("A")
    line.end("A")
    ended = line.last(RunEnded)
    assert ended.action == "Take the unit out."
    details = line.bench.store.read.run(ended.run.run_id)
    step = details.steps[0]
    assert (step.name, step.state, details.run.duplicates) == ("plant", StepState.PASS, "checked")
    names = [each.name for each in step.measurements]
    assert names == ["duplicates", "plant claim", "clock offset"]
    assert step.measurements[1].text == plant.claims.asked[0]
    assert line.bench.store.examine().problems == ()
    (row,) = line.bench.store.read.table()
    assert row.duplicates == "checked"


def test_without_an_answer_the_pass_is_marked_everywhere(plant: Plant) -> None:
    plant.scan()
    plant.line.bench.clock.go_on(4.0)
    plant.line.turn()
    plant.line.work("A")
    plant.line.end("A")
    ended = plant.line.last(RunEnded)
    assert ended.run.text == "bms: version read back; duplicates not checked"
    assert ended.action.startswith("Put it aside")
    assert plant.line.text("A") == ended.action
    details = plant.line.bench.store.read.run(ended.run.run_id)
    assert (details.run.state, details.run.text) == (RunState.PASS, ended.run.text)
    assert details.run.duplicates == "not checked: no answer within 3 s"
    assert details.steps[0].state is StepState.SKIPPED
    assert plant.line.bench.store.examine().problems == ()


@pytest.mark.slow
def test_a_run_whose_claim_the_plant_released_is_marked_in_the_records(plant: Plant) -> None:
    plant.scan()
    plant.answer()
    plant.line.work("A")
    plant.line.end("A")
    store, run_id = plant.line.bench.store, plant.line.last(RunEnded).run.run_id
    life = store.read.unit(SERIAL)
    before = certificate(store, life)
    assert not check_certificate(store, before).problems
    for _ in range(2):
        plant.claims.runs_released = {run_id}
        plant.line.turn()
    assert len(store.read.noted("line-2", AuditEvent.CLAIM_RELEASED)) == 1
    assert store.read.table()[0].duplicates == RELEASED_MARK
    assert store.examine().problems == ()
    assert "not checked whether it has passed at another station" not in before.decode()
    made = certificate(store, life)
    assert "not checked whether it has passed at another station" in made.decode()
    assert not check_certificate(store, made).problems
    (problem,) = check_certificate(store, before).problems
    assert "may have passed at another station" in problem


def test_a_unit_that_runs_elsewhere_is_refused_by_name(plant: Plant) -> None:
    plant.claims.answer = Elsewhere(ElsewhereState.RUNNING, "line-3", "B", THERE)
    plant.scan()
    plant.answer()
    refused = plant.line.last(ScanRefused)
    assert refused.code == Refusal.UNIT_RUNNING
    assert refused.reason == f"{SERIAL} is running on socket B of line-3."
    assert plant.line.state("A") is SocketState.SCAN
    assert plant.claims.released == plant.claims.asked


def test_a_unit_that_has_to_wait_for_a_golden_one_is_free_for_other_stations(
    bench: Bench,
) -> None:
    bench.use(USUAL + '\n[golden]\nserial_numbers = ["W2605000"]\nevery_h = 100\n')
    plant = Plant(bench, needs_golden=True)
    plant.scan()
    plant.answer()
    assert plant.line.last(ScanRefused).code == "GOLDEN_DUE"
    assert plant.claims.released == plant.claims.asked


def test_a_unit_of_a_withdrawn_recipe_is_free_for_other_stations(plant: Plant) -> None:
    station = plant.line.station
    station.recipes["A"] = replace(station.recipes["A"], digest="0" * 64)
    station.offer(Offers((), frozenset({"0" * 64})))
    plant.scan()
    plant.answer()
    assert plant.line.last(ScanRefused).code == Refusal.RECIPE_WITHDRAWN
    assert plant.claims.released == plant.claims.asked


def test_a_unit_that_leaves_while_the_plant_is_asked_is_not_begun(plant: Plant) -> None:
    plant.scan()
    plant.line.leave("A")
    plant.answer()
    assert plant.claims.released == plant.claims.asked
    assert plant.line.of(ScanRefused)
    assert not plant.line.station.is_running
    plant.line.scan(SERIAL)  # it is asked about anew
    plant.line.arrive("B")
    plant.answer()
    assert plant.line.state("B") is SocketState.RUNNING


def test_a_label_that_is_cancelled_while_the_plant_is_asked_is_not_begun(plant: Plant) -> None:
    plant.scan()
    plant.line.scan("CANCEL")
    plant.answer()
    assert plant.line.state("A") is SocketState.SCAN
    assert plant.claims.released == plant.claims.asked


def test_another_label_during_the_question_waits_for_its_own_answer(plant: Plant) -> None:
    plant.scan()
    plant.line.scan("SOCKET A")
    plant.line.scan("W2605003")
    plant.answer()
    assert plant.line.state("A") is SocketState.STARTING
    plant.answer()
    assert plant.line.order("A").serial == "W2605003"


def test_who_scans_again_while_the_plant_is_asked_learns_it(plant: Plant) -> None:
    plant.scan()
    plant.line.bench.clock.go_on(3.0)
    plant.line.scan(SERIAL)
    assert plant.line.last(ScanRefused).remedy == "The plant is asked about this unit."
    plant.answer()
    assert plant.line.state("A") is SocketState.RUNNING


def test_a_line_that_stops_meanwhile_begins_nothing(plant: Plant) -> None:
    plant.scan()
    plant.line.station.line.stop("TEST", "stopped", "go on")
    plant.answer()
    assert plant.claims.released == plant.claims.asked
    assert plant.line.state("A") is SocketState.STOPPED


def test_what_is_asked_at_the_end_of_the_station_is_released(plant: Plant) -> None:
    plant.scan()
    plant.line.station.close()
    assert len(plant.claims.released) == 1


def test_no_is_refused_with_its_reason(bench: Bench) -> None:
    plant = Plant(bench, question=True)
    plant.question.answer = Answer(may_begin=False, text="no: its test is missing")
    plant.scan()
    plant.answer()
    refused = plant.line.last(ScanRefused)
    assert refused.code == Refusal.PLANT_REFUSED
    assert refused.reason == "The plant: no: its test is missing."


def test_yes_with_a_reason_is_shown_and_recorded(bench: Bench) -> None:
    plant = Plant(bench, question=True)
    plant.question.answer = Answer(may_begin=True, text="yes: rework")
    plant.scan()
    plant.answer()
    assert plant.line.last(OperatorPrompted).text == "The plant: yes: rework."
    run = plant.line.order("A").run_id
    (step,) = plant.line.bench.store.read.run(run).steps
    assert ("plant answer", "yes: rework") in [(m.name, m.text) for m in step.measurements]


@pytest.mark.parametrize(("offset_s", "word"), [(3.0, "+3.0 s"), (-2.5, "-2.5 s")])
def test_a_clock_beyond_the_limit_stops(bench: Bench, offset_s: float, word: str) -> None:
    bench.use(USUAL + '\n[plant]\nclock = "stop"\nclock_offset_max_s = 2.0\n')
    plant = Plant(bench)
    plant.claims.clock_offset_s = lambda: offset_s  # type: ignore[method-assign]
    plant.scan()
    plant.answer()
    refused = plant.line.last(ScanRefused)
    assert refused.code == Refusal.CLOCK_OFFSET
    assert word in refused.reason


@pytest.mark.parametrize(("rule", "begins"), [("block", False), ("allow", True)])
def test_the_recipe_decides_what_an_unknown_clock_means(
    bench: Bench, rule: str, begins: bool
) -> None:
    bench.use(USUAL + f'\n[plant]\nclock = "stop"\nclock_unknown = "{rule}"\n')
    plant = Plant(bench)
    plant.claims.clock_offset_s = lambda: None  # type: ignore[method-assign]
    plant.scan()
    plant.answer()
    assert (plant.line.state("A") is SocketState.RUNNING) == begins


def test_a_clock_at_its_limit_is_good(bench: Bench) -> None:
    bench.use(USUAL + '\n[plant]\nclock = "stop"\nclock_offset_max_s = 2.0\n')
    plant = Plant(bench)
    plant.claims.clock_offset_s = lambda: -2.0  # type: ignore[method-assign]
    plant.scan()
    plant.answer()
    assert plant.line.state("A") is SocketState.RUNNING
