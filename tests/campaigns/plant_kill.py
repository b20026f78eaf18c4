# ruff: noqa: T201
"""Kills stations, the processes that send their records, and the plant's server, and looks whether
the plant has every run of every station, once:

    python -m tests.campaigns.plant_kill --stations 30 --runs 10000 --server-kills 20 \
        --station-kills 30 --outage 120 --spacing 10 [--seed N]

A station is a process that records runs of good and bad units (claim, intent, step, measurement,
trace, end) as fast as its disk allows; no bus is simulated. What sends is the product's own
forwarder, in a process of its own that kills itself with SIGKILL, with a probability of 10 % each,
at the named points: after the question for the last row, after the inserts of parts, of traces and
of rows, before the commit, and after the commit before the acknowledgement was read. The server is
a real PostgreSQL whose main process is killed with SIGKILL, also while stations send; once its port
is closed for `--outage` seconds.

At the end the audit rows of all stations are compared with those of the plant, and `flasher plant
verify` examines its database.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import psycopg
from sqlalchemy import func, select

from flasher.plant import forwarder
from flasher.plant.central import Central
from flasher.plant.process import Sending, keep_sending
from flasher.plant.setup import create_database, role_of, setup
from flasher.plant.store import PlantStore
from flasher.plant.verify import PlantExaminer
from flasher.protocol.spec import BMS
from flasher.station.records import schema
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    Measurement,
    Order,
    RunResult,
    RunState,
    StepState,
    Verified,
)
from flasher.station.records.store import Store
from tests.station.factory import BMS_VERSION, IMAGES, make_recipe
from tests.station.postgres import Server, find_programs, running_server
from tests.station.traces import run_messages, write_trace

POINTS: Final = ("enter", "part", "trace", "row", "before commit", "before acknowledgement")
CHANCE: Final = 0.1
PASSWORD: Final = "campaign"  # noqa: S105
_DRAIN_LIMIT_S: Final = 3600.0
_STATEMENTS: Final = {
    forwarder.ENTER: "enter", forwarder._ADD_PART: "part", forwarder._ADD_TRACE: "trace",
    forwarder.ADD_ROW: "row",
}  # fmt: skip


# -- a station -------------------------------------------------------------------------------------


def station_main(name: str, url: str, folder: Path, runs: int) -> None:
    """Record runs until there are `runs`, and send them until everything is sent."""
    folder.mkdir(parents=True, exist_ok=True)
    recipe = make_recipe(folder)
    store = Store.open(
        str(folder / "records.sqlite"), station=name, key_locations=KeyLocations(folder / "keys")
    )
    store.recover()
    sender: Any = None
    context = multiprocessing.get_context("spawn")
    chance = random.Random(f"{name} {time.time_ns()}")
    with store:
        while True:
            with store.database.reading() as connection:
                done = connection.execute(select(func.count()).select_from(schema.run)).scalar_one()
            if done < runs:
                _one_run(store, recipe, folder, f"W26{done // 1000:02}{done % 1000:03}", chance)
            if sender is None or sender.exitcode is not None:
                what = Sending(url, name, str(folder / "records.sqlite"), None)
                sender = context.Process(target=_send, args=(what, folder), daemon=True)
                sender.start()
            if done >= runs:
                state = forwarder.load_state(store.files.folder, name)
                if state.at and not (state.unsent or state.fault) and _is_last(store, state):
                    return
                time.sleep(0.5)


def _is_last(store: Store, state: forwarder.ForwarderState) -> bool:
    with closing(sqlite3.connect(str(store.database.location.file))) as records:
        (last,) = records.execute("SELECT max(number) FROM audit").fetchone()
    return bool(state.sent == last)


def _one_run(store: Store, recipe: Any, folder: Path, serial: str, chance: random.Random) -> None:
    run_id = store.claim(Order(serial, "A", "jo"), recipe).run_id
    is_good = chance.random() < 0.9
    write = store.intent(run_id, "bms", "flash", BMS_VERSION)
    store.verified(write, BMS_VERSION)
    measured = Measurement("voltage", 36.0 + chance.random(), "V", 30.0, 42.0)
    state = StepState.PASS if is_good else StepState.FAIL
    store.step(run_id, "flash", state, duration_s=0.01, measurements=[measured])
    reported = run_messages(serial, BMS_VERSION, IMAGES[BMS])
    trace = write_trace(folder / "run.log.gz", reported, at_s=time.time())
    file = store.files.add("trace", trace)
    end = RunResult(RunState.FAIL, "NO_ANSWER", "", 8.0, {}, file.sha256, [file])
    if is_good:
        reached = {"bms": Verified.VERSION}
        end = RunResult(RunState.PASS, "OK", "", 8.0, reached, file.sha256, [file])
    store.finish(run_id, end)


def _send(what: Sending, folder: Path) -> None:
    """The product's forwarder, which dies at the named points."""
    chance = random.Random(time.time_ns())

    def may_die(point: str) -> None:
        if chance.random() < CHANCE:
            with (folder / "kills").open("a", encoding="ascii") as kills:
                kills.write(f"{point}\n")
            os.kill(os.getpid(), signal.SIGKILL)

    class Dying:
        def __init__(self, connection: Any) -> None:
            self._connection = connection
            self.is_batch = False

        def execute(self, statement: Any, values: Any) -> Any:
            found = self._connection.execute(statement, values)
            self.is_batch = self.is_batch or statement is forwarder.ADD_ROW
            if statement in _STATEMENTS:
                may_die(_STATEMENTS[statement])
            return found

    usual = Central.writing

    @contextmanager
    def writing(central: Central) -> Iterator[Any]:
        with usual(central) as connection:
            dying = Dying(connection)
            yield dying
            if dying.is_batch:
                may_die("before commit")
        if dying.is_batch:
            may_die("before acknowledgement")

    Central.writing = writing  # type: ignore[method-assign, assignment]
    parent = os.getppid()
    with closing(what.open()) as made:

        def wait(limit_s: float) -> bool:
            time.sleep(min(limit_s, 1.0))
            return os.getppid() != parent

        keep_sending(made, wait)


# -- what kills ------------------------------------------------------------------------------------


class Campaign:
    """The server, its stations, and what is killed."""

    def __init__(self, server: Server, options: argparse.Namespace, folder: Path) -> None:
        self.server = server
        self.options = options
        self.folder = folder
        self.chance = random.Random(options.seed)
        self.names = [f"line-{number + 1}" for number in range(options.stations)]
        self.runs = -(-options.runs // options.stations)
        self.kills: Counter[str] = Counter()
        self._stations: dict[str, subprocess.Popen[bytes]] = {}

    def url(self, role: str = "postgres") -> str:
        secret = "" if role == "postgres" else f":{PASSWORD}"
        return f"postgresql://{role}{secret}@127.0.0.1:{self.server.port}/plant"

    def prepare(self) -> None:
        create_database(self.url())
        setup(self.url(), self.names, datetime.now(UTC))
        with psycopg.connect(self.url(), autocommit=True) as admin:
            # The tests' server does without it; what is acknowledged has to be on disk here.
            admin.execute("ALTER DATABASE plant SET synchronous_commit = on")
            for name in self.names:
                admin.execute(f"ALTER ROLE {role_of(name)} PASSWORD '{PASSWORD}'".encode())

    def start(self, name: str) -> None:
        words = ["-m", "tests.campaigns.plant_kill", "--as", name, self.url(role_of(name))]
        self._stations[name] = subprocess.Popen(
            [sys.executable, *words, str(self.folder / name), str(self.runs)],
            start_new_session=True,
        )

    def work(self) -> None:
        for name in self.names:
            self.start(name)
        times = self.options.server_kills + self.options.station_kills
        plan = ["server"] * self.options.server_kills + ["station"] * self.options.station_kills
        self.chance.shuffle(plan)
        for number, what in enumerate(plan):
            time.sleep(self.chance.uniform(0.2, 1.8) * self.options.spacing)
            if what == "server":
                is_outage = number >= times // 2 and not self.kills["outage"]
                self.kill_server(self.options.outage if is_outage else 0.0)
                self.kills["outage"] += is_outage
            else:
                self.kill_station(self.chance.choice(self.names))
            self.kills[what] += 1
        limit = time.perf_counter() + _DRAIN_LIMIT_S
        for name, process in self._stations.items():
            if process.wait(max(1.0, limit - time.perf_counter())):
                raise SystemExit(f"{name} ended with {process.returncode}")

    def kill_station(self, name: str) -> None:
        """Its whole group: what records, and what sends."""
        process = self._stations[name]
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        self.start(name)

    def kill_server(self, away_s: float) -> None:
        data = self.server.folder / "data"
        pid = int((data / "postmaster.pid").read_text().split()[0])
        os.kill(pid, signal.SIGKILL)
        time.sleep(away_s)
        for _ in range(60):
            time.sleep(0.5)  # its processes see that it is gone, and end
            with suppress(subprocess.CalledProcessError):
                self.server._start()
                return
        raise SystemExit("the server does not start again")

    def judge(self) -> int:
        """Print the result; the number of faults."""
        faults = 0
        own = total = 0
        with psycopg.connect(self.url()) as admin:
            for name in self.names:
                with closing(sqlite3.connect(self.folder / name / "records.sqlite")) as records:
                    rows = records.execute("SELECT hash FROM audit ORDER BY number").fetchall()
                    (runs,) = records.execute("SELECT count(*) FROM run").fetchone()
                query = (
                    "SELECT c.hash FROM chain_row c JOIN plant_station p USING (station)"
                    " WHERE p.name = %s ORDER BY c.number"
                )
                faults += int(admin.execute(query, [name]).fetchall() != rows)
                own += runs
            ((total,),) = admin.execute("SELECT count(*) FROM run").fetchall()
        store = PlantStore.open(
            self.url(), station="judge", folder=self.folder / "cache", read_only=True
        )
        with closing(store):
            found = PlantExaminer(store, lambda _done, _total: None).examine_plant()
        points: Counter[str] = Counter()
        for name in self.names:
            path = self.folder / name / "kills"
            points.update(path.read_text().splitlines() if path.exists() else ())
        print(f"runs of the stations: {own:,}; in the plant: {total:,}")
        print(f"chains that differ: {faults}; problems of verify: {len(found.problems)}")
        for problem in found.problems[:5]:
            print(f"  {problem.where}: {problem.what}")
        print(f"killed: {dict(self.kills)}; at a point: {dict(points)}")
        return faults + len(found.problems) + int(own != total)


def main() -> None:
    if sys.argv[1:2] == ["--as"]:
        name, url, folder, runs = sys.argv[2:6]
        station_main(name, url, Path(folder), int(runs))
        return
    parser = argparse.ArgumentParser()
    parser.add_argument("--stations", type=int, default=30)
    parser.add_argument("--runs", type=int, default=10_000, help="of all stations")
    parser.add_argument("--server-kills", type=int, default=20)
    parser.add_argument("--station-kills", type=int, default=30)
    parser.add_argument("--outage", type=float, default=120.0, help="seconds")
    parser.add_argument("--spacing", type=float, default=2.0, help="mean seconds between kills")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    programs = find_programs()
    if programs is None:
        raise SystemExit("PostgreSQL is not installed.")
    began = time.perf_counter()
    with running_server(programs) as server, tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(server, options, Path(folder))
        campaign.prepare()
        try:
            campaign.work()
            faults = campaign.judge()
        finally:
            for process in campaign._stations.values():
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    print(f"{time.perf_counter() - began:.0f} s")
    raise SystemExit(bool(faults))


if __name__ == "__main__":
    main()
