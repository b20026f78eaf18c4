"""`flasher simulate`: random upgrades with faults, judged by what is in the devices' flash."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Final

import click

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.files import check_writable
from flasher.cli.framework import argument, group, option, option_set, typed_values
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, UsageError
from flasher.processes import end_with_parent
from flasher.protocol.frame import Frame
from flasher.protocol.text import printable
from flasher.simulate.campaign import NO_FAULT, Batch, Found, Result, Tally
from flasher.simulate.play import Verdict

_EXAMPLES: Final = """\
examples:
  flasher simulate
  flasher simulate --for 600 --jobs 4
  flasher simulate --seed 1000000 --runs 20000 --keep-going --json
  flasher simulate replay 'job packets=3 ; independent erase=0.05 ; @packet2 power'

A run is an upgrade by the production code on a simulated bus. Its seed decides device, adapter and
faults: frames that are lost, doubled, changed or late, power cuts, unplugged adapters,
other tools, duplicate devices, pauses of this computer. Success is believed only if the device's
flash equals the image; after a failure the device must be brought back by the commands that the
documentation advises. Nothing is sent to a real bus.

The first violation is printed as the shortest plan that shows it, with a command that replays it on
any computer; exit code 12. Every campaign also plants a mistake into its own process (a canary),
which it has to find; a campaign that misses it is blind, exit code 12 as well.
"""
_BATCH: Final = 50
"""Runs of a batch."""
_RUNS: Final = 1000
_ENDLESS: Final = 10**12
"""Runs that no campaign reaches."""
TRACE_FILE: Final = "--trace-file"

DOCUMENTS: Final = (Result, Verdict)

_what = partial(option, panel="what is run, and how")


@dataclass(frozen=True)
class Campaign:
    """What a campaign runs."""

    runs: Annotated[int | None, _what(
        "--runs", type=values.count, metavar="N", brief=True,
        help=f"end after so many runs (default: {_RUNS}, without --for)",
    )]  # fmt: skip
    for_s: Annotated[float | None, _what(
        "--for", "for_s", type=values.seconds, metavar="SECONDS", brief=True,
        help="end after this time",
    )]  # fmt: skip
    seed: Annotated[int, _what(
        "--seed", type=values.number, default="0", metavar="N", brief=True,
        help="seed of the first run; the next run has the next one",
    )]  # fmt: skip
    jobs: Annotated[int, _what(
        "--jobs", type=values.count, default="1", metavar="N", brief=True,
        help="run on N processes side by side",
    )]  # fmt: skip
    keep_going: Annotated[bool, _what(
        "--keep-going", is_flag=True, help="do not end at the first violation",
    )]  # fmt: skip
    strict: Annotated[bool, _what(
        "--strict", is_flag=True,
        help="fail as well if no run reached some row of the tables, or some fault in some phase",
    )]  # fmt: skip


@group(
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.PARTIAL, ExitCode.INTERRUPTED),
    runs_alone=True,
)
@option_set("chosen", Campaign)
def simulate(output: Output, chosen: Campaign) -> int:
    """Upgrade simulated devices with random faults, and compare what the tool claims with what is
    in their flash.
    """
    from flasher.simulate.campaign import Result, batches, campaign_key  # noqa: PLC0415  slow

    most = chosen.runs or (_RUNS if chosen.for_s is None else _ENDLESS)
    began_s = time.perf_counter()
    total = Result(campaign_key())
    with (
        stop_on_signal(lambda: output.progress("Ending.")) as stopped,
        Bar(output, leave=False, unit=" runs" if most < _ENDLESS else " s") as bar,
    ):

        def is_over() -> bool:
            is_late = chosen.for_s is not None and time.perf_counter() - began_s >= chosen.for_s
            has_failed = total.violation_count > 0 and not chosen.keep_going
            return is_late or has_failed or stopped()

        for result in _results(batches(chosen.seed, most, _BATCH), chosen.jobs, is_over):
            total += result
            if most < _ENDLESS:
                bar.move_to(total.runs, most)
            elif chosen.for_s is not None:
                took_s = time.perf_counter() - began_s
                bar.move_to(min(round(took_s), chosen.for_s), chosen.for_s)
    took_s = time.perf_counter() - began_s
    if total.violations and not stopped():
        output.progress("Shrinking the first violation.")
        total = replace(total, violations=(_shrunk(total.violations[0]), *total.violations[1:]))
    _tell(total, took_s, output)
    failed = total.violation_count or total.is_blind or (chosen.strict and total.never_reached)
    code = ExitCode.PARTIAL if failed else ExitCode.OK
    if stopped() and not total.violation_count:
        code = ExitCode.INTERRUPTED
    return output.document(total, exit_code=code)


def _results(todo: Iterable[Batch], jobs: int, is_over: Callable[[], bool]) -> Iterator[Result]:
    """Yield the results of batches as they come, until it is over."""
    from flasher.simulate.campaign import run_batch  # noqa: PLC0415  slow

    if jobs == 1:
        for batch in todo:
            if is_over():
                return
            yield run_batch(batch, is_over)
        return
    waiting = iter(todo)
    with ProcessPoolExecutor(jobs, initializer=end_with_parent) as pool:
        futures = {pool.submit(run_batch, batch) for batch in islice(waiting, 2 * jobs)}
        while futures:
            ended, futures = wait(futures, return_when="FIRST_COMPLETED")
            for future in ended:
                yield future.result()
            if not is_over():
                futures |= {pool.submit(run_batch, each) for each in islice(waiting, len(ended))}


def _shrunk(found: Found) -> Found:
    from flasher.simulate.plan import Plan  # noqa: PLC0415  slow
    from flasher.simulate.shrink import shrink  # noqa: PLC0415  slow

    return replace(found, plan=str(shrink(Plan.parse(found.plan), found.kind)))


def _tell(total: Result, took_s: float, output: Output) -> None:
    """Print the sum of a campaign."""
    rate = 60 * total.runs / took_s if took_s else 0.0
    output.result(f"{counted(total.runs, 'run')} in {took_s:.0f} s, {rate:,.0f} a minute")
    if total.tallies:
        output.table(_rows(total.tallies), indent=2)
    never = total.never_reached
    output.result(f"{len(total.reached)} places reached, {len(never)} never (-v lists them)")
    if output.verbosity > 0:
        output.results(f"  never: {each}" for each in never)
    for name, count in total.canaries_missed.items():
        output.result(f"BLIND: the planted mistake {name} was not found {counted(count, 'time')}")
    found = sum(total.canaries_found.values())
    if found:
        output.result(f"{counted(found, 'canary')} found")
    elif total.is_blind and not total.canaries_missed:
        output.result("BLIND: no canary was tried")
    for each in total.violations:
        output.result(f"VIOLATION {each.kind}: {printable(each.text)}")
        output.result(f"  seed {each.seed}; replay: {replay_line(each.plan)}")
    if total.violation_count > len(total.violations):
        output.result(f"{total.violation_count:,} violations in all")
    if not total.violation_count:
        output.result("no violation")


def _rows(tallies: Mapping[str, Tally]) -> Iterator[Sequence[str]]:
    yield ("fault", "runs", "upgraded", "again", "rescued", "median time")
    for name in (NO_FAULT, *(each for each in tallies if each != NO_FAULT)):
        tally = tallies.get(name)
        if tally is None:
            continue
        median = tally.median_time
        yield (
            name,
            f"{tally.runs:,}",
            f"{tally.good:,}",
            f"{tally.by_flash:,}",
            f"{tally.by_rescue:,}",
            "" if median is None else f"{median:.1f} x",
        )


def replay_line(plan: str) -> str:
    """Return the command that plays a plan again."""
    return shlex.join(["flasher", "simulate", "replay", plan])


@simulate.action("replay", exit_codes=(ExitCode.IMAGE, ExitCode.PARTIAL))
@argument("text", metavar="PLAN")
@option(
    TRACE_FILE, type=values.FilePath("log", "asc", "csv", gives=Path), metavar="FILE",
    panel="reports", help="the frames of the run, as for `flasher explain`",
)  # fmt: skip
def replay(output: Output, *, text: str, trace_file: Path | None) -> int:
    """Play a plan, as printed with a violation, exactly as it was: - reads it from standard input.
    With -v, every frame, fault and event is printed.
    """
    from flasher.simulate.plan import Plan  # noqa: PLC0415  slow
    from flasher.simulate.play import Player  # noqa: PLC0415  slow
    from flasher.trace.recorder import Recorder  # noqa: PLC0415

    line = click.get_text_stream("stdin").read() if text == "-" else text
    try:
        plan = Plan.parse(line)
    except ValueError as error:
        raise UsageError(
            f"The plan cannot be read: {printable(str(error))}.",
            remedy="Give the plan as one argument, in quotes, as it was printed.",
        ) from error
    check_writable(trace_file, TRACE_FILE, typed_values(but="trace_file"))
    with ExitStack() as files:
        recorder = None if trace_file is None else files.enter_context(Recorder(trace_file))

        def record(frame: Frame, sender: str | None, now: float) -> None:
            if recorder is not None:
                recorder(frame, sent=sender == "host", now=now)

        log = output.result if output.verbosity > 0 else None
        verdict = Player(plan, log=log, tap=record).play()
    output.result(f"{verdict.ending}, exit code {verdict.exit_code}, {verdict.took_s:.2f} s")
    if verdict.where:
        output.result(f"  {printable(verdict.where)}")
    output.result(f"in the device's flash: {verdict.left}")
    if verdict.recovered:
        output.result(f"brought back by: flasher {verdict.recovered}")
    output.result(f"digest of all frames: {verdict.wire}")
    for each in verdict.violations:
        word = "not counted" if each.is_excused else "VIOLATION"
        output.result(f"{word} {each.kind}: {printable(each.text)}")
    failed = any(not each.is_excused for each in verdict.violations)
    return output.document(verdict, exit_code=ExitCode.PARTIAL if failed else ExitCode.OK)
