"""Batches that take no time, some of which kill their process; processes import them by name."""

from __future__ import annotations

import json
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Final

from flasher.simulate.campaign import (
    NO_FAULT,
    VIOLATIONS_MAX,
    Batch,
    Found,
    Result,
    Tally,
    campaign_key,
)

KILLER: Final = 37
FOLDER: Final = "TEST_SIMULATE_FOLDER"
"""Environment variable with the folder of the marks of those that kill once."""


def run_quickly(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Sum of the seeds, each with a result of its own."""
    total = Result(batch.campaign)
    if batch.canary:
        return replace(total, canaries_found={batch.canary: 1}, canary_runs=3)
    seeds: list[int] = []
    for seed in range(batch.first, batch.first + batch.count):
        if is_stopped():
            break
        seeds.append(seed)
    found = [seed for seed in seeds if seed % 11 == 0]
    times = Counter(seed % 5 for seed in seeds)
    return Result(
        batch.campaign,
        runs=len(seeds),
        endings=dict(sorted(Counter(f"ending {seed % 3}" for seed in seeds).items())),
        tallies={NO_FAULT: Tally(len(seeds), len(found), times=dict(sorted(times.items())))},
        reached=tuple(sorted({f"place {seed % 7}" for seed in seeds})),
        violations=tuple(Found(seed, "FALSE", "text", "plan") for seed in found)[:VIOLATIONS_MAX],
        violation_count=len(found),
        digest=f"{reduce(xor, (seed**5 % 2**61 for seed in seeds), 0):016x}",
        latest=max(seeds, default=0) / 1000,
        cpu_s=0.1 * len(seeds),
    )


def run_killing(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Run `KILLER` ends its process, each time."""
    if not batch.canary and KILLER in range(batch.first, batch.first + batch.count):
        os._exit(3)
    time.sleep(0.02)  # so that others run beside it
    return run_quickly(batch, is_stopped)


class Unloadable:
    """`run_batch`, in whose process something is missing."""

    def __call__(self, batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
        raise NotImplementedError

    def __reduce__(self) -> tuple[object, ...]:
        return os._exit, (4,)


def run_killing_worker(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Run `KILLER` kills the worker that started its process."""
    if KILLER in range(batch.first, batch.first + batch.count):
        os.kill(os.getppid(), signal.SIGKILL)
    return run_quickly(batch, is_stopped)


def run_killing_once(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """A run ends its process the first time, as one that was killed from outside."""
    mark = Path(os.environ[FOLDER]) / "killed"
    if KILLER in range(batch.first, batch.first + batch.count) and not mark.exists():
        mark.touch()
        os._exit(9)
    return run_quickly(batch, is_stopped)


def run_endlessly(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Run `KILLER` never ends."""
    while KILLER in range(batch.first, batch.first + batch.count):
        pass
    return run_quickly(batch, is_stopped)


def run_failing(batch: Batch, _is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """The process raises an error, which no run of a campaign does."""
    raise FileNotFoundError(batch.campaign)


def run_slowly(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Run as long as is stated, so that a process can be killed meanwhile."""
    time.sleep(0.02 * batch.count)
    return run_quickly(batch, is_stopped)


def text_of(result: Result) -> str:
    """All of a result but its CPU time."""
    plain = {**asdict(result), "cpu_s": 0.0}
    return json.dumps(plain, indent=1)


def no_result() -> Result:
    return Result(campaign_key())
