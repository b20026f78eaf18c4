"""The worker that hands runs over to receivers: jobs of Procrastinate, one attempt each.

An attempt is three steps: the delivery is recorded as sent, the document is sent, the answer is
recorded. A worker that dies between them leaves a job that is due again after its heartbeat has
stopped (`Deliveries.sweep`); the receiver then gets the same key a second time.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final
from uuid import UUID

import psycopg
from procrastinate import App, BaseRetryStrategy, PsycopgConnector, RetryDecision
from procrastinate.exceptions import ConnectorException, ProcrastinateException
from procrastinate.jobs import DeleteJobCondition, Job
from psycopg_pool import PoolTimeout
from sqlalchemy import URL

from flasher.plant.central import Central
from flasher.plant.deliveries import (
    HEARTBEAT_S,
    SILENCE_MAX_S,
    Answer,
    Attempt,
    Deliveries,
    DeliveryState,
)
from flasher.plant.queue import TASK
from flasher.plant.receivers import Receiver
from flasher.plant.transport import Transport, transport_to
from flasher.protocol.text import printable
from flasher.station.records.errors import RecordError

RETRY_FIRST_S: Final = 2
SWEEP_S: Final = 10.0
_POLL_S: Final = 2.0
"""Interval at which jobs are looked for that became due; new ones are notified."""
_LOOK_S: Final = 0.2
_RESTART_S: Final = 2.0
_DATABASE: Final = "the plant's database"
_FAULTS: Final = (ProcrastinateException, psycopg.Error, PoolTimeout, OSError, RecordError)
"""What the workers raise when the database cannot be reached."""


class _NotSettledError(Exception):
    """The delivery needs another attempt."""


@dataclass(frozen=True)
class _Pauses(BaseRetryStrategy):
    """Pauses between the attempts of a delivery; there is no last one."""

    receivers: dict[str, Receiver]

    def get_retry_decision(self, *, exception: BaseException, job: Job) -> RetryDecision:
        limit_s = self.receivers[job.queue].retry_max_s
        pause_s = min(RETRY_FIRST_S * 2 ** min(job.attempts, 20), limit_s)
        return RetryDecision(retry_in={"seconds": pause_s})


@dataclass
class Courier:
    """Delivers runs to receivers. `report` is called after each attempt; `say` with a line about
    each refused run, and when a receiver or the database fails and when it works again; `begun`
    when deliveries begin.
    """

    url: str
    receivers: Sequence[Receiver]
    report: Callable[[Attempt, Answer], None] = lambda _attempt, _answer: None
    say: Callable[[str], None] = lambda _text: None
    begun: Callable[[], None] = lambda: None
    _transports: dict[str, Transport] = field(default_factory=dict)
    _settled: int = 0
    """Deliveries that were settled."""
    _failing: set[str] = field(default_factory=set)
    """Receivers that fail at the moment, and `_DATABASE`."""

    def __post_init__(self) -> None:
        """Raises UsageError if the plant's database is named wrongly."""
        self._central = Central(self.url)
        self._deliveries = Deliveries(self._central)
        # They report every retry, with a traceback, as an error of the program.
        for name in ("procrastinate", "psycopg.pool"):
            logging.getLogger(name).setLevel(logging.CRITICAL)

    def close(self) -> None:
        self._central.close()

    def deliver(self, is_over: Callable[[], bool], *, once: bool = False) -> None:
        """Deliver until `is_over`; with `once`, until no delivery is due. Raises UsageError, and
        RecordError if the database cannot be reached at first.
        """
        asyncio.run(self._deliver(is_over, once=once))

    async def _deliver(self, is_over: Callable[[], bool], *, once: bool) -> None:
        # What fails when Procrastinate records the end of a job is found by the sweep.
        asyncio.get_running_loop().set_exception_handler(lambda _loop, _context: None)
        self._transports = {each.name: transport_to(each) for each in self.receivers}
        try:
            await asyncio.to_thread(self._central.check_schema)
            await asyncio.to_thread(self._deliveries.register, self._transports)
            self.begun()
            while not is_over():
                before = self._settled
                try:
                    await self._work(is_over, once=once)
                except _FAULTS as error:
                    if once:
                        raise
                    self._fails(_DATABASE, " ".join(str(error).split()))
                    await _wait(_RESTART_S, is_over)
                # After a run of a unit its next one is due.
                if once and self._settled == before:
                    return
        finally:
            for transport in self._transports.values():
                await transport.close()

    async def _work(self, is_over: Callable[[], bool], *, once: bool) -> None:
        """Run a worker for each receiver, so that one that is slow does not hold up others, until
        one of them fails.
        """
        app = App(connector=PsycopgConnector(conninfo=_conninfo(self._central.location.url)))
        pauses = _Pauses({each.name: each for each in self.receivers})
        app.task(name=TASK, retry=pauses)(self._attempt)
        async with app.open_async():
            await asyncio.to_thread(self._deliveries.sweep)
            self._works(_DATABASE)
            workers = [asyncio.create_task(_run(app, each, once=once)) for each in self.receivers]
            tasks: list[asyncio.Future[Any]] = [
                asyncio.gather(*workers),
                asyncio.create_task(_wait(None, is_over)),
                asyncio.create_task(self._keep_sweeping()),
            ]
            try:
                done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
            finally:
                for each in tasks:
                    each.cancel()  # a worker first finishes its attempts
                await asyncio.gather(*tasks, *workers, return_exceptions=True)

    async def _attempt(self, receiver: str, station: str, number: int) -> None:
        """Try to deliver a run. Raises _NotSettledError, RecordError."""
        attempt = await asyncio.to_thread(self._deliveries.begin, receiver, UUID(station), number)
        if attempt is None:
            return
        answer = await self._transports[receiver].send(attempt.key, attempt.document)
        await asyncio.to_thread(self._deliveries.end, attempt, answer)
        self.report(attempt, answer)
        if not answer.state.is_settled:
            self._fails(receiver, f"{answer.text} (run {attempt.key})")
            raise _NotSettledError
        self._settled += 1
        self._works(receiver)
        if answer.state is DeliveryState.REFUSED:
            self.say(printable(f"{receiver}: {attempt.key} {answer.state}, {answer.text}"))

    def _fails(self, what: str, why: str) -> None:
        """Report an outage once; its attempts are many."""
        if what not in self._failing:
            self._failing.add(what)
            self.say(printable(f"{what} fails: {why}; runs wait, and are sent when it works again"))

    def _works(self, what: str) -> None:
        if what in self._failing:
            self._failing.remove(what)
            self.say(f"{what} works again")

    async def _keep_sweeping(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            await asyncio.to_thread(self._deliveries.sweep)


async def _run(app: App, receiver: Receiver, *, once: bool) -> None:
    """Run the worker of a receiver; with `once`, until nothing is due."""
    await app.run_worker_async(
        queues=[receiver.name],
        name=receiver.name,
        concurrency=receiver.at_once,
        wait=not once,
        fetch_job_polling_interval=_POLL_S,
        delete_jobs=DeleteJobCondition.ALWAYS,
        install_signal_handlers=False,
        update_heartbeat_interval=HEARTBEAT_S,
        stalled_worker_timeout=SILENCE_MAX_S,
    )
    if not once:  # it ends by itself, without an error, when its connection is lost
        raise ConnectorException("the database ended the connection")


async def _wait(limit_s: float | None, is_over: Callable[[], bool]) -> None:
    """Wait until `is_over`, or for a time."""
    end = None if limit_s is None else asyncio.get_running_loop().time() + limit_s
    while not is_over() and (end is None or asyncio.get_running_loop().time() < end):
        await asyncio.sleep(_LOOK_S)


def _conninfo(url: URL) -> str:
    """The URL as libpq reads it."""
    return url.set(drivername="postgresql").render_as_string(hide_password=False)
