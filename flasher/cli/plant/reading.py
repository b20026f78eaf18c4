"""`flasher plant verify`, `units`, `report` and `pages`: read the records of all stations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from itertools import takewhile
from pathlib import Path

from flasher.cli.bar import Bar
from flasher.cli.output import Output, counted
from flasher.cli.plant.documents import PlantUnitsDocument
from flasher.cli.station.commands import Address, PagesOptions, RecordsOptions, ReportOptions
from flasher.cli.station.maintenance import problem_lines
from flasher.cli.station.place import open_to_read
from flasher.cli.station.records import report as station_report
from flasher.errors import ExitCode
from flasher.plant.bounds import Bounds
from flasher.plant.store import PlantStore, cache_folder
from flasher.plant.verify import PlantExaminer
from flasher.protocol.text import printable
from flasher.station.records.errors import NotFoundError
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import ImageRecord, InstalledUnit, Overview

_AT_ONCE = 1000


def records_of_plant(url: str) -> RecordsOptions:
    return RecordsOptions(url, cache_folder(url))


def verify(output: Output, url: str, archive: Path | None) -> int:
    look = {"unit": " rows", "desc": "examined", "unit_scale": True}
    with (
        closing(open_to_read(records_of_plant(url), PlantStore)) as store,
        Bar(output, **look) as bar,
    ):
        assert isinstance(store, PlantStore)  # noqa: S101  as asked for
        found = PlantExaminer(store, bar.move_to, archive).examine_plant()
    for line in problem_lines(found.problems):
        output.result(printable(line))
    for line in found.remarks:
        output.progress(f"note: {printable(line)}")
    if found.problems:
        output.result(counted(len(found.problems), "problem"))
    else:
        output.result(
            f"{counted(found.runs, 'run')} and {counted(found.traces, 'trace')} of runs that"
            " passed agree with the signed audit trails"
        )
    if found.archives:
        output.result(f"  {counted(len(found.archives), 'file')} of retired months, too")
    for each in found.stations:
        keys = ", ".join(each.keys)
        last = f"to {each.last_at}, signed with {keys}"
        output.result(printable(f"  {each.station}: {counted(each.rows, 'row')} {last}"))
    if found.stations:
        output.result("  compare these keys with `flasher station key` at the stations")
    code = ExitCode.VERIFICATION if found.problems else ExitCode.OK
    return output.document(found, exit_code=code)


# -- units of an image -----------------------------------------------------------------------------


def units(output: Output, url: str, wanted: str) -> int:
    with closing(open_to_read(records_of_plant(url), PlantStore)) as store:
        overview = Overview(store.database)
        images = [
            each
            for each in overview.images(wanted)
            if each.version == wanted or each.sha256.startswith(wanted.lower())
        ]
        if not images:
            raise NotFoundError(
                f"No station has used an image {printable(wanted)}.",
                remedy="Give its SHA-256, the beginning of it, or the whole version;"
                " flasher image-info IMAGE shows both.",
            )
        units = (
            unit
            for sha256 in dict.fromkeys(each.sha256 for each in images)
            for unit in _holders(overview, sha256)
        )
        # Hundreds of thousands: they are printed as they come, and `| head` ends it.
        found = takewhile(lambda _unit: not output.is_stdout_closed, units)
        output.begin_document(PlantUnitsDocument(images, []), "units", found)
        if not output.json_wanted:
            output.results(printable(line) for line in _unit_lines(images, found))
    return output.document(None)


def _holders(overview: Overview, sha256: str) -> Iterator[InstalledUnit]:
    cursor: PageCursor | None = PageCursor()
    while cursor is not None:
        page = overview.holders(sha256, cursor, _AT_ONCE)
        yield from page.rows
        cursor = page.older


def _unit_lines(images: list[ImageRecord], found: Iterator[InstalledUnit]) -> Iterator[str]:
    count = 0
    for image in images:
        yield f"{image.target} {image.name}, version {image.version or 'unknown'}, {image.sha256}"
    for count, unit in enumerate(found, 1):  # noqa: B007
        sure = "" if unit.is_confirmed else ", NOT CONFIRMED: it may hold a part of it, or none"
        nature = ", VIRTUAL" if unit.is_virtual else ""
        state, day = unit.state.value, f"{unit.begun_at:%Y-%m-%d}"
        yield f"  {unit.serial}, part {unit.part}: {unit.target}, {day}, {state}{sure}{nature}"
    yield counted(count, "unit")


# -- all runs --------------------------------------------------------------------------------------


def report(output: Output, options: ReportOptions, url: str) -> int:
    return station_report(output, options, records_of_plant(url), PlantStore)


def pages(output: Output, web: Address, pages: PagesOptions, url: str, bounds: Bounds) -> int:
    from flasher.cli.station.pages import serve  # noqa: PLC0415  an extra
    from flasher.web.plant import PLANT_PAGES, STATIONS, PlantPages  # noqa: PLC0415  an extra

    make = partial(PlantPages, bounds=bounds)
    paths = dict.fromkeys([STATIONS, *PLANT_PAGES])
    return serve(output, web, pages, records_of_plant(url), PlantStore, make, tuple(paths))
