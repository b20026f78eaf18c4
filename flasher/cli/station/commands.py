"""`flasher station`: options of its actions, which are in modules beside this one.

Those need the extra `station` and are imported when called.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import click

from flasher.cli import values
from flasher.cli.extras import Actions, need
from flasher.cli.framework import Decorator, argument, group, option, option_set
from flasher.cli.output import Output
from flasher.errors import ExitCode

DEFAULT_RECORDS: Final = "records.sqlite"
_EXAMPLES: Final = """\
examples:
  flasher station check recipe.toml
  flasher station check recipe.toml --sockets sockets.toml --golden W2605000 --socket A
  flasher station run --recipe recipe.toml --sockets sockets.toml --operator Jo
  flasher station run --recipe recipe.toml --mock-sockets 4 --units 8
  flasher station run --recipe recipe.toml --mock-sockets 4 --web
  flasher station pages --sockets sockets.toml
  flasher station report --lot L17 --csv runs.csv --certificates pages
  flasher station unit W2605002 --certificate W2605002.html
  flasher station backup /mnt/plant/records.sqlite
  flasher station verify --heads /mnt/plant/heads
  flasher station verify --certificate W2605002.html
  flasher station key
  flasher station pin
"""
_RUN_NOTES: Final = """\
A scan is the label of a unit, or a command: SOCKET A, CANCEL, ABORT A, FREE A, LOT 4711,
OPERATOR Jo, REASON text, REPRINT SERIAL, RESUME. They are read from stdin, one on each line, as a
scanner types them. With --scans each label of the file goes to the next socket with a waiting unit.
With --badges the operator is the person whose badge was scanned last; REASON, ABORT and RESUME
depend on that person's role.

Ctrl-C: no further unit starts, and running ones are finished. A second Ctrl-C stops them at their
next safe point; scan them again. Exit code 12 if a unit did not pass.
"""

_PAGES_NOTES: Final = """\
Open the printed address: /runs, /units, /yield, /times, /measurements, /images, /audit,
/certificate. A station
that runs with --web serves these pages too, beside its operator page.
"""


_actions: Final = Actions("flasher.cli.station", "The station", "station")
__getattr__ = _actions.documents


@group(
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.BUS, ExitCode.VERIFICATION, ExitCode.PARTIAL, ExitCode.INTERRUPTED),
)
def station() -> None:
    """Flash units at the end of a production line by a recipe, on several sockets at the same time.
    A PASS is shown only after it is on disk; years later the records still show which file was
    written to which unit, and by whom. The guide is docs/how-to/station.md.
    """


# -- options that actions share --------------------------------------------------------------------


def _path_option(*names: str, **more: Any) -> Decorator:
    metavar = more.pop("metavar", "FILE")
    of = values.FolderPath() if metavar == "DIR" else values.FilePath(gives=Path)
    return option(*names, type=of, metavar=metavar, **more)


@dataclass(frozen=True)
class RecordsOptions:
    """Options for the location of the records."""

    database: Annotated[str | None, option(
        "--database", metavar="FILE", panel="records", brief=True,
        help="the records: an SQLite file (default: of --sockets, "
        f"else {DEFAULT_RECORDS} here)",
    )] = None  # fmt: skip
    files: Annotated[Path | None, _path_option(
        "--files", metavar="DIR", panel="records",
        help="the folder of traces (default: beside the file)",
    )] = None  # fmt: skip
    keys: Annotated[Path | None, _path_option(
        "--keys", metavar="DIR", panel="records",
        help="the folder of the signing key (default: of --sockets, else a place of this user)",
    )] = None  # fmt: skip
    heads: Annotated[tuple[str, ...], option(
        "--heads", metavar="DIR|URL", multiple=True, panel="records",
        help="a place for copies of the signed heads of the audit trails, in addition to the one "
        "beside the key: a folder, best on another computer, or postgresql://USER@HOST/NAME; may "
        "be repeated (default: of --sockets)",
    )] = ()  # fmt: skip
    sockets: Annotated[Path | None, _path_option(
        "--sockets", panel="records", brief=True, help="the station file (TOML)",
    )] = None  # fmt: skip


_records_options: Final = option_set("records", RecordsOptions)


_operator_option: Final = option(
    "--operator", metavar="NAME", brief=True, help="who decides this (default: the login)"
)


def _reason_option(*, required: bool) -> Decorator:
    return option(
        "--reason", type=values.reason, required=required, metavar="TEXT",
        help="the reason, for the records",
    )  # fmt: skip


def _share(text: str) -> float:
    value = values.seconds(text)
    if value > 1:
        raise click.BadParameter("must be from 0 to 1")
    return value


@dataclass(frozen=True)
class Address:
    """Host and port at which the pages are served."""

    host: str
    port: int


def address_of(text: str) -> Address:
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise click.BadParameter("must be PORT or HOST:PORT")
    return Address(host.removeprefix("[").removesuffix("]") or "127.0.0.1", int(port))


def _mock_share_option(name: str, share: float, what: str) -> Decorator:
    return option(
        f"--mock-{name}", type=_share, default=share, metavar="SHARE", panel=_VIRTUAL,
        help=f"share of units that {what}",
    )  # fmt: skip


# -- actions ---------------------------------------------------------------------------------------

PAGES: Final = "pages"
DEFAULT_WEB: Final = "8740"
DEFAULT_DESK: Final = "8741"
_VIRTUAL: Final = "virtual units, for training and demonstration"
_WHICH: Final = "selection of runs (default: all)"
_WRITTEN: Final = "files to write"


@dataclass(frozen=True)
class PagesOptions:
    """Options of the pages: access and language."""

    web_password: Annotated[Path | None, _path_option(
        "--web-password", panel=PAGES,
        help="a file with the password of the pages in its first line",
    )] = None  # fmt: skip
    web_certificate: Annotated[Path | None, _path_option(
        "--web-certificate", panel=PAGES,
        help="serve the pages over TLS with this certificate (PEM)",
    )] = None  # fmt: skip
    web_key: Annotated[Path | None, _path_option(
        "--web-key", panel=PAGES, help="the key of the certificate (PEM)",
    )] = None  # fmt: skip
    web_insecure: Annotated[bool, option(
        "--web-insecure", is_flag=True, panel=PAGES,
        help="allow other computers without TLS: anyone on the network can read the traffic",
    )] = False  # fmt: skip
    language: Annotated[str | None, option(
        "--language", type=click.Choice(("en", "de", "zh")), panel=PAGES,
        help="language of the pages (default: the browser's)",
    )] = None  # fmt: skip


pages_options: Final = option_set("pages", PagesOptions)


@dataclass(frozen=True)
class RunOptions:
    """Options of `flasher station run`."""

    recipe: Annotated[Path | None, _path_option(
        "--recipe", brief=True,
        help="the recipe (TOML): steps, images and limits of a unit; with `plant_recipes` in the "
        "station file it is used until a recipe of the plant is approved",
    )] = None  # fmt: skip
    ignore_approved: Annotated[bool, option(
        "--ignore-approved", is_flag=True,
        help="begin with --recipe although a recipe of the plant was approved; it is recorded",
    )] = False  # fmt: skip
    operator: Annotated[str | None, option(
        "--operator", metavar="NAME", brief=True, help="name of the operator (default: the login)",
    )] = None  # fmt: skip
    lot: Annotated[str, option(
        "--lot", default="", metavar="NAME", show_default=False, help="the lot of the units",
    )] = ""  # fmt: skip
    badges: Annotated[Path | None, _path_option(
        "--badges", help="the badge table of the people who may work here (default: of --sockets)"
    )] = None  # fmt: skip
    scans: Annotated[Path | None, _path_option(
        "--scans", help="a file with a label on each line, in the order of the units; the station "
        "ends after the last",
    )] = None  # fmt: skip
    lines: Annotated[bool, option(
        "--lines", is_flag=True, help="print a line for each event, even on a terminal",
    )] = False  # fmt: skip
    web: Annotated[Address | None, option(
        "--web", type=address_of, is_flag=False, flag_value=DEFAULT_WEB, metavar="[[HOST:]PORT]",
        panel=PAGES, brief=True, show_default=False,
        help="serve the operator and supervisor pages (without a value: on this computer only, "
        f"port {DEFAULT_WEB})",
    )] = None  # fmt: skip
    mix_virtual: Annotated[bool, option(
        "--mix-virtual", is_flag=True, panel="records",
        help="allow real and virtual units in the same records (with different serial numbers)",
    )] = False  # fmt: skip
    mock_sockets: Annotated[int | None, option(
        "--mock-sockets", type=values.count, metavar="N", panel=_VIRTUAL, brief=True,
        help="use N sockets with virtual units",
    )] = None  # fmt: skip
    units: Annotated[int | None, option(
        "--units", type=values.count, metavar="N", panel=_VIRTUAL, brief=True,
        help="end after N virtual units",
    )] = None  # fmt: skip
    scan_by_hand: Annotated[bool, option(
        "--scan-by-hand", is_flag=True, panel=_VIRTUAL,
        help="show the labels of virtual units, to be typed",
    )] = False  # fmt: skip
    mock_bad: Annotated[float, _mock_share_option(
        "bad", 0.15, "refuse the image, or have the wrong hardware",
    )] = 0.0  # fmt: skip
    mock_slow: Annotated[float, _mock_share_option("slow", 0.1, "take longer")] = 0.0
    mock_dead: Annotated[float, _mock_share_option("dead", 0.05, "never answer")] = 0.0
    mock_exchanged: Annotated[float, _mock_share_option(
        "exchanged", 0.0, "are exchanged for the next one while being flashed",
    )] = 0.0  # fmt: skip
    mock_mislabelled: Annotated[float, _mock_share_option(
        "mislabelled", 0.0, "have the label of another unit",
    )] = 0.0  # fmt: skip
    mock_seed: Annotated[int, option(
        "--mock-seed", type=values.number, default="2", metavar="N", panel=_VIRTUAL,
        help="seed of the virtual units; another one gives other units",
    )] = 1  # fmt: skip
    mock_speed: Annotated[float, option(
        "--mock-speed", type=values.speed, default=1.0, metavar="X", panel=_VIRTUAL,
        help="speed relative to a real bus; 0: no delays",
    )] = 1.0  # fmt: skip


@station.action("check")
@argument("recipe", type=values.FilePath("toml", gives=Path), metavar="RECIPE", help="the recipe")
@_path_option("--sockets", brief=True, help="check this station file and its adapters, too")
@option(
    "--golden", metavar="SERIAL", brief=True,
    help="also run this golden unit: its PASS releases this flasher with the recipe at the station "
    "(see `golden_unit` in the station file)",
)  # fmt: skip
@option("--socket", metavar="NAME", help="the socket of the golden unit")
def check(
    output: Output, recipe: Path, sockets: Path | None, golden: str | None, socket: str | None
) -> int:
    """Check a recipe and its images, before a shift. With --golden a known good unit is flashed,
    after an update of flasher or of the recipe; a station with badges asks for the operator's. Exit
    code 12 if it did not pass.
    """
    if golden is None:
        return _actions.call("check.check", output, recipe, sockets)
    options, records = RunOptions(recipe=recipe, lines=True), RecordsOptions(sockets=sockets)
    return _actions.call("check.golden", output, options, records, golden, socket)


@station.action("run", epilog=_RUN_NOTES)
@option_set("options", RunOptions)
@pages_options
@_records_options
def run(output: Output, options: RunOptions, pages: PagesOptions, records: RecordsOptions) -> int:
    """Flash units until Ctrl-C, or until all scans or virtual units are done."""
    if options.web is not None:
        need("The operator page", "web")
    return _actions.call("run.run", output, options, pages, records)


@station.action("pages", epilog=_PAGES_NOTES)
@option(
    "--web", type=address_of, default=DEFAULT_DESK, metavar="[HOST:]PORT", panel=PAGES, brief=True,
    help="address of the pages; a port alone: on this computer only",
)  # fmt: skip
@pages_options
@_records_options
@_actions.calls("pages.serve", also=("The supervisor pages", "web"))
def pages() -> None:
    """Serve the supervisor pages of records until Ctrl-C: runs, units, yield, causes, times,
    images, audit trail. It does not change the records, and needs no running station.
    """


@station.action("pin")
@_actions.calls("setup.pin")
def pin() -> None:
    """Ask for a PIN, without showing it, and print its hash for the badge table."""


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report: which runs, and the files to write."""

    lot: Annotated[str | None, option(
        "--lot", metavar="NAME", panel=_WHICH, brief=True, help="runs of this lot",
    )]  # fmt: skip
    recipe: Annotated[str | None, option(
        "--recipe", metavar="NAME", panel=_WHICH, help="runs by this recipe",
    )]  # fmt: skip
    part: Annotated[str | None, option(
        "--part", metavar="NAME", panel=_WHICH, help="runs of this part",
    )]  # fmt: skip
    serial: Annotated[str | None, option(
        "--serial", metavar="SERIAL", panel=_WHICH, help="runs of this serial number",
    )]  # fmt: skip
    station: Annotated[str | None, option(
        "--station", metavar="NAME", panel=_WHICH, help="runs of this station",
    )]  # fmt: skip
    since: Annotated[str | None, option(
        "--since", metavar="TIME", panel=_WHICH, brief=True,
        help="runs begun at this time or later: 2026-05-17, or 2026-05-17T06:00",
    )]  # fmt: skip
    until: Annotated[str | None, option(
        "--until", metavar="TIME", panel=_WHICH, brief=True, help="runs begun before this time",
    )]  # fmt: skip
    csv: Annotated[Path | None, _path_option(
        "--csv", panel=_WRITTEN, brief=True, help="a table with a row for each run",
    )]  # fmt: skip
    json_report: Annotated[Path | None, _path_option(
        "--json-report", panel=_WRITTEN, help="figures, measurements and runs, as with --json",
    )]  # fmt: skip
    junit: Annotated[Path | None, _path_option(
        "--junit", panel=_WRITTEN, help="JUnit XML with a test case for each run",
    )]  # fmt: skip
    measurements: Annotated[Path | None, _path_option(
        "--measurements", panel=_WRITTEN,
        help="a table (CSV) with a row for each measurement with limits: mean, s, Cpk, Ppk",
    )]  # fmt: skip
    certificates: Annotated[Path | None, _path_option(
        "--certificates", metavar="DIR", panel=_WRITTEN, help="a certificate (HTML) for each unit"
    )]  # fmt: skip


@station.action("report")
@option_set("options", ReportOptions)
@_records_options
@_actions.calls("records.report")
def report() -> None:
    """Show units, yield, failures, times and the capability of measurements with limits (Cpk, Ppk);
    write them to files; make certificates.
    """


@station.action("unit")
@argument("serial", metavar="SERIAL", help="its serial number")
@option("--part", metavar="NAME", help="where several parts have this number")
@option("--story", "full", is_flag=True, brief=True, help="each trace explained in full")
@_path_option("--certificate", "page", help="write its page to print (HTML)")
@_records_options
@_actions.calls("records.unit")
def unit() -> None:
    """Show the whole history of a unit, with its traces."""


@station.action("backup")
@argument("file", type=values.FilePath(gives=Path), metavar="FILE", help="the file to write")
@_records_options
@_actions.calls("maintenance.backup")
def backup() -> None:
    """Copy the records while the station runs."""


@station.action("verify")
@option(
    "--all", "is_all", is_flag=True, brief=True,
    help="examine everything again; default: only records since the last examination without "
    "problems",
)  # fmt: skip
@_path_option(
    "--certificate", brief=True,
    help="check this certificate instead: HTML as flasher wrote it, its print as PDF, or a text "
    "with its signed lines or its QR code",
)  # fmt: skip
@_records_options
def verify(
    output: Output, records: RecordsOptions, certificate: Path | None, *, is_all: bool
) -> int:
    """Check whether records, or a certificate, were changed after they were written."""
    if certificate is not None:
        return _actions.call("maintenance.verify_certificate", output, records, certificate)
    return _actions.call("maintenance.verify", output, records, is_all=is_all)


@station.action("key")
@option("--rotate", is_flag=True, brief=True, help="sign with a new key from now on")
@option("--lost", is_flag=True, help="the key was lost: use a new one (needs --reason)")
@_operator_option
@_reason_option(required=False)
@_records_options
@_actions.calls("maintenance.key")
def key() -> None:
    """Show, or change, the key that signs the records."""


@station.action("accept")
@argument(
    "what",
    type=click.Choice(("clock", "restored")),
    help="clock: the clock is right, although the records contain later times; restored: the "
    "records are an older copy, and newer records are lost",
)
@_operator_option
@_reason_option(required=True)
@_records_options
@_actions.calls("maintenance.accept")
def accept() -> None:
    """Let a station continue after a problem, and record who decided it."""


_station_file: Final = option(
    "--sockets", type=values.FilePath("toml", gives=Path), required=True, brief=True,
    metavar="FILE", help="the station file (TOML)",
)  # fmt: skip
_passphrase_option: Final = _path_option(
    "--passphrase-file",
    help="a file with the passphrase (default: asked for, or the first line of a pipe)",
)


@station.action("export")
@argument("file", type=values.FilePath(gives=Path), metavar="FILE", help="the file to write")
@_station_file
@option(
    "--recipe", "recipes", type=values.FilePath("toml", gives=Path), metavar="FILE", multiple=True,
    help="a recipe to put in, with its images; may be repeated",
)  # fmt: skip
@_passphrase_option
@_actions.calls("spare.export")
def export() -> None:
    """Seal the station's signing key and settings in one file for a spare PC, encrypted with a
    passphrase. Records are not in it: a spare PC takes them from the plant's database.
    """


@station.action("take-over")
@_station_file
@option(
    "--database", "url", metavar="URL", required=True, brief=True,
    help="the plant's database for a reader: postgresql://USER@HOST/NAME",
)  # fmt: skip
@_path_option(
    "--from", "sealed", brief=True,
    help="the sealed export (default: this PC has the key and the settings)",
)  # fmt: skip
@option(
    "--archive", type=values.FolderPath(), metavar="DIR", brief=True,
    help="the folder of the files of retired months, if the plant has any",
)  # fmt: skip
@_passphrase_option
@_operator_option
@_reason_option(required=True)
@_actions.calls("spare.take_over", also=("Taking a station over", "plant"))
def take_over() -> None:
    """Let this PC continue a station from the plant's database. The PC that ran it before is
    refused from then on; to take the station back, run this there. Settings that are missing here
    are taken from the export.
    """


@station.action("bring-in")
@argument(
    "file", type=values.FilePath(gives=Path), metavar="RECORDS",
    help="the records of the PC that ran the station before",
)  # fmt: skip
@_operator_option
@_reason_option(required=True)
@_records_options
@_actions.calls("spare.bring")
def bring_in() -> None:
    """Bring in what another PC recorded as this station after the station was taken over: runs,
    traces, and every signed row as it was.
    """


@station.action("upgrade")
@_records_options
@_actions.calls("maintenance.upgrade")
def upgrade() -> None:
    """Migrate records of an older flasher. The file is backed up first."""
