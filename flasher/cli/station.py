"""`flasher station`: the end-of-line station. Options stand here; the work in modules beside this
one, which are loaded only where a command needs them: they need the extra `station`.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
from pathlib import Path
from typing import Any, Final

from flasher.cli import arguments
from flasher.cli.output import Output
from flasher.errors import UsageError

_EXTRA: Final = ("cryptography", "platformdirs", "pydantic", "sqlalchemy")
"""Packages of the extra."""
_MODULES: Final = {
    "run": "station_run",
    "check": "station_check",
    "report": "station_records",
    "unit": "station_records",
    "roles": "station_roles",
    **dict.fromkeys(("backup", "verify", "key", "accept", "migrate"), "station_care"),
}
DEFAULT_RECORDS: Final = "records.sqlite"
_DESCRIPTION = """\
Flash unit after unit at the end of a line, several sockets at a time, by a recipe. A PASS is shown
only when it is on disk; the records tell years later what was written to which unit, by whom, with
which file. The guide is docs/station.md.
"""
_EPILOG = """\
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
_RUN_EPILOG = """\
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
            importlib.import_module("flasher.cli.station_documents"), name
        )
        return found
    raise AttributeError(name)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = _DESCRIPTION
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    check = actions.add_parser("check", help="everything about a recipe, before a shift")
    check.add_argument("recipe", type=Path, metavar="RECIPE", help="the recipe (TOML)")
    check.add_argument(
        "--sockets", type=Path, metavar="FILE", help="the station's file, and its adapters, too"
    )
    _add_run(actions.add_parser("run", help="flash unit after unit", epilog=_RUN_EPILOG))
    _add_report(actions.add_parser("report", help="units, yield, failures, times; certificates"))
    _add_unit(actions.add_parser("unit", help="the whole life of a unit, with its traces"))
    backup = actions.add_parser("backup", help="copy the records while the station runs")
    backup.add_argument("file", type=Path, metavar="FILE", help="where the copy goes")
    _add_records(backup)
    _add_roles(actions.add_parser("roles", help="users of a PostgreSQL server, with few rights"))
    _add_records(actions.add_parser("verify", help="tell whether the records were changed"))
    _add_key(actions.add_parser("key", help="the key that signs the records"))
    accept = actions.add_parser("accept", help="let the station go on, and note who said so")
    accept.add_argument(
        "what",
        choices=("clock", "restored"),
        help="clock: it is right, though records of a later time are there; restored: the records "
        "are an older copy, and what they lack is lost",
    )
    _add_who(accept)
    _add_records(accept)
    migrate = actions.add_parser(
        "migrate", help="bring records of an older flasher up to date; a backup is made first"
    )
    _add_records(migrate)


def _add_records(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("records")
    group.add_argument(
        "--database",
        metavar="FILE|URL",
        help="the records: an SQLite file or postgresql://USER@HOST/NAME (default: of --sockets, "
        f"else {DEFAULT_RECORDS} here)",
    )
    group.add_argument(
        "--files", type=Path, metavar="DIR", help="the folder of traces (default: beside the file)"
    )
    group.add_argument(
        "--keys",
        type=Path,
        metavar="DIR",
        help="the folder of the signing key (default: of --sockets, else a place of this user)",
    )
    group.add_argument(
        "--heads",
        type=Path,
        metavar="DIR",
        help="the folder where the signed heads of the audit "
        "trails are kept, best on another computer (default: of --sockets, else beside the key)",
    )
    group.add_argument("--sockets", type=Path, metavar="FILE", help="the station's file (TOML)")


def _add_roles(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Give two users of a PostgreSQL server their rights, by the owner of the database: one for "
        "stations, which adds records, and one which reads them. Neither can delete records, or "
        "change tables and triggers. Users and records that are not there yet are made."
    )
    for who in ("station", "reader"):
        parser.add_argument(
            f"--{who}-role",
            metavar="NAME",
            default=f"flasher_{who}",
            help="(default: %(default)s)",
        )
    _add_records(parser)


def _add_who(parser: argparse.ArgumentParser, *, needs_reason: bool = True) -> None:
    parser.add_argument("--operator", metavar="NAME", help="who says so (default: the login)")
    parser.add_argument("--reason", required=needs_reason, metavar="TEXT", help="why")


def _add_key(parser: argparse.ArgumentParser) -> None:
    change = parser.add_mutually_exclusive_group()
    change.add_argument("--rotate", action="store_true", help="sign with a new key from now on")
    change.add_argument(
        "--lost", action="store_true", help="the key is gone: go on with a new one (needs --reason)"
    )
    _add_who(parser, needs_reason=False)
    _add_records(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--recipe", type=Path, required=True, metavar="FILE", help="what is done to each unit"
    )
    parser.add_argument("--operator", metavar="NAME", help="who works here (default: the login)")
    parser.add_argument("--lot", default="", metavar="NAME", help="the lot of the units")
    parser.add_argument(
        "--scans", metavar="FILE", help="labels in the order of the units; it ends behind the last"
    )
    parser.add_argument(
        "--lines", action="store_true", help="a line for each happening, on a terminal too"
    )
    _add_records(parser)
    parser.add_argument(
        "--mix-virtual",
        action="store_true",
        help="let real and virtual units share the records (no serial number is both)",
    )
    mock = parser.add_argument_group("virtual units, for training and demonstration")
    mock.add_argument(
        "--mock-sockets", type=arguments.count, metavar="N", help="N sockets with virtual units"
    )
    mock.add_argument(
        "--units", type=arguments.count, metavar="N", help="end after N virtual units"
    )
    mock.add_argument(
        "--scan-by-hand", action="store_true", help="their labels are shown, and have to be typed"
    )
    for name, share, text in (
        ("bad", 0.15, "refuse the image, or have the wrong hardware"),
        ("slow", 0.1, "take longer"),
        ("dead", 0.05, "never answer"),
    ):
        mock.add_argument(
            f"--mock-{name}",
            type=_share,
            default=share,
            metavar="SHARE",
            help=f"how many {text} (default %(default)g)",
        )
    mock.add_argument(
        "--mock-seed", type=_whole, default=2, metavar="N", help="other ones (default %(default)s)"
    )
    mock.add_argument(
        "--mock-speed",
        type=arguments.speed,
        default=1.0,
        metavar="X",
        help="times as fast as a real bus; 0 takes no time (default %(default)g)",
    )


def _add_report(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("which runs (default: all)")
    group.add_argument("--lot", metavar="NAME")
    group.add_argument("--recipe", metavar="NAME", help="name in the recipe")
    group.add_argument("--part", metavar="NAME")
    group.add_argument("--serial", metavar="SERIAL")
    group.add_argument(
        "--since", metavar="TIME", help="begun then or later: 2026-05-17, or 2026-05-17T06:00"
    )
    group.add_argument("--until", metavar="TIME", help="begun before")
    group = parser.add_argument_group("what is written")
    for option, text in (
        ("--csv", "one row a run"),
        ("--json-report", "figures and runs"),
        ("--junit", "one test case a run"),
    ):
        group.add_argument(option, type=Path, metavar="FILE", help=text)
    group.add_argument(
        "--certificates", type=Path, metavar="DIR", help="a page to print for each unit (HTML)"
    )
    _add_records(parser)


def _add_unit(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("serial", metavar="SERIAL", help="its serial number")
    parser.add_argument("--part", metavar="NAME", help="where several parts have this number")
    parser.add_argument("--story", action="store_true", help="each trace explained in full")
    parser.add_argument(
        "--certificate", type=Path, metavar="FILE", help="write its page to print (HTML)"
    )
    _add_records(parser)


def _share(text: str) -> float:
    value = arguments.seconds(text)
    if value > 1:
        raise argparse.ArgumentTypeError("must be from 0 to 1")
    return value


def _whole(text: str) -> int:
    value: int = arguments.number(text)
    return value


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code. Raises UsageError without the extra."""
    missing = [name for name in _EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"The station needs packages that are not installed: {', '.join(missing)}.",
            remedy="In the checkout: pip install -c .ci/constraints.txt '.[station]'",
        )
    module: Any = importlib.import_module(f"flasher.cli.{_MODULES[options.action]}")
    code: int = module.run(options, output)
    return code
