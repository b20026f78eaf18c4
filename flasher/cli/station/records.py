"""`flasher station report` and `unit`: what the records say. They need no station, change nothing,
and may be asked while one runs.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Final
from urllib.parse import quote

from flasher.cli.documents import plain_value
from flasher.cli.files import check_writable, write_whole
from flasher.cli.output import Output, counted
from flasher.cli.station.commands import DEFAULT_RECORDS
from flasher.cli.station.documents import (
    StationReportDocument,
    UnitDocument,
    UnitTraceDocument,
    figures_document,
    run_document,
)
from flasher.cli.station.text import figure_lines, unit_lines
from flasher.errors import ExitCode, FlasherError, UsageError
from flasher.protocol.text import printable
from flasher.station.config import load_config
from flasher.station.records import (
    AttachmentFile,
    Examination,
    Keeping,
    RecordError,
    RunFilter,
    RunId,
    RunState,
    Store,
    UnitLife,
    UnprovenError,
)
from flasher.station.records.database import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.records.model import TORN_TRACE, TRACE
from flasher.station.reports import Report, make_report
from flasher.trace.source import explain_path
from flasher.trace.story import Story

_READER: Final = "report"
"""Who reads is no station: it claims no unit."""


def run(options: SimpleNamespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    action = {"report": _report, "unit": _unit}[options.action]
    with closing(open_to_read(options)) as store:
        return action(options, output, store)


@dataclass(frozen=True)
class RecordsPlace:
    """Where the options say that the records are, and what belongs to them."""

    url: str
    """A file, or an SQLAlchemy URL."""
    files: Path | None
    lock_timeout_s: float
    keeping: Keeping
    station: str | None
    """The station's name, where the options name its file."""

    def open(self, station: str, *, create: bool = True, read_only: bool = False) -> Store:
        """The records as a station opens them. Raises UsageError, RecordError."""
        return Store.open(
            self.url,
            station=station,
            folder=self.files,
            lock_timeout_s=self.lock_timeout_s,
            create=create,
            read_only=read_only,
            keeping=self.keeping,
        )


def records_of(options: SimpleNamespace) -> RecordsPlace:
    """Where the options say that the records are. Raises UsageError."""
    config = load_config(options.sockets) if options.sockets is not None else None
    database, files, keys, heads = options.database, options.files, options.keys, options.heads
    if config is None:
        return RecordsPlace(
            database or DEFAULT_RECORDS, files, DEFAULT_LOCK_TIMEOUT_S, Keeping(keys, heads), None
        )
    if database is None:
        database, files = config.records, files or _path(config.files)
    keeping = Keeping(keys or _path(config.keys), heads or _path(config.heads))
    return RecordsPlace(database, files, config.lock_timeout_s, keeping, config.name)


def _path(text: str) -> Path | None:
    return Path(text) if text else None


def open_to_read(options: SimpleNamespace) -> Store:
    """The records as they are: nothing of them is changed. Raises UsageError, RecordError."""
    return records_of(options).open(_READER, read_only=True)


# -- many runs ------------------------------------------------------------------------------------


def _report(options: SimpleNamespace, output: Output, store: Store) -> int:
    wanted: dict[str, tuple[Path | None, Callable[[Report], str]]] = {
        "--csv": (options.csv, Report.to_csv),
        "--json-report": (options.json_report, _report_json),
        "--junit": (options.junit, Report.to_junit),
    }
    for option, (path, _) in wanted.items():
        if path is not None:
            check_writable(path, option)
    report = make_report(store.read, _filter(options))
    for line in figure_lines(report.figures):
        output.result(line)
    for option, (path, make) in wanted.items():
        if path is not None:
            write_whole(path, make(report).encode("utf-8"), option)
            output.progress(f"written: {printable(str(path))}")
    code = ExitCode.OK
    if options.certificates is not None and _certificates(
        options.certificates, report, store, output
    ):
        code = ExitCode.VERIFICATION
    document = StationReportDocument(
        figures=figures_document(report.figures),
        runs=[run_document(row) for row in report.runs],
    )
    output.document(document, exit_code=code)
    return code


def _report_json(report: Report) -> str:
    return json.dumps(report.to_dict(), indent=1) + "\n"


def _filter(options: SimpleNamespace) -> RunFilter:
    return RunFilter(
        lot=options.lot,
        recipe=options.recipe,
        since=_moment(options.since, "--since"),
        until=_moment(options.until, "--until"),
        serial=options.serial,
        part=options.part,
    )


def _moment(text: str | None, option: str) -> datetime | None:
    """A time of the clock on the wall, unless it names its zone."""
    if text is None:
        return None
    try:
        return datetime.fromisoformat(text).astimezone()
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{text!a:.40} is no time.",
            where=option,
            remedy="Write 2026-05-17 or 2026-05-17T06:00.",
        ) from error


def _certificates(folder: Path, report: Report, store: Store, output: Output) -> int:
    """Write the pages; for how many units there is none, since their records were changed."""
    option = "--certificates"
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{printable(str(folder))} cannot be made: {error.strerror}.",
            where=option,
            remedy="Name a folder in a folder that exists.",
        ) from error
    units = sorted({(str(row["serial"]), str(row["part"])) for row in report.runs})
    serials = [serial for serial, _ in units]
    lives = [store.read.unit(serial, part) for serial, part in units]
    examined = store.examine({life.runs[-1].run.run_id for life in lives})
    refused = 0
    for life in lives:
        # Two parts may have one serial number; no name leads out of the folder.
        name = life.serial if serials.count(life.serial) == 1 else f"{life.part} {life.serial}"
        page = folder / f"{quote(name, safe=' ').replace('.', '%2E')}.html"
        try:
            write_whole(page, certificate(store, life, examined), option)
        except UnprovenError as error:
            refused += 1
            output.result(printable(f"no page for {life.serial}: {error.cause}"))
    written = counted(len(units) - refused, "page")
    output.progress(f"written: {written} in {printable(str(folder))}")
    return refused


def certificate(store: Store, life: UnitLife, examined: Examination | None = None) -> bytes:
    """The page of a unit. Raises UnprovenError where its records were changed."""
    from flasher.station.certificate import render_certificate  # noqa: PLC0415  loads jinja2

    last = life.runs[-1].run if life.runs else None
    head = None
    if last is not None and last.state is not RunState.RUNNING:
        examined = examined or store.examine({last.run_id})
        problems = examined.of_run(last.run_id)
        if problems:
            raise UnprovenError(
                f"No certificate for {printable(life.serial)}: its records were changed.",
                cause=f"{problems[0].where}: {problems[0].what}",
                remedy="Look at all of it with flasher station verify.",
            )
        head = store.read.head_of(last.run_id)
    is_kept = examined is not None and examined.is_checked_elsewhere
    return render_certificate(life, datetime.now(UTC), head, is_kept=is_kept).encode("utf-8")


# -- one unit -------------------------------------------------------------------------------------


def _unit(options: SimpleNamespace, output: Output, store: Store) -> int:
    if options.certificate is not None:
        check_writable(options.certificate, "--certificate")
    life = store.read.unit(options.serial, options.part)
    told: dict[RunId, list[str | Story]] = {}
    traces = []
    for details in life.runs:
        for file in details.attachments:
            if file.kind in (TRACE, TORN_TRACE):
                found = explained(store, file)
                told.setdefault(details.run.run_id, []).append(found)
                traces.append(_trace_document(details.run.run_id, file, found, full=options.story))
    for line in unit_lines(life, told, full=options.story):
        output.result(line)
    if options.certificate is not None:
        write_whole(options.certificate, certificate(store, life), "--certificate")
        output.progress(f"page: {printable(str(options.certificate))}")
    output.document(UnitDocument(unit=plain_value(life), traces=traces))
    return ExitCode.OK


def explained(store: Store, file: AttachmentFile) -> Story | str:
    """The story of a trace in the records; or in words why there is none."""
    try:
        with store.files.named(file) as path:
            return replace(explain_path(path), source=printable(file.name))
    except RecordError as error:
        return error.what
    except FlasherError as error:
        return f"The trace cannot be explained: {error.cause or error.what}"
    except OSError as error:
        return f"The trace cannot be explained: {error.strerror or error}."


def _trace_document(
    run_id: RunId, file: AttachmentFile, found: Story | str, *, full: bool
) -> UnitTraceDocument:
    if isinstance(found, str):
        return UnitTraceDocument(
            run_id=run_id, sha256=file.sha256, cause=None, text=found, story=None
        )
    return UnitTraceDocument(
        run_id=run_id,
        sha256=file.sha256,
        cause=plain_value(found.verdict.cause),
        text=found.verdict.text,
        story=plain_value(found) if full else None,
    )
