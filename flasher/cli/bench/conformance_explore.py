"""`flasher conformance explore`: random walks through messages, until one breaks a rule."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.bench.campaigns import (
    CampaignOptions,
    exit_code,
    print_sum,
    run_campaign,
    walk_line,
    what_option,
)
from flasher.cli.bench.conformance_bench import (
    OUTPUT_OPTIONS,
    bench_options,
    confirm_wear,
    described,
    opened,
)
from flasher.cli.bench.conformance_export import NAME as EXPORT_TEST
from flasher.cli.bench.conformance_export import check_export, export, export_option
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import command, option, option_set, rebuild_command_line, typed_values
from flasher.cli.options import Bus, adapter_options
from flasher.cli.output import Output, counted
from flasher.conformance.bench_options import BenchOptions, open_bench
from flasher.conformance.results import ExploreResult
from flasher.errors import ExitCode, UsageError
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.simulate.campaign import Found

_EXAMPLES: Final = """\
examples:
  flasher conformance explore -t bms --subject ./boot --steps 5000
  flasher conformance explore -t bms --subject ./boot --for 30
  flasher conformance explore -t bms --mock --variant accepts-early-end --seed 7
  flasher conformance explore -t bms --mock --replay 'reset update=384 packet packet-crc'
  flasher conformance explore -t bms --subject ./boot --runs 100000 --jobs 4 --ledger walks.jsonl

A walk begins with a running good image, and ends with an upgrade to it, which has to succeed. Only
valid messages may be answered positively, and every valid message has to be answered. A finding is
reduced to the shortest walk that shows it; --replay repeats that walk. Exit code 12 for a
finding. A device on a bus is erased about twice a walk (12 steps on average).

--runs, --jobs, --shard, --ledger and --keep-going make it a campaign, as `flasher simulate` runs
them: each walk has a seed and a new mock or bootloader of its own, so walks may be spread over
processes, computers and days. `flasher simulate merge` adds the ledgers of its parts up. Each
campaign also walks on a wrong device model (a canary), which it has to find.
"""
_TRACE_FILE: Final = "--trace-file"
_STEPS: Final = 2000
_WALKS_PER_STEP: Final = 1 / 12
_ERASES_A_WALK: Final = 2
_SEED_DIGITS: Final = 12
_CAMPAIGN: Final = ("--runs", "--jobs", "--shard", "--ledger", "--keep-going")
_REPLACED: Final = frozenset(
    {"--steps", "--for", "--seed", "--replay", _TRACE_FILE, EXPORT_TEST, "--yes", *OUTPUT_OPTIONS}
    | {*_CAMPAIGN}
)


DOCUMENTS: Final = (ExploreResult,)


@command(
    short_help="Send messages of all kinds, valid or not, until one shows a violation",
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.IMAGE, ExitCode.BUS, ExitCode.PARTIAL, ExitCode.INTERRUPTED),
)
@bench_options
@what_option(
    "--steps", type=values.count, metavar="N", brief=True,
    help=f"end after so many steps (default: {_STEPS}, without --for); not in a campaign",
)  # fmt: skip
@option_set("chosen", CampaignOptions)
@what_option(
    "--seed", default="1", metavar="SEED", brief=True,
    help="decides every walk; in a campaign it is the number of the first one",
)  # fmt: skip
@what_option(
    "--replay", metavar="STEPS", help="take these steps instead, as printed with a finding"
)
@what_option("-y", "--yes", is_flag=True, help="do not ask before a device on a bus is worn")
@option(
    _TRACE_FILE, type=values.FilePath("log", gives=Path), metavar="FILE", panel="reports",
    help="the frames of the walk that found something (candump)",
)  # fmt: skip
@export_option
@adapter_options
def explore(
    output: Output,
    bus: Bus,
    bench: BenchOptions,
    *,
    steps: int | None,
    chosen: CampaignOptions,
    seed: str,
    replay: str | None,
    yes: bool,
    trace_file: Path | None,
    export_test: Path | None,
) -> int:
    """Walk through valid and invalid messages in any order until the device breaks a rule, and
    find the shortest walk that breaks it.
    """
    from flasher.conformance.explore import Explorer  # noqa: PLC0415  much is loaded

    bench = described(bench, bus)
    for_s = chosen.for_s
    check_writable(trace_file, _TRACE_FILE, typed_values(but="trace_file"))
    check_export(export_test, bench)
    if chosen.runs or chosen.jobs > 1 or chosen.shard or chosen.ledger or chosen.keep_going:
        of_one: dict[str, object] = {"--steps": steps, "--replay": replay}
        of_one |= {_TRACE_FILE: trace_file, EXPORT_TEST: export_test}
        _check_campaign(bench, of_one, seed)
        return _campaign(output, bench, chosen, int(seed))
    most = steps or (_STEPS if for_s is None else inf)
    if not (bench.is_simulated or replay):
        if most < inf:
            erases = max(1, round(most * _WALKS_PER_STEP * _ERASES_A_WALK))
            wear = f"{most} steps erase and write the device about {erases} times"
        else:
            wear = f"the device is erased and written again and again for {for_s:g} s"
        confirm_wear(wear, is_agreed=yes)
    with (
        opened(bench, output) as (subject, profile, stopped),
        Bar(output, leave=False, unit=" steps" if most < inf else " s") as bar,
    ):
        began_s = time.perf_counter()

        def is_over() -> bool:
            return for_s is not None and time.perf_counter() - began_s >= for_s

        def show(done: int) -> None:
            if most < inf:
                bar.move_to(min(done, most), most)
            elif for_s is not None:
                bar.move_to(min(round(time.perf_counter() - began_s), for_s), for_s)

        explorer = Explorer(
            subject,
            profile,
            seed=seed,
            stopped=stopped,
            progress=show,
        )
        explored = (
            explorer.explore(most, is_over=is_over)
            if replay is None
            else explorer.replay(replay.split())
        )
        if export_test is not None:
            from flasher.conformance.dut.exported_test import export_walk  # noqa: PLC0415

            make = partial(export_walk, explored, subject, profile, stopped=stopped)
            found = [] if explored.finding is None else [("the walk", make)]
            export(export_test, found, output)
        was_stopped = stopped()
    code = ExitCode.OK if explored.finding is None else ExitCode.PARTIAL
    if was_stopped and explored.finding is None:
        code = ExitCode.INTERRUPTED
    return _tell(explored, output, trace_file, code)


def _check_campaign(bench: BenchOptions, of_one: Mapping[str, object], seed: str) -> None:
    """Raise UsageError for what does not fit a campaign; `of_one` are options of a single walk."""
    names = ", ".join(_CAMPAIGN)
    if not bench.is_simulated:
        raise UsageError(
            f"A campaign of walks ({names}) needs --mock or --subject.",
            cause="each of its walks begins on a new device, and several may run side by side; on a"
            " bus there is one device, which wears out",
            remedy="For a device on a bus, limit the walks by --steps or --for.",
        )
    if name := next((name for name, value in of_one.items() if value is not None), ""):
        raise UsageError(
            f"{name} does not work in a campaign ({names}).",
            remedy="Leave it out: --runs and --for limit a campaign, and the replay line of what it"
            f" finds takes {_TRACE_FILE} and {EXPORT_TEST}.",
        )
    if not (seed.isascii() and seed.isdecimal() and len(seed) <= _SEED_DIGITS):
        raise UsageError(
            f"The seed of a campaign is a number, not {printable(seed)[:40]!r}.",
            remedy="Write --seed 1, or leave it out.",
        )


def _campaign(output: Output, bench: BenchOptions, chosen: CampaignOptions, seed: int) -> int:
    from flasher.conformance.explore import Explorer  # noqa: PLC0415  much is loaded
    from flasher.simulate.walks import run_walks, walk_batches, walks_key  # noqa: PLC0415

    with open_bench(bench):
        pass  # one that is unusable is refused before the first walk

    def shrunk(first: Found, stopped: Callable[[], bool]) -> Found:
        with open_bench(bench) as (subject, profile):
            explorer = Explorer(subject, profile, stopped=stopped)
            finding = explorer.replay(first.plan.split(), shrinks=True).finding
        if finding is None:
            return first
        return replace(first, text=finding.text, plan=" ".join(finding.steps))

    total, was_stopped = run_campaign(
        chosen,
        seed,
        chosen.part(walk_batches(bench, seed, chosen.most)),
        walks_key(bench),
        output,
        run_one=run_walks,
        shrunk=shrunk,
    )
    is_shard, replay = chosen.shard is not None, partial(walk_line, words=_words())
    print_sum(total, output, replay=replay, is_shard=is_shard, is_brief=True)
    code = exit_code(total, is_shard=is_shard, was_stopped=was_stopped)
    return output.document(total, exit_code=code)


def _words() -> list[str]:
    """Return the command line for this device, without what is run."""
    ctx = click.get_current_context()
    words = ["flasher", *rebuild_command_line(ctx, "conformance", without=_REPLACED.__contains__)]
    words.insert(words.index("conformance") + 1, "explore")
    return words


def _tell(explored: ExploreResult, output: Output, trace_file: Path | None, code: ExitCode) -> int:
    finding = explored.finding
    met = sum(bool(each.count) for each in explored.coverage)
    output.result(
        f"{printable(explored.subject)}: {counted(explored.walks, 'walk')}, "
        f"{counted(explored.steps, 'step')}, seed {printable(explored.seed)}"
    )
    output.result(f"{met} of {len(explored.coverage)} pairs of phase and step were covered")
    if explored.not_covered and output.verbosity > 0:
        for phase in dict.fromkeys(phase for phase, _ in explored.not_covered):
            names = [name for its, name in explored.not_covered if its == phase]
            output.result(f"  never in the phase {phase}: {', '.join(names)}")
    if finding is not None:
        replay = shlex.join([*_words(), "--replay", " ".join(finding.steps)])
        explored = replace(explored, finding=replace(finding, replay=replay))
        output.result(f"FOUND {finding.rule}: {printable(finding.text)}")
        output.result(f"  steps: {' '.join(finding.steps) or 'none: the good image is flashed'}")
        output.result(f"  replay: {printable(replay)}")
        if trace_file is not None:
            from flasher.conformance.reports import candump  # noqa: PLC0415

            write_whole(trace_file, candump(finding.trace), _TRACE_FILE, is_private=True)
            output.progress(f"trace: {printable(str(trace_file))}")
        if explored.stopped:
            output.result(printable(explored.stopped))
    else:
        output.result(explored.stopped or "nothing was found")
    return output.document(explored, exit_code=code)
