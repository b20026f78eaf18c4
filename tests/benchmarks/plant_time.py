"""Compares the time of a unit at stations that send to a plant with stations that do not:

    python -m tests.benchmarks.plant_time --stations 4 --rounds 5 --units 1

In each round all stations run at the same time, once with the plant and once without, in turns.
A station is a process with a socket of its own and virtual units at the pace of the bus; what sends
is the product's own process; PostgreSQL runs on the same cores. A pair is a station's median with
the plant and without in one round, so that what else loads the computer meets both.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from datetime import UTC, datetime

import psycopg

from flasher.plant.process import Sending, sending
from flasher.plant.setup import create_database, role_of, setup
from tests.benchmarks.station_sockets import Measured
from tests.station.postgres import find_programs, running_server

PASSWORD = "benchmark"  # noqa: S105  of a server that lives as long as this


def run_times(name: str, url: str, units: int) -> list[float]:
    """Seconds of each unit at a station; without a `url` it sends nothing."""
    return Measured(
        1,
        units,
        name,
        beside=lambda records: (
            sending(Sending(url, name, str(records), None)) if url else nullcontext()
        ),
    ).run_s


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--stations", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--units", type=int, default=1, help="of each station in a round")
    options = parser.parse_args()
    programs = find_programs()
    if programs is None:
        raise SystemExit("PostgreSQL is not installed.")
    pairs: list[tuple[float, float]] = []
    context = multiprocessing.get_context("spawn")
    with (
        running_server(programs) as server,
        ProcessPoolExecutor(options.stations, mp_context=context) as pool,
    ):
        url = f"postgresql://postgres@127.0.0.1:{server.port}/plant"
        create_database(url)
        for number in range(options.rounds):
            names = [f"line-{at + 1}-{number + 1}" for at in range(options.stations)]
            setup(url, names, datetime.now(UTC))
            with psycopg.connect(url, autocommit=True) as admin:
                for name in names:
                    admin.execute(f"ALTER ROLE {role_of(name)} PASSWORD '{PASSWORD}'".encode())
            found: dict[bool, list[float]] = {}
            for is_sent in (True, False) if number % 2 else (False, True):
                runs = [
                    pool.submit(
                        run_times,
                        name,
                        url.replace("postgres@", f"{role_of(name)}:{PASSWORD}@") if is_sent else "",
                        options.units,
                    )
                    for name in names
                ]
                found[is_sent] = [statistics.median(each.result()) for each in runs]
            pairs += zip(found[True], found[False], strict=True)
            load = os.getloadavg()[0]
            ratios = [sent / alone - 1 for sent, alone in pairs[-options.stations :]]
            print(
                f"round {number + 1}: with the plant {statistics.median(found[True]):.2f} s,"
                f" without {statistics.median(found[False]):.2f} s, pairs"
                f" {min(ratios):+.1%} to {max(ratios):+.1%}, load {load:.1f}",
                flush=True,
            )
        with psycopg.connect(url) as admin:
            ((arrived,),) = admin.execute("SELECT count(*) FROM run").fetchall()
    ratios = sorted(sent / alone - 1 for sent, alone in pairs)
    print(
        f"{len(pairs)} pairs: median {statistics.median(ratios):+.2%},"
        f" {ratios[0]:+.1%} to {ratios[-1]:+.1%}; runs in the plant: {arrived}"
    )


if __name__ == "__main__":
    main()
