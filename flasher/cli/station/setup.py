"""Sets up recipes, badges, label printer and scanners of a station; `flasher station pin`."""

from __future__ import annotations

import getpass
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from datetime import date
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from flasher.cli.extras import need
from flasher.cli.output import Output
from flasher.cli.station.commands import RunOptions
from flasher.cli.station.documents import PinDocument
from flasher.errors import ErrorCode, FlasherError, UsageError, how_to_install
from flasher.protocol.text import printable
from flasher.station.adapters import Resolved, check_samples
from flasher.station.config import StationConfig
from flasher.station.gate import Gate
from flasher.station.given_recipes import RecipeFolder
from flasher.station.label_printer import LabelPrinter, printer_of
from flasher.station.label_template import LabelTemplate, sample_of
from flasher.station.operators import Crew, load_badges
from flasher.station.pins import FORM_WORDS, Pin, hash_of, is_form
from flasher.station.recipe import ClockRule, SerialNumberRule, Unchecked
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.recipe_offers import Offers, RecipeOffers, approved, problem_of
from flasher.station.records.errors import RecordError
from flasher.station.records.store import Store, SystemClock
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


def gate_of(
    config: StationConfig, recipes: Mapping[str, LoadedRecipe], store: Store
) -> Gate | None:
    """What asks the plant before each run; None if the station file names no plant. `recipes`:
    that of each socket. Raises UsageError.
    """
    question, claims = config.question, None
    if question is None and not config.plant:
        return None
    clock, recipe = SystemClock(), next(iter(recipes.values()))
    asked = None
    if question is not None:
        from flasher.station.question import Question  # noqa: PLC0415  few stations ask

        asked = Question(question, recipe, config.name)
    if config.plant:
        from flasher.plant.central import Central  # noqa: PLC0415  an extra
        from flasher.plant.claims import PlantClaims  # noqa: PLC0415

        # The gate applies the limit of each recipe.
        limit_s = max(each.recipe.plant.time_limit_s for each in recipes.values())
        central = Central(config.plant, lock_timeout_s=limit_s, statement_limit_s=limit_s)
        claims = PlantClaims(central, store.database, config.name, clock)
    return Gate(recipe.recipe, claims, asked, clock.monotonic_s)


def check_clock(config: StationConfig, recipe: LoadedRecipe, output: Output) -> float | None:
    """Compare the clock with that of the plant's database; None if that does not answer. Raises
    UsageError for a difference with which the recipe stops.
    """
    need("The plant's database", "plant")
    from flasher.plant.central import Central  # noqa: PLC0415  an extra
    from flasher.plant.claims import clock_offset_s  # noqa: PLC0415

    rule, offset_s = recipe.recipe.plant, None
    limit_s = rule.time_limit_s
    central = Central(config.plant, lock_timeout_s=limit_s, statement_limit_s=limit_s)
    try:
        with closing(central):
            offset_s = clock_offset_s(central, SystemClock())
    except RecordError as error:
        words = f"the clock was not compared with the plant's: {error.cause or error.what}"
        is_good, remedy = False, error.remedy
    else:
        words = f"the clock differs by {offset_s:+.2f} s from that of the plant's database"
        is_good, remedy = abs(offset_s) <= rule.clock_offset_max_s, "Set the clock."
    is_blocked = offset_s is not None or rule.clock_unknown is Unchecked.BLOCK
    if not is_good and is_blocked and rule.clock is ClockRule.STOP:
        raise UsageError(
            f"{words[0].upper()}{words[1:].rstrip('.')}.",
            cause=f"the recipe allows {rule.clock_offset_max_s:g} s, and stops",
            remedy=remedy,
        )
    if is_good:
        output.result(words)
    else:
        output.error_line(f"warning: {words}")
    return offset_s


# -- recipes from the plant ------------------------------------------------------------------------


def recipes_of(
    options: RunOptions,
    config: StationConfig,
    sockets: Sequence[Resolved],
    store: Store,
    local: LoadedRecipe | None,
    day: date,
) -> dict[str, LoadedRecipe]:
    """Recipe of each socket: the one from the plant that was approved last, else the local one.
    Raises UsageError, RecordError.
    """
    newest = approved(store.read, config.name) if config.plant_recipes else {}
    if options.ignore_approved:
        newest = {}
    folder = RecipeFolder.of(store.files.folder, config.name)
    loaded: dict[str, LoadedRecipe] = {}
    found: dict[str, LoadedRecipe] = {}
    for socket in sockets:
        name = socket.config.name
        digest = str(newest[name]["digest"]) if name in newest else ""
        if digest and digest not in loaded:
            loaded[digest] = _load_approved(folder, digest, newest[name], config, sockets, day)
        chosen = loaded.get(digest, local)
        if chosen is None:
            raise UsageError(
                f"No recipe was approved for socket {printable(name)} yet.",
                remedy="Give --recipe FILE to begin with. It is used until a supervisor has"
                " approved the plant's first one.",
            )
        found[name] = chosen
    return found


def check_golden(config: StationConfig, loaded: LoadedRecipe) -> None:
    """Check that a recipe names golden units if the station needs one. Raises UsageError."""
    if config.golden_unit == "required" and loaded.recipe.golden is None:
        raise UsageError(
            "The recipe names no golden unit, and this station requires one after each update.",
            remedy='Add [golden] to the recipe, or remove golden_unit = "required" from the station'
            " file.",
        )


def _load_approved(
    folder: RecipeFolder,
    digest: str,
    approval: Mapping[str, Any],
    config: StationConfig,
    sockets: Sequence[Resolved],
    day: date,
) -> LoadedRecipe:
    try:
        loaded = folder.load(digest, day)
        _check_fits(loaded, config=config, sockets=sockets)
    except FlasherError as error:
        name = printable(f"{approval.get('name')}, revision {approval.get('revision')}")
        raise UsageError(
            f"The approved recipe {name} cannot be used: {problem_of(error)}",
            where=f"digest {digest}",
            remedy="Fetch it again (flasher plant fetch --sockets FILE); or begin with a local one"
            " (--recipe FILE --ignore-approved), and approve another one of the plant there.",
            code=error.code,
        ) from error
    return loaded


def _check_fits(
    loaded: LoadedRecipe, *, config: StationConfig, sockets: Sequence[Resolved]
) -> None:
    """Check that a recipe fits the station's adapters, badges and labels. Raises FlasherError."""
    check_samples(sockets, loaded)
    check_golden(config, loaded)
    if config.badges:
        load_badges(Path(config.badges), loaded.recipe.serial_number)
    labels_of(config, loaded)


@contextmanager
def offered(
    config: StationConfig,
    sockets: Sequence[Resolved],
    files: Path,
    offer: Callable[[Offers], None],
) -> Iterator[None]:
    """Offer the plant's recipes to a station while the block runs. Raises RecordError."""
    names = [each.config.name for each in sockets]
    check = partial(_check_fits, config=config, sockets=sockets)
    folder = RecipeFolder.of(files, config.name)
    offers = RecipeOffers(folder, names, check, offer)
    offers.look()  # what was withdrawn counts from the first unit on
    with offers.watching():
        yield


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
    typed = ask_secret("PIN: ")
    if not is_form(typed):
        raise UsageError(f"A PIN has {FORM_WORDS}.", remedy="Type another one.")
    if sys.stdin.isatty() and ask_secret("Repeat the PIN: ") != typed:
        raise UsageError("The two PINs differ.", remedy="Run the command again.")
    document = PinDocument(pin=hash_of(Pin(typed)))
    output.result(document.pin)
    return output.document(document)


def ask_secret(prompt: str) -> str:
    """Read a line without echo from a terminal, or the first line of a pipe."""
    if sys.stdin is None or not sys.stdin.isatty():
        return "" if sys.stdin is None else sys.stdin.readline().strip()
    try:
        return getpass.getpass(prompt).strip()
    except EOFError:
        return ""
