"""`flasher conformance`: tests a bootloader against the protocol, case by case; compares two such
runs; documents the profile. How a run goes stands in `conformance_run`.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

from flasher.cli import values
from flasher.cli.bench.conformance_documents import (
    DOCUMENTS,
    CaseListDocument,
    ListedCaseDocument,
    ProfileKeyDocument,
    ProfileKeysDocument,
    difference_document,
)
from flasher.cli.bench.conformance_text import difference_lines, list_lines
from flasher.cli.framework import Decorator, argument, group, option
from flasher.cli.options import Bus, adapter_options, allow_implausible_option, target_option
from flasher.cli.output import Output
from flasher.conformance.catalogue import GROUPS
from flasher.conformance.diff import THRESHOLD_PERCENT, compare, read_run
from flasher.conformance.real import HOST_UNCERTAINTY_S
from flasher.errors import ExitCode

__all__ = ["DOCUMENTS", "conformance"]
_EXAMPLES: Final = """\
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


def _report_option(name: str) -> Decorator:
    flag, text = FILES[name]
    return option(
        flag, name, type=values.FilePath(gives=Path), metavar="FILE", panel="reports", help=text
    )


_set_option: Final = option(
    "--set", "choices", multiple=True, metavar="KEY=VALUE", panel="without hardware",
    help="set a choice of the model, see `flasher mock --help`; may be repeated",
)  # fmt: skip


@group(
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.IMAGE, ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.PARTIAL, ExitCode.INTERRUPTED,
    ),
    runs_alone=True,
)  # fmt: skip
@target_option(required=False)
@option(
    "--profile",
    metavar="FILE",
    type=values.FilePath("toml"),
    panel="device under test",
    brief=True,
    help="the product's choices and limits (TOML)",
)
@option(
    "--good-image",
    metavar="IMAGE",
    type=values.FilePath(*values.IMAGE_SUFFIXES),
    panel="device under test",
    brief=True,
    help="an image that runs on the device",
)
@option(
    "--second-image",
    metavar="IMAGE",
    type=values.FilePath(*values.IMAGE_SUFFIXES),
    panel="device under test",
    help="another one, smaller, of another version",
)
@allow_implausible_option("device under test")
@option(
    "--power-cmd",
    metavar="COMMAND",
    panel="device under test",
    help="command that switches the device, as 'relay 3 {on|off}'",
)
@option(
    "--readback-cmd",
    metavar="COMMAND",
    panel="device under test",
    help="command that dumps the application area, as 'dump {file}'",
)
@option(
    "--uncertainty",
    type=values.seconds,
    default=HOST_UNCERTAINTY_S,
    metavar="SECONDS",
    panel="device under test",
    help="how far the adapter's and the computer's times may be off",
)
@option(
    "--mock",
    is_flag=True,
    panel="without hardware",
    brief=True,
    help="test the device model in this process; takes no time",
)
@option(
    "--variant",
    metavar="NAME",
    panel="without hardware",
    help="one that is wrong, see `flasher mock --list-variants`",
)
@_set_option
@option(
    "--list",
    "list",
    is_flag=True,
    panel="what is run, and how",
    brief=True,
    help="list the cases, and end",
)
@option(
    "--case",
    "cases",
    multiple=True,
    type=str.upper,
    metavar="ID",
    panel="what is run, and how",
    brief=True,
    help="run this case only, as TX-03; may be repeated",
)
@option(
    "--group",
    "groups",
    multiple=True,
    type=str.upper,
    metavar="G",
    panel="what is run, and how",
    brief=True,
    help=f"run this group only: {' '.join(GROUPS)}; may be repeated",
)
@option(
    "--quick",
    is_flag=True,
    panel="what is run, and how",
    brief=True,
    help="some of every group, in under a minute on a real bus",
)
@option(
    "--seed",
    default=SEED,
    metavar="SEED",
    panel="what is run, and how",
    help="decides all that is left to chance",
)
@option(
    "--repeat",
    type=values.count,
    default="1",
    metavar="N",
    panel="what is run, and how",
    help="run every case N times",
)
@option(
    "--timeout",
    type=values.seconds,
    metavar="SECONDS",
    panel="what is run, and how",
    help="end the run after this time (default: every case has its own limit)",
)
@option(
    "--strict",
    is_flag=True,
    panel="what is run, and how",
    help="a deviation of the profile that is none any more fails the run",
)
@_report_option("junit")
@_report_option("json_report")
@_report_option("html")
@option(
    TRACE_DIR,
    type=values.FolderPath(),
    metavar="DIR",
    panel="reports",
    help="folder for a trace file (candump) of each case that does not pass",
)
@adapter_options
def conformance(output: Output, bus: Bus, **chosen: Any) -> int:
    """Test a bootloader against the protocol, case by case: on a device on a bench, or on the
    built-in device model. Every case begins with a device that runs the known-good image; at the
    end that image is flashed once more and verified. The device is erased and written many times.
    """
    options = SimpleNamespace(bus=bus, mock=bus.mock, **chosen)
    if options.list:
        return _list(options, output)
    from flasher.cli.bench.conformance_run import run_suite  # noqa: PLC0415  much is loaded

    return run_suite(options, output)


def _list(options: SimpleNamespace, output: Output) -> int:
    from flasher.cli.bench.conformance_run import selection_of  # noqa: PLC0415
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


@conformance.action("diff", exit_codes=(ExitCode.PARTIAL,))
@argument("old", type=values.FilePath("json", gives=Path), metavar="OLD", help="the older report")
@argument("new", type=values.FilePath("json", gives=Path), metavar="NEW", help="the newer report")
@option(
    "--threshold",
    type=values.seconds,
    default=THRESHOLD_PERCENT,
    metavar="PERCENT",
    help="a time is slower when its median or p95 grew by more than this, and by more than its "
    "uncertainty",
)
@option("--strict", is_flag=True, help="slower times and cases that are gone count as worse too")
def diff(output: Output, *, old: Path, new: Path, threshold: float, strict: bool) -> int:
    """Compare two reports that --json-report wrote. Exit code 12 when a case got worse, or a new
    one fails.
    """
    before, after = read_run(old), read_run(new)
    found = compare(before, after, threshold)
    for line in difference_lines(found, before, after):
        output.result(line)
    is_worse = found.is_worse or (strict and bool(found.slower or found.gone))
    code = ExitCode.PARTIAL if is_worse else ExitCode.OK
    output.document(difference_document(found), exit_code=code)
    return code


@conformance.action("profile", exit_codes=())
@option("--mock", is_flag=True, help="what the built-in device model would have")
@_set_option
def profile(output: Output, *, mock: bool, choices: tuple[str, ...]) -> int:
    """Print a profile with every key explained."""
    from flasher.conformance.profile import (  # noqa: PLC0415
        ConformanceProfile,
        profile_keys,
    )

    values_of = ConformanceProfile()
    if mock or choices:
        from flasher.conformance.mock import profile_of_mock  # noqa: PLC0415
        from flasher.conformance.opening import device_profile  # noqa: PLC0415

        values_of = profile_of_mock(device_profile(list(choices)))
    toml = values_of.to_toml()
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
