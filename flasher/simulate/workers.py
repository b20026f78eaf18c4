"""Runs batches on the cores of this computer, and finds the run that kills its process."""

from __future__ import annotations

import ctypes
import hashlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection
from typing import Final

from flasher.processes import end_with_parent, signals_blocked
from flasher.simulate.campaign import NO_FAULT, Batch, Found, Result, Tally, run_batch
from flasher.simulate.draw import drawn

KILLED: Final = "KILLED"
"""Kind of the violation of a run that ended its process."""
BATCH_S: Final = 1.0
"""CPU time that a batch is cut to."""
_FIRST_RUNS: Final = 10
"""Runs of a batch while no time was measured."""
_NICENESS: Final = 10
_POLL_S: Final = 0.1
_JOIN_S: Final = 5.0

RunBatch = Callable[[Batch, Callable[[], bool]], Result]
"""`campaign.run_batch`; a function that processes can import by its name."""
OnResult = Callable[[Batch, Result], None]

_stop: ctypes.c_bool
"""In the processes. Without a lock: one that is killed would keep it."""


class Pace:
    """Measures how many runs take the CPU time that a batch is aimed at."""

    def __init__(self) -> None:
        self.aimed_s = BATCH_S
        self._runs, self._cpu_s = 0, 0.0

    def add(self, result: Result) -> None:
        if result.runs:
            self._runs += result.runs
            self._cpu_s += result.cpu_s

    def cut(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the batches in parts, each as large as the pace then is; canaries whole."""
        for batch in batches:
            first, end = batch.first, batch.first + batch.count
            while first < end:
                count = batch.count if batch.canary else min(self._size(), end - first)
                yield replace(batch, first=first, count=count)
                first += count

    def _size(self) -> int:
        if not self._cpu_s:
            return _FIRST_RUNS
        return max(1, int(self.aimed_s * self._runs / self._cpu_s))


def run(
    batches: Iterable[Batch],
    jobs: int,
    *,
    on_result: OnResult,
    is_stopped: Callable[[], bool],
    run_one: RunBatch = run_batch,
) -> None:
    """Run batches, cut by time, on `jobs` processes; report each result as it comes, once stopped
    those of the runs until then. Batches whose process may have been killed run again, seed by
    seed (`run_alone`).
    """
    pace = Pace()
    parts = pace.cut(batches)

    def report(batch: Batch, result: Result) -> None:
        pace.add(result)
        on_result(batch, result)

    while not is_stopped():
        suspects = _run_in_pool(parts, jobs, report, is_stopped, run_one)
        if not suspects:
            return
        alone = partial(run_alone, is_stopped=is_stopped, run_one=run_one)
        with ThreadPoolExecutor(jobs) as threads:
            for batch, result in zip(suspects, threads.map(alone, suspects), strict=True):
                report(batch, result)


def _run_in_pool(
    parts: Iterator[Batch],
    jobs: int,
    report: OnResult,
    is_stopped: Callable[[], bool],
    run_one: RunBatch,
) -> list[Batch]:
    """Run batches until all are done, the run is stopped, or a process is killed; return those
    whose results are then lost.
    """
    context = multiprocessing.get_context("spawn")
    stop = context.RawValue(ctypes.c_bool)
    running: dict[Future[Result], Batch] = {}
    lost: list[Batch] = []
    with ProcessPoolExecutor(jobs, context, _begin, (stop,)) as pool:
        try:
            while True:
                while not (lost or is_stopped()) and len(running) <= jobs:
                    batch = next(parts, None)
                    if batch is None:
                        break
                    try:
                        with signals_blocked():
                            running[pool.submit(_run_one, run_one, batch)] = batch
                    except BrokenProcessPool:
                        lost.append(batch)
                if not running:
                    return lost
                for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
                    batch = running.pop(future)
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        lost.append(batch)
                    else:
                        report(batch, result)
                if is_stopped():
                    stop.value = True
        finally:
            stop.value = True  # an error of one ends the others


def _begin(stop: ctypes.c_bool) -> None:
    global _stop  # noqa: PLW0603  a process of the pool has no other place
    _stop = stop
    _begin_process()


def _begin_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops it
    end_with_parent()
    if hasattr(os, "nice"):
        os.nice(_NICENESS)


def _run_one(run_one: RunBatch, batch: Batch) -> Result:
    return run_one(batch, lambda: bool(_stop.value))


def run_alone(
    batch: Batch, is_stopped: Callable[[], bool] = lambda: False, run_one: RunBatch = run_batch
) -> Result:
    """Run a batch seed by seed in a process of its own. The seed that kills it runs once more, in
    a new process; if it kills that one too, it is a violation of kind `KILLED`.
    """
    total = Result(batch.campaign)
    seed, end, suspect = batch.first, batch.first + batch.count, -1
    while seed < end and not is_stopped():
        part = replace(batch, first=seed, count=1 if seed == suspect else end - seed)
        with _process(run_one, part) as (process, results):
            while seed < part.first + part.count and not is_stopped():
                try:
                    if not results.poll(_POLL_S):
                        continue
                    result: Result | Exception = results.recv()
                except EOFError:
                    process.join(_JOIN_S)
                    if seed == suspect:
                        result = _killed(batch, seed, process.exitcode)
                    else:
                        suspect = seed
                        break
                if isinstance(result, Exception):
                    raise result
                total += replace(result, canaries_missed={})
                if total.canaries_found:
                    return total
                seed += 1
    if batch.canary and seed == end:
        return replace(total, canaries_missed={batch.canary: 1})
    return total


@contextmanager
def _process(
    run_one: RunBatch, batch: Batch
) -> Iterator[tuple[multiprocessing.process.BaseProcess, Connection]]:
    """Start a process that sends the result of each seed; it ends with the block."""
    context = multiprocessing.get_context("spawn")
    results, sending = context.Pipe(duplex=False)
    # The workers of a cluster are daemons, which `multiprocessing` lets start no process so that
    # none remains; this one ends with its parent.
    config = multiprocessing.current_process()._config  # type: ignore[attr-defined]  # noqa: SLF001
    is_daemon = config.pop("daemon", None)
    try:
        process = context.Process(target=_send_each, args=(run_one, batch, sending))
        with signals_blocked():
            process.start()
    finally:
        sending.close()
        if is_daemon is not None:
            config["daemon"] = is_daemon
    try:
        yield process, results
    finally:
        process.kill()
        process.join()
        results.close()


def _send_each(run_one: RunBatch, batch: Batch, sending: Connection) -> None:
    _begin_process()
    for seed in range(batch.first, batch.first + batch.count):
        try:
            sending.send(run_one(replace(batch, first=seed, count=1), lambda: False))
        except Exception as error:  # noqa: BLE001  for the parent
            sending.send(error)
            return


def _killed(batch: Batch, seed: int, exit_code: int | None) -> Result:
    """Result of a run that ended its process."""
    if batch.canary:
        return Result(batch.campaign, canaries_found={batch.canary: 1}, canary_runs=1)
    how = f"exit code {exit_code}"
    if exit_code is not None and exit_code < 0:
        how = signal.Signals(-exit_code).name
    plan = drawn(seed)
    return Result(
        batch.campaign,
        runs=1,
        endings={"killed": 1},
        tallies={name: Tally(runs=1) for name in {each.NAME for each in plan.events} or {NO_FAULT}},
        violations=(Found(seed, KILLED, f"the run ended its process: {how}", str(plan)),),
        violation_count=1,
        digest=hashlib.sha256(f"{seed} {KILLED}".encode()).hexdigest()[:16],
    )
