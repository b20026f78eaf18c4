"""Records and figures of a station in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from flasher.cli.look.explain_text import story_lines
from flasher.cli.output import counted, duration
from flasher.prose import prose
from flasher.protocol.text import printable
from flasher.station.records.model import (
    Figures,
    RunDetails,
    RunId,
    RunState,
    StepRecord,
    UnitLife,
    WriteRecord,
)
from flasher.trace.story import Story

_NO_VERDICT: Final = (RunState.ERROR, RunState.ABORTED, RunState.INTERRUPTED)


def percent(share: float | None) -> str:
    """A share of 1; never 100 % for a little less."""
    if share is None:
        return "-"
    return f"{int(share * 1000) / 10:g} %"


def figures_line(figures: Figures) -> str:
    """The figures in one line."""
    failed = figures.units - figures.passed
    first = percent(figures.first_pass_share)
    line = (
        f"{counted(figures.units, 'unit')}: {figures.passed:,} passed, {failed:,} failed; "
        f"yield {percent(figures.yield_share)}, first pass {first}"
    )
    if figures.duration_median_s is not None:
        line += f"; median {duration(figures.duration_median_s)}"
    return line


def figure_lines(figures: Figures) -> Iterator[str]:
    """The figures of a report."""
    yield figures_line(figures)
    open_runs = {state: figures.by_state.get(state.value, 0) for state in _NO_VERDICT}
    words = [f"{count:,} {state.value}" for state, count in open_runs.items() if count]
    yield f"  runs:     {figures.runs:,}" + (f", of them {', '.join(words)}" if words else "")
    if figures.virtual_runs:
        yield f"  VIRTUAL:  {counted(figures.virtual_runs, 'run')} of virtual units, no products"
    if figures.duration_longest_s is not None:
        yield f"  longest:  {duration(figures.duration_longest_s)} of those that passed"
    for code, count in figures.failures.items():
        yield f"  {count:7,}  {printable(code)}"


def unit_lines(
    life: UnitLife, told: Mapping[RunId, Sequence[Story | str]], *, full: bool
) -> Iterator[str]:
    """A unit's whole life; `told` are the stories of each run's traces, or why there is none."""
    nature = ", a VIRTUAL unit, no product" if life.is_virtual else ""
    yield printable(f"{life.serial}, part {life.part}: {life.state.value}{nature}")
    for details in life.runs:
        yield ""
        yield from _run_lines(details)
        for story in told.get(details.run.run_id, ()):
            yield from _story_lines(story, full=full)


def _run_lines(details: RunDetails) -> Iterator[str]:
    run = details.run
    took = "" if run.duration_s is None else f" after {duration(run.duration_s)}"
    code = "" if run.state is RunState.PASS else f" {run.code}"
    begun = f"{run.begun_at:%Y-%m-%d %H:%M:%S} UTC"
    kind = f"virtual {run.kind.value}" if run.is_virtual else run.kind.value
    yield f"run {run.run_id}, {begun}, {kind}: {run.state.value}{code}{took}"
    if run.text:
        yield f"  {printable(run.text)}"
    if run.reason:
        yield f"  reason:   {printable(run.reason)}"
    where = f"{run.station}, socket {run.socket}, operator {run.operator}"
    yield printable(f"  where:    {where}" + (f", lot {run.lot}" if run.lot else ""))
    yield printable(f"  recipe:   {run.recipe}, revision {run.recipe_revision}")
    for target in details.targets:
        reached = "not verified" if target.reached is None else target.reached.words
        version = target.version or "no version named"
        yield printable(f"  {target.target.upper() + ':':<9} {target.image}, {version}: {reached}")
    for write in details.writes:
        yield _write_line(write)
    for step in details.steps:
        yield from _step_lines(step)


def _write_line(write: WriteRecord) -> str:
    if write.verified_at is None:
        end = "not confirmed"
    elif write.read_back is None:
        end = "confirmed, not read back"
    elif write.read_back == write.value:
        end = "read back"
    else:
        end = f"read back: {write.read_back}"
    return printable(f"  written:  {write.target.upper()} {write.what}: {write.value} ({end})")


def _step_lines(step: StepRecord) -> Iterator[str]:
    tries = f", try {step.try_number}" if step.try_number > 1 else ""
    said = f"  {step.code}: {step.text}" if step.code else ""
    name = f"{step.name}{tries}"
    yield printable(
        f"  step:     {name:<14} {step.state.value:<7} {duration(step.duration_s)}{said}"
    )
    for each in step.measurements:
        value = each.text if each.value is None else f"{each.value:g} {each.unit}".rstrip()
        outside = "" if each.is_within else ": outside of its limits"
        yield printable(f"              {each.name}: {value}{outside}")


def _story_lines(story: Story | str, *, full: bool) -> Iterator[str]:
    if isinstance(story, str):
        yield f"  trace:    {printable(story)}"
        return
    if full:
        yield from (f"  | {line}".rstrip() for line in story_lines(story))
        return
    frames = f"{counted(story.frames, 'frame')} in {duration(story.duration_s)}"
    yield f"  trace:    {frames}: {prose(story.verdict.cause)}"
    yield f"            {story.verdict.text}"
    if story.verdict.likely:
        yield f"            likely cause: {story.verdict.likely}"
