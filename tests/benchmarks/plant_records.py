"""How fast an outage is caught up in a plant's database, and how long questions take over many
runs:

    python -m tests.benchmarks.plant_records --runs 50000 [--traces N]

A station has recorded `--runs` runs of 8 steps while the server was away (`bulk_records` writes
them, the last ones with a trace); the forwarder of the product sends them. PostgreSQL runs beside
it, without waiting for the disk.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import psycopg

from flasher.plant.central import Central
from flasher.plant.forwarder import Forwarder
from flasher.plant.setup import create_database, role_of, setup
from flasher.plant.stations import statuses
from flasher.plant.store import PlantStore
from flasher.protocol.spec import BMS
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from tests.benchmarks.bulk_records import fill
from tests.station.factory import IMAGES, Bench
from tests.station.postgres import find_programs, running_server


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=50_000)
    parser.add_argument("--traces", type=int, default=1000, help="of the last runs")
    options = parser.parse_args()
    programs = find_programs()
    if programs is None:
        raise SystemExit("PostgreSQL is not installed.")
    with running_server(programs) as server, tempfile.TemporaryDirectory() as folder:
        url = f"postgresql://postgres@127.0.0.1:{server.port}/plant"
        create_database(url)
        setup(url, ["line-2"], datetime.now(UTC))
        role = role_of("line-2")
        with psycopg.connect(url, autocommit=True) as admin:
            admin.execute(f"ALTER ROLE {role} PASSWORD 'x'".encode())
        bench = Bench(Path(folder))
        bench.make(lot="L1")
        began_s = time.perf_counter()
        fill(bench, options.runs, options.traces)
        print(f"{options.runs:,} runs recorded in {time.perf_counter() - began_s:.0f} s")
        _catch_up(bench, url.replace("postgres@", f"{role}:x@"), options.runs)
        with psycopg.connect(url, autocommit=True) as admin:
            admin.execute("ANALYZE")
            query = "SELECT pg_size_pretty(pg_database_size(current_database()))"
            ((size,),) = admin.execute(query).fetchall()
        print(f"size of the database: {size}")
        _ask(url, Path(folder) / "desk")


def _catch_up(bench: Bench, url: str, runs: int) -> None:
    forwarder = Forwarder(
        bench.opened().database, bench.store.files, Central(url), "line-2", bench.clock
    )
    Path("/proc/self/clear_refs").write_text("5", "ascii")  # the peak of recording counts no more
    with closing(forwarder):
        began_s, before_mb, at = time.perf_counter(), _peak_mb(), 0
        forwarder.forward()
        first_mb = _peak_mb()
        while forwarder.forward():
            at += 1
            if at == 20:
                first_mb = _peak_mb()
        took_s = time.perf_counter() - began_s
    if forwarder.error is not None:
        raise forwarder.error
    print(
        f"caught up: {runs / took_s:,.0f} runs/s ({took_s:.0f} s); peak memory"
        f" {before_mb:.0f} MB before, {first_mb:.0f} MB after 20 batches, {_peak_mb():.0f} MB at"
        " the end"
    )


def _statuses(central: Central) -> object:
    with central.reading() as connection:
        return statuses(connection)


def _ask(url: str, folder: Path) -> None:
    store = PlantStore.open(url, station="desk", folder=folder, read_only=True)
    with closing(store), closing(Central(url)) as central:
        overview = Overview(store.database)
        sha256 = IMAGES[BMS].sha256
        questions: dict[str, Callable[[], object]] = {
            "units of an image, a page": lambda: overview.holders(sha256, PageCursor()),
            "yield of all runs, without daily sums": store.read.figures,
            "all stations": lambda: _statuses(central),
        }
        for name, ask in questions.items():
            began_s = time.perf_counter()
            ask()
            print(f"{name}: {time.perf_counter() - began_s:.3f} s")


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
