# ruff: noqa: T201
"""Hands runs over to receivers that fail, and kills what hands them over:

    python -m tests.campaigns.handover --units 1000 --kills 50 --server-restarts 3 \
        --broker-restarts 3 [--seed N]

A station's runs are sent to the plant's database (a real PostgreSQL) by the product's forwarder,
while `flasher plant deliver` hands them over to an HTTP receiver and, over a real Mosquitto, to a
subscriber of MQTT 5 whose session is kept. The receiver answers 503, ends connections, does not
answer, and takes a run and then does not answer or answers 500; it honours the key, as it has to.
The worker kills itself with SIGKILL at the named points, also between sending and recording the
answer, until it has died `--kills` times. PostgreSQL and Mosquitto are restarted meanwhile.

At the end each run of the station has to be in effect at each receiver once: none missing, none
twice, none that differs between two attempts, and no delivery open. The attempts, and how often a
receiver was sent the same key, are printed.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import psycopg
from aiomqtt import Client, MqttError, ProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from pydantic_core import from_json

from flasher.plant.central import Central
from flasher.plant.courier import Courier
from flasher.plant.deliveries import Answer, Attempt, Deliveries
from flasher.plant.process import Sending
from flasher.plant.receivers import load_receivers
from flasher.plant.reconcile import compare
from flasher.plant.setup import create_database, role_of, setup
from flasher.station.records.keys import KeyLocations
from flasher.station.records.store import Store
from tests.campaigns.plant_kill import PASSWORD, _one_run
from tests.plant.broker import Broker, find_mosquitto, running_broker
from tests.plant.receiver import Act, Receiver, receiving
from tests.station.factory import make_recipe
from tests.station.postgres import Server, find_programs, running_server

POINTS: Final = ("fetched", "recorded as sent", "sent", "recorded", "settled")
CHANCE: Final = 0.03
NAMES: Final = ("mes", "broker")
TOPIC: Final = "plant/runs"
_LIMIT_S: Final = 900.0
_LOOK_S: Final = 0.5
ACTS: Final = {
    Act.TAKE: 80, Act.FAIL: 5, Act.TAKE_AND_FAIL: 3, Act.DROP: 4, Act.HANG: 2,
    Act.TAKE_AND_HANG: 4, Act.BUSY: 2,
}  # fmt: skip
SETTINGS: Final = """\
[[receiver]]
name = "mes"
url = "{mes}"
time_limit_s = 2
retry_max_s = 4
at_once = 8

[[receiver]]
name = "broker"
url = "mqtt://127.0.0.1:{port}/{topic}"
time_limit_s = 5
retry_max_s = 4
at_once = 8
"""


# -- the worker, which dies at the named points ----------------------------------------------------


def worker_main(url: str, file: Path, kills: Path, kills_max: int) -> None:
    chance = random.Random(time.time_ns())

    def may_die(point: str) -> None:
        done = len(kills.read_text().splitlines()) if kills.exists() else 0
        if done < kills_max and chance.random() < CHANCE:
            with kills.open("a", encoding="ascii") as marks:
                marks.write(f"{point}\n")
            os.kill(os.getpid(), signal.SIGKILL)

    begin, end = Deliveries.begin, Deliveries.end

    def dying_begin(self: Deliveries, *of: Any) -> Attempt | None:
        may_die("fetched")
        attempt = begin(self, *of)
        may_die("recorded as sent")
        return attempt

    def dying_end(self: Deliveries, attempt: Attempt, answer: Answer) -> None:
        may_die("sent")
        end(self, attempt, answer)
        may_die("recorded")

    Deliveries.begin, Deliveries.end = dying_begin, dying_end  # type: ignore[method-assign, assignment]
    settled = Courier._attempt

    async def dying_attempt(self: Courier, receiver: str, station: str, number: int) -> None:
        await settled(self, receiver, station, number)
        may_die("settled")

    Courier._attempt = dying_attempt  # type: ignore[method-assign]
    parent = os.getppid()
    with closing(Courier(url, load_receivers(file))) as courier:
        courier.deliver(lambda: os.getppid() != parent)


# -- the subscriber of MQTT ------------------------------------------------------------------------


class Subscriber:
    """Takes what the broker has for it, in a thread; the broker keeps its session."""

    def __init__(self, broker: Broker, receiver: Receiver) -> None:
        self.broker = broker
        self.receiver = receiver
        self.over = threading.Event()
        self.is_ready = threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self._take()), daemon=True)

    async def _take(self) -> None:
        session = Properties(PacketTypes.CONNECT)
        session.SessionExpiryInterval = 86_400
        while not self.over.is_set():
            with suppress(MqttError, OSError, TimeoutError):
                client = Client(
                    "127.0.0.1", self.broker.port, identifier="subscriber", clean_start=False,
                    protocol=ProtocolVersion.V5, properties=session,
                )  # fmt: skip
                async with client:
                    await client.subscribe(TOPIC, qos=1)
                    self.is_ready.set()
                    async for message in client.messages:
                        document = from_json(message.payload)
                        self.receiver.requests[document["key"]] += 1
                        self.receiver.take(document["key"], document)
            await asyncio.sleep(0.2)


# -- the campaign ----------------------------------------------------------------------------------


class Campaign:
    def __init__(self, server: Server, broker: Broker, options: argparse.Namespace, folder: Path):
        self.server = server
        self.broker = broker
        self.options = options
        self.folder = folder
        self.chance = random.Random(options.seed)
        self.receivers = {name: Receiver() for name in NAMES}
        self.receivers["mes"].plan = self._act
        self.worker: subprocess.Popen[bytes] | None = None
        self.starts = 0
        self.restarts: Counter[str] = Counter()

    def _act(self) -> Act:
        (act,) = self.chance.choices(list(ACTS), list(ACTS.values()))
        return act

    def url(self, role: str = "postgres") -> str:
        secret = "" if role == "postgres" else f":{PASSWORD}"
        return f"postgresql://{role}{secret}@127.0.0.1:{self.server.port}/plant"

    def prepare(self) -> None:
        create_database(self.url())
        setup(self.url(), ["line-2"], datetime.now(UTC))
        with psycopg.connect(self.url(), autocommit=True) as admin:
            admin.execute("ALTER DATABASE plant SET synchronous_commit = on")
            admin.execute(f"ALTER ROLE {role_of('line-2')} PASSWORD '{PASSWORD}'".encode())
            admin.execute(f"CREATE ROLE courier LOGIN PASSWORD '{PASSWORD}'".encode())
            admin.execute("GRANT flasher_deliverers TO courier")
        with closing(Central(self.url("courier"))) as central:
            Deliveries(central).register(NAMES)

    def write_settings(self) -> None:
        text = SETTINGS.format(mes=self.receivers["mes"].url, port=self.broker.port, topic=TOPIC)
        (self.folder / "receivers.toml").write_text(text, encoding="utf-8")

    @property
    def kills(self) -> list[str]:
        path = self.folder / "kills"
        return path.read_text().splitlines() if path.exists() else []

    def keep_worker(self) -> None:
        """Start the worker, again after it died."""
        if self.worker is None or self.worker.poll() is not None:
            words = ["-m", "tests.campaigns.handover", "--as-worker", self.url("courier")]
            files = [self.folder / "receivers.toml", self.folder / "kills"]
            self.worker = subprocess.Popen(
                [sys.executable, *words, *map(str, files), str(self.options.kills)]
            )
            self.starts += 1

    def work(self) -> None:
        """Record and send runs, restart what is to be restarted, until nothing is open."""
        recipe = make_recipe(self.folder)
        records = str(self.folder / "records.sqlite")
        store = Store.open(
            records, station="line-2", key_locations=KeyLocations(self.folder / "keys")
        )
        store.recover()
        what = Sending(self.url(role_of("line-2")), "line-2", records, None)
        plan = ["server"] * self.options.server_restarts + ["broker"] * self.options.broker_restarts
        self.chance.shuffle(plan)
        at = [self.options.units * (number + 1) // (len(plan) + 1) for number in range(len(plan))]
        limit = time.perf_counter() + _LIMIT_S
        with store, closing(what.open()) as forwarder:
            for number in range(self.options.units):
                _one_run(store, recipe, self.folder, f"W26{number // 1000:02}{number % 1000:03}",
                         self.chance)  # fmt: skip
                if number % 20 == 0:
                    self.keep_worker()
                    forwarder.forward()
                if number in at:
                    self.restart(plan[at.index(number)])
            while forwarder.forward() or forwarder.state.fault:
                self.keep_worker()
            # What is left of the kills and of the deliveries.
            while time.perf_counter() < limit and not self.is_done():
                self.keep_worker()
                time.sleep(_LOOK_S)
        assert self.worker is not None
        self.worker.terminate()
        self.worker.wait()

    def is_done(self) -> bool:
        with psycopg.connect(self.url()) as admin:
            query = "SELECT count(*) FROM plant_delivery WHERE state <> 'confirmed'"
            ((open_ones,),) = admin.execute(query).fetchall()
        taken = all(len(each.documents) >= self.options.units for each in self.receivers.values())
        return open_ones == 0 and taken

    def restart(self, what: str) -> None:
        if what == "server":
            self.server.stop("fast")
            self.server.start()
        else:
            self.broker.stop()
            time.sleep(self.chance.uniform(0.0, 3.0))
            self.broker.start()
        self.restarts[what] += 1

    def judge(self) -> int:
        with closing(sqlite3.connect(self.folder / "records.sqlite")) as records:
            (runs,) = records.execute("SELECT count(*) FROM run").fetchone()
        with psycopg.connect(self.url()) as admin:
            query = (
                "SELECT receiver, state, count(*), sum(attempts) FROM plant_delivery GROUP BY 1, 2"
            )
            states = admin.execute(query).fetchall()
            ((jobs,),) = admin.execute("SELECT count(*) FROM procrastinate_jobs").fetchall()
        faults = int(jobs)
        print(f"runs of the station: {runs:,}; jobs left: {jobs}")
        for name, state, count, attempts in sorted(states):
            print(f"deliveries to {name}, {state}: {count:,}, attempts {attempts:,}")
            faults += 0 if state == "confirmed" else count
        with closing(Central(self.url())) as central:
            for name, receiver in self.receivers.items():
                found = compare(name, list(receiver.documents), Deliveries(central).keys(name))
                again = sum(count - 1 for count in receiver.requests.values())
                total = sum(receiver.requests.values())
                print(
                    f"{name}: in effect {len(receiver.documents):,}, got {total:,} times"
                    f" ({again:,} of a key that it had been sent before); missing"
                    f" {len(found.missing)}, unknown {len(found.unknown)}, documents that differ"
                    f" {len(receiver.differing)}"
                )
                faults += len(found.missing) + len(found.unknown) + len(receiver.differing)
                faults += int(len(receiver.documents) != runs)
        points = dict(Counter(self.kills))
        print(f"worker killed {len(self.kills)} times, at {points}; started {self.starts} times")
        print(f"restarted: {dict(self.restarts)}; faults: {faults}")
        return faults + int(len(self.kills) < self.options.kills)


def main() -> None:
    if sys.argv[1:2] == ["--as-worker"]:
        url, file, kills, kills_max = sys.argv[2:6]
        worker_main(url, Path(file), Path(kills), int(kills_max))
        return
    parser = argparse.ArgumentParser()
    parser.add_argument("--units", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=50, help="of the worker")
    parser.add_argument("--server-restarts", type=int, default=3)
    parser.add_argument("--broker-restarts", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    programs, mosquitto = find_programs(), find_mosquitto()
    if programs is None or mosquitto is None:
        raise SystemExit("PostgreSQL or Mosquitto is not installed.")
    began = time.perf_counter()
    with (
        running_server(programs) as server,
        running_broker(mosquitto) as broker,
        tempfile.TemporaryDirectory() as folder,
    ):
        campaign = Campaign(server, broker, options, Path(folder))
        campaign.prepare()
        subscriber = Subscriber(broker, campaign.receivers["broker"])
        subscriber.thread.start()
        subscriber.is_ready.wait(30.0)
        with receiving(campaign.receivers["mes"]):
            campaign.write_settings()
            try:
                campaign.work()
                faults = campaign.judge()
            finally:
                subscriber.over.set()
                if campaign.worker is not None:
                    campaign.worker.kill()
    print(f"{time.perf_counter() - began:.0f} s")
    raise SystemExit(bool(faults))


if __name__ == "__main__":
    main()
