"""`flasher simulate`: random upgrades with faults, judged by the flash memory of the devices."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Final

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.bench.campaigns import (
    CampaignOptions,
    canary_lines,
    exit_code,
    in_order,
    print_sum,
    run_campaign,
    violation_lines,
    walk_line,
    what_option,
)
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import argument, group, option, option_set, typed_values
from flasher.cli.options import target_option
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, UsageError
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.simulate.campaign import (
    Batch,
    Found,
    Result,
    batches,
    campaign_key,
    corpus_batch,
    run_batch,
    without_log,
)
from flasher.simulate.ledger import Merged
from flasher.simulate.ledger import merge as merge_ledgers
from flasher.simulate.plan import TEXT_MAX_SIZE, Plan, Subject
from flasher.simulate.play import Player, Verdict
from flasher.simulate.shrink import shows, shrink
from flasher.simulate.sweep import PartResult, parts
from flasher.simulate.sweep import run as run_part
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
TRACE_FILE: Final = "--trace-file"


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
class Campaign(CampaignOptions):
    """What a campaign runs."""

    seed: Annotated[int, what_option(
        "--seed", type=values.number, default="0", metavar="N", brief=True,
        help="seed of the first run; the next run has the next one",
    )]  # fmt: skip
    subject: Annotated[str | None, _subject]
    target: Annotated[Target | None, target_option(required=False)]
    dask: Annotated[str | None, what_option(
        "--dask", metavar="ADDRESS",
        help="run on the workers of this Dask scheduler (extra `cluster`), as tcp://host:8786",
    )]  # fmt: skip
    strict: Annotated[bool, what_option(
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
    size = _SUBJECT_BATCH if subject else _BATCH
    todo = chosen.part(batches(chosen.seed, chosen.most, size, subject, target))
    if not subject and (chosen.shard is None or chosen.shard[0] == 1):
        todo = chain([corpus_batch()], todo)

    def shrunk(first: Found, is_over: Callable[[], bool]) -> Found:
        shown = partial(shows, bench=Batch(key, 0, 0, subject=subject, target=target).bench)
        plan = shrink(Plan.parse(first.plan), first.kind, is_bad=shown, is_over=is_over)
        return replace(first, plan=str(plan))

    total, was_stopped = run_campaign(
        chosen, chosen.seed, todo, key, output, run_one=run_batch, shrunk=shrunk, dask=chosen.dask
    )
    is_shard = chosen.shard is not None
    replay = partial(_plan_line, subject=subject)
    # Most places are of the host's tables, not the business of who tests a bootloader.
    print_sum(total, output, replay=replay, is_shard=is_shard, is_brief=bool(subject))
    code = exit_code(total, is_strict=chosen.strict, is_shard=is_shard, was_stopped=was_stopped)
    _write_page(
        chosen.html,
        total,
        code,
        output,
        is_shard=is_shard,
        replay=replay,
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


def _write_page(
    path: Path | None,
    total: Result,
    code: ExitCode,
    output: Output,
    *,
    replay: Callable[[Found], str],
    is_shard: bool = False,
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
        canaries=[*canary_lines(total, is_shard=is_shard)],
        missing=[*missing],
        tallies=[*in_order(total.tallies)],
        classes=range(min(times, default=0), max(times, default=-1) + 1),
        replay=replay,
        places=len(total.reachable),
    )
    write_whole(path, page.encode("utf-8"), "--html")
    output.progress(f"html: {printable(str(path))}")


def _plan_line(found: Found, subject: str = "") -> str:
    return replay_line(found.plan, subject)


def replay_line(plan: str, subject: str = "") -> str:
    """Return the command that plays a plan again. Ledgers do not name the bootloader under test."""
    is_subject = any(isinstance(each, Subject) for each in Plan.parse(plan).devices)
    device = ["--subject", subject or "BOOTLOADER"] if is_subject else []
    return shlex.join(["flasher", "simulate", "replay", *device, plan])


@simulate.action("replay", exit_codes=(ExitCode.IMAGE, ExitCode.PARTIAL))
@argument("text", metavar="PLAN", help="the plan, in quotes; - reads it from standard input")
@_subject
@option(
    TRACE_FILE, type=values.FilePath("log", "asc", "csv", gives=Path), metavar="FILE",
    panel="reports", help="the frames of the run, as for `flasher explain`",
)  # fmt: skip
def replay(output: Output, *, text: str, subject: str | None, trace_file: Path | None) -> int:
    """Play a plan, as printed with a violation, exactly as it was. With -v, every frame, fault and
    event is printed.
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
        output.results(violation_lines(word, each))
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
    "files", nargs=-1, required=True, type=values.FilePath("jsonl", gives=Path), metavar="FILE...",
    help="the ledgers",
)  # fmt: skip
@_html
def merge(output: Output, *, files: tuple[Path, ...], html: Path | None) -> int:
    """Add up the ledgers of a campaign: of its shards, or of several sessions."""
    check_writable(html, "--html", files)
    merged = merge_ledgers(files)
    for notice in merged.notices:
        output.progress(notice)
    output.result(counted(merged.result.runs, "run"))
    replay = walk_line if merged.result.is_of_walks else _plan_line
    print_sum(merged.result, output, replay=replay, is_brief=merged.result.is_of_walks)
    missing = [f"MISSING: seeds {first} to {end - 1}" for first, end in merged.missing]
    if canaries := merged.missing_canaries:
        missing.append(
            f"MISSING: {len(canaries):,} of the canaries, the first at seed {canaries[0]}"
        )
    output.results(missing)
    code = exit_code(merged.result)
    if merged.missing or merged.missing_canaries:
        code = ExitCode.PARTIAL
    _write_page(html, merged.result, code, output, replay=replay, missing=missing)
    return output.document(merged, exit_code=code)


@dataclass(frozen=True)
class Sweep:
    """Parts of a sweep that were run."""

    parts: Sequence[PartResult]


@simulate.action("sweep", exit_codes=(ExitCode.PARTIAL, ExitCode.INTERRUPTED))
@argument("names", nargs=-1, metavar="[PART...]", help="see --list (default: all)")
@what_option("--list", "is_list", is_flag=True, brief=True, help="list the parts, and end")
@what_option(
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
