"""Runs are handed over to the plant's systems: in effect once where the receiver honours the key,
whatever fails; and what is not known is not stated.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import psycopg
import pytest

from flasher.documents import SCHEMA_VERSION, as_json
from flasher.errors import UsageError
from flasher.plant import courier
from flasher.plant.central import Central
from flasher.plant.courier import Courier
from flasher.plant.deliveries import Answer, Attempt, Deliveries, DeliveryState, parse_key
from flasher.plant.delivery_list import Delivery, deliveries_of, receivers_of
from flasher.plant.receivers import Receiver as Settings
from flasher.plant.transport import transport_to
from flasher.station.records.errors import NotFoundError, RecordError
from flasher.station.records.model import RunState
from tests.plant.factory import COURIER, READER, Plant, Sender
from tests.plant.receiver import Act, Receiver, receiving

OTHER = "W2605003"


class Desk:
    """A plant's database with a receiver, and what `flasher plant` does with them."""

    def __init__(self, plant: Plant, sender: Sender, receiver: Receiver) -> None:
        self.plant = plant
        self.sender = sender
        self.receiver = receiver
        self.central = Central(plant.url(COURIER))
        self.deliveries = Deliveries(self.central)
        self.deliveries.register(["mes"])
        self.answers: list[Answer] = []

    def deliver(self, **settings: Any) -> None:
        """What is due, by a new worker."""
        receivers = [self.settings(**settings)]
        with closing(Courier(self.plant.url(COURIER), receivers, self._keep)) as worker:
            worker.deliver(lambda: False, once=True)

    def _keep(self, _attempt: Attempt, answer: Answer) -> None:
        self.answers.append(answer)

    def settings(self, **others: Any) -> Settings:
        usual = {"name": "mes", "url": self.receiver.url, "time_limit_s": 20.0, "at_once": 1}
        return Settings.model_validate(usual | others)

    def fetch(self) -> None:
        """Give the first job to a worker that lives."""
        with self.plant.connect() as owner:
            owner.execute(
                "SELECT procrastinate_fetch_job_v2('{mes}', w.worker_id)"
                " FROM procrastinate_register_worker_v1() w"
            )

    def make_due(self) -> None:
        """As if the pauses were over, and the worker's heartbeat had stopped long ago."""
        with self.plant.connect() as owner:
            owner.execute("UPDATE procrastinate_jobs SET scheduled_at = NULL")
            owner.execute(
                "UPDATE procrastinate_workers SET last_heartbeat = now() - '1h'::interval"
            )

    def only(self) -> Delivery:
        (found,) = self.listed()
        return found

    def listed(self) -> Sequence[Delivery]:
        with self.central.reading() as connection:
            return deliveries_of(connection).rows


@pytest.fixture
def desk(plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(courier, "RETRY_FIRST_S", 600)  # no pause ends by itself
    with receiving(Receiver()) as receiver:
        made = Desk(plant, sender, receiver)
        yield made
        made.central.close()


def test_a_run_arrives_at_the_receiver_with_its_key_and_all_its_parts(desk: Desk) -> None:
    desk.sender.bench.make()
    desk.sender.send()
    desk.deliver()
    ((station, number),) = desk.plant.rows(
        "SELECT station, number FROM chain_row WHERE content IS NOT NULL"
    )
    key = f"{station}-{number}"
    assert list(desk.receiver.documents) == [key]
    document = desk.receiver.documents[key]
    assert (document["schema"], document["row"]) == (SCHEMA_VERSION, number)
    with closing(desk.plant.store()) as store:
        (run,) = store.read.table()
        details = store.read.run(run.run_id)
    assert document["run"] == as_json(details), "as flasher station unit --json prints it"
    assert document["run"]["run"]["verified"] == "version"
    found = desk.only()
    assert (found.key, found.state, found.attempts) == (key, DeliveryState.CONFIRMED, 1)
    assert desk.plant.rows("SELECT count(*) FROM procrastinate_jobs") == [(0,)]


def test_runs_before_the_receiver_was_named_are_not_sent(desk: Desk) -> None:
    desk.sender.bench.make()
    desk.deliveries.stop("mes")
    desk.sender.send()
    assert not desk.listed()
    desk.deliveries.register(["mes"])
    desk.sender.bench.make(serial=OTHER)
    desk.sender.send()
    assert [each.serial for each in desk.listed()] == [OTHER]


def test_a_batch_that_is_not_committed_leaves_no_job(desk: Desk) -> None:
    desk.sender.bench.make()
    with desk.plant.connect() as owner:
        owner.execute("ALTER TABLE chain_row ADD CONSTRAINT never CHECK (event <> 'finished')")
    desk.sender.forwarder.forward()
    assert desk.sender.forwarder.error is not None
    assert desk.plant.rows("SELECT count(*) FROM procrastinate_jobs") == [(0,)]


@pytest.mark.parametrize(
    ("act", "state", "text"),
    [
        (Act.REFUSE, DeliveryState.REFUSED, "HTTP 422: no such part"),
        (Act.BUSY, DeliveryState.WAITING, "HTTP 429"),
        (Act.FAIL, DeliveryState.UNKNOWN, "HTTP 503: away"),
        (Act.DROP, DeliveryState.UNKNOWN, "no answer"),
        (Act.TAKE_AND_FAIL, DeliveryState.UNKNOWN, "HTTP 500"),
        (Act.TAKE_AND_HANG, DeliveryState.UNKNOWN, "no answer: the time limit"),
    ],
)
def test_an_answer_is_stated_as_what_it_is(
    desk: Desk, act: Act, state: DeliveryState, text: str
) -> None:
    desk.receiver.plan = lambda: act
    desk.sender.bench.make()
    desk.sender.send()
    desk.deliver(time_limit_s=1.0)
    found = desk.only()
    assert (found.state, found.attempts) == (state, 1)
    assert found.answer.startswith(text)
    assert (found.next_at is None) is state.is_settled
    # The same key again, and in effect once.
    desk.receiver.plan = lambda: Act.TAKE
    if state is DeliveryState.REFUSED:
        desk.make_due()
        desk.deliver()
        assert desk.only().attempts == 1, "what was refused is sent by hand only"
        desk.deliveries.send_again("mes", [found.key])
    desk.make_due()
    desk.deliver()
    assert desk.only().state is DeliveryState.CONFIRMED
    assert dict(desk.receiver.requests) == {found.key: 2}
    assert (list(desk.receiver.documents), desk.receiver.differing) == ([found.key], [])


def test_a_receiver_that_is_away_gets_nothing_and_nothing_is_unknown(desk: Desk) -> None:
    desk.sender.bench.make()
    desk.sender.send()
    desk.deliver(url="http://127.0.0.1:1/runs")
    found = desk.only()
    assert found.state is DeliveryState.WAITING
    assert found.answer.startswith("no connection")


def test_an_outage_is_one_line_and_its_end_is_another(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(courier, "RETRY_FIRST_S", 0)
    monkeypatch.setattr(courier, "_POLL_S", 0.05)
    lines: list[str] = []
    desk.sender.bench.make()
    desk.sender.send()
    acts = iter([Act.FAIL] * 5)
    desk.receiver.plan = lambda: next(acts, Act.REFUSE)
    begun = threading.Event()
    worker = Courier(
        desk.plant.url(COURIER), [desk.settings()], desk._keep, lines.append, begun.set
    )
    with closing(worker):
        worker.deliver(lambda: desk.only().state is DeliveryState.REFUSED)
    key = desk.only().key
    assert begun.is_set()
    assert lines == [
        f"mes fails: HTTP 503: away (run {key}); runs wait, and are sent when it works again",
        "mes works again",
        f"mes: {key} refused, HTTP 422: no such part",
    ]


def test_a_database_that_is_away_is_one_line(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(courier, "_RESTART_S", 0.0)
    lines: list[str] = []
    sweep, calls = Deliveries.sweep, iter(range(6))

    def broken(of: Deliveries) -> int:
        if next(calls, 6) < 5:
            raise RecordError("gone", cause="the server\nstops")
        return sweep(of)

    monkeypatch.setattr(Deliveries, "sweep", broken)
    worker = Courier(desk.plant.url(COURIER), [desk.settings()], say=lines.append)
    with closing(worker):
        worker.deliver(lambda: len(lines) > 1)
    first, second = lines
    assert first.startswith("the plant's database fails: gone")
    assert second == "the plant's database works again"


def test_a_worker_that_died_before_it_recorded_the_answer(desk: Desk) -> None:
    desk.sender.bench.make()
    desk.sender.send()
    desk.fetch()
    attempt = desk.deliveries.begin("mes", *parse_key(desk.only().key))
    assert attempt is not None

    async def send() -> Answer:
        transport = transport_to(desk.settings())
        answer = await transport.send(attempt.key, attempt.document)
        await transport.close()
        return answer

    assert asyncio.run(send()).state is DeliveryState.CONFIRMED
    assert desk.only().state is DeliveryState.SENT
    desk.make_due()
    assert desk.deliveries.sweep() == 1
    assert desk.only().state is DeliveryState.UNKNOWN
    desk.deliver()
    assert (desk.only().state, desk.only().attempts) == (DeliveryState.CONFIRMED, 2)
    assert list(desk.receiver.requests.values()) == [2]
    assert len(desk.receiver.documents) == 1


def test_the_sweep_finds_jobs_of_dead_workers_and_deliveries_without_a_job(desk: Desk) -> None:
    for serial in ("W2605011", "W2605012", "W2605013"):
        desk.sender.bench.make(serial=serial)
    desk.sender.send()
    with desk.plant.connect() as owner:
        (alive,) = owner.execute(
            "SELECT worker_id FROM procrastinate_register_worker_v1()"
        ).fetchone()  # type: ignore[misc]
        owner.execute("SELECT procrastinate_fetch_job_v2('{mes}', %s)", [alive])
        owner.execute("DELETE FROM procrastinate_jobs WHERE id = 3")
    assert desk.deliveries.sweep() == 1, "the one without a job; the other's worker lives"
    desk.make_due()
    assert desk.deliveries.sweep() == 1
    assert desk.deliveries.sweep() == 0
    desk.deliver()
    assert len(desk.receiver.documents) == 3


def test_a_job_whose_end_could_not_be_recorded_is_found_although_its_worker_lives(
    desk: Desk,
) -> None:
    desk.sender.bench.make()
    desk.sender.send()
    with desk.plant.connect() as owner:
        (alive,) = owner.execute(
            "SELECT worker_id FROM procrastinate_register_worker_v1()"
        ).fetchone()  # type: ignore[misc]
        owner.execute("SELECT procrastinate_fetch_job_v2('{mes}', %s)", [alive])
        owner.execute("UPDATE procrastinate_events SET at = at - '1h'::interval")
    assert desk.deliveries.sweep() == 1


def test_the_runs_of_a_unit_are_delivered_in_their_order(desk: Desk) -> None:
    plan = iter([Act.FAIL, Act.TAKE, Act.TAKE, Act.TAKE])
    desk.receiver.plan = lambda: next(plan)
    desk.sender.bench.make(RunState.FAIL)
    desk.sender.bench.make()
    desk.sender.bench.make(serial=OTHER)
    desk.sender.send()
    desk.deliver()
    assert desk.receiver.order == [OTHER], (
        "the second run of the first unit waits for its first one"
    )
    desk.make_due()
    desk.deliver()
    assert len(desk.receiver.order) == 3
    states = [
        document["run"]["run"]["state"]
        for document in desk.receiver.documents.values()
        if document["run"]["run"]["serial"] != OTHER
    ]
    assert states == ["fail", "pass"]


def test_a_late_answer_does_not_replace_a_confirmation(desk: Desk) -> None:
    desk.sender.bench.make()
    desk.sender.send()
    station, number = parse_key(desk.only().key)
    first = desk.deliveries.begin("mes", station, number)
    second = desk.deliveries.begin("mes", station, number)
    assert first is not None
    assert second is not None
    desk.deliveries.end(first, Answer(DeliveryState.UNKNOWN, "late"))
    assert desk.only().state is DeliveryState.SENT, "another attempt is being made"
    desk.deliveries.end(first, Answer(DeliveryState.CONFIRMED, "HTTP 200"))
    desk.deliveries.end(second, Answer(DeliveryState.UNKNOWN, "no answer"))
    assert desk.only().state is DeliveryState.CONFIRMED
    assert desk.deliveries.begin("mes", station, number) is None


def test_two_receivers_do_not_wait_for_each_other(desk: Desk) -> None:
    desk.deliveries.register(["slow"])
    desk.sender.bench.make()
    desk.sender.send()
    desk.receiver.plan = iter([Act.HANG, Act.TAKE]).__next__
    desk.deliver(name="slow", time_limit_s=0.5)
    desk.deliver()
    with desk.central.reading() as connection:
        found = {each.name: each.counts for each in receivers_of(connection)}
    assert found == {"mes": {DeliveryState.CONFIRMED: 1}, "slow": {DeliveryState.UNKNOWN: 1}}


def test_keys_that_are_none(desk: Desk) -> None:
    for key in ("", "1204", "x-1", "0a6c3e42-7d1f-4b58-9c3a-5d2e8f901b47"):
        with pytest.raises(UsageError, match="not the key of a run"):
            desk.deliveries.document(key)
    with pytest.raises(NotFoundError):
        desk.deliveries.document("0a6c3e42-7d1f-4b58-9c3a-5d2e8f901b47-7")


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE plant_delivery SET state = 'confirmed'",
        "DELETE FROM plant_delivery",
        "INSERT INTO plant_receiver (name) VALUES ('mine')",
        "SELECT plant_enqueue('mes', gen_random_uuid(), 1)",
        "DELETE FROM procrastinate_jobs",
    ],
)
def test_a_reader_changes_nothing(plant: Plant, statement: str) -> None:
    with plant.connect(READER) as reader, pytest.raises(psycopg.errors.InsufficientPrivilege):
        reader.execute(statement.encode())


def test_a_worker_changes_no_records(plant: Plant) -> None:
    for statement in ("UPDATE run SET state = 'PASS'", "DELETE FROM chain_row"):
        with plant.connect(COURIER) as worker, pytest.raises(psycopg.errors.InsufficientPrivilege):
            worker.execute(statement.encode())


@pytest.mark.slow
def test_a_station_loads_nothing_of_it() -> None:
    program = (
        "import json, sys, flasher.plant.process, flasher.plant.health; "
        "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    loaded = set(json.loads(done.stdout))
    assert not loaded & {"procrastinate", "aiomqtt", "paho", "httpx2", "psycopg_pool"}
    assert "sqlalchemy" in loaded, "the names are those of the packages"


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT * FROM procrastinate_jobs",
        "DELETE FROM procrastinate_jobs",
        "SELECT procrastinate_defer_jobs_v1('{}')",
        "SELECT procrastinate_fetch_job_v2(NULL, 1)",
    ],
)
def test_a_station_has_no_part_in_the_queue(plant: Plant, statement: str) -> None:
    with (
        plant.connect("flasher_line_2") as attacker,
        pytest.raises(psycopg.errors.InsufficientPrivilege),
    ):
        attacker.execute(statement.encode())
