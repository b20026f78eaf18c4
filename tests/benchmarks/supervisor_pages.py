"""Times each page of the supervisor over the records of a plant, and what a station notices of it.

    python -m tests.benchmarks.supervisor_pages [--runs N]

The first run is a station's own, with its trace. The others are rows like its rows, written past
the station's rules, since 100,000 runs by its own operations take half an hour: 8 sockets, 40 lots,
three images, two months of three shifts, every ninth unit bad at first. Their audit rows
vouch for nothing, so the certificate is timed in records of its own, which a station made.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import sqlite3
import statistics
import tempfile
import threading
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final

from flasher.protocol.spec import BMS
from flasher.station.records.keys import Keeping
from flasher.station.records.model import AuditEvent, RunState, utc_text
from flasher.station.records.store import Store
from flasher.station.tally import DEFAULT_SHIFTS
from flasher.web.answers import AnswerProcesses, Question
from flasher.web.supervisor import open_supervisor, place_of
from tests.benchmarks.station_records import SERIAL_NUMBER, fill
from tests.station.factory import HEAD, SERIAL, Bench, make_recipe, target_table
from tests.web.answering import app_of, client_of

REPEATS: Final = 5
SOCKETS: Final = tuple("ABCDEFGH")
CODES: Final = ("NO_ANSWER", "REFUSED", "WRONG_HARDWARE", "TRANSFER_FAILED", "OTHER_VERSION")
STEPS: Final = (
    ("connect", 0.4), ("identify", 0.1), ("check", 0.2), ("flash", 9.0), ("write", 0.6),
    ("restart", 2.1), ("verify", 0.9), ("save", 0.05),
)  # fmt: skip
DAYS: Final = 60
RUNS_OF_CERTIFICATE: Final = 2000
TURNS: Final = 300
TURN_S: Final = 0.02
_Rows = dict[str, list[tuple[Any, ...]]]


def make_plant(folder: Path, runs: int) -> Bench:
    """Records of `runs` runs in `folder`."""
    bench = Bench(folder)
    bench.make(lot="L000")
    bench.store.close()
    with closing(sqlite3.connect(bench.path)) as connection:
        rules = "SELECT name, sql FROM sqlite_master WHERE type = 'trigger'"
        found = connection.execute(rules).fetchall()
        for name, _ in found:
            connection.execute(f"DROP TRIGGER {name}")
        _copy_runs(connection, runs)
        for _, statement in found:
            connection.execute(statement)
        connection.commit()
    return bench


class _Table:
    """Rows that are written past the rules, many at a time."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._columns: dict[str, tuple[str, ...]] = {}
        self._rows: _Rows = {}

    def add(self, table: str, **values: Any) -> None:
        self._columns.setdefault(table, tuple(values))
        self._rows.setdefault(table, []).append(tuple(values.values()))

    def write(self) -> None:
        for table, rows in self._rows.items():
            names = ", ".join(self._columns[table])
            marks = ", ".join("?" * len(self._columns[table]))
            self._connection.executemany(
                f"INSERT INTO {table} ({names}) VALUES ({marks})",  # noqa: S608  our own names
                rows,
            )
        self._rows.clear()


def _copy_runs(connection: sqlite3.Connection, runs: int) -> None:
    connection.row_factory = sqlite3.Row

    def last(table: str) -> dict[str, Any]:
        query = f"SELECT * FROM {table} ORDER BY id DESC LIMIT 1"  # noqa: S608  our own names
        return dict(connection.execute(query).fetchone())

    run, recipe, image, audit = (last(each) for each in ("run", "recipe", "artifact", "audit"))
    chance, made, part = random.Random(7), _Table(connection), recipe["part"]
    for other in range(1, len(SOCKETS)):
        made.add("socket", id=other + 1, station_id=1, name=SOCKETS[other])
    made.add("recipe", **{**recipe, "id": 2, "revision": "5", "sha256": "5" * 64})
    made.add("artifact", **{**image, "id": 2, "name": "next.bin", "sha256": "e" * 64})
    made.add("artifact", **{**image, "id": 3, "name": "pilot.bin", "sha256": "f" * 64})
    for lot in range(1, 40):
        made.add("lot", id=lot + 1, part=part, name=f"L{lot:03}")
    unit, was_bad = 1, False
    for run_id in range(2, runs + 1):
        if not was_bad:
            unit += 1
            made.add("unit", id=unit, part=part, serial=f"W{unit:07}")
        was_bad = not was_bad and chance.random() < 0.11
        share = run_id / runs
        at = datetime(2026, 4, 1, tzinfo=UTC) + timedelta(days=share * DAYS)
        took_s = sum(seconds for _, seconds in STEPS)
        made.add("run", **{
            **run, "id": run_id, "unit_id": unit, "socket_id": 1 + run_id % len(SOCKETS),
            "recipe_id": 1 + (share > 0.6), "lot_id": 1 + int(share * 39),
            "state": (RunState.FAIL if was_bad else RunState.PASS).value,
            "code": chance.choices(CODES, (50, 25, 12, 8, 5))[0] if was_bad else "OK",
            "begun_at": utc_text(at), "begun_monotonic_s": run_id * 20.0,
            "ended_at": utc_text(at + timedelta(seconds=took_s)),
            "ended_monotonic_s": run_id * 20.0 + took_s, "log_sha256": f"{run_id:064x}",
            "verification_reached": None if was_bad else 1,
        })  # fmt: skip
        image_id = 3 if run_id % 2000 == 0 else 1 + (share > 0.6)
        made.add("run_target", run_id=run_id, artifact_id=image_id, position=0, target="bms",
                 required=1, reached=None if was_bad else 1)  # fmt: skip
        _parts_of_run(made, run_id, utc_text(at), chance, was_bad=was_bad)
        for event in ("claimed", "finished"):
            number = audit["number"] + 2 * run_id + (event == "finished")
            made.add("audit", **{
                **audit, "id": number + 10, "number": number, "at": utc_text(at), "event": event,
                "run_id": run_id, "hash": f"{number:064x}", "previous_hash": f"{number - 1:064x}",
            })  # fmt: skip
        if run_id % 5000 == 0:
            made.write()
    made.write()


def _parts_of_run(
    made: _Table, run_id: int, at: str, chance: random.Random, *, was_bad: bool
) -> None:
    for position, (name, seconds) in enumerate(STEPS):
        step_id = run_id * 10 + position
        failed = was_bad and position == len(STEPS) - 2
        made.add("step", id=step_id, run_id=run_id, position=position, name=name, try_number=1,
                 state="FAIL" if failed else "PASS", code="", text="", begun_at=at,
                 begun_monotonic_s=0.0, duration_s=seconds * chance.lognormvariate(0, 0.2),
                 )  # fmt: skip
        if position in (1, 2, 6):
            made.add("measurement", step_id=step_id, name="voltage", value=36.2, unit="V", low=30.0,
                     high=42.0, text=None, expected=None)  # fmt: skip
    for what in ("flash", "serial-number"):
        made.add("device_write", run_id=run_id, target="bms", what=what, value="V1", intended_at=at,
                 intended_monotonic_s=0.0, read_back=None,
                 verified_at=None if was_bad and what == "flash" else at)  # fmt: skip
    made.add("attachment", run_id=run_id, kind="trace", name="t.log.gz", sha256=f"{run_id:064x}",
             size_bytes=900)  # fmt: skip


def pages_of(image: str, serial: str) -> tuple[str, ...]:
    """What is asked for, the usual first."""
    return (
        "/runs", "/runs?search=4321", "/runs?lot=L005&outcome=FAIL", "/runs?part=BAT-36",
        "/runs?code=NOWHERE", "/runs?before=1000", f"/units?serial={serial}", "/runs/1/trace",
        "/images", f"/images?sha256={image}", "/images?image=pilot", f"/images.csv?sha256={image}",
        "/yield", "/yield?by=lot", "/yield?by=shift", "/yield?from=2026-04-01",
        "/times", "/times?from=2026-04-01", "/audit", "/audit?event=begun",
        "/runs.csv?lot=L005", "/runs.csv", "/runs.json", "/runs.xml",
    )  # fmt: skip


def measure_pages(bench: Bench) -> None:
    client = client_of(app_of(bench.path, bench.keys))
    image = bench.recipe.targets[0].image.sha256
    for path in pages_of(image, SERIAL):
        taken_s = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            answer = client.get(path)
            taken_s.append(time.perf_counter() - began)
            if answer.status_code != 200:
                raise SystemExit(f"{path}: {answer.status_code}\n{answer.text}")
        shown = path if len(path) < 40 else f"{path[:37]}..."
        print(
            f"  {shown:<40} {statistics.median(taken_s) * 1000:7.0f} ms,"
            f" longest {max(taken_s) * 1000:.0f}, {len(answer.content) / 1000:.0f} kB"
        )


def measure_certificate(folder: Path, runs: int) -> None:
    """In records that hold together: the whole audit trail is gone through."""
    folder.mkdir()
    bench = Bench(folder)
    bench.recipe = make_recipe(folder, HEAD + SERIAL_NUMBER + target_table(BMS))
    fill(bench, runs)
    bench.store.close()
    client = client_of(app_of(bench.path, bench.keys))
    began = time.perf_counter()
    answer = client.get("/units/certificate?serial=W0000017")
    if answer.status_code != 200:
        raise SystemExit(answer.text)
    print(f"  certificate in records of {runs} runs    {time.perf_counter() - began:7.2f} s")


def measure_station(bench: Bench) -> None:
    """A station that records, alone and while two desks ask for pages without a pause."""
    store = Store.open(
        str(bench.path), station="line-2", clock=bench.clock, keeping=Keeping(bench.keys)
    )
    answering = AnswerProcesses(partial(open_supervisor, *place_of(store), DEFAULT_SHIFTS))
    with closing(store), closing(answering):
        store.recover()
        _commits(store, "alone")
        ended = threading.Event()
        asking = threading.Thread(target=lambda: asyncio.run(_ask(answering, ended)))
        asking.start()
        time.sleep(5.0)  # the processes have begun
        _commits(store, "while pages are asked for")
        ended.set()
        asking.join()


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


async def _ask(answering: AnswerProcesses, ended: threading.Event) -> None:
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
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        began = time.perf_counter()
        plant = folder / "plant"
        plant.mkdir()
        bench = make_plant(plant, options.runs)
        print(f"  {options.runs} runs made in {time.perf_counter() - began:.0f} s")
        measure_pages(bench)
        measure_station(bench)
        measure_certificate(folder / "certificate", RUNS_OF_CERTIFICATE)


if __name__ == "__main__":
    main()
