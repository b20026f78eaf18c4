"""Records of many runs: what a line and a page ask for does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from flasher.station.records.model import Order, RunFilter, RunState
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from tests.benchmarks import bulk_records
from tests.benchmarks.bulk_records import FIRST_DAY, RUNS_A_DAY
from tests.station.factory import Bench

pytestmark = pytest.mark.slow

FEW, MANY = 300, 2400
GROWTH_MAX = 2.0
"""Eight times as many runs are no reason for twice the work; a walk through all is one."""


def large(folder: Path, runs: int) -> Bench:
    folder.mkdir()
    bench = Bench(folder)
    bench.make(lot="L000")
    bulk_records.fill(bench, runs, traces=5)
    bench.clock.now = FIRST_DAY + timedelta(days=runs / RUNS_A_DAY + 1)
    return bench


@pytest.fixture(scope="module")
def benches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Bench, Bench]]:
    folder = tmp_path_factory.mktemp("large")
    patch = pytest.MonkeyPatch()
    patch.setattr(bulk_records, "RUNS_A_LOT", 100)
    few, many = large(folder / "few", FEW), large(folder / "many", MANY)
    with closing(few.store), closing(many.store):
        patch.undo()
        yield few, many


def work_of(bench: Bench, action: Callable[[Bench], object]) -> int:
    """The steps of SQLite's machine that it takes."""
    steps = 0

    def count() -> None:
        nonlocal steps
        steps += 1

    def listen(connection: Any, *_: object) -> None:
        connection.set_progress_handler(count, 20)

    bench.store.database.close()
    event.listen(bench.store.database.engine, "connect", listen)
    action(bench)
    event.remove(bench.store.database.engine, "connect", listen)
    bench.store.database.close()
    return steps


def runs(**chosen: Any) -> Callable[[Bench], object]:
    return lambda bench: Overview(bench.store.database).runs(RunFilter(**chosen), PageCursor(), 10)


def claim(bench: Bench) -> None:
    serial = f"W27{bench._traces:05}"
    bench.traced(serial)
    bench.store.claim(Order(serial, "A", "jo"), bench.recipe)
    bench.store.end_unknown(())


def image_count(bench: Bench) -> int:
    return len(Overview(bench.store.database).holders("2" * 64, PageCursor(), 10).rows)


@pytest.mark.parametrize(
    "action",
    [
        pytest.param(claim, id="claim and end"),
        pytest.param(lambda bench: bench.store.signer.public, id="key"),
        pytest.param(lambda bench: bench.store.read.unit_kinds(), id="unit-kinds"),
        pytest.param(
            lambda bench: bench.store.read.known("BAT-36", ["W0000007", "W0000008"]), id="numbers"
        ),
        pytest.param(runs(), id="runs"),
        pytest.param(runs(state=RunState.ABORTED), id="runs aborted"),
        pytest.param(runs(code="NOWHERE"), id="runs with a code"),
        pytest.param(runs(lot="L000", code="NOWHERE"), id="runs of a lot with a code"),
        pytest.param(runs(socket="A", state=RunState.ABORTED), id="runs of a socket"),
        pytest.param(runs(recipe="Battery 36 V", part="BAT-36"), id="runs of a recipe"),
        pytest.param(runs(serial="W0000007"), id="runs of a unit"),
        pytest.param(runs(until=FIRST_DAY), id="first runs"),
        pytest.param(
            lambda bench: Overview(bench.store.database).audit(PageCursor(), event="begun"),
            id="audit",
        ),
        pytest.param(image_count, id="units with an image"),
        pytest.param(
            lambda bench: Overview(bench.store.database).last_begin(RunFilter(lot="L000")),
            id="last begin",
        ),
    ],
)
def test_the_work_does_not_grow_with_the_records(
    benches: tuple[Bench, Bench], action: Callable[[Bench], object]
) -> None:
    few, many = (work_of(bench, action) for bench in benches)
    assert many <= few * GROWTH_MAX + 30


def test_a_search_that_finds_many_and_one_that_finds_few_find_the_same_runs(
    benches: tuple[Bench, Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    from flasher.station.records import newest  # noqa: PLC0415

    overview = Overview(benches[0].store.database)
    for chosen in (RunFilter(search="w00000"), RunFilter(search="1", socket="B")):
        for cut in (PageCursor(), PageCursor(before=200), PageCursor(after=100)):
            found = []
            for units_max in (0, 5000):
                monkeypatch.setattr(newest, "_UNITS_MAX", units_max)
                page = overview.runs(chosen, cut, 7)
                found.append([row.run_id for row in page.rows])
            assert found[0] == found[1]
            assert len(found[0]) == 7


def test_every_filter_finds_what_a_report_finds(
    benches: tuple[Bench, Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    from flasher.station.records import newest  # noqa: PLC0415

    store = benches[0].store
    hour = timedelta(hours=1)
    filters = [
        {"lot": "L000"}, {"recipe": "Battery 36 V"}, {"part": "BAT-36"}, {"part": "nowhere"},
        {"state": RunState.FAIL}, {"code": "NO_ANSWER"}, {"socket": "C"},
        {"since": FIRST_DAY + hour}, {"until": FIRST_DAY + 2 * hour},
        {"since": FIRST_DAY + hour, "until": FIRST_DAY + 2 * hour, "state": RunState.FAIL},
        {"socket": "C", "state": RunState.FAIL, "since": FIRST_DAY},
        {"lot": "L000", "code": "NO_ANSWER", "recipe": "Battery 36 V"},
    ]  # fmt: skip
    for words in filters:
        chosen = RunFilter(**words)  # type: ignore[arg-type]
        wanted = [run.run_id for run in store.read.table(chosen)][::-1]
        for short, lead in ((20_000, 50), (0, 50), (0, 0)):
            monkeypatch.setattr(newest, "_SHORT", short)
            monkeypatch.setattr(newest, "_LEAD_MAX", lead)
            page = Overview(store.database).runs(chosen, PageCursor(), 10_000)
            assert [row.run_id for row in page.rows] == wanted


def test_bulk_records_are_as_a_station_writes_them(benches: tuple[Bench, Bench]) -> None:
    bench = benches[0]
    problems = bench.store.examine().problems
    assert {problem.what for problem in problems} == {"An attachment is missing."}
    assert len(problems) == FEW - 6
