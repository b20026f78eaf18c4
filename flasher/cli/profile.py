"""`flasher profile`: what holds for a target, where each value comes from, and whether a file is
right. Also the --profile option, for the commands that take one.
"""

from __future__ import annotations

import argparse
from typing import Final, TypedDict

from flasher import api
from flasher.cli import arguments
from flasher.cli.output import Output
from flasher.errors import ExitCode
from flasher.image.plausible import Cpu
from flasher.protocol.text import printable
from flasher.settings.profile import FILE_NAME, Profile, check_profile, load_profile

_EPILOG = f"""\
examples:
  flasher profile show -t bms
  flasher profile show -t mc --profile bench.toml
  flasher profile check bench.toml

Without --profile, {FILE_NAME} of the working directory holds, else the one of the user's
configuration directory. Values before the first table are for every device, a table such as [wmc]
is for one:

  attempts = 5
  [timings]
  ack_timeout_s = 1.0
  [wmc]
  frame_gap_s = 0.001
  reset_command = 0x4205
  reset_data = "RESET"
  [wmc.application_area]
  start = 0x08004000
  size_bytes = 0x1C000
"""
_HEXADECIMAL: Final = frozenset(
    {"command", "answer_command", "answer_id", "reset_command", "start"}
)

ProfileValue = str | bool | int | float | list[int] | None
"""Bytes are a list of their values, as in the file."""


class SourcedValue(TypedDict):
    """A value of a profile and where it comes from."""

    value: ProfileValue
    source: str
    """"default", "document", or the path of a file."""


class ProfileDocument(TypedDict):
    """Every value that holds for a target; those of a table have its name before a point."""

    target: str
    dialect: str
    values: dict[str, SourcedValue]


class CheckedProfileDocument(TypedDict):
    """A profile that is right."""

    file: str
    targets: list[str]
    """The targets that it has values of their own for."""


DOCUMENTS: Final = (ProfileDocument, CheckedProfileDocument)


def add_option(parser: argparse.ArgumentParser) -> None:
    """The option --profile."""
    parser.add_argument(
        "--profile",
        metavar="FILE",
        help=f"target profile (default: {FILE_NAME} here or in the user's configuration)",
    )


def profile_of(options: argparse.Namespace) -> Profile:
    """The profile for --profile, --target and --dialect. Raises UsageError."""
    return load_profile(options.profile, options.target, api.as_dialect(options.dialect))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = (
        "Show what holds for a target and where each value comes from, or check a file. Opens no "
        "adapter."
    )
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    show = actions.add_parser("show", help="every value with its source")
    arguments.add_target(show)
    arguments.add_dialect(show)
    add_option(show)
    check = actions.add_parser("check", help="is a file right")
    check.add_argument("file", metavar="FILE", help="the file to check")


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    if options.action == "show":
        output.document(_show(options, output))
    else:
        output.document(_check(options, output))
    return ExitCode.OK


def _check(options: argparse.Namespace, output: Output) -> CheckedProfileDocument:
    names = [target.name for target in check_profile(options.file)]
    own = f"with values of their own for {', '.join(names)}" if names else "for every device alike"
    output.result(f"{printable(options.file)}: right, {own}")
    return {"file": options.file, "targets": names}


def _show(options: argparse.Namespace, output: Output) -> ProfileDocument:
    profile = profile_of(options)
    rows = [(name, _shown(name, value)) for name, value in profile.values()]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    for name, shown in rows:
        source = printable(profile.sources[name])
        output.result(f"{name:<{widths[0]}}  {shown:<{widths[1]}}  {source}")
    return {
        "target": profile.target.name,
        "dialect": profile.dialect.name,
        "values": {
            name: {"value": _plain(value), "source": profile.sources[name]}
            for name, value in profile.values()
        },
    }


def _shown(name: str, value: object) -> str:
    """A value as the file would have it."""
    match value:
        case None:
            return "not set"
        case bool():
            return str(value).lower()
        case Cpu():
            return f'"{value.value}"'
        case bytes() if value.isascii() and value.decode().isprintable():
            return f'"{value.decode()}"'
        case bytes():
            return str(list(value))
        case int() if name.rpartition(".")[2] in _HEXADECIMAL:
            return f"0x{value:04X}"
        case int():
            return str(int(value))
        case _:
            return str(value)


def _plain(value: object) -> ProfileValue:
    match value:
        case bytes():
            return list(value)
        case Cpu():
            return value.value
        case None | bool() | int() | float() | str():
            return value
        case _:
            raise TypeError(f"a profile has no value like {value!r}")
