"""Runs batches on the cores of this computer, and finds the run that kills its process."""

from __future__ import annotations

import gc
import hashlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Event, Lock
from typing import Final, Self

from flasher.errors import UsageError
from flasher.processes import end_with_parent, signals_blocked
from flasher.simulate.campaign import CORPUS_SEEDS, NO_FAULT, Batch, Found, Result, Tally, run_batch

KILLED: Final = "KILLED"
"""Kind of the violation of a run that ended its process."""
BATCH_S: Final = 1.0
"""CPU time that a batch is cut to."""
_FIRST_RUNS: Final = 10
"""Runs of a batch while no time was measured."""
_NICENESS: Final = 10
_POLL_S: Final = 0.1
_JOIN_S: Final = 5.0
_RUN_S: Final = 60.0
"""CPU time that a run may take; most take some 10 ms."""

RunBatch = Callable[[Batch, Callable[[], bool]], Result]
"""`campaign.run_batch`; a function that processes can import by its name."""
OnResult = Callable[[Batch, Result], None]


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
        """Yield the batches in parts, each as large as the pace then is; canaries and the corpus
        whole.
        """
        for batch in batches:
            first, end = batch.first, batch.first + batch.count
            while first < end:
                is_whole = batch.canary or batch.is_corpus
                count = batch.count if is_whole else min(self._size(), end - first)
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
    those of the runs until then. A batch whose process is killed runs again, seed by seed
    (`run_alone`). `is_stopped` is called from several threads.
    """
    pace, parts_lock = Pace(), Lock()
    parts = pace.cut(batches)
    ended = SimpleQueue[tuple[Batch, Result] | None]()
    has_failed = Event()

    def stops() -> bool:
        return has_failed.is_set() or is_stopped()

    def run_parts() -> None:
        try:
            with BatchProcess(run_one) as worker:
                while not stops():
                    with parts_lock:
                        batch = next(parts, None)
                    if batch is None:
                        return
                    result = worker.run(batch, stops)
                    with parts_lock:
                        pace.add(result)
                    ended.put((batch, result))
        except BaseException:
            has_failed.set()
            raise
        finally:
            ended.put(None)

    with ThreadPoolExecutor(jobs) as threads:
        try:
            workers = [threads.submit(run_parts) for _ in range(jobs)]
            for _ in workers:
                for batch, result in iter(ended.get, None):
                    on_result(batch, result)
            for worker in workers:
                worker.result()
        finally:
            has_failed.set()  # an error of one ends the others


class BatchProcess:
    """A process that runs batches, one at a time, through a pipe of its own: a process that is
    killed while it reads from a shared queue keeps the lock of the queue. A new process replaces
    one that was killed.
    """

    def __init__(self, run_one: RunBatch) -> None:
        self._run_one = run_one
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self.exit_code = 0
        """Of the process that was killed last."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def run(self, batch: Batch, is_stopped: Callable[[], bool]) -> Result:
        """Run a batch, seed by seed (`run_alone`) if that kills the process; once stopped, return
        the result of the runs until then. Raises the error that `run_one` raises.
        """
        try:
            return self.run_once(batch, is_stopped)
        except EOFError:
            return run_alone(batch, is_stopped, self._run_one)

    def run_once(self, batch: Batch, is_stopped: Callable[[], bool]) -> Result:
        """As `run`, but raises EOFError if the process is killed."""
        pipe = self._pipe or self._start() or self._start()
        if pipe is None:
            raise UsageError(
                f"A process for runs did not start: {_exit_text(self.exit_code)}.",
                cause="memory is short, or the installed flasher was changed meanwhile",
                remedy="Run again with fewer --jobs, and with the same --ledger if there was one.",
            )
        is_stop_sent = False
        try:
            pipe.send(batch)
            while not pipe.poll(_POLL_S):
                if is_stopped() and not is_stop_sent:
                    pipe.send(None)
                    is_stop_sent = True
            result: Result | Exception = pipe.recv()
        except (EOFError, OSError) as error:  # OSError: while it sent
            if self._process is not None:
                self._process.join(_JOIN_S)
            self.end()
            raise EOFError from error
        if isinstance(result, Exception):
            raise result
        return result

    def _start(self) -> Connection | None:
        """Return the pipe of a new process; None if it ended before it took a batch: no run is to
        blame.
        """
        context = multiprocessing.get_context("spawn")
        pipe, far_end = context.Pipe()
        # The workers of a cluster are daemons, which `multiprocessing` lets start no process so
        # that none remains; this one ends with its parent.
        config = multiprocessing.current_process()._config  # type: ignore[attr-defined]  # noqa: SLF001
        is_daemon = config.pop("daemon", None)
        try:
            self._process = context.Process(target=_run_each, args=(self._run_one, far_end, _RUN_S))
            with signals_blocked():
                self._process.start()
        finally:
            far_end.close()
            if is_daemon is not None:
                config["daemon"] = is_daemon
        self._pipe = pipe
        try:
            pipe.recv()
        except (EOFError, OSError):
            self._process.join(_JOIN_S)
            self.end()
            return None
        return pipe

    def end(self) -> None:
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self.exit_code = self._process.exitcode or 0
            self._pipe.close()
            self._pipe = None


def _begin_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops it
    end_with_parent()
    if hasattr(os, "nice"):
        os.nice(_NICENESS)


def _run_each(run_one: RunBatch, pipe: Connection, run_s: float) -> None:
    """In the process: run what comes through the pipe; anything that comes meanwhile is a stop."""
    _begin_process()
    if hasattr(gc, "freeze"):  # PyPy has none
        gc.freeze()  # the modules do not become garbage: looking through them takes 5 % of a run
    pipe.send(None)  # it has started
    while True:
        try:
            batch: Batch | None = pipe.recv()
        except EOFError:  # the parent ended
            return
        if batch is None:  # a stop that came too late
            continue
        result: Result | Exception
        try:
            with _time_limit(run_s) as begin_run:
                result = run_one(batch, lambda: begin_run() or pipe.poll())
        except Exception as error:  # noqa: BLE001  for the parent
            result = error
        pipe.send(result)


@contextmanager
def _time_limit(limit_s: float) -> Iterator[Callable[[], None]]:
    """End this process by SIGPROF if it takes more CPU time in the block without a call of the
    function that it gets. Does nothing on Windows.
    """
    if not hasattr(signal, "setitimer"):
        yield lambda: None
        return

    def begin() -> None:
        signal.setitimer(signal.ITIMER_PROF, limit_s)

    begin()
    try:
        yield begin
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def run_alone(
    batch: Batch, is_stopped: Callable[[], bool] = lambda: False, run_one: RunBatch = run_batch
) -> Result:
    """Run a batch seed by seed in a process of its own. The seed that kills it runs once more, in
    a new process; if it kills that one too, it is a violation of kind `KILLED`.
    """
    total = Result(batch.campaign)
    seed, end, suspect = batch.first, batch.first + batch.count, -1
    with BatchProcess(run_one) as worker:
        while seed < end and not is_stopped():
            try:
                result = worker.run_once(replace(batch, first=seed, count=1), is_stopped)
            except EOFError:
                if seed != suspect:
                    suspect = seed
                    continue
                result = _killed(batch, seed, worker.exit_code)
            total += replace(result, canaries_missed={})
            if total.canaries_found:
                return total
            seed += 1
    if batch.canary and seed == end:
        return replace(total, canaries_missed={batch.canary: 1})
    return total


def _exit_text(exit_code: int) -> str:
    return signal.Signals(-exit_code).name if exit_code < 0 else f"exit code {exit_code}"


def _killed(batch: Batch, seed: int, exit_code: int) -> Result:
    """Result of a run that ended its process."""
    if batch.canary:
        return Result(batch.campaign, canaries_found={batch.canary: 1}, canary_runs=1)
    how = f"ended its process: {_exit_text(exit_code)}"
    if how.endswith("SIGPROF"):
        how = f"took more than {_RUN_S:g} s of CPU time"
    text, plan, names = f"the run {how}", "", set[str]()
    if batch.walks is None:
        played = batch.plan_of(seed)
        plan, names = str(played), {each.NAME for each in played.events} or {NO_FAULT}
    if batch.is_corpus:
        found = Found(seed - CORPUS_SEEDS, KILLED, text, plan)
        return Result(batch.campaign, corpus_runs=1, violations=(found,), violation_count=1)
    return Result(
        batch.campaign,
        runs=1,
        endings={"killed": 1},
        tallies={name: Tally(runs=1) for name in names},
        violations=(Found(seed, KILLED, text, plan),),
        violation_count=1,
        digest=hashlib.sha256(f"{seed} {KILLED}".encode()).hexdigest()[:16],
    )
