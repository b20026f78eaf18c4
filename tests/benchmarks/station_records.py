"""Records of a plant: makes runs through the station's own operations, then times the reports.

    python -m tests.benchmarks.station_records [--runs N] [--keep FOLDER]

Filling is done without waiting for the disk (`synchronous` off, on this copy only); the time of one
durable run is measured apart, with the settings that a station has.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from flasher.cli.station.records import certificate
from flasher.documents import as_json
from flasher.protocol.spec import BMS
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    Measurement,
    RunFilter,
    RunResult,
    RunState,
    StepName,
    StepState,
    Verified,
)
from flasher.station.records.store import Store
from flasher.station.reports import Report
from tests.station.factory import BMS_VERSION, HEAD, Bench, make_recipe, target_table

SERIAL_NUMBER = """
[serial_number]
pattern = 'W(?P<number>[0-9]{7})'
example = "W0000001"
"""
REPEATS = 5
UNITS_PER_LOT = 500
BAD_EVERY = 17


def fill(bench: Bench, runs: int) -> None:
    """`runs` runs: every 17th unit fails first and passes then."""
    serial, bad = 0, False
    for _ in range(runs):
        if not bad:
            serial += 1
        bad = not bad and serial % BAD_EVERY == 0
        one_run(bench, f"W{serial:07d}", bad=bad)


def one_run(bench: Bench, serial: str, *, bad: bool) -> None:
    """A run with the steps, writes and measurements of a usual recipe."""
    store = bench.store
    lot = f"L{int(serial[1:]) // UNITS_PER_LOT:03d}"
    run_id = bench.claim(serial, lot=lot).run_id
    voltage = Measurement("voltage", 36.2, "V", 30.0, 42.0)
    for name in (StepName.CONNECT, StepName.IDENTIFY, StepName.CHECK):
        store.step(run_id, name, StepState.PASS, duration_s=0.3, measurements=[voltage])
    for what, value in (("flash", BMS_VERSION), ("user-string-1", serial)):
        write = store.intent(run_id, "bms", what, value)
        store.verified(write, value)
        store.step(run_id, what, StepState.PASS, duration_s=2.0)
    state = StepState.FAIL if bad else StepState.PASS
    store.step(run_id, StepName.VERIFY, state, duration_s=1.0)
    trace = bench.traced(serial)
    file = store.files.add("trace", trace)
    trace.unlink()
    verified = {} if bad else {"bms": Verified.VERSION}
    outcome, code = (RunState.FAIL, "VERSION") if bad else (RunState.PASS, "OK")
    store.finish(run_id, RunResult(outcome, code, "", 8.0, verified, file.sha256, [file]))


def timed(name: str, work: Callable[[], object]) -> None:
    """Print the median time of some repetitions."""
    taken_s = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        taken_s.append(time.perf_counter() - began)
    print(f"  {name:<34} {statistics.median(taken_s) * 1000:8.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--keep", type=Path, help="make it in this folder, and leave it there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        measure(options.keep or Path(temporary), options.runs)


def measure(folder: Path, runs: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(folder, lock_timeout_s=5.0)
    bench.recipe = make_recipe(folder, HEAD + SERIAL_NUMBER + target_table(BMS))
    fast = bench.store
    fast.close()
    key_locations = KeyLocations(bench.keys)
    with Store.open(
        str(bench.path), station="line-2", clock=bench.clock, key_locations=key_locations
    ) as bench.store:
        bench.store.recover()
        timed("one durable run of 12 commits", lambda: durable(bench))
    bench.store = fast
    bench.store.recover()
    began = time.perf_counter()
    fill(bench, runs)
    print(f"  {runs} runs made in {time.perf_counter() - began:.0f} s")
    bench.store.close()
    with Store.open(
        str(bench.path), station="report", read_only=True, key_locations=key_locations
    ) as store:
        records = store.read
        timed("figures of all runs", records.figures)
        timed("figures of one lot", lambda: records.figures(RunFilter(lot="L001")))
        timed("all runs", records.table)
        timed("report of all as CSV", lambda: Report(store, RunFilter()).to_csv())
        timed("report of all as JSON document", lambda: Report(store, RunFilter()).to_json())
        timed("report of all as JUnit", lambda: Report(store, RunFilter()).to_junit())
        timed("one unit", lambda: as_json(records.unit("W0000017")))
        timed("certificate", lambda: certificate(store, records.unit("W0000017")))
        timed("backup", lambda: store.backup(folder / "backup.sqlite"))
        for incremental in (False, True):
            began = time.perf_counter()
            problems = store.examine(incremental=incremental).problems
            what = "verify, again" if incremental else "verify --all"
            print(f"  {what}: {len(problems)} problems, {time.perf_counter() - began:.1f} s")
        print(f"  figures: {records.figures()}")
    size_bytes = (folder / "backup.sqlite").stat().st_size
    print(f"  database: {size_bytes / 1e6:.1f} MB, {size_bytes / (runs + REPEATS):.0f} bytes a run")


_durable = 9_000_000


def durable(bench: Bench) -> None:
    """One run with the settings of a station."""
    global _durable  # noqa: PLW0603  a serial number for each repetition
    _durable += 1
    one_run(bench, f"W{_durable}", bad=False)


if __name__ == "__main__":
    main()
