"""Options, progress and totals of campaigns: `flasher simulate`, `flasher conformance explore`."""

from __future__ import annotations

import shlex
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import click

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.extras import need
from flasher.cli.framework import option
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.conformance.results import LINE_JOINT
from flasher.errors import ExitCode
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.simulate.campaign import Batch, Found, Result, Tally
    from flasher.simulate.oracle import Violation
    from flasher.simulate.workers import RunBatch

_RUNS: Final = 1000
_COLUMNS: Final = 79
_ENDLESS: Final = 10**12
"""Runs that no campaign reaches."""

what_option: Final = partial(option, panel="what is run, and how")


def _shard(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise click.BadParameter(f"{text!r} is not a part of a campaign, as 3/8")
    return int(number), int(count)


@dataclass(frozen=True)
class CampaignOptions:
    """How many runs a campaign has, and where."""

    runs: Annotated[int | None, what_option(
        "--runs", type=values.count, metavar="N", brief=True,
        help=f"end a campaign after so many runs (default: {_RUNS}, without --for)",
    )]  # fmt: skip
    for_s: Annotated[float | None, what_option(
        "--for", "for_s", type=values.seconds, metavar="SECONDS", brief=True,
        help="end after this time",
    )]  # fmt: skip
    jobs: Annotated[int, what_option(
        "--jobs", type=values.processes, default="1", metavar="N", brief=True,
        help="run on N processes side by side",
    )]  # fmt: skip
    shard: Annotated[tuple[int, int] | None, what_option(
        "--shard", type=_shard, metavar="I/N",
        help="run part I of N, as in a job array; `simulate merge` adds them up",
    )]  # fmt: skip
    ledger: Annotated[Path | None, what_option(
        "--ledger", type=values.FilePath("jsonl", gives=Path), metavar="FILE",
        help="save finished runs in this file, and run those that it lacks",
    )]  # fmt: skip
    keep_going: Annotated[bool, what_option(
        "--keep-going", is_flag=True, help="do not end at the first violation",
    )]  # fmt: skip

    @property
    def most(self) -> int:
        """Runs after which it ends."""
        return self.runs or (_RUNS if self.for_s is None else _ENDLESS)

    def part(self, batches: Iterable[Batch]) -> Iterable[Batch]:
        """Return the batches of the shard."""
        from flasher.simulate.campaign import share  # noqa: PLC0415  for campaigns only

        return batches if self.shard is None else share(batches, *self.shard)


def run_campaign(
    chosen: CampaignOptions,
    seed: int,
    todo: Iterable[Batch],
    key: str,
    output: Output,
    *,
    run_one: RunBatch,
    shrunk: Callable[[Found, Callable[[], bool]], Found],
    dask: str | None = None,
) -> tuple[Result, bool]:
    """Run the batches that the ledger lacks, and print the rate. Returns the sum with the first
    violation `shrunk`, and whether the user stopped it.
    """
    # Commands that run no campaign load this module too.
    from flasher.simulate.campaign import Result  # noqa: PLC0415
    from flasher.simulate.ledger import Ledger  # noqa: PLC0415
    from flasher.simulate.workers import KILLED  # noqa: PLC0415
    from flasher.simulate.workers import run as run_in_processes  # noqa: PLC0415

    began_s = time.perf_counter()
    total, most = Result(key), chosen.most
    with (
        stop_on_signal(lambda: output.progress("Ending.")) as stopped,
        Bar(output, leave=False, unit=" runs" if most < _ENDLESS else " s") as bar,
        ExitStack() as files,
    ):
        ledger: Ledger | None = None
        if chosen.ledger is not None:
            whole = None if most == _ENDLESS else most
            ledger = files.enter_context(Ledger(chosen.ledger, seed, whole, key))
            total, todo = ledger.result, ledger.left(todo)
            output.progress(ledger.notice or f"{counted(total.runs, 'run')} found in the ledger")
        before = total.runs

        def is_over() -> bool:
            is_late = chosen.for_s is not None and time.perf_counter() - began_s >= chosen.for_s
            has_failed = total.violation_count > 0 and not chosen.keep_going
            return is_late or has_failed or stopped()

        def add(batch: Batch, result: Result) -> None:
            nonlocal total
            total += result
            if ledger is not None:
                ledger.add(batch, result)
            took_s = time.perf_counter() - began_s
            if most < _ENDLESS:
                bar.move_to(total.runs, -(-most // (chosen.shard or (1, 1))[1]))
            elif chosen.for_s is not None:
                bar.move_to(min(round(took_s), chosen.for_s), chosen.for_s)

        if dask is not None:
            need("--dask", "cluster")
            from flasher.simulate.cluster import run_on_cluster  # noqa: PLC0415  an extra

            run_on_cluster(dask, todo, on_result=add, is_stopped=is_over, run_one=run_one)
        elif chosen.jobs > 1:
            run_in_processes(todo, chosen.jobs, on_result=add, is_stopped=is_over, run_one=run_one)
        else:
            for batch in todo:
                if is_over():
                    break
                add(batch, run_one(batch, is_over))
        took_s = time.perf_counter() - began_s
        first = next(iter(total.violations), None)
        if first is not None and first.kind != KILLED and not stopped():
            output.progress("Shrinking the first violation; Ctrl-C ends that.")
            total = replace(total, violations=(shrunk(first, stopped), *total.violations[1:]))
        was_stopped = stopped()
    rate = 60 * (total.runs - before) / took_s if took_s else 0.0
    output.result(f"{counted(total.runs, 'run')}, {rate:,.0f} a minute")
    return total, was_stopped


def exit_code(
    total: Result, *, is_strict: bool = False, is_shard: bool = False, was_stopped: bool = False
) -> ExitCode:
    is_blind = bool(total.canaries_missed) if is_shard else total.is_blind
    is_empty = not (total.runs or is_shard)
    failed = total.violation_count or is_blind or is_empty or (is_strict and total.never_reached)
    if failed:
        return ExitCode.PARTIAL
    return ExitCode.INTERRUPTED if was_stopped else ExitCode.OK


def print_sum(
    total: Result,
    output: Output,
    *,
    replay: Callable[[Found], str],
    is_shard: bool = False,
    is_brief: bool = False,
) -> None:
    """Print the sum of a campaign. `replay` makes the command that repeats a run; what no run
    reached `is_brief` unless there is -v.
    """
    if total.tallies:
        output.table(_rows(total.tallies), indent=2)
    count, never = len(total.reachable), total.never_reached
    if total.corpus_runs:
        output.result(f"{counted(total.corpus_runs, 'plan')} of the corpus played")
    is_listed = output.verbosity > 0 or not is_brief
    hint = "" if is_listed or not never else " (-v lists the others)"
    places = "pairs of phase and step" if total.is_of_walks else "places"
    output.result(f"{count - len(never)} of {count} {places} reached{hint}")
    if is_listed:
        output.results(_never_lines(never))
    output.results(canary_lines(total, is_shard=is_shard))
    for each in total.violations:
        output.results(violation_lines("VIOLATION", each))
        where = "corpus" if each.seed < 0 else f"seed {each.seed}"
        output.result(f"  {where}; replay: {replay(each)}")
    if total.violation_count > len(total.violations):
        output.result(f"{total.violation_count:,} violations in all")
    if not total.runs:
        how = "allow more time, or make fewer parts" if is_shard else "allow more time"
        output.result(f"NOTHING TRIED: no random run was finished; {how}")
    elif not total.violation_count:
        output.result(f"no violation in {counted(total.runs, 'run')}")


def _never_lines(never: Iterable[str]) -> Iterator[str]:
    """Yield what no run reached, by state, in lines for a narrow terminal."""
    split = (each.rpartition(": ") if ", " not in each else each.partition(", ") for each in never)
    for head, same in groupby(split, key=lambda each: each[0]):
        text = "; ".join(name for _, _, name in same)
        yield from textwrap.wrap(
            f"never: {head}: {text}", _COLUMNS, initial_indent="  ", subsequent_indent=" " * 9
        )


def violation_lines(word: str, violation: Violation | Found) -> Iterator[str]:
    text, *printed = violation.text.split(LINE_JOINT)
    yield f"{word} {violation.kind}: {printable(text)}"
    yield from (f"    {printable(line)}" for line in printed)


def canary_lines(total: Result, *, is_shard: bool) -> Iterator[str]:
    for name, count in total.canaries_missed.items():
        yield f"BLIND: the planted mistake {name} was not found {counted(count, 'time')}"
    found = sum(total.canaries_found.values())
    if found:
        yield f"canaries found: {found}"
    elif is_shard and not total.canaries_missed:
        yield "no canary in this part: `flasher simulate merge` judges that"
    elif total.is_blind and not total.canaries_missed:
        yield "BLIND: no canary was tried"


def _rows(tallies: Mapping[str, Tally]) -> Iterator[Sequence[str]]:
    yield ("fault", "runs", "upgraded", "again", "rescued", "median time")
    for name, tally in in_order(tallies):
        median = tally.median_time
        yield (
            name,
            f"{tally.runs:,}",
            f"{tally.good:,}",
            f"{tally.by_flash:,}",
            f"{tally.by_rescue:,}",
            "" if median is None else f"{median:.1f} x",
        )


def in_order(tallies: Mapping[str, Tally]) -> Sequence[tuple[str, Tally]]:
    """Return tallies by the name of the fault; runs without a fault come first."""
    from flasher.simulate.campaign import NO_FAULT  # noqa: PLC0415  as above

    return sorted(tallies.items(), key=lambda each: each[0] != NO_FAULT)


def walk_line(
    found: Found,
    words: Sequence[str] = (
        *("flasher", "conformance", "explore"),
        *("-t", "TARGET", "--subject", "BOOTLOADER"),
    ),
) -> str:
    """Return the command that takes a walk again. Ledgers do not name the device under test."""
    how = ["--replay", found.plan] if found.plan else ["--runs", "1", "--seed", str(found.seed)]
    return shlex.join([*words, *how])
