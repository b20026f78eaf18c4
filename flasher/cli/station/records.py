"""`flasher station report` and `unit`: read the records, even while a station runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final
from urllib.parse import quote

from flasher.cli.files import check_writable, write_whole
from flasher.cli.look.explain_text import story_lines
from flasher.cli.output import Output, counted, duration, utc_time
from flasher.cli.station.commands import RecordsOptions, ReportOptions
from flasher.cli.station.documents import (
    UnitDocument,
    UnitTraceDocument,
)
from flasher.cli.station.place import open_to_read
from flasher.cli.station.views import figures_line
from flasher.errors import ErrorCode, ExitCode, UsageError
from flasher.protocol.text import printable
from flasher.report.scale import figure_text
from flasher.station.records.capability import VALUES_MIN, Basis, Capability
from flasher.station.records.errors import NotFoundError, UnprovenError
from flasher.station.records.model import (
    TORN_TRACE,
    TRACE,
    AttachmentFile,
    Figures,
    PassedTwice,
    RunDetails,
    RunFilter,
    RunId,
    RunState,
    StepRecord,
    UnitLife,
    WriteRecord,
    local_moment,
)
from flasher.station.records.store import Store
from flasher.station.reports import TWICE_MAX, Report
from flasher.station.stories import explained
from flasher.trace.story import Story
from flasher.wording import wording

_NO_VERDICT: Final = (RunState.ERROR, RunState.ABORTED, RunState.INTERRUPTED)


# -- many runs ------------------------------------------------------------------------------------


def report(
    output: Output, options: ReportOptions, records: RecordsOptions, kind: type[Store] = Store
) -> int:
    wanted: dict[str, tuple[Path | None, Callable[[Report], str]]] = {
        "--csv": (options.csv, Report.to_csv),
        "--json-report": (options.json_report, Report.to_json),
        "--junit": (options.junit, Report.to_junit),
        "--measurements": (options.measurements, Report.to_measurements_csv),
    }
    for option, (path, _) in wanted.items():
        check_writable(path, option)
    since, until = period_of(options.since, options.until)
    chosen = RunFilter(
        lot=options.lot,
        recipe=options.recipe,
        since=since,
        until=until,
        serial=options.serial,
        part=options.part,
        station=options.station,
    )
    with closing(open_to_read(records, kind)) as store:
        _check_station(store, options.station)
        first = store.figures_begin()
        if first is not None and (chosen.since is None or chosen.since < first):
            output.progress(f"note: runs before {first:%Y-%m-%d} are retired and not counted")
            chosen = replace(chosen, since=first)
        made = Report(store, chosen)
        output.results(figure_lines(made.figures))
        output.results(capability_lines(made.measurements))
        output.results(passed_twice_lines(made.passed_twice))
        for option, (path, make) in wanted.items():
            if path is not None:
                write_whole(path, make(made).encode("utf-8"), option)
                output.progress(f"written: {printable(str(path))}")
        code = ExitCode.OK
        if options.certificates is not None and _certificates(
            options.certificates, made, store, output
        ):
            code = ExitCode.VERIFICATION
        if not output.json_wanted:
            return code  # the runs are read for the document alone
        return output.document(made, exit_code=code)


def _check_station(store: Store, station: str | None) -> None:
    """Raises NotFoundError for a station that has no runs here."""
    names = store.read.stations()
    if station is not None and station not in names:
        raise NotFoundError(
            f"There is no station {printable(station)} in the records.",
            remedy=f"Name one of: {', '.join(map(printable, names)) or 'none'}.",
        )


def period_of(since: str | None, until: str | None) -> tuple[datetime | None, datetime | None]:
    """Parse the period of --since and --until. Raises UsageError."""
    begin, end = _moment_of(since, "--since"), _moment_of(until, "--until")
    if begin is not None and end is not None and end <= begin:
        raise UsageError(
            f"The period from {since!a} to {until!a} is empty.",
            where="--until",
            remedy="Give the first time that is no longer in it: for one day,"
            " --since 2026-05-17 --until 2026-05-18.",
        )
    return begin, end


def _moment_of(text: str | None, option: str) -> datetime | None:
    """Parse a time; it is local without a time zone. Raises UsageError."""
    if text is None:
        return None
    try:
        return local_moment(datetime.fromisoformat(text))
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{text!a:.40} is not a time.",
            where=option,
            remedy="Write 2026-05-17 or 2026-05-17T06:00.",
        ) from error


def _certificates(folder: Path, report: Report, store: Store, output: Output) -> int:
    """Write a certificate for each unit. Returns the number of units without one, because their
    records were changed.
    """
    option = "--certificates"
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{printable(str(folder))} cannot be created: {error.strerror}.",
            where=option,
            remedy="Name a folder whose parent exists.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        ) from error
    units = sorted({(run.serial, run.part) for run in report.runs})
    serials = [serial for serial, _ in units]
    lives = [store.read.unit(serial, part) for serial, part in units]
    refused = 0
    for life in lives:
        # Two parts may have the same serial number. The name is quoted to stay in the folder.
        name = life.serial if serials.count(life.serial) == 1 else f"{life.part} {life.serial}"
        page = folder / f"{quote(name, safe=' ').replace('.', '%2E')}.html"
        try:
            write_whole(page, certificate(store, life), option)
        except UnprovenError as error:
            refused += 1
            output.result(printable(f"no certificate for {life.serial}: {error.cause}"))
    written = counted(len(units) - refused, "certificate")
    output.progress(f"written: {written} in {printable(str(folder))}")
    return refused


def certificate(store: Store, life: UnitLife) -> bytes:
    """Render the certificate of a unit. Raises UnprovenError if its records were changed."""
    from flasher.station.certificate import proven, render_certificate  # noqa: PLC0415  loads jinja2

    now = datetime.now(UTC)
    return render_certificate(life, now, proven(store, life, now)).encode("utf-8")


# -- one unit -------------------------------------------------------------------------------------


def unit(
    output: Output,
    records: RecordsOptions,
    serial: str,
    part: str | None,
    page: Path | None,
    *,
    full: bool,
) -> int:
    with closing(open_to_read(records)) as store:
        check_writable(page, "--certificate")
        life = store.read.unit(serial, part)
        stories: dict[RunId, list[str | Story]] = {}
        traces = []
        for details in life.runs:
            for file in details.attachments:
                if file.kind in (TRACE, TORN_TRACE):
                    story = explained(store.files, file)
                    stories.setdefault(details.run.run_id, []).append(story)
                    traces.append(_trace_document(details.run.run_id, file, story, full=full))
        released = store.read.released()
        marked = tuple(replace(each, run=each.run.marked(released)) for each in life.runs)
        shown = replace(life, runs=marked)
        output.results(unit_lines(shown, stories, full=full))
        if page is not None:
            write_whole(page, certificate(store, life), "--certificate")
            output.progress(f"page: {printable(str(page))}")
        return output.document(UnitDocument(unit=shown, traces=traces))


def _trace_document(
    run_id: RunId, file: AttachmentFile, story: Story | str, *, full: bool
) -> UnitTraceDocument:
    if isinstance(story, str):
        return UnitTraceDocument(
            run_id=run_id, sha256=file.sha256, cause=None, text=story, story=None
        )
    return UnitTraceDocument(
        run_id=run_id,
        sha256=file.sha256,
        cause=story.verdict.cause,
        text=story.verdict.text,
        story=story if full else None,
    )


# -- as text --------------------------------------------------------------------------------------


def passed_twice_lines(found: Sequence[PassedTwice]) -> Iterator[str]:
    if not found:
        return
    yield f"passed at two stations: {counted(len(found), 'unit')}" + (
        " and more; the newest:" if len(found) == TWICE_MAX else ""
    )
    for each in found:
        runs = (
            f"{run.station}, socket {run.socket}, {utc_time(run.begun_at)}"
            + (", duplicates NOT CHECKED" if run.is_unchecked else "")
            for run in (each.first, each.second)
        )
        nature = ", VIRTUAL" if each.is_virtual else ""
        yield printable(f"  {each.serial}, part {each.part}{nature}: {'; '.join(runs)}")


def figure_lines(figures: Figures) -> Iterator[str]:
    yield figures_line(figures)
    open_runs = {state: figures.by_state.get(state, 0) for state in _NO_VERDICT}
    words = [f"{count:,} {state.value}" for state, count in open_runs.items() if count]
    yield f"  runs:     {figures.runs:,}" + (f", of them {', '.join(words)}" if words else "")
    if figures.virtual_runs:
        yield f"  VIRTUAL:  {counted(figures.virtual_runs, 'run')} of virtual units, no products"
    if figures.duration_longest_s is not None:
        yield f"  longest:  {duration(figures.duration_longest_s)} of those that passed"
    for code, count in figures.failures.items():
        yield f"  {count:7,}  {printable(code)}"


def capability_lines(found: Sequence[Capability]) -> Iterator[str]:
    """Format measurements with limits."""
    if found:
        yield "measurements with limits (docs/how-to/station_records.md explains Cpk and Ppk):"
    for each in found:
        yield printable(f"  {each.part} {each.step}, {each.name}: {_capability_text(each)}")


def _capability_text(each: Capability) -> str:
    unit = f" {each.unit}" if each.unit else ""
    values = counted(each.count, "value") + (f", {each.outside:,} outside" if each.outside else "")
    deviation = "" if each.deviation is None else f", s {figure_text(each.deviation)}"
    text = f"{values}; limits {each.limits}{unit}; mean {figure_text(each.mean)}{deviation}; "
    if each.basis is Basis.TOO_FEW:
        return f"{text}no Cpk: fewer than {VALUES_MIN} values"
    if each.basis is Basis.CONSTANT:
        return f"{text}no Cpk: all values are equal (s = 0)"
    cpk = "not computed" if each.cpk is None else f"{each.cpk:.2f}"
    return f"{text}Cpk {cpk}, Ppk {each.ppk:.2f}"


def unit_lines(
    life: UnitLife, stories: Mapping[RunId, Sequence[Story | str]], *, full: bool
) -> Iterator[str]:
    """Format all runs of a unit. `stories`: explanations of its traces, or reasons for none."""
    nature = ", a VIRTUAL unit, no product" if life.is_virtual else ""
    yield printable(f"{life.serial}, part {life.part}: {life.state.value}{nature}")
    for details in life.runs:
        yield ""
        yield from _run_lines(details)
        for story in stories.get(details.run.run_id, ()):
            yield from _story_lines(story, full=full)


def _run_lines(details: RunDetails) -> Iterator[str]:
    run = details.run
    took = "" if run.duration_s is None else f" after {duration(run.duration_s)}"
    code = "" if run.state is RunState.PASS else f" {run.code}"
    kind = f"virtual {run.kind.value}" if run.is_virtual else run.kind.value
    yield f"run {run.run_id}, {utc_time(run.begun_at)}, {kind}: {run.state.value}{code}{took}"
    if run.text:
        yield f"  {printable(run.text)}"
    if run.is_unchecked:
        yield f"  duplicates {printable(run.duplicates or '')}"
    if run.reason:
        yield f"  reason:   {printable(run.reason)}"
    where = f"{run.station}, socket {run.socket}, operator {run.operator}"
    yield printable(f"  where:    {where}" + (f", lot {run.lot}" if run.lot else ""))
    yield printable(f"  recipe:   {run.recipe}, revision {run.recipe_revision}")
    for target in details.targets:
        reached = "not verified" if target.reached is None else target.reached.words
        version = target.version or "no version named"
        yield printable(f"  {target.target.upper() + ':':<9} {target.image}, {version}: {reached}")
        if target.signature is not None:
            yield printable(f"  {'':<9} {target.signature}")
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
    cause = f"  {step.code}: {step.text}" if step.code else ""
    name = f"{step.name}{tries}"
    yield printable(
        f"  step:     {name:<14} {step.state.value:<7} {duration(step.duration_s)}{cause}"
    )
    for each in step.measurements:
        value = each.text if each.value is None else f"{each.value:g} {each.unit}".rstrip()
        outside = "" if each.is_within else ": outside its limits"
        yield printable(f"              {each.name}: {value}{outside}")


def _story_lines(story: Story | str, *, full: bool) -> Iterator[str]:
    if isinstance(story, str):
        yield f"  trace:    {printable(story)}"
        return
    if full:
        yield from (f"  | {line}".rstrip() for line in story_lines(story))
        return
    frames = f"{counted(story.frames, 'frame')} in {duration(story.duration_s)}"
    yield f"  trace:    {frames}: {wording(story.verdict.cause)}"
    yield f"            {story.verdict.text}"
    if story.verdict.likely:
        yield f"            likely cause: {story.verdict.likely}"
