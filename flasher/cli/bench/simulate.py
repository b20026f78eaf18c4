"""`flasher simulate`: random upgrades with faults, judged by what is in the devices' flash."""

from __future__ import annotations

import shlex
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import Annotated, Final

import click

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.extras import need
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import argument, group, option, option_set, typed_values
from flasher.cli.options import target_option
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.conformance.results import LINE_JOINT
from flasher.errors import ExitCode, UsageError
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.simulate.campaign import (
    NO_FAULT,
    Batch,
    Found,
    Result,
    Tally,
    batches,
    campaign_key,
    corpus_batch,
    run_batch,
    share,
    without_log,
)
from flasher.simulate.ledger import Ledger, Merged
from flasher.simulate.ledger import merge as merge_ledgers
from flasher.simulate.oracle import Violation
from flasher.simulate.plan import TEXT_MAX_SIZE, Plan, Subject
from flasher.simulate.play import Player, Verdict
from flasher.simulate.shrink import shows, shrink
from flasher.simulate.sweep import PartResult, parts
from flasher.simulate.sweep import run as run_part
from flasher.simulate.workers import KILLED, OnResult
from flasher.simulate.workers import run as run_in_processes
from flasher.trace.recorder import Recorder

_EXAMPLES: Final = """\
examples:
  flasher simulate
  flasher simulate --for 600 --jobs 4
  flasher simulate --seed 1000000 --runs 20000 --keep-going --json
  flasher simulate --runs 1000000 --jobs 8 --ledger campaign.jsonl
  flasher simulate --subject ./boot -t bms --for 60
  flasher simulate sweep limits
  flasher simulate replay 'job packets=3 ; independent erase=0.05 ; @packet2 power'

A run is an upgrade by the production code on a simulated bus. Its seed decides device, adapter and
faults: frames that are lost, doubled, changed or late, power cuts, unplugged adapters,
other tools, duplicate devices, pauses of this computer. Success is believed only if the device's
flash equals the image; after a failure the device must be brought back by the commands that the
documentation advises. Nothing is sent to a real bus.

In the table, `again` is how many failed runs the same command brought back without faults,
`rescued` how many `flasher rescue` did, and `median time` that of the successful ones, as a
multiple of the time on the bus.

With --subject, all devices are your bootloader, with simulated flash memory and application. It
gets the same faults, and more of them in its flash operations. A crash, a sanitizer report, a call
that does not return, and a forbidden flash access are violations of kind SUBJECT.

Before the random runs, each campaign plays a corpus: plans for what random ones seldom reach. What
no run reached is listed, without what none can reach.

The first violation is printed as the shortest plan that shows it, with a command that replays it on
any computer; exit code 12. Every campaign also plants a mistake into its own process (a canary),
which it has to find; a campaign that misses it is blind, exit code 12 as well.
"""
_BATCH: Final = 50
"""Runs of a batch."""
_SUBJECT_BATCH: Final = 10
"""The same with a bootloader under test, whose runs take longer."""
_RUNS: Final = 1000
_COLUMNS: Final = 79
_ENDLESS: Final = 10**12
"""Runs that no campaign reaches."""
TRACE_FILE: Final = "--trace-file"


_what = partial(option, panel="what is run, and how")


def _shard(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise click.BadParameter(f"{text!r} is not a part of a campaign, as 3/8")
    return int(number), int(count)


_subject: Final = option(
    "--subject", metavar="BOOTLOADER", panel="device", brief=True,
    help="upgrade the bootloader of a target (-t, default bms) that is compiled for this computer:"
    " a program, a shared library, or MODULE:FACTORY; see `flasher conformance header`",
)  # fmt: skip
_html: Final = option(
    "--html", type=values.FilePath("html", gives=Path), metavar="FILE", panel="reports",
    help="the campaign as one self-contained page",
)  # fmt: skip


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
        "--jobs", type=values.processes, default="1", metavar="N", brief=True,
        help="run on N processes side by side",
    )]  # fmt: skip
    shard: Annotated[tuple[int, int] | None, _what(
        "--shard", type=_shard, metavar="I/N",
        help="run the part I of N parts, as in a job array; `simulate merge` adds them up",
    )]  # fmt: skip
    ledger: Annotated[Path | None, _what(
        "--ledger", type=values.FilePath("jsonl", gives=Path), metavar="FILE",
        help="save what is done in this file, and go on with what it lacks",
    )]  # fmt: skip
    subject: Annotated[str | None, _subject]
    target: Annotated[Target | None, target_option(required=False)]
    dask: Annotated[str | None, _what(
        "--dask", metavar="ADDRESS",
        help="run on the workers of this Dask scheduler (extra `cluster`), as tcp://host:8786",
    )]  # fmt: skip
    keep_going: Annotated[bool, _what(
        "--keep-going", is_flag=True, help="do not end at the first violation",
    )]  # fmt: skip
    strict: Annotated[bool, _what(
        "--strict", is_flag=True,
        help="fail as well if no run reached some row of the tables, fault in a phase, exit code,"
        " or reading of the documents",
    )]  # fmt: skip
    html: Annotated[Path | None, _html]


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
    check_writable(chosen.html, "--html", typed_values(but="html"))
    subject, target = _subject_of(chosen)
    key = campaign_key(subject, target)
    most = chosen.runs or (_RUNS if chosen.for_s is None else _ENDLESS)
    todo: Iterable[Batch] = batches(
        chosen.seed, most, _SUBJECT_BATCH if subject else _BATCH, subject, target
    )
    if chosen.shard is not None:
        todo = share(todo, *chosen.shard)
    if not subject and (chosen.shard is None or chosen.shard[0] == 1):
        todo = chain([corpus_batch()], todo)
    began_s = time.perf_counter()
    total = Result(key)
    with (
        stop_on_signal(lambda: output.progress("Ending.")) as stopped,
        Bar(output, leave=False, unit=" runs" if most < _ENDLESS else " s") as bar,
        ExitStack() as files,
    ):
        ledger: Ledger | None = None
        if chosen.ledger is not None:
            whole = None if most == _ENDLESS else most
            ledger = files.enter_context(Ledger(chosen.ledger, chosen.seed, whole, key))
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

        _run(todo, chosen, add, is_over)
        took_s = time.perf_counter() - began_s
        first = next(iter(total.violations), None)
        if first is not None and first.kind != KILLED and not stopped():
            output.progress("Shrinking the first violation; Ctrl-C ends that.")
            shown = partial(shows, bench=Batch(key, 0, 0, subject=subject, target=target).bench)
            plan = shrink(Plan.parse(first.plan), first.kind, is_bad=shown, is_over=stopped)
            total = replace(
                total, violations=(replace(first, plan=str(plan)), *total.violations[1:])
            )
        was_stopped = stopped()
    rate = 60 * (total.runs - before) / took_s if took_s else 0.0
    output.result(f"{counted(total.runs, 'run')}, {rate:,.0f} a minute")
    is_shard = chosen.shard is not None
    _print_sum(total, output, is_shard=is_shard, subject=subject)
    code = _exit_code(total, is_strict=chosen.strict, is_shard=is_shard)
    if was_stopped and code is ExitCode.OK:
        code = ExitCode.INTERRUPTED
    _write_page(
        chosen.html,
        total,
        code,
        output,
        is_shard=is_shard,
        subject=subject,
        missing=["STOPPED before its end"] if was_stopped else [],
    )
    return output.document(total, exit_code=code)


def _subject_of(chosen: Campaign) -> tuple[str, str]:
    """Return the bootloader under test and its target; both are empty without one. Raises
    UsageError for one that is unusable, and for options that do not fit.
    """
    if chosen.subject is None:
        if chosen.target is not None:
            raise UsageError(
                "-t/--target works with --subject only.",
                remedy="Leave it out: the plans have devices of each kind.",
            )
        return "", ""
    if chosen.dask is not None:
        raise UsageError("--subject does not work with --dask.", remedy="Use --jobs or --shard.")
    target = "bms" if chosen.target is None else chosen.target.name
    from flasher.simulate.subject import bench  # noqa: PLC0415  loads much of the suite

    bench(chosen.subject, target)
    return chosen.subject, target


def _run(
    todo: Iterable[Batch], chosen: Campaign, add: OnResult, is_over: Callable[[], bool]
) -> None:
    """Run batches here, on processes, or on a cluster."""
    if chosen.dask is not None:
        need("--dask", "cluster")
        from flasher.simulate.cluster import run_on_cluster  # noqa: PLC0415  an extra

        run_on_cluster(chosen.dask, todo, on_result=add, is_stopped=is_over)
    elif chosen.jobs > 1:
        run_in_processes(todo, chosen.jobs, on_result=add, is_stopped=is_over)
    else:
        for batch in todo:
            if is_over():
                break
            add(batch, run_batch(batch, is_over))


def _exit_code(total: Result, *, is_strict: bool, is_shard: bool = False) -> ExitCode:
    is_blind = bool(total.canaries_missed) if is_shard else total.is_blind
    is_empty = not (total.runs or is_shard)
    failed = total.violation_count or is_blind or is_empty or (is_strict and total.never_reached)
    return ExitCode.PARTIAL if failed else ExitCode.OK


def _print_sum(total: Result, output: Output, *, is_shard: bool = False, subject: str = "") -> None:
    """Print the sum of a campaign."""
    if total.tallies:
        output.table(_rows(total.tallies), indent=2)
    count, never = len(total.reachable), total.never_reached
    if total.corpus_runs:
        output.result(f"{counted(total.corpus_runs, 'plan')} of the corpus played")
    # Most are of the host's tables, which are not the business of who tests a bootloader.
    is_listed = not subject or output.verbosity > 0
    hint = "" if is_listed or not never else " (-v lists the others)"
    output.result(f"{count - len(never)} of {count} places reached{hint}")
    if is_listed:
        output.results(_never_lines(never))
    output.results(_canary_lines(total, is_shard=is_shard))
    for each in total.violations:
        output.results(_violation_lines("VIOLATION", each))
        where = "corpus" if each.seed < 0 else f"seed {each.seed}"
        output.result(f"  {where}; replay: {replay_line(each.plan, subject)}")
    if total.violation_count > len(total.violations):
        output.result(f"{total.violation_count:,} violations in all")
    if not total.runs:
        how = "allow more time, or make fewer parts" if is_shard else "allow more time"
        output.result(f"NOTHING TRIED: no random plan was played; {how}")
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


def _violation_lines(word: str, violation: Violation | Found) -> Iterator[str]:
    text, *printed = violation.text.split(LINE_JOINT)
    yield f"{word} {violation.kind}: {printable(text)}"
    yield from (f"    {printable(line)}" for line in printed)


def _canary_lines(total: Result, *, is_shard: bool) -> Iterator[str]:
    for name, count in total.canaries_missed.items():
        yield f"BLIND: the planted mistake {name} was not found {counted(count, 'time')}"
    found = sum(total.canaries_found.values())
    if found:
        yield f"canaries found: {found}"
    elif is_shard and not total.canaries_missed:
        yield "no canary in this part: `flasher simulate merge` judges that"
    elif total.is_blind and not total.canaries_missed:
        yield "BLIND: no canary was tried"


def _write_page(
    path: Path | None,
    total: Result,
    code: ExitCode,
    output: Output,
    *,
    is_shard: bool = False,
    subject: str = "",
    missing: Iterable[str] = (),
) -> None:
    """Write the page of a campaign; `missing`: lines about what a merged one lacks."""
    if path is None:
        return
    from flasher.report.base import Status, render_page  # noqa: PLC0415  loads jinja2

    times = [each for tally in total.tallies.values() for each in tally.times]
    page = render_page(
        "campaign.html",
        total=total,
        status=Status.GOOD if code is ExitCode.OK else Status.BAD,
        canaries=[*_canary_lines(total, is_shard=is_shard)],
        missing=[*missing],
        tallies=[*_in_order(total.tallies)],
        classes=range(min(times, default=0), max(times, default=-1) + 1),
        replay=partial(replay_line, subject=subject),
        places=len(total.reachable),
    )
    write_whole(path, page.encode("utf-8"), "--html")
    output.progress(f"html: {printable(str(path))}")


def _rows(tallies: Mapping[str, Tally]) -> Iterator[Sequence[str]]:
    yield ("fault", "runs", "upgraded", "again", "rescued", "median time")
    for name, tally in _in_order(tallies):
        median = tally.median_time
        yield (
            name,
            f"{tally.runs:,}",
            f"{tally.good:,}",
            f"{tally.by_flash:,}",
            f"{tally.by_rescue:,}",
            "" if median is None else f"{median:.1f} x",
        )


def _in_order(tallies: Mapping[str, Tally]) -> Sequence[tuple[str, Tally]]:
    """Return tallies by the name of the fault; runs without a fault come first."""
    return sorted(tallies.items(), key=lambda each: each[0] != NO_FAULT)


def replay_line(plan: str, subject: str = "") -> str:
    """Return the command that plays a plan again. Ledgers do not name the bootloader under test."""
    is_subject = any(isinstance(each, Subject) for each in Plan.parse(plan).devices)
    device = ["--subject", subject or "BOOTLOADER"] if is_subject else []
    return shlex.join(["flasher", "simulate", "replay", *device, plan])


@simulate.action("replay", exit_codes=(ExitCode.IMAGE, ExitCode.PARTIAL))
@argument("text", metavar="PLAN")
@_subject
@option(
    TRACE_FILE, type=values.FilePath("log", "asc", "csv", gives=Path), metavar="FILE",
    panel="reports", help="the frames of the run, as for `flasher explain`",
)  # fmt: skip
def replay(output: Output, *, text: str, subject: str | None, trace_file: Path | None) -> int:
    """Play a plan, as printed with a violation, exactly as it was: - reads it from standard input.
    With -v, every frame, fault and event is printed.
    """
    line = sys.stdin.read(TEXT_MAX_SIZE + 1) if text == "-" else text
    try:
        plan = Plan.parse(line)
    except ValueError as error:
        raise UsageError(
            f"The plan cannot be read: {printable(str(error))}.",
            remedy="Give the plan as it was printed: in quotes as one argument, or without quotes"
            " on standard input.",
        ) from error
    _check_device(plan, subject)
    check_writable(trace_file, TRACE_FILE, typed_values(but="trace_file"))
    bench = Batch("", 0, 0, subject=subject or "", target=plan.job.target).bench
    with ExitStack() as files:
        recorder = None if trace_file is None else files.enter_context(Recorder(trace_file))

        def record(frame: Frame, sender: str | None, now: float) -> None:
            if recorder is not None:
                recorder(frame, sent=sender == "host", now=now)

        log: Callable[[str], object] | None = output.result if output.verbosity > 0 else None
        verdict = Player(plan, bench=bench, log=log, tap=record).play()
    output.result(f"{verdict.ending}, exit code {verdict.exit_code}, {verdict.took_s:.2f} s")
    if verdict.where:
        output.result(f"  {printable(verdict.where)}")
    if verdict.left:
        output.result(f"in the device's flash: {verdict.left}")
    if verdict.recovered:
        output.result(f"brought back by: flasher {verdict.recovered}")
    output.result(f"digest of all frames: {verdict.wire}")
    for each in verdict.violations:
        word = "not counted" if each.is_excused else "VIOLATION"
        output.results(_violation_lines(word, each))
    failed = any(not each.is_excused for each in verdict.violations)
    return output.document(verdict, exit_code=ExitCode.PARTIAL if failed else ExitCode.OK)


def _check_device(plan: Plan, subject: str | None) -> None:
    is_subject = [isinstance(each, Subject) for each in plan.devices]
    if subject is None and any(is_subject):
        raise UsageError(
            "The device of the plan is a bootloader under test.",
            remedy="Name it: --subject ./boot.",
        )
    if subject is not None and is_subject != [True]:
        raise UsageError(
            "The device of the plan is not the bootloader under test.",
            remedy="Write `subject` for its device, or leave --subject out.",
        )


@simulate.action("merge", exit_codes=(ExitCode.PARTIAL,))
@argument(
    "files", nargs=-1, required=True, type=values.FilePath("jsonl", gives=Path), metavar="FILE..."
)
@_html
def merge(output: Output, *, files: tuple[Path, ...], html: Path | None) -> int:
    """Add the ledgers of a campaign up: of its shards, or of several sessions."""
    check_writable(html, "--html", files)
    merged = merge_ledgers(files)
    for notice in merged.notices:
        output.progress(notice)
    output.result(counted(merged.result.runs, "run"))
    _print_sum(merged.result, output)
    missing = [f"MISSING: seeds {first} to {end - 1}" for first, end in merged.missing]
    if canaries := merged.missing_canaries:
        missing.append(
            f"MISSING: {len(canaries):,} of the canaries, the first at seed {canaries[0]}"
        )
    output.results(missing)
    code = _exit_code(merged.result, is_strict=False)
    if merged.missing or merged.missing_canaries:
        code = ExitCode.PARTIAL
    _write_page(html, merged.result, code, output, missing=missing)
    return output.document(merged, exit_code=code)


@dataclass(frozen=True)
class Sweep:
    """Parts of a sweep that were run."""

    parts: Sequence[PartResult]


@simulate.action("sweep", exit_codes=(ExitCode.PARTIAL, ExitCode.INTERRUPTED))
@argument("names", nargs=-1, metavar="[PART...]")
@_what("--list", "is_list", is_flag=True, brief=True, help="list the parts, and end")
@_what(
    "--every", type=values.count, default="1", metavar="N", brief=True,
    help="run every Nth case only",
)  # fmt: skip
@without_log()
def sweep(output: Output, *, names: tuple[str, ...], is_list: bool, every: int) -> int:
    """Try every single fault, pair of faults, power cut and time limit in an upgrade of 4 packets,
    and all small errors against the CRC: all parts, or those that are named.
    """
    known = {each.name: each for each in parts()}
    if unknown := [name for name in names if name not in known]:
        raise UsageError(
            f"The sweep has no part {printable(unknown[0])}.",
            remedy=f"Name one of: {', '.join(known)}.",
        )
    if is_list:
        output.table([(each.name, f"{each.count:,}", each.what) for each in known.values()])
        return output.document(None)
    done: list[PartResult] = []
    with stop_on_signal(lambda: output.progress("Ending.")) as stopped:
        for name in names or known:
            part = known[name].taken(every)
            with Bar(output, leave=False, unit=" cases", desc=name) as bar:
                found = run_part(part, stopped, _progress(bar, part.count))
            done.append(found)
            output.result(f"{name}: {found.runs:,} of {counted(part.count, 'case')}")
            output.table(
                [(ending, f"{count:,}") for ending, count in found.endings.items()], indent=2
            )
            for each in found.violations:
                output.result(f"VIOLATION {each.kind}: {printable(each.text)}")
                output.result(f"  case {each.seed}; replay: {replay_line(each.plan)}")
            if stopped():
                break
        was_stopped = stopped()
    failed = any(each.violations for each in done)
    code = ExitCode.PARTIAL if failed else ExitCode.OK
    if was_stopped and not failed:
        code = ExitCode.INTERRUPTED
    return output.document(Sweep(done), exit_code=code)


def _progress(bar: Bar, count: int) -> Callable[[int, int], None]:
    return lambda runs, _violations: bar.move_to(runs, count)


DOCUMENTS: Final = (Result, Verdict, Merged, Sweep)
