"""Runs batches on a Dask cluster. Needs the extra `cluster`."""

from __future__ import annotations

import asyncio
import logging
import platform
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import Final

from distributed import (
    Client,
    Future,
    KilledWorker,
    Scheduler,
    Worker,
    WorkerPlugin,
    as_completed,
    get_worker,
)
from distributed.comm.addressing import resolve_address
from distributed.core import Status

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.simulate.campaign import Batch, Result, campaign_key, run_batch
from flasher.simulate.workers import BATCH_S, BatchProcess, OnResult, Pace, RunBatch

ALLOWED_FAILURES: Final = 20
"""Workers that may die with a batch before the campaign ends."""
_FEW_CORES: Final = 50
_LONG_BATCH_S: Final = 15.0
"""For more cores: the scheduler handles some hundred batches a second."""
_WINDOW: Final = 3
"""Batches in the cluster for each worker."""
_CONNECT_S: Final = 10.0
_WORKER_S: Final = 60.0
"""Time in which the first worker, and each result or a worker after it, has to be there."""
_GATHER_S: Final = 10.0
_POLL_S: Final = 0.05
_SCHEDULER_ENDED: Final = "its scheduler ended or was restarted"

_log: Final = logging.getLogger("flasher.simulate")
# It warns of each worker that dies, on the terminal; what that means is handled here.
logging.getLogger("distributed.client").setLevel(logging.CRITICAL)


class CampaignPlugin(WorkerPlugin):
    """Runs the batches of one campaign on a worker, in a process that it starts: a run that kills
    its process, or is killed because it does not end, leaves the worker alive. Closes a worker that
    joins with other code or another Python.
    """

    def __init__(self, run_one: RunBatch) -> None:
        self.name = f"flasher-{uuid.uuid4().hex}"
        self.campaign, self.python = campaign_key(), platform.python_version()
        self.run_one = run_one

    async def setup(self, worker: Worker) -> None:
        self._process = BatchProcess(self.run_one)
        self._is_over = threading.Event()
        self._one_at_a_time = threading.Lock()
        """A worker may have several threads, but has one process."""
        if self.campaign != campaign_key():
            why = _other_code(worker.address, campaign_key(), platform.python_version(), self)
            _log.error("%s", why.what)
            # After an exception the worker would take batches all the same; it cannot close until
            # it is registered, and takes none while it is paused.
            worker.status = Status.paused
            self._closing = asyncio.create_task(worker.close(reason=why.what))

    def play(self, batch: Batch) -> Result:
        with self._one_at_a_time:
            result = Result(batch.campaign)
            if not self._is_over.is_set():
                result = self._process.run(batch, self._is_over.is_set)
        if self._is_over.is_set():
            self._end_process()
        return result

    def teardown(self, worker: Worker) -> None:
        self._is_over.set()
        self._end_process()

    def _end_process(self) -> None:
        if self._one_at_a_time.acquire(blocking=False):  # else the thread that has it does so
            try:
                self._process.end()
            finally:
                self._one_at_a_time.release()


def run_on_cluster(
    address: str,
    batches: Iterable[Batch],
    *,
    on_result: OnResult,
    is_stopped: Callable[[], bool],
    run_one: RunBatch = run_batch,
) -> None:
    """Run batches, cut by time, on the workers of the scheduler at `address`; report each result
    as it comes. Once stopped, the results of batches that are not done are lost.

    Raises UsageError without a scheduler or a worker, and for workers of other code or Python.
    """
    plugin = CampaignPlugin(run_one)
    with _connected(address, plugin) as client:
        todo = _Todo(client, batches, plugin.name)
        has_worker_until = time.perf_counter() + _WORKER_S
        try:
            while not is_stopped():
                try:
                    are_left, ended = todo.submit(), todo.ended()
                    now = time.perf_counter()
                    if ended or (now >= has_worker_until and todo.has_workers()):
                        has_worker_until = now + _WORKER_S
                except OSError as error:
                    raise _lost(_SCHEDULER_ENDED) from error
                for batch, result in ended:
                    on_result(batch, result)
                if not are_left:
                    return
                if now >= has_worker_until:
                    raise _lost(f"it had no worker and gave no result for {_WORKER_S:g} s")
                if not ended:
                    time.sleep(_POLL_S)
        finally:
            with suppress(OSError):
                todo.cancel()


@contextmanager
def _connected(address: str, plugin: CampaignPlugin) -> Iterator[Client]:
    shown = printable(address)
    try:
        resolve_address(address)  # a client that fails by its address ends 20 s later
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"No scheduler of a Dask cluster answers at {shown}.",
            cause=printable(str(error)),
            remedy="Start one with `dask scheduler`; it prints its address.",
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_WORKER_S)
        except TimeoutError as error:
            raise UsageError(
                f"The Dask cluster at {shown} has no worker.",
                remedy=f"Start one for each core: `dask worker {shown} --nthreads 1`.",
            ) from error
        _check_code(client, plugin)
        client.register_plugin(plugin)
        allowed = client.run_on_scheduler(_allow_failures(ALLOWED_FAILURES))
        try:
            yield client
        finally:
            with suppress(OSError):
                if client.status == "running":
                    client.run_on_scheduler(_allow_failures(allowed))
                    client.unregister_worker_plugin(plugin.name)


def _allow_failures(limit: int) -> Callable[[Scheduler], int]:
    """Return a function that sets the limit on the scheduler. It is nested, so that Dask sends its
    code: the scheduler needs no flasher.
    """

    def set_limit(dask_scheduler: Scheduler) -> int:
        before: int = dask_scheduler.allowed_failures
        dask_scheduler.allowed_failures = limit
        return before

    return set_limit


def _check_code(client: Client, own: CampaignPlugin) -> None:
    """Raise UsageError if a worker has no flasher, or another one."""
    pythons = client.run(platform.python_version, on_error="return")
    for worker, campaign in client.run(campaign_key, on_error="return").items():
        if campaign != own.campaign:
            raise _other_code(worker, campaign, pythons.get(worker), own)


def _other_code(worker: str, campaign: object, python: object, own: CampaignPlugin) -> UsageError:
    its = "no flasher" if isinstance(campaign, Exception) else f"flasher {campaign}"
    return UsageError(
        f"The worker {printable(worker)} has {printable(str(its))} on Python {python}; this "
        f"campaign has flasher {own.campaign} on Python {own.python}.",
        cause="flasher or Python was changed, or the worker was started before",
        remedy="Install the same checkout and Python on each worker, then start the workers again.",
    )


def _play(plugin: str, batch: Batch) -> Result:
    at_worker: CampaignPlugin = get_worker().plugins[plugin]
    return at_worker.play(batch)


def _lost(cause: str) -> UsageError:
    return UsageError(
        "The Dask cluster lost a batch.",
        cause=cause,
        remedy="Repair and start the cluster, then run again with the same --ledger.",
    )


class _Todo:
    """Batches that are left, and those that the cluster has."""

    def __init__(self, client: Client, batches: Iterable[Batch], plugin: str) -> None:
        self._client = client
        self._plugin = plugin
        self._pace = Pace()
        self._parts = self._pace.cut(batches)
        self._window = 1
        self._running: dict[object, tuple[Future, Batch]] = {}
        # Not `with_results`: it never yields a batch whose result got lost, and that then failed.
        self._completed = as_completed(loop=client.loop)

    def submit(self) -> bool:
        """Fill the window; False when all is done."""
        if len(self._running) < self._window:
            workers = len(self._client.nthreads())
            self._window = _WINDOW * max(1, workers)
            self._pace.aimed_s = BATCH_S if workers <= _FEW_CORES else _LONG_BATCH_S
        while len(self._running) < self._window:
            batch = next(self._parts, None)
            if batch is None:
                break
            key = (
                self._plugin,
                batch.campaign,
                batch.canary,
                int(batch.is_corpus),
                batch.first,
                batch.count,
            )
            future = self._client.submit(_play, self._plugin, batch, key=key)
            self._running[future.key] = future, batch
            self._completed.add(future)
        return bool(self._running)

    def has_workers(self) -> bool:
        return bool(self._client.nthreads())

    def ended(self) -> list[tuple[Batch, Result]]:
        """Return the results that have come since."""
        results = []
        for future in self._completed.next_batch(block=False):
            _, batch = self._running[future.key]
            try:
                if future.status in ("lost", "pending"):
                    raise TimeoutError  # noqa: TRY301
                result = future.result(timeout=_GATHER_S)
            except TimeoutError:
                # Its worker died before it gave the result, which another one now computes.
                self._completed.add(future)
                continue
            except KilledWorker as error:
                raise _lost(f"{error.allowed_failures + 1} workers died with it") from error
            except CancelledError as error:
                raise _lost(_SCHEDULER_ENDED) from error
            else:
                self._pace.add(result)
                results.append((batch, result))
            del self._running[future.key]
            future.release()
        return results

    def cancel(self) -> None:
        self._client.cancel([future for future, _ in self._running.values()], force=True)
