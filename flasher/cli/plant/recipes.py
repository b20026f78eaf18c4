"""`flasher plant publish`, `withdraw` and `recipes`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

from flasher.cli.output import Output, utc_time
from flasher.cli.plant.documents import PlantPublishDocument, PlantRecipesDocument
from flasher.errors import UsageError
from flasher.plant import recipes as centre
from flasher.plant.central import open_central
from flasher.plant.recipes import WITHDRAWN, RecipeEvent, events_of
from flasher.protocol.text import printable
from flasher.station.recipe_file import load_checked


def publish(
    output: Output,
    recipe: Path,
    url: str,
    stations: Sequence[str],
    sockets: Sequence[str],
    *,
    is_all: bool,
) -> int:
    if is_all == bool(stations):
        raise UsageError("Name stations with --station, or give --all.", remedy="Choose one.")
    day = datetime.now().astimezone().date()
    loaded = load_checked(recipe, day)
    with open_central(url) as central:
        bundle = centre.publish(central, loaded, stations, sockets, day)
    rule = loaded.recipe
    output.result(printable(f"published {rule.name}, revision {rule.revision}"))
    output.result(f"  digest:   {bundle.digest}")
    for name, sha256 in bundle.files.items():
        output.result(printable(f"  file:     {name}, {sha256}"))
    for target in loaded.targets:
        if (signature := target.signature()) is not None:
            output.result(printable(f"  origin:   {target.name.upper()}: {signature.text}"))
    output.result(printable(f"  stations: {', '.join(stations) or 'all'}"))
    output.result(printable(f"  sockets:  {', '.join(sockets) or 'all'}"))
    output.result("It is used after a supervisor of the station has approved it there.")
    return output.document(
        PlantPublishDocument(
            rule.name, rule.revision, bundle.digest, dict(bundle.files), [*stations], [*sockets]
        )
    )


def withdraw(output: Output, digest: str, url: str, reason: str) -> int:
    with open_central(url) as central:
        event = centre.withdraw(central, digest, reason)
    output.results(_lines([event]))
    output.result(
        "Stations that use it begin no further unit. Publish another recipe for them, even one that"
        " was published before: the newest publication counts."
    )
    return output.document(PlantRecipesDocument([event]))


def recipes(output: Output, url: str) -> int:
    with open_central(url) as central:
        events = events_of(central)
    output.results(_lines(events))
    if not events:
        output.result("nothing was published: flasher plant publish RECIPE --database URL")
    return output.document(PlantRecipesDocument(events))


def _lines(events: Sequence[RecipeEvent]) -> Iterator[str]:
    for each in events:
        where = f"{each.station or 'all stations'}, {each.socket or 'all sockets'}"
        detail = each.reason if each.what == WITHDRAWN else where
        yield printable(
            f"{utc_time(each.at)} {each.what} by {each.by}: {each.name},"
            f" revision {each.revision}, {each.digest[:16]}: {detail}"
        )
