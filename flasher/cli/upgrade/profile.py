"""`flasher profile`: show the settings of a target with their sources, or check a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from flasher.api import as_dialect
from flasher.cli.framework import argument, group
from flasher.cli.options import dialect_option, profile_option, target_option
from flasher.cli.output import Output
from flasher.cli.values import FilePath
from flasher.image.plausible import Cpu
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.profile import FILE_NAME, check_profile, load_profile

_EXAMPLES: Final = f"""\
examples:
  flasher profile show -t bms
  flasher profile show -t mc --profile bench.toml
  flasher profile check bench.toml

Without --profile, {FILE_NAME} of the working directory is used, else that of the user's
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

The table [bus] of the same file names the adapter, where no option, no CAN_* variable and no
configuration file of python-can does:

  [bus]
  interface = "pcan"
  channel = "PCAN_USBBUS1"
"""
_HEXADECIMAL: Final = frozenset(
    {"command", "answer_command", "answer_id", "reset_command", "start"}
)

ProfileValue = str | bool | int | float | list[int] | None
"""Bytes are a list of their values, as in the file."""


@dataclass(frozen=True)
class SourcedValue:
    """Setting with its source."""

    value: ProfileValue
    source: str
    """"default", "document", or the path of a file."""


@dataclass(frozen=True)
class ProfileDocument:
    """All settings of a target; those of a table have its name before a point."""

    target: str
    dialect: str
    values: dict[str, SourcedValue]


@dataclass(frozen=True)
class CheckedProfileDocument:
    """Valid profile."""

    file: str
    targets: list[str]
    """Targets with their own tables."""


DOCUMENTS: Final = (ProfileDocument, CheckedProfileDocument)


@group(epilog=_EXAMPLES)
def profile() -> None:
    """Show the settings of a target with their sources, or check a file. Opens no adapter."""


@profile.action("check")
@argument("file", metavar="FILE", type=FilePath("toml"), help="the file to check")
def check(output: Output, *, file: str) -> int:
    """Check whether a file is valid."""
    names = [target.name for target in check_profile(file)]
    own = f"with values of their own for {', '.join(names)}" if names else "for every device alike"
    output.result(f"{printable(file)}: right, {own}")
    return output.document(CheckedProfileDocument(file=file, targets=names))


@profile.action("show")
@target_option()
@dialect_option
@profile_option
def show(output: Output, target: Target, *, dialect_name: str, profile: str | None) -> int:
    """Show every setting with its source."""
    holds = load_profile(profile, target, as_dialect(dialect_name))
    output.table(
        (name, _as_in_file(name, value), printable(holds.sources[name]))
        for name, value in holds.values()
    )
    shown = {
        name: SourcedValue(_plain(value), holds.sources[name]) for name, value in holds.values()
    }
    return output.document(ProfileDocument(holds.target.name, holds.dialect.name, shown))


def _as_in_file(name: str, value: object) -> str:
    """Format a value in the notation of the file."""
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


def _plain(value: Any) -> ProfileValue:
    if isinstance(value, bytes):
        return list(value)
    plain: ProfileValue = value.value if isinstance(value, Cpu) else value
    return plain
