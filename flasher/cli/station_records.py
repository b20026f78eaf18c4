"""`flasher station report`, `unit`, `backup` and `verify`: what the records say. They need no
station, and may be asked while one runs.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final
from urllib.parse import quote

from flasher.cli.documents import plain_value
from flasher.cli.files import check_writable, write_whole
from flasher.cli.output import Output, byte_count, counted
from flasher.cli.station import DEFAULT_RECORDS
from flasher.cli.station_documents import (
    BackupDocument,
    ProblemDocument,
    StationReportDocument,
    UnitDocument,
    UnitTraceDocument,
    VerifiedRecordsDocument,
    figures_document,
    run_document,
)
from flasher.cli.station_text import figure_lines, unit_lines
from flasher.errors import ExitCode, FlasherError, UsageError
from flasher.protocol.text import printable
from flasher.station.config import load_config
from flasher.station.records import AttachmentFile, RecordError, RunFilter, RunId, Store, UnitLife
from flasher.station.records.database import DEFAULT_LOCK_TIMEOUT_S
from flasher.station.reports import Report, make_report
from flasher.trace.source import explain_path
from flasher.trace.story import Story

TRACE_KINDS: Final = ("trace", "torn-trace")
_SUFFIX: Final = re.compile(r"(?:\.[a-z0-9]{1,4}){1,2}$")
_READER: Final = "report"
"""Who reads is no station: it claims no unit."""


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    actions: dict[str, Callable[[argparse.Namespace, Output, Store], int]] = {
        "report": _report,
        "unit": _unit,
        "backup": _backup,
        "verify": _verify,
    }
    with closing(_open(options)) as store:
        return actions[options.action](options, output, store)


def records_of(options: argparse.Namespace) -> tuple[str, Path | None, float]:
    """Where the options say that the records are: file or URL, folder of the files, and how long a
    lock is waited for in seconds. Raises UsageError.
    """
    database, files = options.database, options.files
    lock_timeout_s = DEFAULT_LOCK_TIMEOUT_S
    if options.sockets is not None:
        config = load_config(options.sockets)
        if database is None:
            database = config.records
            files = files or (Path(config.files) if config.files else None)
        lock_timeout_s = config.lock_timeout_s
    return database or DEFAULT_RECORDS, files, lock_timeout_s


def _open(options: argparse.Namespace) -> Store:
    url, files, lock_timeout_s = records_of(options)
    return Store.open(
        url, station=_READER, folder=files, lock_timeout_s=lock_timeout_s, create=False
    )


# -- many runs ------------------------------------------------------------------------------------


def _report(options: argparse.Namespace, output: Output, store: Store) -> int:
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
    if options.certificates is not None:
        _certificates(options.certificates, report, store, output)
    output.document(
        StationReportDocument(
            figures=figures_document(report.figures),
            runs=[run_document(row) for row in report.runs],
        )
    )
    return ExitCode.OK


def _report_json(report: Report) -> str:
    return json.dumps(report.to_dict(), indent=1) + "\n"


def _filter(options: argparse.Namespace) -> RunFilter:
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


def _certificates(folder: Path, report: Report, store: Store, output: Output) -> None:
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
    for serial, part in units:
        # Two parts may have one serial number; no name leads out of the folder.
        name = serial if serials.count(serial) == 1 else f"{part} {serial}"
        page = folder / f"{quote(name, safe=' ').replace('.', '%2E')}.html"
        write_whole(page, certificate(store.read.unit(serial, part)), option)
    output.progress(f"written: {counted(len(units), 'page')} in {printable(str(folder))}")


def certificate(life: UnitLife) -> bytes:
    """The page of a unit."""
    from flasher.station.certificate import render_certificate  # noqa: PLC0415  loads jinja2

    return render_certificate(life, datetime.now(UTC)).encode("utf-8")


# -- one unit -------------------------------------------------------------------------------------


def _unit(options: argparse.Namespace, output: Output, store: Store) -> int:
    if options.certificate is not None:
        check_writable(options.certificate, "--certificate")
    life = store.read.unit(options.serial, options.part)
    told: dict[RunId, list[str | Story]] = {}
    traces = []
    for details in life.runs:
        for file in details.attachments:
            if file.kind in TRACE_KINDS:
                found = explained(store, file)
                told.setdefault(details.run.run_id, []).append(found)
                traces.append(_trace_document(details.run.run_id, file, found, full=options.story))
    for line in unit_lines(life, told, full=options.story):
        output.result(line)
    if options.certificate is not None:
        write_whole(options.certificate, certificate(life), "--certificate")
        output.progress(f"page: {printable(str(options.certificate))}")
    output.document(UnitDocument(unit=plain_value(life), traces=traces))
    return ExitCode.OK


def explained(store: Store, file: AttachmentFile) -> Story | str:
    """The story of a trace in the records; or in words why there is none."""
    suffix = _SUFFIX.search(file.name)
    try:
        data = store.files.read(file.sha256)
        with tempfile.TemporaryDirectory(prefix="flasher-") as folder:
            # Under a name of our own: what stands in the records is nobody's path.
            path = Path(folder) / f"trace{suffix[0] if suffix else ''}"
            path.write_bytes(data)
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


# -- care -----------------------------------------------------------------------------------------


def _backup(options: argparse.Namespace, output: Output, store: Store) -> int:
    check_writable(options.file, "FILE")
    made = store.backup(options.file)
    output.result(f"{printable(str(made.path))}: {byte_count(made.size_bytes)}, checked")
    output.result(f"  sha256: {made.sha256}")
    output.result(f"  traces: {printable(made.path.name)}.files beside it")
    output.document(
        BackupDocument(path=str(made.path), sha256=made.sha256, size_bytes=made.size_bytes)
    )
    return ExitCode.OK


def _verify(_options: argparse.Namespace, output: Output, store: Store) -> int:
    problems = store.verify()
    for each in problems:
        output.result(f"{printable(each.where)}: {printable(each.what)}")
    for limit in store.limits:
        output.progress(f"note: {limit}")
    good = "records and attachments are as they were written"
    output.result(f"{counted(len(problems), 'problem')}" if problems else good)
    code = ExitCode.VERIFICATION if problems else ExitCode.OK
    found = [ProblemDocument(where=each.where, what=each.what) for each in problems]
    output.document(VerifiedRecordsDocument(problems=found), exit_code=code)
    return code
