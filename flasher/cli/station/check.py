"""`flasher station check`: check a recipe, its images and a station file before a shift."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date, datetime
from pathlib import Path

from flasher.cli.documents import document_of
from flasher.cli.output import Output, byte_count
from flasher.cli.station.commands import PagesOptions, RecordsOptions, RunOptions
from flasher.cli.station.documents import (
    CheckedTargetDocument,
    FindingsDocument,
    RecipeFindingDocument,
    StationCheckDocument,
)
from flasher.cli.station.run import run
from flasher.cli.station.setup import ask_secret, check_clock, check_golden, labels_of
from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.adapters import check_samples, detect, resolve
from flasher.station.config import load_config
from flasher.station.operators import Crew, load_badges
from flasher.station.recipe import fill
from flasher.station.recipe_file import LoadedRecipe, load_checked
from flasher.station.scans import Word


def golden(
    output: Output, options: RunOptions, records: RecordsOptions, serial: str, socket: str | None
) -> int:
    """Run a golden unit. Its PASS releases this flasher with the recipe at the station. With a
    badge table the badge of the operator is typed or scanned first.
    """
    if records.sockets is None or options.recipe is None:
        raise UsageError("--golden needs the station file.", remedy="Give --sockets FILE.")
    recipe = load_checked(options.recipe, datetime.now().astimezone().date())
    rule = recipe.recipe.golden
    known = () if rule is None else rule.serial_numbers
    if serial not in known:
        listed = ", ".join(map(printable, known)) or "none"
        raise UsageError(
            f"{printable(serial)} is no golden unit of the recipe: it names {listed}.",
            remedy="Name one of them, or add it to [golden] in the recipe.",
        )
    config = load_config(records.sockets)
    names = [each.name for each in config.socket]
    if socket is None and len(names) > 1:
        raise UsageError(
            "The station has several sockets.",
            remedy=f"Give --socket with one of {', '.join(map(printable, names))}.",
        )

    def scans(crew: Crew | None) -> list[str]:
        of_unit = [f"{Word.SOCKET.value} {socket or names[0]}", serial]
        if crew is None:
            return of_unit
        badge = ask_secret("Badge: ")
        if badge not in crew.codes:
            raise UsageError(
                "This badge is not in the badge table.",
                remedy="Run the command again, and scan the badge of a person in"
                f" {printable(config.badges)}.",
            )
        return [badge, *of_unit]

    return run(output, options, PagesOptions(), records, golden=scans)


def check(output: Output, path: Path, station_file: Path | None) -> int:
    # Local time: the day of production is written to units.
    day = datetime.now().astimezone().date()
    try:
        recipe = load_checked(path, day)
    except UsageError as error:
        if not error.faults:
            raise
        findings = [
            RecipeFindingDocument(
                where=each.place or "the whole file", what=each.what, remedy=each.remedy
            )
            for each in error.faults
        ]
        return output.failure(error, FindingsDocument(findings=findings))
    output.results(_lines(recipe, day))
    for target in recipe.targets:
        for warning in target.provenance.warnings if target.provenance else ():
            output.error_line(f"warning: {warning}")
    sockets: dict[str, str] = {}
    clock_offset_s = None
    if station_file is not None:
        config = load_config(station_file)
        if config.badges:
            load_badges(Path(config.badges), recipe.recipe.serial_number)
        labels_of(config, recipe)
        if config.question is not None:
            from flasher.station.question import Question  # noqa: PLC0415  few stations ask

            Question(config.question, recipe, config.name)  # reads its certificates
        if config.plant:
            clock_offset_s = check_clock(config, recipe, output)
        check_golden(config, recipe)
        resolved = resolve(config.socket, detect(config.socket))
        check_samples(resolved, recipe)
        for socket in resolved:
            bus = socket.bus
            adapter = "virtual units" if bus is None else f"{bus['interface']} {bus['channel']}"
            sockets[socket.config.name] = adapter
    for name, adapter in sockets.items():
        output.result(f"socket {printable(name)}: {printable(adapter)}")
    output.result("no problem was found")
    return output.document(
        document_of(
            StationCheckDocument,
            recipe.recipe,
            recipe=recipe.recipe.name,
            sha256=recipe.sha256,
            targets=[
                CheckedTargetDocument(
                    target=target.name,
                    image=printable(target.firmware.image),
                    sha256=target.image.sha256,
                    size_bytes=target.image.size_bytes,
                    version=target.version,
                    required=target.required,
                )
                for target in recipe.targets
            ],
            sockets=sockets,
            clock_offset_s=clock_offset_s,
        )
    )


def _lines(recipe: LoadedRecipe, day: date) -> Iterator[str]:
    rules = recipe.recipe
    yield printable(f"{recipe.path}: {rules.name}, part {rules.part}, revision {rules.revision}")
    yield f"  sha256:   {recipe.sha256}"
    for target in recipe.targets:
        version = target.version or "no version named"
        yield printable(
            f"  flash:    {target.name.upper()}: {target.firmware.image}, {version}, "
            f"{byte_count(target.image.size_bytes)}; {target.required.words}"
        )
        if (signature := target.signature()) is not None:
            yield printable(f"  origin:   {target.name.upper()}: {signature.text}")
    yield printable(f"  example:  {rules.serial_number.example}")
    scan = recipe.scan(rules.serial_number.example, day)
    for write in rules.write:
        values = " ".join(fill(each, scan) for each in write.values)
        yield printable(f"  write:    {write.target.upper()} {write.item}: {values}")
    for kept in rules.unchanged:
        yield printable(f"  keep:     {kept.target.upper()} {kept.item}")
