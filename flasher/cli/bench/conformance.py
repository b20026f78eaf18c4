"""`flasher conformance`: test a bootloader against the protocol, compare runs, print a profile."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import click

from flasher.cli import values
from flasher.cli.bench import (
    conformance_explore,
    conformance_init,
    conformance_replay,
    conformance_serve,
)
from flasher.cli.bench.conformance_bench import (
    OUTPUT_OPTIONS,
    bench_options,
    confirm_wear,
    described,
    opened,
    set_option,
)
from flasher.cli.bench.conformance_explore import explore
from flasher.cli.bench.conformance_export import NAME as EXPORT_TEST
from flasher.cli.bench.conformance_export import check_export, export, export_option
from flasher.cli.bench.conformance_init import init
from flasher.cli.bench.conformance_replay import replay
from flasher.cli.bench.conformance_serve import serve
from flasher.cli.bench.conformance_text import (
    FAILED,
    ListedCase,
    difference_lines,
    gap_lines,
    list_lines,
    report_lines,
    side_by_side_lines,
)
from flasher.cli.documents import document_of
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import (
    argument,
    group,
    option,
    option_set,
    rebuild_command_line,
    typed_values,
)
from flasher.cli.options import Bus, adapter_options
from flasher.cli.output import Output
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.catalogue import (
    BRING_UP,
    CASES,
    FULL_BENCH,
    GROUPS,
    MISSING_ON_BARE_BENCH,
    WEAR,
    Selection,
    bench_gaps,
    case_text,
    catalogue_order,
    full_verdict_needs,
    known_cases,
    missing_requirements,
)
from flasher.conformance.diff import (
    THRESHOLD_PERCENT,
    Difference,
    compare,
    read_report,
    verdicts_of,
)
from flasher.conformance.results import CaseVerdict, CheckOutcome, Gap, RunReport
from flasher.conformance.side_by_side import SideBySide, side_by_side
from flasher.errors import ErrorCode, ExitCode, UsageError
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.conformance.dut.exported_test import ExportedTest
    from flasher.conformance.profile import ConformanceProfile
    from flasher.conformance.subject import Subject

_EXAMPLES: Final = """\
examples:
  flasher conformance -t bms --mock
  flasher conformance -t bms --mock --variant no-crc-check
  flasher conformance -t bms -i socketcan -c can0 --profile p.toml --good-image known_good.hex
  flasher conformance -t bms -i socketcan -c can0 --profile p.toml --good-image known_good.hex \\
      --power-cmd 'relay 3 {on|off}' --html report.html --junit report.xml --json-report new.json
  flasher conformance --list --group TX
  flasher conformance diff old.json new.json
  flasher conformance compare a.json b.json c.json --html side_by_side.html
  flasher conformance profile > p.toml
  flasher conformance init -t bms --subject ./boot -o boot.toml
  flasher conformance header .
  flasher conformance -t bms --subject ./boot

Without power control the device is brought back by the protocol, and cases that cut the power are
reported as unsupported. Ctrl-C ends the run with a report of the finished cases, and flashes the
good image; a second one ends at once.
"""
_TRACE_DIR: Final = "--trace-dir"
_FILES: Final = {
    name: f"--{name.replace('_', '-')}"
    for name in ("junit", "json_report", "html", "badge", "summary", "matrix")
}
"""Report files: their field names in the options, and their options."""
_RUN_OPTIONS: Final = frozenset(
    {
        *("--list", "--case", "--group", "--exclude", "--rerun-failed", "--quick"),
        *("--seed", "--repeat", "--jobs", "--timeout"),
        *_FILES.values(),
        EXPORT_TEST,
        _TRACE_DIR,
        *OUTPUT_OPTIONS,
    }
)
"""Options about the selection, the reports and the output; the others are about the bench."""


# -- documents -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConformanceDocument:
    """Result of a run."""

    report: RunReport


@dataclass(frozen=True)
class CaseListDocument:
    """The selected cases, with the reasons why some cannot be judged."""

    cases: list[ListedCase]
    bare_bench: tuple[Gap, ...]
    """On a bench of device, adapter and good image."""
    full_bench: tuple[Gap, ...]
    """On one that also has power control, readback and a second image."""


@dataclass(frozen=True)
class ProfileKeyDocument:
    """A key of the profile."""

    key: str
    """With its table, as limits.ack_s."""
    default: str | int | float
    allowed: str
    meaning: str


@dataclass(frozen=True)
class ProfileKeysDocument:
    """All keys of a profile."""

    keys: list[ProfileKeyDocument]
    toml: str
    """A whole profile, as printed without --json."""


@dataclass(frozen=True)
class HeaderDocument:
    """The files written."""

    files: list[str]


_DOCUMENTS: Final = (
    ConformanceDocument, CaseListDocument, Difference, SideBySide, ProfileKeysDocument,
    HeaderDocument,
    *conformance_explore.DOCUMENTS, *conformance_init.DOCUMENTS, *conformance_serve.DOCUMENTS,
    *conformance_replay.DOCUMENTS,
)  # fmt: skip


def __getattr__(name: str) -> tuple[type, ...]:
    """The types of the `--json` documents, for the schema: that of campaigns takes long to load."""
    if name != "DOCUMENTS":
        raise AttributeError(name)
    from flasher.simulate.campaign import Result  # noqa: PLC0415

    return (*_DOCUMENTS, Result)


# -- a run -----------------------------------------------------------------------------------------


_what = partial(option, panel="what is run, and how")
_report = partial(option, metavar="FILE", type=values.FilePath(gives=Path), panel="reports")


@dataclass(frozen=True)
class Choices:
    """Selected cases, and the report files."""

    is_list: Annotated[bool, _what(
        "--list", "is_list", is_flag=True, brief=True, help="list the cases, and end",
    )]  # fmt: skip
    cases: Annotated[tuple[str, ...], _what(
        "--case", "cases", multiple=True, type=str.upper, metavar="ID", brief=True,
        help="run this case only, as TX-03; may be repeated",
    )]  # fmt: skip
    groups: Annotated[tuple[str, ...], _what(
        "--group", "groups", multiple=True, type=str.upper, metavar="G", brief=True,
        help=f"run this group only: {' '.join(GROUPS)}; may be repeated. SO and SP wear the device "
        "and run only when they are named",
    )]  # fmt: skip
    excluded: Annotated[tuple[str, ...], _what(
        "--exclude", "excluded", multiple=True, type=str.upper, metavar="ID|G",
        help="run all but this case or group; may be repeated",
    )]  # fmt: skip
    rerun_failed: Annotated[Path | None, _what(
        "--rerun-failed", type=values.FilePath("json", gives=Path), metavar="REPORT",
        help="run the cases that did not pass in this report of --json-report, with its seed",
    )]  # fmt: skip
    quick: Annotated[bool, _what(
        "--quick", is_flag=True, brief=True,
        help="some of every group: one to three minutes on a real bus with an image of a few KiB",
    )]  # fmt: skip
    seed: Annotated[str, _what(
        "--seed", default="1", metavar="SEED", help="decides all that is left to chance",
    )]  # fmt: skip
    repeat: Annotated[int, _what(
        "--repeat", type=values.count, default="1", metavar="N", help="run every case N times",
    )]  # fmt: skip
    jobs: Annotated[int, _what(
        "--jobs", type=values.processes, default="1", metavar="N",
        help="run cases on N processes side by side, with --mock or --subject",
    )]  # fmt: skip
    timeout: Annotated[float | None, _what(
        "--timeout", type=values.seconds, metavar="SECONDS",
        help="end the run after this time (default: every case has its own limit)",
    )]  # fmt: skip
    strict: Annotated[bool, _what(
        "--strict", is_flag=True,
        help="also fail the run for a partial pass, or a profile deviation that no longer occurs",
    )]  # fmt: skip
    upgrades: Annotated[int | None, _what(
        "--upgrades", type=values.count, metavar="N",
        help="how often each case of SO and SP has the device upgraded (default: "
        + ", ".join(f"{case_id} {count}" for case_id, count in WEAR.items()) + ")",
    )]  # fmt: skip
    yes: Annotated[bool, _what(
        "-y", "--yes", is_flag=True, help="do not ask before SO and SP wear a device on a bus",
    )]  # fmt: skip
    junit: Annotated[Path | None, _report("--junit", help="JUnit XML, for CI servers")]
    json_report: Annotated[Path | None, _report(
        "--json-report", help="the report as JSON, for `flasher conformance diff`",
    )]  # fmt: skip
    html: Annotated[Path | None, _report("--html", help="the report as one self-contained page")]
    badge: Annotated[Path | None, _report(
        "--badge", help="a badge (SVG) with the result of the run",
    )]  # fmt: skip
    summary: Annotated[Path | None, _report(
        "--summary", help="the run on one page (HTML) to be printed, for a release",
    )]  # fmt: skip
    matrix: Annotated[Path | None, _report(
        "--matrix", help="each clause with its cases and their verdicts (.csv or .html)",
    )]  # fmt: skip
    export_test: Annotated[Path | None, export_option]
    trace_dir: Annotated[Path | None, option(
        _TRACE_DIR, type=values.FolderPath(), metavar="DIR", panel="reports",
        help="folder for a trace file (candump) of each case that does not pass",
    )]  # fmt: skip

    @property
    def selection(self) -> Selection:
        return Selection(self.cases, self.groups, quick=self.quick, excluded=self.excluded)


_choices = option_set("chosen", Choices)


@group(
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.IMAGE, ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.PARTIAL, ExitCode.INTERRUPTED,
    ),
    runs_alone=True,
)  # fmt: skip
@bench_options
@_choices
@adapter_options
def conformance(output: Output, bus: Bus, bench: BenchOptions, chosen: Choices) -> int:
    """Test a bootloader against the protocol, case by case: on a device on a bench, or on the
    built-in device model. Every case begins with a device that runs the known-good image; at the
    end that image is flashed once more and verified. The device is erased and written many times.
    """
    if chosen.is_list:
        return _list(chosen.selection, output)
    from flasher.cli.bench.conformance_progress import progress  # noqa: PLC0415  much is loaded
    from flasher.conformance.runner import SuiteOptions, run  # noqa: PLC0415

    bench = described(bench, bus)
    if chosen.jobs > 1 and not bench.is_simulated:
        raise UsageError(
            "--jobs works with --mock or --subject only.",
            cause="there is one device on a bus",
        )
    _check_files(chosen)
    check_export(chosen.export_test, bench)
    if chosen.rerun_failed is not None:
        chosen = _only_failed(chosen, chosen.rerun_failed, bench.device.name)
    wear = chosen.selection.wears(chosen.upgrades)
    if wear and not bench.is_simulated:
        named = ", ".join(f"{case_id} {count} times" for case_id, count in wear.items())
        confirm_wear(f"the device is erased and written: {named}", is_agreed=chosen.yes)
    started_at = datetime.now(UTC).isoformat(timespec="seconds")
    with (
        opened(bench, output) as (subject, profile, stopped),
        progress(output) as observer,
    ):
        missing = bench_gaps(missing_requirements(subject, profile), chosen.selection.chosen())
        for line in gap_lines("this bench", missing) if missing else ():
            output.progress(line)
        suite = SuiteOptions(
            chosen.seed, chosen.repeat, chosen.timeout, chosen.strict, chosen.upgrades
        )
        if chosen.jobs > 1:
            from flasher.conformance.parallel import run_in_processes  # noqa: PLC0415  only here

            report = run_in_processes(
                bench,
                subject,
                profile,
                jobs=chosen.jobs,
                selection=chosen.selection,
                suite=suite,
                observer=observer,
                stopped=stopped,
            )
        else:
            report = run(
                subject,
                profile,
                selection=chosen.selection,
                options=suite,
                observer=observer,
                stopped=stopped,
            )
        export(chosen.export_test, _exportable(report, subject, profile, stopped), output)
        was_stopped = stopped()
    code = exit_code(report, was_stopped=was_stopped)
    _tell(report, chosen, output, started_at, code)
    return code


def _exportable(
    report: RunReport,
    subject: Subject,
    profile: ConformanceProfile,
    stopped: Callable[[], bool],
) -> Iterator[tuple[str, Callable[[], ExportedTest]]]:
    """Failed cases, and how to make a test in C of each."""
    from flasher.conformance.dut.exported_test import export_case  # noqa: PLC0415  rarely needed

    for text, result in report.by_case():
        if result.verdict is CaseVerdict.FAIL:
            make = partial(export_case, result, text.title, subject, profile, stopped=stopped)
            yield result.case_id, make


def _only_failed(chosen: Choices, path: Path, target: str) -> Choices:
    """Select the cases that did not pass in a report. Raises UsageError when there is none, or when
    the report cannot be read.
    """
    source = click.get_current_context().get_parameter_source("seed")
    if chosen.selection != Selection() or source is not click.core.ParameterSource.DEFAULT:
        raise UsageError(
            "--rerun-failed selects the cases and the seed itself.",
            remedy="Leave out --case, --group, --exclude, --quick and --seed.",
        )
    report = read_report(path)
    if report.target != target:
        raise UsageError(
            f"{printable(str(path))} is about the target {report.target}, not {target}.",
            where="--rerun-failed",
            remedy=f"Write -t {report.target}, or name another report.",
        )
    failed = [case_id for case_id, each in verdicts_of(report).items() if each in FAILED]
    if not failed:
        raise UsageError(
            f"No case of {printable(str(path))} failed: there is nothing to run again.",
            where="--rerun-failed",
        )
    return replace(chosen, cases=tuple(failed), seed=report.seed)


def _check_files(chosen: Choices) -> None:
    """Raises UsageError if a report file cannot be written."""
    for name, option_name in _FILES.items():
        check_writable(getattr(chosen, name), option_name, typed_values(but=name))
    if chosen.matrix is not None and chosen.matrix.suffix.lower() not in (".csv", ".html"):
        raise UsageError(
            f"{printable(str(chosen.matrix))} names no format.",
            where="--matrix",
            remedy="Name a file that ends in .csv or .html.",
        )
    if chosen.trace_dir is not None:
        try:
            chosen.trace_dir.mkdir(parents=True, exist_ok=True)
            check_writable(chosen.trace_dir / "trace", _TRACE_DIR)
        except OSError as error:
            raise UsageError(
                f"{printable(str(chosen.trace_dir))} cannot be made: {error.strerror}.",
                where=_TRACE_DIR,
                remedy="Name a folder that exists, or a new one in a folder that does.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            ) from error


def _tell(
    report: RunReport, chosen: Choices, output: Output, started_at: str, code: ExitCode
) -> None:
    """Print the summary and write the files; one failure does not stop the others. Raises
    UsageError.
    """
    from flasher.conformance.reports import (  # noqa: PLC0415
        candump,
        completed,
        is_traced,
        trace_file_name,
    )

    report = completed(report, started_at=started_at, replays=replay_commands(report))
    output.results(report_lines(report, verbose=output.verbosity > 0))
    failed: list[UsageError] = []
    if chosen.trace_dir is not None:
        results = list(report.results)
        for index, result in enumerate(results):
            if is_traced(result):
                name = trace_file_name(result)
                try:
                    write_whole(
                        chosen.trace_dir / name, candump(result.trace), _TRACE_DIR, is_private=True
                    )
                    results[index] = replace(result, trace_file=name)
                except UsageError as error:
                    failed.append(error)
        report = replace(report, results=tuple(results))
        count = sum(bool(result.trace_file) for result in results)
        if count:
            output.progress(f"traces: {count} in {printable(str(chosen.trace_dir))}")
    for name, option_name in _FILES.items():
        path: Path | None = getattr(chosen, name)
        if path is None:
            continue
        try:
            write_whole(path, _content(name, report, path), option_name)
            output.progress(f"{name.replace('_', ' ')}: {printable(str(path))}")
        except UsageError as error:
            failed.append(error)
    if failed:
        raise failed[0]
    if code not in (ExitCode.OK, ExitCode.PARTIAL):
        output.error_line(f"the run is not complete: {printable(report.stopped)}")
    output.document(ConformanceDocument(report), exit_code=code)


def _content(name: str, report: RunReport, path: Path) -> bytes:
    """Content of the report file of this name."""
    from flasher.conformance import html_report, matrix, reports, summary_page  # noqa: PLC0415

    match name:
        case "junit":
            return reports.junit_report(report)
        case "json_report":
            return reports.to_bytes(report)
        case "html":
            text = html_report.html_page(report)
        case "badge":
            text = summary_page.badge(report)
        case "matrix":
            rows = matrix.requirements_matrix(report)
            is_csv = path.suffix.lower() == ".csv"
            text = matrix.matrix_csv(rows) if is_csv else html_report.matrix_page(report, rows)
        case _:
            text = summary_page.summary_page(report)
    return text.encode("utf-8")


def replay_commands(report: RunReport) -> dict[tuple[str, int], str]:
    """The command that repeats each result's case, on the same bench and with the same seed, by
    case id and repeat.
    """
    ctx = click.get_current_context()
    bench = [
        "flasher",
        *rebuild_command_line(ctx, "conformance", without=_RUN_OPTIONS.__contains__),
    ]
    found = {}
    for result in report.results:
        words = [*bench, "--case", result.case_id, "--seed", report.seed]
        if result.repeat > 1:
            words += ["--repeat", str(result.repeat)]
        found[result.key] = shlex.join(words)
    return found


def exit_code(report: RunReport, *, was_stopped: bool) -> ExitCode:
    """The exit code of a run: interrupted, adapter failure, a device that never answered, else
    whether all cases passed.
    """
    if was_stopped and report.stopped:
        return ExitCode.INTERRUPTED
    if report.adapter_failed:
        return ExitCode.BUS
    was_judged = any(
        check.outcome is not CheckOutcome.UNSUPPORTED
        for result in report.results
        for check in result.checks
        if result.case_id != BRING_UP
    )
    if report.stopped and not was_judged and report.count(CaseVerdict.NOT_RUN):
        return ExitCode.NO_ANSWER
    return ExitCode.OK if report.ok else ExitCode.PARTIAL


# -- the other actions -----------------------------------------------------------------------------


def _list(selection: Selection, output: Output) -> int:
    from flasher.conformance import cases  # noqa: F401, PLC0415  registers the cases
    from flasher.conformance.profile import ConformanceProfile  # noqa: PLC0415

    selection.check()
    # The list includes cases that run only when named.
    chosen = catalogue_order(known_cases()) if selection == Selection() else selection.chosen()
    texts = [case_text(case_id, ConformanceProfile()) for case_id in chosen]
    found = [
        document_of(
            ListedCase,
            text,
            in_part_without=full_verdict_needs(text.id),
            choices=tuple(text.choices),
            can_be_run=text.id in CASES,
            only_when_named=text.id in WEAR,
        )
        for text in texts
    ]
    output.results(list_lines(found, verbose=output.verbosity > 0))
    bare, full = (
        bench_gaps(MISSING_ON_BARE_BENCH, chosen),
        bench_gaps(set(MISSING_ON_BARE_BENCH).difference(FULL_BENCH), chosen),
    )
    for name, missing in (
        ("a bare bench (device, adapter, good image)", bare),
        ("a full bench (with power, readback and a second image)", full),
    ):
        output.results(gap_lines(name, missing))
    return output.document(CaseListDocument(found, bare_bench=bare, full_bench=full))


@conformance.action("diff", exit_codes=(ExitCode.PARTIAL,))
@argument("old", type=values.FilePath("json", gives=Path), metavar="OLD", help="the older report")
@argument("new", type=values.FilePath("json", gives=Path), metavar="NEW", help="the newer report")
@option(
    "--threshold", type=values.percent, default=THRESHOLD_PERCENT, metavar="PERCENT",
    help="a time is slower when its median or p95 grew by more than this, and by more than its "
    "uncertainty",
)  # fmt: skip
@option(
    "--strict", is_flag=True,
    help="slower times, and cases that are gone or judged less fully, count as worse too",
)  # fmt: skip
def diff(output: Output, *, old: Path, new: Path, threshold: float, strict: bool) -> int:
    """Compare two reports that --json-report wrote. Exit code 12 when a case got worse, or a new
    one fails.
    """
    found = compare(read_report(old), read_report(new), threshold)
    output.result(f"{printable(str(old))}, then {printable(str(new))}")
    output.results(difference_lines(found))
    is_worse = found.is_worse or (strict and bool(found.slower or found.gone or found.less))
    code = ExitCode.PARTIAL if is_worse else ExitCode.OK
    return output.document(found, exit_code=code)


@conformance.action("compare", exit_codes=())
@argument(
    "reports", nargs=-1, required=True, type=values.FilePath("json", gives=Path),
    metavar="REPORT...", help="two reports or more",
)  # fmt: skip
@_report("--html", help="the comparison as one self-contained page")
def compare_runs(output: Output, *, reports: tuple[Path, ...], html: Path | None) -> int:
    """Show reports that --json-report wrote side by side: the cases whose verdicts differ (-v:
    all), what else differs, and the times.
    """
    if len(reports) < 2:
        raise UsageError("A comparison takes two reports or more.")
    check_writable(html, "--html", reports)
    found = side_by_side(reports, [read_report(path) for path in reports])
    output.results(side_by_side_lines(found, verbose=output.verbosity > 0))
    if html is not None:
        from flasher.conformance.html_report import comparison_page  # noqa: PLC0415  loads jinja2

        write_whole(html, comparison_page(found).encode("utf-8"), "--html")
        output.progress(f"html: {printable(str(html))}")
    return output.document(found)


@conformance.action("profile", exit_codes=())
@option("--mock", is_flag=True, help="the profile of the built-in device model")
@set_option
def profile(output: Output, *, mock: bool, choices: tuple[str, ...]) -> int:
    """Print a profile with every key explained."""
    from flasher.conformance.profile import ConformanceProfile, profile_keys  # noqa: PLC0415

    found = ConformanceProfile()
    if mock or choices:
        from flasher.conformance.bench_options import device_profile  # noqa: PLC0415
        from flasher.conformance.mock import profile_of_mock  # noqa: PLC0415

        found = profile_of_mock(device_profile(choices))
    toml = found.to_toml()
    output.result(toml.strip("\n"))
    keys = [
        ProfileKeyDocument(key=key.path, default=key.default, allowed=key.allowed, meaning=key.text)
        for key in profile_keys().values()
    ]
    return output.document(ProfileKeysDocument(keys=keys, toml=toml))


@conformance.action("header", exit_codes=())
@argument(
    "folder", type=values.FolderPath(), metavar="FOLDER", required=False, default=".",
    help="where the two files are written (default: here)",
)  # fmt: skip
def header(output: Output, *, folder: Path) -> int:
    """Write the two C files that make a bootloader a subject for --subject. The header is
    flasher_dut.h; a bootloader that is linked as a program also needs flasher_dut_process.c.
    """
    names = ("flasher_dut.h", "flasher_dut_process.c")
    written = []
    for name in names:
        content = (resources.files("flasher.conformance.dut") / name).read_bytes()
        write_whole(folder / name, content, "FOLDER")
        written.append(str(folder / name))
        output.result(printable(written[-1]))
    return output.document(HeaderDocument(written))


conformance.add_command(explore, "explore")
conformance.add_command(init, "init")
conformance.add_command(replay, "replay")
conformance.add_command(serve, "serve")
