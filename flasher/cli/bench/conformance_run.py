"""A run of the suite from the command line: the device under test, the progress, the reports and
the exit code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Final

from flasher.cli.bench.conformance import FILES, TRACE_DIR
from flasher.cli.bench.conformance_documents import ConformanceDocument
from flasher.cli.bench.conformance_progress import Progress
from flasher.cli.bench.conformance_replay import replay_commands
from flasher.cli.bench.conformance_text import report_lines
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import command_line
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.conformance.catalogue import Selection
from flasher.conformance.json_report import ReportDocument, report_document
from flasher.conformance.opening import BenchOptions, check_bench, open_bench
from flasher.conformance.real import PowerCommand, ReadbackCommand
from flasher.conformance.results import CaseVerdict, CheckOutcome, RunReport
from flasher.conformance.runner import RunOptions, run
from flasher.errors import ExitCode, UsageError
from flasher.protocol.text import printable

_MOCK_ONLY: Final = (("--variant", "variant"), ("--set", "choices"))
_BENCH_ONLY: Final = (("--power-cmd", "power_cmd"), ("--readback-cmd", "readback_cmd"))


def run_suite(options: SimpleNamespace, output: Output) -> int:
    """Run the selected cases and report; returns the exit code."""
    _check_options(options)
    stopping = lambda: output.progress(  # noqa: E731
        "stopping: the device gets its good image back; press again to end at once"
    )
    started_at = datetime.now(UTC).isoformat(timespec="seconds")
    with (
        open_bench(_bench(options)) as (subject, profile),
        stop_on_signal(stopping) as stopped,
        Progress(output) as progress,
    ):
        report = run(
            subject,
            profile,
            selection=selection_of(options),
            options=RunOptions(options.seed, options.repeat, options.timeout, options.strict),
            observer=progress,
            stopped=stopped,
        )
        was_stopped = stopped()
    return _Reporting(options, output, report, started_at).all(was_stopped=was_stopped)


def selection_of(options: SimpleNamespace) -> Selection:
    """Which cases the options name."""
    return Selection(tuple(options.cases), tuple(options.groups), quick=options.quick)


def _check_options(options: SimpleNamespace) -> None:
    if options.target is None:
        raise UsageError(
            "flasher conformance: -t/--target is required.", remedy="Write -t wmc, bms or obc."
        )
    wrong, unless = (_BENCH_ONLY, "without --mock") if options.mock else (_MOCK_ONLY, "with --mock")
    for option, dest in wrong:
        if getattr(options, dest):
            raise UsageError(f"{option} works {unless} only.")
    check_bench(_bench(options))
    for dest, (option, _) in FILES.items():
        if getattr(options, dest) is not None:
            check_writable(getattr(options, dest), option)
    if options.trace_dir is not None:
        _make_folder(options.trace_dir)


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"{printable(str(path))} cannot be made: {error.strerror}.", where=TRACE_DIR
        ) from error


def _bench(options: SimpleNamespace) -> BenchOptions:
    return BenchOptions(
        target=options.target.name,
        is_mock=options.mock,
        variant=options.variant,
        choices=list(options.choices),
        profile=options.profile,
        good_image=options.good_image,
        second_image=options.second_image,
        allow_implausible=options.allow_implausible,
        bus=options.bus.config,
        power=None if options.power_cmd is None else PowerCommand(options.power_cmd),
        readback=None if options.readback_cmd is None else ReadbackCommand(options.readback_cmd),
        uncertainty_s=options.uncertainty,
    )


# -- what is written about it ---------------------------------------------------------------------


@dataclass(frozen=True)
class _Reporting:
    options: SimpleNamespace
    output: Output
    report: RunReport
    started_at: str

    def all(self, *, was_stopped: bool) -> int:
        """Print the summary, write the files; returns the exit code of the run."""
        report, output = self.report, self.output
        replays = replay_commands(report, command_line())
        for line in report_lines(report, replays, verbose=output.verbosity > 0):
            output.result(line)
        traces = self._write_traces()
        document = report_document(
            report, started_at=self.started_at, replays=replays, trace_files=traces
        )
        for dest, make in self._files(document, replays, traces).items():
            path = getattr(self.options, dest)
            if path is not None:
                write_whole(path, make(), FILES[dest][0])
                output.progress(f"{dest.replace('_', ' ')}: {printable(str(path))}")
        code = exit_code(report, was_stopped=was_stopped)
        if code not in (ExitCode.OK, ExitCode.PARTIAL):
            output.error_line(f"the run is not complete: {printable(report.stopped)}")
        output.document(ConformanceDocument(report=document), exit_code=code)
        return code

    def _files(
        self,
        document: ReportDocument,
        replays: dict[tuple[str, int], str],
        traces: dict[tuple[str, int], str],
    ) -> dict[str, Callable[[], bytes]]:
        """What makes each file; its name in the options first."""

        def junit() -> bytes:
            from flasher.conformance.reports import junit_report  # noqa: PLC0415  when wanted

            return junit_report(self.report, started_at=self.started_at, replays=replays)

        def page() -> bytes:
            from flasher.conformance.html_report import html_page  # noqa: PLC0415  loads jinja2

            return html_page(
                self.report, started_at=self.started_at, replays=replays, trace_files=traces
            ).encode("utf-8")

        def json_report() -> bytes:
            from flasher.conformance.json_report import to_bytes  # noqa: PLC0415

            return to_bytes(document)

        return {"junit": junit, "json_report": json_report, "html": page}

    def _write_traces(self) -> dict[tuple[str, int], str]:
        folder = self.options.trace_dir
        if folder is None:
            return {}
        from flasher.conformance.reports import (  # noqa: PLC0415
            candump,
            is_traced,
            trace_file_name,
        )

        written = {}
        for result in self.report.results:
            if is_traced(result):
                name = trace_file_name(result)
                write_whole(folder / name, candump(result.trace), TRACE_DIR)
                written[result.key] = name
        if written:
            self.output.progress(f"traces: {len(written)} in {printable(str(folder))}")
        return written


def exit_code(report: RunReport, *, was_stopped: bool) -> ExitCode:
    """The exit code of a run: interrupted, the adapter, a device that never answered, else whether
    all cases passed.
    """
    if was_stopped and report.stopped:
        return ExitCode.INTERRUPTED
    if report.adapter_failed:
        return ExitCode.BUS
    was_judged = any(
        check.outcome is not CheckOutcome.UNSUPPORTED
        for result in report.results
        for check in result.checks
    )
    never_ran = not was_judged and any(
        result.verdict is CaseVerdict.NOT_RUN for result in report.results
    )
    if report.stopped and never_ran:
        return ExitCode.NO_ANSWER
    return ExitCode.OK if report.ok else ExitCode.PARTIAL
