"""Campaigns of random walks (`flasher conformance explore`): one seed and a new device for each."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf
from typing import Final

from flasher.conformance.bench_options import BenchOptions, open_bench
from flasher.conformance.explore import Explorer
from flasher.conformance.results import ExploreResult, TraceEntry
from flasher.files import read
from flasher.image.load import FILE_MAX_SIZE
from flasher.simulate.campaign import (
    WALKS,
    Batch,
    Found,
    Result,
    batches,
    campaign_key,
    check_code,
    without_log,
)
from flasher.simulate.reached import step_place
from flasher.simulate.subject import source_of

CANARY: Final = "accepts-early-end"
"""Wrong variant of the device model that a campaign has to find."""
_BATCH: Final = 50
"""Walks of a batch."""


def walks_key(options: BenchOptions) -> str:
    """Return a hash of all that decides the walk of a seed: the code, and the device under test
    with its files, as they are now. Raises UsageError for a file that cannot be read.
    """
    what = (options.device.name, options.subject, options.is_mock, options.variant)
    key = hashlib.sha256(f"{what} {sorted(options.choices)}\0".encode())
    if options.subject is not None:
        key.update(source_of(options.subject))
    for path in (options.profile, options.good_image, options.second_image):
        content = b"" if path is None else read(path, FILE_MAX_SIZE)
        key.update(len(content).to_bytes(8, "big") + content)
    return campaign_key() + WALKS + key.hexdigest()[:16]


def walk_batches(options: BenchOptions, first: int, runs: int) -> Iterator[Batch]:
    """Yield the batches of a campaign of `runs` walks, from seed `first` on."""
    key = walks_key(options)
    for each in batches(first, runs, _BATCH):
        canary = CANARY if each.canary else ""
        subject = options.subject or ""
        yield replace(each, campaign=key, canary=canary, subject=subject, walks=options)


def run_walks(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Take the walks of a batch; once stopped, the sum of those that were taken. Raises as
    `run_batch`.
    """
    assert batch.walks is not None  # noqa: S101  `walk_batches`
    check_code(batch, walks_key(batch.walks))
    began_s = time.process_time()
    total = Result(batch.campaign)
    hunted = BenchOptions(batch.walks.device, is_mock=True, variant=CANARY)
    with without_log():
        for seed in range(batch.first, batch.first + batch.count):
            if is_stopped():
                break
            if not batch.canary:
                total += _walk(batch.campaign, batch.walks, seed)
                continue
            explored, _ = _explored(hunted, seed)
            found = {CANARY: 1} if explored.finding is not None else {}
            total += Result(batch.campaign, canaries_found=found, canary_runs=1)
            if found:
                break
        else:
            if batch.canary:
                total += Result(batch.campaign, canaries_missed={CANARY: 1})
    check_code(batch, walks_key(batch.walks))
    return replace(total, cpu_s=time.process_time() - began_s)


def _walk(campaign: str, options: BenchOptions, seed: int) -> Result:
    explored, frames = _explored(options, seed)
    found: tuple[Found, ...] = ()
    if (finding := explored.finding) is not None:
        found = (Found(seed, finding.rule, finding.text, " ".join(finding.steps)),)
    taken = (step_place(each.phase, each.step) for each in explored.coverage if each.count)
    return Result(
        campaign,
        runs=1,
        endings={found[0].kind if found else "no violation": 1},
        reached=tuple(sorted(taken)),
        violations=found,
        violation_count=len(found),
        digest=hashlib.sha256(f"{seed} {found} {frames}".encode()).hexdigest()[:16],
    )


def _explored(options: BenchOptions, seed: int) -> tuple[ExploreResult, tuple[TraceEntry, ...]]:
    """Take one walk on a new device; returns its frames, too."""
    with open_bench(options) as (subject, profile):
        explorer = Explorer(subject, profile, seed=str(seed))
        return explorer.explore(inf, is_over=lambda: True, shrinks=False), explorer.trace
