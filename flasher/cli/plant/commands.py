"""`flasher plant`: options of its actions, which are in modules beside this one.

Those need the extra `plant` and are imported when called.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import click

from flasher.cli import values
from flasher.cli.extras import Actions
from flasher.cli.framework import argument, group, option, option_set
from flasher.cli.station.commands import (
    DEFAULT_DESK,
    PAGES,
    ReportOptions,
    address_of,
    pages_options,
)
from flasher.errors import ExitCode
from flasher.plant.bounds import USUAL_BOUNDS, Bounds

_EXAMPLES: Final = """\
examples:
  flasher plant init --database postgresql://flasher_plant@plant-db/flasher --print
  flasher plant init --database postgresql://flasher_plant@plant-db/flasher --station line-2
  flasher plant status --database postgresql://reader@plant-db/flasher
  flasher plant units --database postgresql://reader@plant-db/flasher --image V1r0r4_20220512
  flasher plant report --database postgresql://reader@plant-db/flasher --since 2026-05-17
  flasher plant pages --database postgresql://reader@plant-db/flasher
  flasher plant verify --database postgresql://reader@plant-db/flasher
  flasher plant claims --database postgresql://reader@plant-db/flasher
  flasher plant publish recipe.toml --station line-2 --database postgresql://anna@plant-db/flasher
  flasher plant recipes --database postgresql://reader@plant-db/flasher
  flasher plant retire --database postgresql://owner@plant-db/flasher --archive DIR --keep-months 24
  flasher plant send --sockets sockets.toml
  flasher plant deliver --receivers receivers.toml --database postgresql://courier@plant-db/flasher
  flasher plant deliveries --state refused --database postgresql://reader@plant-db/flasher
"""


_actions: Final = Actions("flasher.cli.plant", "The plant's database", "plant")
__getattr__ = _actions.documents


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.VERIFICATION, ExitCode.PARTIAL, ExitCode.INTERRUPTED))
def plant() -> None:
    """Collect the records of all stations of a plant in one PostgreSQL database. Each station keeps
    its own records and sends them when the server can be reached; no station waits for it. The
    guide is docs/how-to/plant.md.
    """


_database_option: Final = option(
    "--database", "url", metavar="URL", required=True, brief=True,
    help="the plant's database: postgresql://USER@HOST/NAME",
)  # fmt: skip


@plant.action("init")
@_database_option
@option(
    "--station", "stations", metavar="NAME", multiple=True, brief=True,
    help="a station that may send: creates its role; may be repeated",
)  # fmt: skip
@option(
    "--renew", "renewed", metavar="NAME", multiple=True,
    help="a station that has new records: its old ones stay, and only the new ones are accepted "
    "from now on; may be repeated",
)  # fmt: skip
@option(
    "--print", "prints", is_flag=True, brief=True,
    help="change nothing: print what an administrator of the server has to run",
)  # fmt: skip
@_actions.calls("administration.init")
def init() -> None:
    """Create or upgrade the database and the roles of the stations."""


_ALERTS: Final = "bounds of alerts"


_bounds: Final = option_set(
    "bounds", Bounds,
    option(
        "--yield-min", "yield_min_percent", type=values.percent,
        default=USUAL_BOUNDS.yield_min_percent, metavar="PERCENT", panel=_ALERTS, brief=True,
        help="alert if fewer units of the shift passed in their last run",
    ),
    option(
        "--yield-units", "units_min", type=values.count, default=str(USUAL_BOUNDS.units_min),
        metavar="N", panel=_ALERTS, help="units of the shift from which its yield is judged",
    ),
    option(
        "--silent", "silent_s", type=values.seconds, default=USUAL_BOUNDS.silent_s, metavar="S",
        panel=_ALERTS, brief=True, help="alert if a station has not reported for this time",
    ),
    option(
        "--repeats", type=values.count, default=str(USUAL_BOUNDS.repeats), metavar="N",
        panel=_ALERTS, brief=True,
        help="alert if the last N runs of a socket, within 24 hours, ended with the same code",
    ),
    option(
        "--unsent", "unsent_s", type=values.seconds, default=USUAL_BOUNDS.unsent_s, metavar="S",
        panel=_ALERTS, help="alert if a record has waited at its station for longer",
    ),
    option(
        "--clock", "clock_s", type=values.seconds, default=USUAL_BOUNDS.clock_s, metavar="S",
        panel=_ALERTS,
        help="alert if a station's clock differs from the database's by more",
    ),
    option(
        "--disk", "disk_bytes", type=values.number, default=f"{USUAL_BOUNDS.disk_bytes >> 20}M",
        metavar="BYTES", panel=_ALERTS, help="alert if a station's disk has less free space",
    ),
)  # fmt: skip


@plant.action("status")
@_bounds
@_database_option
@_actions.calls("administration.status")
def status() -> None:
    """List the stations with their checks: last report, last row, last run, yield, unsent rows,
    clock, disk, version. Exit code 10 if the database refuses the records of one, else 12 if there
    is an alert. A check that cannot be judged, such as a yield of too few units, is "not known".
    """


@plant.action("verify")
@_database_option
@option(
    "--archive", type=values.FolderPath(), metavar="DIR", brief=True,
    help="examine the files of retired months in this folder, too",
)  # fmt: skip
@_actions.calls("reading.verify")
def verify() -> None:
    """Examine every audit trail with its signatures, every run against its audit rows, and every
    PASS against its trace. Exit code 10 if something was changed.
    """


@dataclass(frozen=True)
class ClaimOptions:
    """Options: which claims, as in `flasher.plant.claim_list.ClaimFilter`."""

    station: Annotated[str | None, option(
        "--station", metavar="NAME", brief=True, help="only of this station",
    )]  # fmt: skip
    part: Annotated[str | None, option("--part", metavar="NAME", help="only of this part")]
    serial: Annotated[str | None, option(
        "--serial", metavar="SERIAL", brief=True, help="only of this unit",
    )]  # fmt: skip


@plant.action("claims")
@option_set("options", ClaimOptions)
@option(
    "--release", "releases", is_flag=True, brief=True,
    help="release those that have expired: their station does not return. Only the owner of the "
    "database may do it",
)  # fmt: skip
@option("--reason", metavar="TEXT", brief=True, help="the reason, for the records")
@_database_option
@_actions.calls("claims.claims")
def claims() -> None:
    """List the units that stations claim and whose run has not arrived, and the claims that were
    released. While a claim exists, other stations do not know whether its unit has passed. A run
    that arrives after its claim was released is marked: duplicates not checked.
    """


@plant.action("retire")
@_database_option
@option(
    "--archive", type=values.FolderPath(), metavar="DIR", required=True, brief=True,
    help="the folder of the files",
)  # fmt: skip
@option("--before", metavar="MONTH", brief=True, help="months before this one: 2024-01")
@option(
    "--keep-months", type=values.count, metavar="N", brief=True,
    help="instead: months that ended at least N months ago",
)  # fmt: skip
@option("--dry-run", "-n", is_flag=True, help="change nothing: show what would be retired")
@option(
    "--with-problems", is_flag=True,
    help="archive records that plant verify finds fault with as they are, instead of refusing",
)  # fmt: skip
@_actions.calls("retiring.retire")
def retire() -> None:
    """Move old months from the database to files, one for each month. A month is deleted only
    after its file is on the disk and was verified. The last run of each unit, and its last
    transfer, stay. Only the owner of the database may do it; when interrupted, run it again. Exit
    code 10 if the records of a month have problems: it stays.
    """


@plant.action("units")
@_database_option
@option(
    "--image", "wanted", metavar="SHA256|VERSION", required=True, brief=True,
    help="SHA-256 of the image, its beginning, or its version",
)  # fmt: skip
@_actions.calls("reading.units")
def units() -> None:
    """List the units whose last transfer to a target was of this image, newest first."""


@plant.action("report")
@option_set("options", ReportOptions)
@_database_option
@_actions.calls("reading.report")
def report() -> None:
    """Show units, yield, failures and times of all stations; write them to files."""


@plant.action("pages")
@option(
    "--web", type=address_of, default=DEFAULT_DESK, metavar="[HOST:]PORT", panel=PAGES, brief=True,
    help="address of the pages; a port alone: on this computer only",
)  # fmt: skip
@pages_options
@_bounds
@_database_option
@_actions.calls("reading.pages", also=("The supervisor pages", "web"))
def pages() -> None:
    """Serve the supervisor pages over the records of all stations until Ctrl-C: the page of all
    stations with their alerts, and those of a station.
    """


@plant.action("send")
@option(
    "--sockets", type=values.FilePath("toml", gives=Path), required=True, brief=True,
    metavar="FILE", help="the station file (TOML), with `plant`",
)  # fmt: skip
@_actions.calls("administration.send")
def send() -> None:
    """Send what the plant's database lacks of a station's records, and end. A running station sends
    by itself.
    """


@plant.action("publish")
@argument("recipe", type=values.FilePath("toml", gives=Path), metavar="RECIPE", help="the recipe")
@option(
    "--station", "stations", metavar="NAME", multiple=True, brief=True,
    help="a station that gets it; may be repeated",
)  # fmt: skip
@option("--all", "is_all", is_flag=True, brief=True, help="all stations get it")
@option(
    "--socket", "sockets", metavar="NAME", multiple=True,
    help="a socket that gets it (default: all of the station); may be repeated",
)  # fmt: skip
@_database_option
@_actions.calls("recipes.publish")
def publish() -> None:
    """Give a recipe with its images to stations with `plant_recipes` in their file. A station
    fetches it, and uses it after one of its supervisors has approved it there.
    """


@plant.action("withdraw")
@argument("digest", metavar="DIGEST", help="its digest, or the first digits")
@option(
    "--reason", type=values.reason, required=True, brief=True, metavar="TEXT",
    help="the reason, for the records",
)  # fmt: skip
@_database_option
@_actions.calls("recipes.withdraw")
def withdraw() -> None:
    """Withdraw a published recipe: stations begin no unit with it as soon as they know. To publish
    it again takes that back.
    """


@plant.action("recipes")
@_database_option
@_actions.calls("recipes.recipes")
def recipes() -> None:
    """List what was published and withdrawn, by whom and when."""


@plant.action("fetch")
@option(
    "--sockets", type=values.FilePath("toml", gives=Path), required=True, brief=True,
    metavar="FILE", help="the station file (TOML), with `plant`",
)  # fmt: skip
@_actions.calls("administration.fetch")
def fetch() -> None:
    """Fetch the recipes that the plant gives to a station, and end. A running station does it by
    itself. Exit code 12 if one could not be fetched.
    """


# -- to the plant's systems ------------------------------------------------------------------------


@plant.action("deliver")
@option(
    "--receivers", "file", type=values.FilePath("toml", gives=Path), required=True, brief=True,
    metavar="FILE", help="the file of receivers (TOML): their addresses",
)  # fmt: skip
@option("--once", is_flag=True, help="end when no run is due, instead of waiting for more")
@_database_option
@_actions.calls("handover.deliver")
def deliver() -> None:
    """Hand over the runs that arrive in the plant's database to the plant's other systems, by HTTP
    or MQTT, until Ctrl-C. Each run comes with a key; it counts once if the receiver ignores a key
    that it has already. A receiver is new when it is first in the file: it gets the runs that
    arrive from then on.
    """


@dataclass(frozen=True)
class DeliveryOptions:
    """Options: which deliveries, as in `flasher.plant.delivery_list.DeliveryFilter`."""

    receiver: Annotated[str | None, option(
        "--receiver", metavar="NAME", brief=True, help="only to this receiver",
    )]  # fmt: skip
    state: Annotated[str | None, option(
        "--state", type=click.Choice(("waiting", "sent", "confirmed", "unknown", "refused")),
        brief=True, help="only in this state",
    )]  # fmt: skip
    station: Annotated[str | None, option(
        "--station", metavar="NAME", help="only runs of this station",
    )]  # fmt: skip
    serial: Annotated[str | None, option("--serial", metavar="SERIAL", help="only of this unit")]
    since: Annotated[str | None, option(
        "--since", metavar="TIME",
        help="only runs that arrived at this time or later: 2026-05-17, or 2026-05-17T06:00",
    )]  # fmt: skip
    until: Annotated[str | None, option(
        "--until", metavar="TIME", help="only runs that arrived before this time",
    )]  # fmt: skip
    key: Annotated[str | None, option(
        "--key", metavar="KEY", help="only the run with this key; --json contains its document",
    )]  # fmt: skip


@plant.action("deliveries")
@option_set("options", DeliveryOptions)
@option(
    "--limit", type=values.count, default="20", metavar="N",
    help="list at most N, the newest (default 20)",
)  # fmt: skip
@option(
    "--resend", is_flag=True, brief=True,
    help="hand all runs that the options choose over again, or at once",
)  # fmt: skip
@option(
    "--stop", metavar="NAME",
    help="hand no further runs over to this receiver, which is no longer in the file",
)  # fmt: skip
@_database_option
@_actions.calls("handover.deliveries")
def deliveries() -> None:
    """List what was handed over to the plant's systems, and what they answered."""


@plant.action("reconcile")
@argument(
    "file", metavar="FILE", type=values.FilePath("csv", "json", gives=Path),
    help="the keys that the receiver has",
)  # fmt: skip
@option("--receiver", metavar="NAME", required=True, brief=True, help="the receiver")
@option("--resend", is_flag=True, brief=True, help="hand over again what is missing there")
@_database_option
@_actions.calls("handover.reconcile")
def reconcile() -> None:
    """Compare the keys that a receiver has, from a CSV or JSON file, with what was handed over:
    missing there, more than once there, unknown here. Exit code 10 if they differ.
    """
