"""`flasher conformance`: tests a bootloader against the protocol, case by case; compares two such
runs; documents the profile. How a run goes stands in `conformance_run`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from flasher.cli import arguments
from flasher.cli.conformance_documents import (
    DOCUMENTS,
    CaseListDocument,
    ListedCaseDocument,
    ProfileKeyDocument,
    ProfileKeysDocument,
    difference_document,
)
from flasher.cli.conformance_text import difference_lines, list_lines
from flasher.cli.output import Output
from flasher.conformance.catalogue import GROUPS
from flasher.conformance.diff import THRESHOLD_PERCENT, compare, read_run
from flasher.conformance.real import HOST_UNCERTAINTY_S
from flasher.errors import ExitCode

__all__ = ["DOCUMENTS", "add_arguments", "run"]
_DESCRIPTION = """\
Test a bootloader against the protocol, case by case: on a device on a bench, or on the built-in
device model. Every case begins with a device that runs the known-good image; at the end that image
is flashed once more and verified. The device is erased and written many times.
"""
_EPILOG = """\
examples:
  flasher conformance -t bms --mock
  flasher conformance -t bms --mock --variant no-crc-check
  flasher conformance -t bms -i socketcan -c can0 --profile p.toml --good-image known_good.hex
  flasher conformance -t bms -i socketcan -c can0 --profile p.toml --good-image known_good.hex \\
      --power-cmd 'relay 3 {on|off}' --html report.html --junit report.xml --json-report new.json
  flasher conformance --list --group TX
  flasher conformance diff old.json new.json
  flasher conformance profile > p.toml

Without power control the device is brought back by the protocol, and cases that cut the power are
reported as unsupported. Ctrl-C ends the run with a report of what was run, and puts the good image
back; a second one ends at once.
"""
FILES: Final = {
    "junit": ("--junit", "JUnit XML, for CI servers"),
    "json_report": ("--json-report", "the report as JSON, for `flasher conformance diff`"),
    "html": ("--html", "the report as one self-contained page"),
}
"""Name in the options, option, help."""
TRACE_DIR: Final = "--trace-dir"
SEED: Final = "1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = _DESCRIPTION
    parser.epilog = _EPILOG
    arguments.add_target(parser, required=False)
    _add_device(parser)
    _add_selection(parser)
    _add_reports(parser)
    arguments.add_bus(parser)
    actions = parser.add_subparsers(
        dest="action", metavar="ACTION", title="other actions", required=False
    )
    diff = actions.add_parser("diff", help="what got better, worse or slower between two runs")
    _add_diff(diff)
    profile = actions.add_parser("profile", help="print a profile with every key explained")
    profile.add_argument(
        "--mock", action="store_true", help="what the built-in device model would have"
    )
    profile.add_argument(
        "--set",
        dest="choices",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="with --mock: a choice of the device model, as in `flasher mock`",
    )


def _add_device(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("device under test")
    group.add_argument("--profile", metavar="FILE", help="the product's choices and limits (TOML)")
    group.add_argument("--good-image", metavar="IMAGE", help="an image that runs on the device")
    group.add_argument(
        "--second-image", metavar="IMAGE", help="another one, smaller, of another version"
    )
    arguments.add_implausible(group)
    group.add_argument(
        "--power-cmd",
        metavar="COMMAND",
        help="command that switches the device, as 'relay 3 {on|off}'",
    )
    group.add_argument(
        "--readback-cmd",
        metavar="COMMAND",
        help="command that dumps the application area, as 'dump {file}'",
    )
    group.add_argument(
        "--uncertainty",
        type=arguments.seconds,
        default=HOST_UNCERTAINTY_S,
        metavar="SECONDS",
        help="how far the adapter's and the computer's times may be off (default %(default)s)",
    )
    mock = parser.add_argument_group("without hardware")
    mock.add_argument(
        "--mock", action="store_true", help="test the device model in this process; takes no time"
    )
    mock.add_argument(
        "--variant", metavar="NAME", help="one that is wrong, see `flasher mock --list-variants`"
    )
    mock.add_argument(
        "--set",
        dest="choices",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set a choice of the model, see `flasher mock --help`; may be repeated",
    )


def _add_selection(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what is run, and how")
    group.add_argument("--list", action="store_true", help="list the cases, and end")
    group.add_argument(
        "--case",
        dest="cases",
        nargs="+",
        action="extend",
        default=[],
        type=str.upper,
        metavar="ID",
        help="run these cases only, as TX-03",
    )
    group.add_argument(
        "--group",
        dest="groups",
        nargs="+",
        action="extend",
        default=[],
        type=str.upper,
        metavar="G",
        help=f"run these groups only: {' '.join(GROUPS)}",
    )
    group.add_argument(
        "--quick", action="store_true", help="some of every group, in under a minute on a real bus"
    )
    group.add_argument(
        "--seed", default=SEED, help="decides all that is left to chance (default %(default)s)"
    )
    group.add_argument(
        "--repeat",
        type=arguments.count,
        default=1,
        metavar="N",
        help="run every case N times (default %(default)s)",
    )
    group.add_argument(
        "--timeout",
        type=arguments.seconds,
        metavar="SECONDS",
        help="end the run after this time (default: every case has its own limit)",
    )
    group.add_argument(
        "--strict",
        action="store_true",
        help="a deviation of the profile that is none any more fails the run",
    )


def _add_reports(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("reports")
    for dest, (option, text) in FILES.items():
        group.add_argument(option, dest=dest, type=Path, metavar="FILE", help=text)
    group.add_argument(
        TRACE_DIR,
        type=Path,
        metavar="DIR",
        help="folder for a trace file (candump) of each case that does not pass",
    )


def _add_diff(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Compare two reports that --json-report wrote. Exit code 12 when a case got worse, or a "
        "new one fails."
    )
    parser.add_argument("old", type=Path, metavar="OLD", help="the report of the older run")
    parser.add_argument("new", type=Path, metavar="NEW", help="the report of the newer run")
    parser.add_argument(
        "--threshold",
        type=arguments.seconds,
        default=THRESHOLD_PERCENT,
        metavar="PERCENT",
        help="a time is slower when its median or p95 grew by more than this, and by more than its "
        "uncertainty (default %(default)g)",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="slower times and cases that are gone count as worse too",
    )


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    if options.action == "diff":
        return _diff(options, output)
    if options.action == "profile":
        return _profile(options, output)
    if options.list:
        return _list(options, output)
    from flasher.cli.conformance_run import run_suite  # noqa: PLC0415  much is loaded

    return run_suite(options, output)


def _list(options: argparse.Namespace, output: Output) -> int:
    from flasher.cli.conformance_run import selection_of  # noqa: PLC0415
    from flasher.conformance import cases  # noqa: F401, PLC0415  registers the cases
    from flasher.conformance.catalogue import CASES, case_text  # noqa: PLC0415
    from flasher.conformance.profile import ConformanceProfile  # noqa: PLC0415

    selection = selection_of(options)
    selection.check()
    found = [case_text(case_id, ConformanceProfile()) for case_id in selection.chosen()]
    for line in list_lines(found):
        output.result(line)
    output.document(
        CaseListDocument(
            cases=[
                ListedCaseDocument(
                    id=case.id,
                    group=case.group,
                    title=case.title,
                    clause=case.clause,
                    requires=list(case.requires),
                    choices=list(case.choices),
                    can_be_run=case.id in CASES,
                )
                for case in found
            ]
        )
    )
    return ExitCode.OK


def _diff(options: argparse.Namespace, output: Output) -> int:
    old, new = read_run(options.old), read_run(options.new)
    found = compare(old, new, options.threshold)
    for line in difference_lines(found, old, new):
        output.result(line)
    is_worse = found.is_worse or (options.strict and bool(found.slower or found.gone))
    code = ExitCode.PARTIAL if is_worse else ExitCode.OK
    output.document(difference_document(found), exit_code=code)
    return code


def _profile(options: argparse.Namespace, output: Output) -> int:
    from flasher.conformance.profile import (  # noqa: PLC0415
        ConformanceProfile,
        profile_keys,
    )

    profile = ConformanceProfile()
    if options.mock or options.choices:
        from flasher.conformance.mock import profile_of_mock  # noqa: PLC0415
        from flasher.conformance.opening import device_profile  # noqa: PLC0415

        profile = profile_of_mock(device_profile(options.choices))
    toml = profile.to_toml()
    output.result(toml.strip("\n"))
    output.document(
        ProfileKeysDocument(
            keys=[
                ProfileKeyDocument(
                    key=key.path, default=key.default, allowed=key.allowed, meaning=key.text
                )
                for key in profile_keys().values()
            ],
            toml=toml,
        )
    )
    return ExitCode.OK
