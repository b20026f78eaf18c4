"""Sets up badges, label printer and scanners of a station; `flasher station pin`."""

from __future__ import annotations

import getpass
import sys
from importlib.util import find_spec
from pathlib import Path

from flasher.cli.output import Output
from flasher.cli.station.commands import RunOptions
from flasher.cli.station.documents import PinDocument
from flasher.errors import ErrorCode, UsageError, how_to_install
from flasher.station.config import StationConfig
from flasher.station.label_printer import LabelPrinter, printer_of
from flasher.station.label_template import LabelTemplate, sample_of
from flasher.station.operators import Crew, load_badges
from flasher.station.pins import FORM_WORDS, Pin, hash_of, is_form
from flasher.station.recipe import SerialNumberRule
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.scanners import Scanner
from flasher.station.station import Station


def crew_of(
    options: RunOptions, config: StationConfig, serial_number: SerialNumberRule
) -> Crew | None:
    """People of the badge table; None without a table. Raises UsageError."""
    table = options.badges or (Path(config.badges) if config.badges else None)
    if table is None:
        return None
    given = [name for name in ("operator", "units") if getattr(options, name)]
    if given:
        raise UsageError(
            f"--{given[0]} cannot be combined with a badge table: "
            + ("the operator scans a badge." if given == ["operator"] else "people scan labels."),
            remedy=f"Remove --{given[0]}.",
        )
    return Crew(load_badges(table, serial_number))


def labels_of(config: StationConfig, recipe: LoadedRecipe) -> LabelPrinter | None:
    """Label printer of the station file; None without one. Raises UsageError."""
    label = config.label
    if label is None:
        return None
    return LabelPrinter(
        LabelTemplate(Path(label.template), sample_of(recipe.recipe, config.name)),
        printer_of(label),
        limit_s=label.time_limit_s,
        prints_each=label.on == "pass",
    )


def scanners_of(config: StationConfig, station: Station) -> list[Scanner]:
    """Scanners of the station file. Raises UsageError."""
    needs = {"serial": any(each.port for each in config.scanner)}
    needs["evdev"] = not all(each.port for each in config.scanner)
    missing = [name for name, is_needed in needs.items() if is_needed and not find_spec(name)]
    if missing:
        raise UsageError(
            f"Scanners need packages that are not installed: {', '.join(missing)}.",
            remedy=how_to_install("scanner"),
            code=ErrorCode.PACKAGE_MISSING,
        )
    return [Scanner(each, station.submit, station.publish) for each in config.scanner]


def pin(output: Output) -> int:
    typed = _typed("PIN: ")
    if not is_form(typed):
        raise UsageError(f"A PIN has {FORM_WORDS}.", remedy="Type another one.")
    if sys.stdin.isatty() and _typed("Repeat the PIN: ") != typed:
        raise UsageError("The two PINs differ.", remedy="Run the command again.")
    document = PinDocument(pin=hash_of(Pin(typed)))
    output.result(document.pin)
    return output.document(document)


def _typed(prompt: str) -> str:
    """Read a line without echo from a terminal, or the first line of a pipe."""
    if sys.stdin is None or not sys.stdin.isatty():
        return "" if sys.stdin is None else sys.stdin.readline().strip()
    try:
        return getpass.getpass(prompt).strip()
    except EOFError:
        return ""
