"""`flasher conformance explore`: random walks through messages, until one breaks a rule."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Final

import click

from flasher.cli import values
from flasher.cli.bar import Bar
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
from flasher.cli.framework import command, option, rebuild_command_line, typed_values
from flasher.cli.options import Bus, adapter_options
from flasher.cli.output import Output, counted
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.results import ExploreResult
from flasher.errors import ExitCode
from flasher.protocol.text import printable

_EXAMPLES: Final = """\
examples:
  flasher conformance explore -t bms --subject ./boot --steps 5000
  flasher conformance explore -t bms --subject ./boot --for 30
  flasher conformance explore -t bms --mock --variant accepts-early-end --seed 7
  flasher conformance explore -t bms --mock --replay 'reset update=384 packet packet-crc'

A walk begins with a running good image, and ends with an upgrade to it, which has to succeed. Only
valid messages may be answered positively, and every valid message has to be answered. A finding is
reduced to the shortest walk that shows it; --replay repeats that walk. Exit code 12 for a
finding. A device on a bus is erased about twice a walk (12 steps on average).
"""
_TRACE_FILE: Final = "--trace-file"
_STEPS: Final = 2000
_WALKS_PER_STEP: Final = 1 / 12
_ERASES_A_WALK: Final = 2
_REPLACED: Final = frozenset(
    {"--steps", "--for", "--seed", "--replay", _TRACE_FILE, EXPORT_TEST, "--yes", *OUTPUT_OPTIONS}
)


DOCUMENTS: Final = (ExploreResult,)


_what = partial(option, panel="what is run, and how")


@command(
    short_help="Walk through messages of all kinds until something is found",
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.IMAGE, ExitCode.BUS, ExitCode.PARTIAL, ExitCode.INTERRUPTED),
)
@bench_options
@_what(
    "--steps", type=values.count, metavar="N", brief=True,
    help=f"end after so many steps (default: {_STEPS}, without --for)",
)  # fmt: skip
@_what(
    "--for", "for_s", type=values.seconds, metavar="SECONDS", brief=True,
    help="end after the walk in which this time is over",
)  # fmt: skip
@_what(
    "--seed", default="1", metavar="SEED", brief=True,
    help="decides every walk; another seed takes others",
)  # fmt: skip
@_what("--replay", metavar="STEPS", help="take these steps instead, as printed with a finding")
@_what("-y", "--yes", is_flag=True, help="do not ask before a device on a bus is worn")
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
    for_s: float | None,
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
    check_writable(trace_file, _TRACE_FILE, typed_values(but="trace_file"))
    check_export(export_test, bench)
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


def _tell(explored: ExploreResult, output: Output, trace_file: Path | None, code: ExitCode) -> int:
    ctx, finding = click.get_current_context(), explored.finding
    words = ["flasher", *rebuild_command_line(ctx, "conformance", without=_REPLACED.__contains__)]
    words.insert(words.index("conformance") + 1, "explore")
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
        replay = shlex.join([*words, "--replay", " ".join(finding.steps)])
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
