"""`flasher plant`: options of its actions, which are in modules beside this one.

Those need the extra `plant` and are imported when called.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Final

from flasher.cli import values
from flasher.cli.extras import need
from flasher.cli.framework import group, option
from flasher.cli.output import Output
from flasher.errors import ExitCode

_EXAMPLES: Final = """\
examples:
  flasher plant init --database postgresql://flasher_plant@plant-db/flasher --print
  flasher plant init --database postgresql://flasher_plant@plant-db/flasher --station line-2
  flasher plant status --database postgresql://reader@plant-db/flasher
  flasher plant send --sockets sockets.toml
"""


def __getattr__(name: str) -> tuple[type, ...]:
    """Types of the `--json` documents, for the schema; they need the extra."""
    if name in ("DOCUMENTS", "LINES"):
        found: tuple[type, ...] = getattr(
            importlib.import_module("flasher.cli.plant.documents"), name
        )
        return found
    raise AttributeError(name)


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.VERIFICATION, ExitCode.INTERRUPTED))
def plant() -> None:
    """Collect the records of all stations of a plant in one PostgreSQL database. Each station keeps
    its own records and sends them when the server can be reached; no station waits for it. The
    guide is docs/how-to/plant.md.
    """


def _call(action: str, *args: object, **named: object) -> int:
    """Run an action ("module.function") and return its exit code. Raises UsageError when the extra
    `plant` is not installed.
    """
    need("The plant's database", "plant")
    module, _, name = action.partition(".")
    code: int = getattr(importlib.import_module(f"flasher.cli.plant.{module}"), name)(
        *args, **named
    )
    return code


_database_option: Final = option(
    "--database", metavar="URL", required=True, brief=True,
    help="the plant's database: postgresql://USER@HOST/NAME",
)  # fmt: skip


@plant.action("init")
@_database_option
@option(
    "--station", "stations", metavar="NAME", multiple=True, brief=True,
    help="a station that may send: creates its role; may be repeated",
)  # fmt: skip
@option(
    "--renew", metavar="NAME", multiple=True,
    help="a station that has new records: its old ones stay, and only the new ones are accepted "
    "from now on; may be repeated",
)  # fmt: skip
@option(
    "--print", "prints", is_flag=True, brief=True,
    help="change nothing: print what an administrator of the server has to run",
)  # fmt: skip
def init(
    output: Output,
    database: str,
    stations: tuple[str, ...],
    renew: tuple[str, ...],
    *,
    prints: bool,
) -> int:
    """Create or upgrade the database and the roles of the stations."""
    return _call("administration.init", output, database, stations, renew, prints=prints)


@plant.action("status")
@_database_option
def status(output: Output, database: str) -> int:
    """List the stations: last report, last row, unsent rows, clock, disk, version. Exit code 10 if
    the database refuses the records of one.
    """
    return _call("administration.status", output, database)


@plant.action("send")
@option(
    "--sockets", type=values.FilePath("toml", gives=Path), required=True, brief=True,
    metavar="FILE", help="the station file (TOML), with `plant`",
)  # fmt: skip
def send(output: Output, sockets: Path) -> int:
    """Send what the plant's database lacks of a station's records, and end. A running station sends
    by itself.
    """
    return _call("administration.send", output, sockets)
