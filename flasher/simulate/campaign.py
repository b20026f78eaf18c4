"""Campaigns of simulated upgrades: batches of seeds, and results that are merged in any order.

A batch is a range of seeds; `run_batch` plays their plans, wherever it runs. Results are added
(`Result.__add__`): counts by +, places by |, violations by the lowest seeds, digests by exclusive
or; so neither the size of the batches nor the order of their ends changes the sum.

The corpus (`corpus.toml`) keeps plans for places that random plans seldom reach: shrunk plans, not
seeds, which mean something else after the next change. A campaign plays it first.

A canary is a planted mistake (`planting`) that a campaign has to find, or it is blind.
"""

from __future__ import annotations

import hashlib
import logging
import platform
import random
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from math import log2
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.simulate import plan as plans
from flasher.simulate.corpus import corpus
from flasher.simulate.draw import drawn
from flasher.simulate.planting import swapped, upgrade_bugs
from flasher.simulate.play import Verdict, play
from flasher.simulate.reached import (
    DEVICE_PLACES,
    READINGS,
    exit_place,
    reachable,
    recorded_cells,
    step_place,
    with_readings,
)

if TYPE_CHECKING:
    from flasher.conformance.bench_options import BenchOptions
    from flasher.simulate.subject import SubjectBench

VIOLATIONS_MAX: Final = 20
"""Violations that a result keeps, those of the lowest seeds; all are counted."""
CANARY_EVERY: Final = 2000
"""Runs of a campaign for each canary."""
CANARY_RUNS: Final = 1000
"""Runs in which a canary has to be found."""
CORPUS_SEEDS: Final = 1_000_000
"""More than the corpus has plans."""
CANARIES: Final = (
    "last-program-unit-lost",
    "one-packet-more-for-whole-sizes",
)
"""Planted mistakes that few runs find."""
SUBJECT_CANARY: Final = CANARIES[1]
"""The one that is not in the device model."""
_SUBJECT: Final = "-"
"""Between the hash of the code and that of the bootloader under test, in `Result.campaign`."""
WALKS: Final = "+"
"""The same before the hash of the device under test of a campaign of walks."""
NO_FAULT: Final = "none"
_TIMES_PER_OCTAVE: Final = 4
"""Classes of times: each 2^(1/4) times as long as the one before."""


@dataclass(frozen=True)
class Batch:
    """Range of seeds, the unit of work; with a canary, the runs that have to find it."""

    campaign: str
    """`campaign_key`: a batch runs on the same code only."""
    first: int
    count: int
    canary: str = ""
    """Name of a planted mistake."""
    is_corpus: bool = False
    """`first` and `count` are those of plans of the corpus."""
    subject: str = ""
    """Bootloader under test (see `BootloaderProcess`), which is the device of each plan."""
    target: str = ""
    """Of the subject."""
    walks: BenchOptions | None = None
    """Device under test of walks (`simulate.walks`); None for upgrades."""

    @property
    def bench(self) -> SubjectBench | None:
        """Raises UsageError for a subject that is unusable."""
        if not self.subject:
            return None
        from flasher.simulate.subject import bench  # noqa: PLC0415  loads much of the suite

        return bench(self.subject, self.target)

    def plan_of(self, number: int) -> plans.Plan:
        """Return the plan of a seed, or of the corpus."""
        if self.bench is not None:
            return self.bench.drawn(number)
        return [*corpus().values()][number] if self.is_corpus else drawn(number)


@dataclass(frozen=True, order=True)
class Found:
    """Violation, and the plan that shows it."""

    seed: int
    """Or the number of a plan of the corpus less 1,000,000, so that it is below 0."""
    kind: str
    text: str
    plan: str


@dataclass(frozen=True)
class Tally:
    """How the runs with a kind of fault ended."""

    runs: int = 0
    good: int = 0
    """Claimed success, and the device has the image."""
    by_flash: int = 0
    """Failed with an error; the same command without faults then succeeded."""
    by_rescue: int = 0
    """Failed with an error; `rescue` without faults succeeded."""
    times: Mapping[int, int] = field(default_factory=dict)
    """Number of good runs by their time: four times the binary logarithm of its ratio to the time
    that all frames take on the bus, rounded.
    """

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.runs + other.runs,
            self.good + other.good,
            self.by_flash + other.by_flash,
            self.by_rescue + other.by_rescue,
            _sum(self.times, other.times),
        )

    @property
    def median_time(self) -> float | None:
        """Median duration of the good runs, as a multiple of the time on the bus."""
        left = (self.good + 1) // 2
        for each, count in sorted(self.times.items()):
            left -= count
            if left <= 0:
                return float(2 ** (each / _TIMES_PER_OCTAVE))
        return None


@dataclass(frozen=True)
class Result:
    """Sum of the runs of any number of batches."""

    campaign: str
    runs: int = 0
    """Random ones: endings and tallies count only these."""
    corpus_runs: int = 0
    endings: Mapping[str, int] = field(default_factory=dict)
    tallies: Mapping[str, Tally] = field(default_factory=dict)
    """By the name of a clause that a plan contains; `none` for plans without a fault."""
    reached: tuple[str, ...] = ()
    """Sorted."""
    violations: tuple[Found, ...] = ()
    violation_count: int = 0
    excused: int = 0
    """Successes beside a device that cannot be seen: kind UNSEEN of a violation."""
    canaries_found: Mapping[str, int] = field(default_factory=dict)
    canaries_missed: Mapping[str, int] = field(default_factory=dict)
    canary_runs: int = 0
    digest: str = "0" * 16
    """Of all frames of all runs, with their times."""
    latest: float = 0.0
    """Latest end as a share of its announced deadline."""
    cpu_s: float = 0.0

    def __add__(self, other: Result) -> Result:
        """Raises ValueError for results of different campaigns."""
        if self.campaign != other.campaign:
            raise ValueError(f"results of two campaigns: {self.campaign} and {other.campaign}")
        violations = sorted({*self.violations, *other.violations})
        more = {
            name: self.tallies.get(name, Tally()) + tally for name, tally in other.tallies.items()
        }
        return Result(
            campaign=self.campaign,
            runs=self.runs + other.runs,
            corpus_runs=self.corpus_runs + other.corpus_runs,
            endings=_sum(self.endings, other.endings),
            tallies=dict(sorted({**self.tallies, **more}.items())),
            reached=with_readings({*self.reached, *other.reached}),
            violations=tuple(violations[:VIOLATIONS_MAX]),
            violation_count=self.violation_count + other.violation_count,
            excused=self.excused + other.excused,
            canaries_found=_sum(self.canaries_found, other.canaries_found),
            canaries_missed=_sum(self.canaries_missed, other.canaries_missed),
            canary_runs=self.canary_runs + other.canary_runs,
            digest=f"{int(self.digest, 16) ^ int(other.digest, 16):016x}",
            latest=max(self.latest, other.latest),
            cpu_s=self.cpu_s + other.cpu_s,
        )

    @property
    def never_reached(self) -> list[str]:
        """Places that no run reached, without those that none can reach."""
        return sorted(self.reachable - {*self.reached})

    @property
    def is_of_walks(self) -> bool:
        return WALKS in self.campaign

    @property
    def reachable(self) -> set[str]:
        """Places that a run can reach; a bootloader under test reaches none in the device model."""
        if self.is_of_walks:
            from flasher.conformance.explore.steps import reachable_pairs  # noqa: PLC0415  as above

            return {step_place(phase.value, name) for phase, name in reachable_pairs()}
        is_subject = _SUBJECT in self.campaign
        return {
            each
            for each in reachable()
            if not (is_subject and each.startswith((DEVICE_PLACES, READINGS)))
        }

    @property
    def is_blind(self) -> bool:
        """True unless every canary was found."""
        return bool(self.canaries_missed) or not self.canaries_found


Key = TypeVar("Key", int, str)


def _sum(one: Mapping[Key, int], other: Mapping[Key, int]) -> dict[Key, int]:
    return {key: one.get(key, 0) + other.get(key, 0) for key in sorted(one.keys() | other.keys())}


def campaign_key(subject: str = "", target: str = "") -> str:
    """Return a hash of all that decides the upgrade of a seed: the code, and Python's version; with
    a bootloader under test also a hash of that, as it is now.
    """
    if not subject:
        return _code_key()
    from flasher.simulate.subject import source_of  # noqa: PLC0415  loads much of the suite

    key = hashlib.sha256(f"{subject} {target}\0".encode() + source_of(subject))
    return _code_key() + _SUBJECT + key.hexdigest()[:16]


@cache
def _code_key() -> str:
    digest = hashlib.sha256(platform.python_version().encode())
    package = Path(__file__).parents[1]
    for file in sorted([*package.rglob("*.py"), *package.rglob("*.toml")]):
        digest.update(f"{file.relative_to(package).as_posix()}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def corpus_batch() -> Batch:
    """Return the batch of the whole corpus."""
    return Batch(campaign_key(), 0, len(corpus()), is_corpus=True)


def batches(
    first: int, runs: int, count: int, subject: str = "", target: str = ""
) -> Iterator[Batch]:
    """Yield the batches of a campaign of `runs` seeds from `first` on, each of `count` runs, with a
    canary before each `CANARY_EVERY` runs.
    """
    key, end = campaign_key(subject, target), first + runs
    for start in range(first, end, CANARY_EVERY):
        canary = random.Random(start).choice(CANARIES) if not subject else SUBJECT_CANARY
        yield Batch(key, start, CANARY_RUNS, canary, subject=subject, target=target)
        part_end = min(start + CANARY_EVERY, end)
        for begin in range(start, part_end, count):
            yield Batch(key, begin, min(count, part_end - begin), subject=subject, target=target)


def share(batches: Iterable[Batch], number: int, count: int) -> Iterator[Batch]:
    """Yield the batches of shard `number` (from 1 on) of `count`: every count-th one."""
    return islice(batches, number - 1, None, count)


def run_batch(batch: Batch, is_stopped: Callable[[], bool] = lambda: False) -> Result:
    """Play the plans of a batch; once stopped, the sum of those that were played.

    Raises ValueError for a batch of other code, UsageError for one of another bootloader under
    test, or one that is changed meanwhile.
    """
    check_code(batch, campaign_key(batch.subject, batch.target))
    began_s = time.process_time()
    with without_log():
        total = _hunt(batch, is_stopped) if batch.canary else _played(batch, is_stopped)
    check_code(batch, campaign_key(batch.subject, batch.target))
    return replace(total, cpu_s=time.process_time() - began_s)


def check_code(batch: Batch, key: str) -> None:
    """Raise ValueError for a batch of other code, UsageError for one whose device under test was
    changed since. `key` is that of its campaign now.
    """
    if batch.campaign == key:
        return
    kind = len(_code_key()) + 1  # the code, and the mark after it
    if batch.campaign[:kind] != key[:kind]:
        raise ValueError(f"a batch of {batch.campaign}; this is the code {key}")
    what = f"The bootloader {printable(batch.subject)}" if batch.subject else "A file of the device"
    raise UsageError(
        f"{what} was changed during the campaign.",
        cause="it was built again, or another profile or image was saved",
        remedy="Begin again, with a new ledger; test a copy of it while you build.",
    )


@contextmanager
def without_log() -> Iterator[None]:
    """Log nothing: thousands of upgrades fail as they should."""
    before = logging.root.manager.disable
    logging.disable()
    try:
        yield
    finally:
        logging.disable(before)


def _played(batch: Batch, is_stopped: Callable[[], bool]) -> Result:
    total = Result(batch.campaign)
    with recorded_cells() as cells:
        for seed in range(batch.first, batch.first + batch.count):
            if is_stopped():
                break
            plan = batch.plan_of(seed)
            verdict = play(plan, bench=batch.bench)
            number = seed - CORPUS_SEEDS * batch.is_corpus
            total += _result_of(batch.campaign, number, plan, verdict)
    return total + Result(batch.campaign, reached=tuple(cells - {""}))


def _result_of(campaign: str, seed: int, plan: plans.Plan, verdict: Verdict) -> Result:
    """Return the result of one run; `seed` as in `Found`."""
    text = f"{seed} {verdict.wire} {verdict.ending} {verdict.left} {verdict.recovered}"
    found = tuple(
        Found(seed, each.kind, each.text, str(plan))
        for each in verdict.violations
        if not each.is_excused
    )
    result = Result(
        campaign,
        reached=(*verdict.reached, exit_place(verdict.exit_code)),
        violations=found,
        violation_count=len(found),
        excused=len(verdict.violations) - len(found),
        digest=hashlib.sha256(text.encode()).hexdigest()[:16],
        latest=verdict.lateness,
    )
    if seed < 0:
        return replace(result, corpus_runs=1)
    is_good, times = verdict.is_good, {}
    if is_good and verdict.share_of_bus_time:
        times = {round(_TIMES_PER_OCTAVE * log2(verdict.share_of_bus_time)): 1}
    tally = Tally(
        runs=1,
        good=int(is_good),
        by_flash=int(not is_good and verdict.recovered == "flash"),
        by_rescue=int(not is_good and verdict.recovered == "rescue"),
        times=times,
    )
    names = {each.NAME for each in plan.events} or {NO_FAULT}
    return replace(result, runs=1, endings={verdict.ending: 1}, tallies=dict.fromkeys(names, tally))


def _hunt(batch: Batch, is_stopped: Callable[[], bool]) -> Result:
    """Play plans with a planted mistake until one shows it."""
    bug = next(each for each in upgrade_bugs() if each.name == batch.canary)
    runs = 0
    with swapped(bug.codes()):
        while runs < batch.count:
            if is_stopped():
                return Result(batch.campaign, canary_runs=runs)
            plan = batch.plan_of(batch.first + runs)
            runs += 1
            violations = play(plan, bench=batch.bench).violations
            if any(not each.is_excused for each in violations):
                return Result(batch.campaign, canaries_found={bug.name: 1}, canary_runs=runs)
    return Result(batch.campaign, canaries_missed={bug.name: 1}, canary_runs=runs)
