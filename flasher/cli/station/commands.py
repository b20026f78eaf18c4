"""`flasher station`: the options of its actions. What they do stands in modules beside this one,
which are loaded only where an action needs them: they need the extra `station`.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import click

from flasher.cli import values
from flasher.cli.framework import Decorator, argument, group, option
from flasher.cli.output import Output
from flasher.errors import ExitCode, UsageError

DEFAULT_RECORDS: Final = "records.sqlite"
_EXTRA: Final = ("cryptography", "platformdirs", "pydantic", "sqlalchemy")
"""Packages of the extra."""
_EXAMPLES: Final = """\
examples:
  flasher station check recipe.toml
  flasher station run --recipe recipe.toml --sockets sockets.toml --operator Jo
  flasher station run --recipe recipe.toml --mock-sockets 4 --units 8
  flasher station report --lot L17 --csv runs.csv --certificates pages
  flasher station unit W2605002 --certificate W2605002.html
  flasher station backup /mnt/plant/records.sqlite
  flasher station verify --heads /mnt/plant/heads
  flasher station key
  flasher station roles --database postgresql://flasher_owner@plant-db/flasher
"""
_RUN_NOTES: Final = """\
A scan is the label of a unit, or a command: SOCKET A, CANCEL, ABORT A, FREE A, LOT 4711,
OPERATOR Jo, REASON text, RESUME. They are read from stdin, a line each: a scanner is a keyboard.
With --scans each label of the file goes to the next socket in which a unit waits.

Ctrl-C: no further unit is begun, and those that run are finished. A second one stops them at their
next safe place; they have to be scanned again. Exit code 12 when a unit did not pass.
"""


def __getattr__(name: str) -> tuple[type, ...]:
    """What `--json` prints, for the schema; it is made of classes that need the extra."""
    if name in ("DOCUMENTS", "LINES"):
        found: tuple[type, ...] = getattr(
            importlib.import_module("flasher.cli.station.documents"), name
        )
        return found
    raise AttributeError(name)


@group(
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.BUS, ExitCode.VERIFICATION, ExitCode.PARTIAL, ExitCode.INTERRUPTED),
)
def station() -> None:
    """Flash unit after unit at the end of a line, several sockets at a time, by a recipe. A PASS is
    shown only when it is on disk; the records tell years later what was written to which unit, by
    whom, with which file. The guide is docs/station.md.
    """


def _carry_out(action: str, output: Output, options: dict[str, Any]) -> int:
    """Run an action ("module.function"); returns the exit code. Raises UsageError without the
    extra.
    """
    missing = [name for name in _EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"The station needs packages that are not installed: {', '.join(missing)}.",
            remedy="In the checkout: pip install -c .ci/constraints.txt '.[station]'",
        )
    module, _, name = action.partition(".")
    run = getattr(importlib.import_module(f"flasher.cli.station.{module}"), name)
    code: int = run(SimpleNamespace(**options), output)
    return code


# -- options that actions share --------------------------------------------------------------------


def _path_option(*names: str, **more: Any) -> Decorator:
    metavar = more.pop("metavar", "FILE")
    of = values.FolderPath() if metavar == "DIR" else values.FilePath(gives=Path)
    return option(*names, type=of, metavar=metavar, **more)


_RECORDS: Final = (
    option(
        "--database", metavar="FILE|URL", panel="records", brief=True,
        help="the records: an SQLite file or postgresql://USER@HOST/NAME (default: of --sockets, "
        f"else {DEFAULT_RECORDS} here)",
    ),
    _path_option(
        "--files", metavar="DIR", panel="records",
        help="the folder of traces (default: beside the file)",
    ),
    _path_option(
        "--keys", metavar="DIR", panel="records",
        help="the folder of the signing key (default: of --sockets, else a place of this user)",
    ),
    _path_option(
        "--heads", metavar="DIR", panel="records",
        help="the folder where the signed heads of the audit trails are kept, best on another "
        "computer (default: of --sockets, else beside the key)",
    ),
    _path_option("--sockets", panel="records", brief=True, help="the station's file (TOML)"),
)  # fmt: skip


def _records_options(function: Callable[..., int]) -> Callable[..., int]:
    for each in reversed(_RECORDS):
        function = each(function)
    return function


_operator_option: Final = option(
    "--operator", metavar="NAME", brief=True, help="who says so (default: the login)"
)


def _reason_option(*, required: bool) -> Decorator:
    return option("--reason", required=required, metavar="TEXT", help="why")


def _share(text: str) -> float:
    value = values.seconds(text)
    if value > 1:
        raise click.BadParameter("must be from 0 to 1")
    return value


def _mock_share_option(name: str, share: float, what: str) -> Decorator:
    return option(
        f"--mock-{name}", type=_share, default=share, metavar="SHARE", panel=_VIRTUAL,
        help=f"how many {what}",
    )  # fmt: skip


# -- actions ---------------------------------------------------------------------------------------

_VIRTUAL: Final = "virtual units, for training and demonstration"
_WHICH: Final = "which runs (default: all)"
_WRITTEN: Final = "what is written"


@station.action("check")
@argument("recipe", type=values.FilePath("toml", gives=Path), metavar="RECIPE", help="the recipe")
@_path_option("--sockets", brief=True, help="the station's file, and its adapters, too")
def check(output: Output, **options: Any) -> int:
    """Check everything about a recipe, before a shift."""
    return _carry_out("check.check", output, options)


@station.action("run", epilog=_RUN_NOTES)
@_path_option("--recipe", required=True, help="what is done to each unit")
@option("--operator", metavar="NAME", brief=True, help="who works here (default: the login)")
@option("--lot", default="", metavar="NAME", show_default=False, help="the lot of the units")
@_path_option("--scans", help="labels in the order of the units; it ends behind the last")
@option("--lines", is_flag=True, help="a line for each happening, on a terminal too")
@_records_options
@option(
    "--mix-virtual", is_flag=True, panel="records",
    help="let real and virtual units share the records (no serial number is both)",
)  # fmt: skip
@option(
    "--mock-sockets", type=values.count, metavar="N", panel=_VIRTUAL, brief=True,
    help="N sockets with virtual units",
)  # fmt: skip
@option(
    "--units", type=values.count, metavar="N", panel=_VIRTUAL, brief=True,
    help="end after N virtual units",
)  # fmt: skip
@option(
    "--scan-by-hand", is_flag=True, panel=_VIRTUAL,
    help="their labels are shown, and have to be typed",
)  # fmt: skip
@_mock_share_option("bad", 0.15, "refuse the image, or have the wrong hardware")
@_mock_share_option("slow", 0.1, "take longer")
@_mock_share_option("dead", 0.05, "never answer")
@option(
    "--mock-seed", type=values.number, default="2", metavar="N", panel=_VIRTUAL, help="other ones"
)
@option(
    "--mock-speed", type=values.speed, default=1.0, metavar="X", panel=_VIRTUAL,
    help="times as fast as a real bus; 0 takes no time",
)  # fmt: skip
def run(output: Output, **options: Any) -> int:
    """Flash unit after unit."""
    return _carry_out("run.run", output, options)


@station.action("report")
@option("--lot", metavar="NAME", panel=_WHICH, brief=True, help="of this lot")
@option("--recipe", metavar="NAME", panel=_WHICH, help="by the recipe of this name")
@option("--part", metavar="NAME", panel=_WHICH, help="of this part")
@option("--serial", metavar="SERIAL", panel=_WHICH, help="of the unit with this serial number")
@option(
    "--since", metavar="TIME", panel=_WHICH, brief=True,
    help="begun then or later: 2026-05-17, or 2026-05-17T06:00",
)  # fmt: skip
@option("--until", metavar="TIME", panel=_WHICH, brief=True, help="begun before")
@_path_option("--csv", panel=_WRITTEN, brief=True, help="one row a run")
@_path_option("--json-report", panel=_WRITTEN, help="figures and runs")
@_path_option("--junit", panel=_WRITTEN, help="one test case a run")
@_path_option(
    "--certificates", metavar="DIR", panel=_WRITTEN, help="a page to print for each unit (HTML)"
)
@_records_options
def report(output: Output, **options: Any) -> int:
    """Show units, yield, failures and times; write them to files; make certificates."""
    return _carry_out("records.report", output, options)


@station.action("unit")
@argument("serial", metavar="SERIAL", help="its serial number")
@option("--part", metavar="NAME", help="where several parts have this number")
@option("--story", is_flag=True, brief=True, help="each trace explained in full")
@_path_option("--certificate", help="write its page to print (HTML)")
@_records_options
def unit(output: Output, **options: Any) -> int:
    """Show the whole life of a unit, with its traces."""
    return _carry_out("records.unit", output, options)


@station.action("backup")
@argument("file", type=values.FilePath(gives=Path), metavar="FILE", help="where the copy goes")
@_records_options
def backup(output: Output, **options: Any) -> int:
    """Copy the records while the station runs."""
    return _carry_out("care.backup", output, options)


@station.action("roles")
@option("--station-role", metavar="NAME", default="flasher_station", help="it adds records")
@option("--reader-role", metavar="NAME", default="flasher_reader", help="it reads them")
@_records_options
def roles(output: Output, **options: Any) -> int:
    """Give two users of a PostgreSQL server their rights, by the owner of the database: one for
    stations, which adds records, and one which reads them. Neither can delete records, or change
    tables and triggers. Users and records that are not there yet are made.
    """
    return _carry_out("care.roles", output, options)


@station.action("verify")
@_records_options
def verify(output: Output, **options: Any) -> int:
    """Tell whether the records were changed."""
    return _carry_out("care.verify", output, options)


@station.action("key")
@option("--rotate", is_flag=True, brief=True, help="sign with a new key from now on")
@option("--lost", is_flag=True, help="the key is gone: go on with a new one (needs --reason)")
@_operator_option
@_reason_option(required=False)
@_records_options
def key(output: Output, **options: Any) -> int:
    """Show, or change, the key that signs the records."""
    if options["rotate"] and options["lost"]:
        raise UsageError("--rotate and --lost do not go together.", remedy="Leave one out.")
    return _carry_out("care.key", output, options)


@station.action("accept")
@argument(
    "what",
    type=click.Choice(("clock", "restored")),
    help="clock: it is right, though records of a later time are there; restored: the records are "
    "an older copy, and what they lack is lost",
)
@_operator_option
@_reason_option(required=True)
@_records_options
def accept(output: Output, **options: Any) -> int:
    """Let the station go on, and note who said so."""
    return _carry_out("care.accept", output, options)


@station.action("migrate")
@_records_options
def migrate(output: Output, **options: Any) -> int:
    """Bring records of an older flasher up to date; a backup is made first."""
    return _carry_out("care.migrate", output, options)
