"""Times what a plant asks of the records of many runs, and what a station notices of it: pages of
the supervisor, the certificate, the report of a day, the commit of a run.

    python -m tests.benchmarks.supervisor_pages [--runs N] [--traces N] [--keep FOLDER]

`cold`: records opened anew, and nothing of them in the computer's memory. `warm`: asked once more;
`CPU`: of that, the work of this process. The records are made in bulk (`bulk_records`); with --keep
they stay in FOLDER, and are used again from there.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import statistics
import tempfile
import threading
import time
from contextlib import closing
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Final

from flasher.protocol.spec import BMS
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.errors import ClaimRefusedError
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    AuditEvent,
    Order,
    RunFilter,
    RunId,
    RunResult,
    RunState,
    StepState,
    Verified,
)
from flasher.station.records.overview import Overview
from flasher.station.records.rollup import Rollup
from flasher.station.records.store import Store
from flasher.station.reports import Report
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.query_processes import RUN, QueryProcesses, Question
from flasher.web.supervisor import PAGES, open_supervisor, place_of
from tests.benchmarks import bulk_records
from tests.benchmarks.bulk_records import FIRST_DAY, RUNS_A_DAY
from tests.station.factory import BMS_VERSION, IMAGES, USUAL, Bench, FakeClock, make_recipe
from tests.station.traces import run_messages, write_trace

TURNS: Final = 300
TURN_S: Final = 0.02
RUNS_MADE: Final = 40


@dataclass
class Plant:
    """Records of many runs."""

    folder: Path
    runs: int
    is_filled: bool = field(init=False)

    def __post_init__(self) -> None:
        self.is_filled = self.files.exists()

    def fill(self, traces: int) -> None:
        bench = Bench(self.folder)
        bench.make(lot="L000")
        bulk_records.fill(bench, self.runs, traces)
        bench.store.close()

    def open(self, *, read_only: bool = True, clock: FakeClock | None = None) -> Store:
        return Store.open(
            self.url, station="line-2", folder=self.files, read_only=read_only, clock=clock,
            key_locations=KeyLocations(self.folder / "keys"),
        )  # fmt: skip

    @property
    def files(self) -> Path:
        return self.folder / "records.sqlite.files"

    @property
    def url(self) -> str:
        return str(self.folder / "records.sqlite")

    def cool(self) -> None:
        """Let the computer forget what it holds of the records."""
        for path in self.folder.rglob("*"):
            if path.is_file():
                handle = os.open(path, os.O_RDONLY)
                os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
                os.close(handle)


def questions_of(plant: Plant) -> list[tuple[str, Question]]:
    """What is asked for, the usual first."""
    runs = plant.runs
    last = FIRST_DAY + timedelta(days=runs / RUNS_A_DAY)
    a_day = {
        "from": f"{last - timedelta(days=9):%Y-%m-%d}",
        "to": f"{last - timedelta(days=8):%Y-%m-%d}",
    }
    image = {"sha256": "2" * 64}
    lot = f"L{runs // 2 // bulk_records.RUNS_A_LOT:03}"
    serial = _serial(plant)
    asked: list[tuple[str, dict[str, str]]] = [
        ("/runs", {}),
        ("/runs", {"before": str(runs // 2)}),
        ("/runs", {"search": serial[-5:]}),
        ("/runs", {"search": "nowhere"}),
        ("/runs", {"lot": lot, "outcome": "FAIL"}),
        ("/runs", {"outcome": "FAIL"}),
        ("/runs", {"outcome": "ABORTED"}),
        ("/runs", {"part": "BAT-36"}),
        ("/runs", {"code": "NOWHERE"}),
        ("/runs", {"code": "OTHER_VERSION"}),
        ("/runs", {"socket": "C"}),
        ("/runs", {"recipe": "Battery 36 V"}),
        ("/runs", a_day),
        ("/runs", {"to": f"{FIRST_DAY + timedelta(days=3):%Y-%m-%d}"}),
        ("/units", {"serial": serial}),
        ("/images", {}),
        ("/images", image),
        ("/images", {"image": "pilot"}),
        ("/yield", {}),
        ("/yield", {"by": "lot"}),
        ("/yield", {"by": "shift"}),
        ("/yield", {"lot": lot}),
        ("/yield", {"socket": "C"}),
        ("/times", {}),
        ("/times", {"lot": lot}),
        ("/audit", {}),
        ("/audit", {"event": "begun"}),
        ("/audit", {"event": "finished"}),
        ("/audit", a_day),
        ("/runs.csv", a_day),
        ("/runs.json", a_day),
        ("/runs.xml", a_day),
        ("/runs.csv", {"lot": lot}),
        ("/units/certificate", {"serial": serial}),
        ("/yield", {"from": f"{FIRST_DAY:%Y-%m-%d}"}),
        ("/yield", {"from": f"{FIRST_DAY:%Y-%m-%d}", "by": "shift"}),
        ("/yield", {"from": f"{FIRST_DAY:%Y-%m-%d}", "by": "lot", "socket": "C"}),
        ("/yield", {"from": f"{FIRST_DAY + timedelta(days=7):%Y-%m-%d}T05:17"}),
        ("/times", {"from": f"{FIRST_DAY:%Y-%m-%d}"}),
        ("/times", {"from": f"{FIRST_DAY + timedelta(days=7):%Y-%m-%d}T05:17", "socket": "C"}),
        ("/images.csv", image),
    ]
    found = []
    for path, fields in asked:
        shown = path + (
            "?" + "&".join(f"{name}={value[:16]}" for name, value in fields.items())
            if fields
            else ""
        )
        found.append((shown, Question(path, fields)))
    found.insert(14, ("/runs/N/trace", Question(f"/runs/{RUN}/trace", run=runs - 1)))
    return found


def _serial(plant: Plant) -> str:
    with plant.open() as store:
        return store.read.run(RunId(plant.runs - 1)).run.serial


def measure_pages(plant: Plant, wanted: str) -> None:
    place = (plant.url, plant.files, KeyLocations(plant.folder / "keys"), DEFAULT_SHIFTS)
    questions = questions_of(plant)
    open_supervisor(*place).answer(questions[0][1])  # templates and statements are there
    for shown, question in questions:
        if wanted not in shown:
            continue
        plant.cool()
        began = time.perf_counter()
        supervisor = open_supervisor(*place)
        answer = PAGES[question.path](supervisor, question)
        cold_s = time.perf_counter() - began
        began, worked_s = time.perf_counter(), time.process_time()
        PAGES[question.path](supervisor, question)
        warm_s, cpu_s = time.perf_counter() - began, time.process_time() - worked_s
        supervisor.store.close()
        mark = "  !" if cold_s > 1.0 else ""
        print(
            f"  {shown:<44} cold {cold_s * 1000:7.0f} ms, warm {warm_s * 1000:6.0f} ms"
            f" (CPU {cpu_s * 1000:.0f}),"
            f" {len(answer.body) / 1000:6.0f} kB{mark}",
            flush=True,
        )


def measure_files(plant: Plant) -> None:
    """Files of everything, which are sent in parts."""
    place = (plant.url, plant.files, KeyLocations(plant.folder / "keys"), DEFAULT_SHIFTS)
    supervisor = open_supervisor(*place)
    for path, fields in (("/images.csv", {"sha256": "2" * 64}), ("/runs.csv", {})):
        parts_s: list[float] = []
        began, size, after = time.perf_counter(), 0, ""
        while after or not parts_s:
            part_began = time.perf_counter()
            answer = PAGES[path](
                supervisor, Question(path, fields | ({"after": after} if after else {}))
            )
            after, size = answer.after, size + len(answer.body)
            parts_s.append(time.perf_counter() - part_began)
        print(
            f"  {path}, all of it: {time.perf_counter() - began:.0f} s, {size / 1e6:.0f} MB,"
            f" {len(parts_s)} parts of at most {max(parts_s) * 1000:.0f} ms",
            flush=True,
        )
    supervisor.store.close()


def measure_sums(plant: Plant) -> None:
    """What a process of the pages does in the background: the sums of days, the first time all."""
    began, batches_s = time.perf_counter(), []
    with plant.open() as store:
        rollup = Rollup(store.database)
        has_more = True
        while has_more:
            batch_began = time.perf_counter()
            has_more = rollup.add(datetime.now(UTC) + timedelta(days=3650))
            batches_s.append(time.perf_counter() - batch_began)
    size = (plant.files / "figures.sqlite").stat().st_size
    print(
        f"  sums of all days made in {time.perf_counter() - began:.0f} s,"
        f" at once at most {max(batches_s):.1f} s; {size / 1e6:.0f} MB"
    )


def measure_report(plant: Plant) -> None:
    """`flasher station report` over a day."""
    end = FIRST_DAY + timedelta(days=plant.runs / RUNS_A_DAY - 3)
    plant.cool()
    began = time.perf_counter()
    with plant.open() as store:
        made = Report(store, RunFilter(since=end - timedelta(days=1), until=end))
        text = made.to_csv() + made.to_json() + made.to_junit()
    print(
        f"  report of a day, {len(made.runs)} runs {'':<12} cold"
        f" {(time.perf_counter() - began) * 1000:7.0f} ms, {len(text) / 1000:.0f} kB"
    )


def measure_station(plant: Plant) -> None:
    """A station that records: its start, whole runs, notes while two desks ask for pages."""
    plant.cool()
    with plant.open() as store:
        last = Overview(store.database).last_begin(RunFilter())
    assert last is not None
    clock = FakeClock(last + timedelta(hours=1))
    recipe = make_recipe(plant.folder, USUAL)
    began = time.perf_counter()
    store = plant.open(read_only=False, clock=clock)
    store.recover()
    print(f"  a station starts, cold {(time.perf_counter() - began) * 1000:7.0f} ms")
    answering = QueryProcesses(
        partial(open_supervisor, *place_of(store), DEFAULT_SHIFTS, keeps_sums=True)
    )
    with closing(store), closing(answering):
        _runs(store, clock, recipe, plant.folder)
        _commits(store, "alone")
        ended = threading.Event()
        asking = threading.Thread(target=lambda: asyncio.run(_ask(answering, ended)))
        asking.start()
        time.sleep(5.0)  # the processes have begun
        _commits(store, "while pages are asked for")
        ended.set()
        asking.join()


def _runs(store: Store, clock: FakeClock, recipe: LoadedRecipe, folder: Path) -> None:
    taken_ms: dict[str, list[float]] = {"claim": [], "finish": [], "whole run, 5 commits": []}
    for _ in range(RUNS_MADE):
        serial = f"W27{random.randrange(1, 51):02}{random.randrange(1000):03}"
        reported = run_messages(serial, BMS_VERSION, IMAGES[BMS])
        trace = write_trace(folder / "made.log.gz", reported)
        began = time.perf_counter()
        try:
            claim = store.claim(Order(serial, "A", "jo"), recipe)
        except ClaimRefusedError:
            continue  # this number was drawn before
        claimed = time.perf_counter()
        write = store.intent(claim.run_id, "bms", "flash", BMS_VERSION)
        store.verified(write, BMS_VERSION)
        store.step(claim.run_id, "flash", StepState.PASS, duration_s=8.0)
        file = store.files.add("trace", trace)
        ending = RunResult(
            RunState.PASS, "OK", "", 8.0, {"bms": Verified.VERSION}, file.sha256, [file]
        )
        worked = time.perf_counter()
        store.finish(claim.run_id, ending)
        ended = time.perf_counter()
        for name, value in zip(
            taken_ms, (claimed - began, ended - worked, ended - began), strict=True
        ):
            taken_ms[name].append(value * 1000)
        clock.go_on(20.0)
    for name, values in taken_ms.items():
        print(f"  {name:<28} {statistics.median(values):6.1f} ms, most {max(values):.1f}")


def _commits(store: Store, when: str) -> None:
    taken_s, late_s = [], []
    for _ in range(TURNS):
        began = time.perf_counter()
        time.sleep(TURN_S)
        late_s.append(time.perf_counter() - began - TURN_S)
        began = time.perf_counter()
        store.note(AuditEvent.OPERATOR, {"operator": "jo"})
        taken_s.append(time.perf_counter() - began)
    for name, values in (("a commit", taken_s), ("a turn is late by", late_s)):
        ranked = sorted(values)
        print(
            f"  {when:<28} {name:<18} {statistics.median(ranked) * 1000:6.1f} ms,"
            f" 99 % {ranked[int(len(ranked) * 0.99)] * 1000:.1f}, most {ranked[-1] * 1000:.1f}"
        )


async def _ask(answering: QueryProcesses, ended: threading.Event) -> None:
    asked = 0

    async def ask_on(paths: tuple[str, ...]) -> None:
        nonlocal asked
        while not ended.is_set():
            for path in paths:
                answer = await answering.ask(Question(path, {"search": "4321"}))
                asked += answer.status == 200

    began = time.perf_counter()
    await asyncio.gather(
        ask_on(("/runs", "/yield", "/times", "/images", "/audit")),
        ask_on(("/times", "/yield", "/audit", "/runs")),
    )
    print(f"  {asked} pages in {time.perf_counter() - began:.0f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--traces", type=int, default=1000, help="the last runs that have one")
    parser.add_argument("--keep", type=Path, help="make them in this folder, or use those in it")
    parser.add_argument("--files", action="store_true", help="whole files, too")
    parser.add_argument("--pages", default="", help="only pages with this in their address")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        plant = Plant(folder, options.runs)
        if not plant.is_filled:
            began = time.perf_counter()
            plant.fill(options.traces)
            os.sync()
            took_s = time.perf_counter() - began
            print(f"  {options.runs:,} runs made in {took_s:.0f} s", flush=True)
        measure_sums(plant)
        measure_pages(plant, options.pages)
        if options.files:
            measure_files(plant)
        measure_report(plant)
        measure_station(plant)


if __name__ == "__main__":
    main()
