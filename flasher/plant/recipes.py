"""Publishes recipes in the plant's database, withdraws them, and lists what was published."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Final

from sqlalchemy import Connection, select, text
from sqlalchemy.dialects.postgresql import insert

from flasher.errors import UsageError
from flasher.files import read
from flasher.image.load import FILE_MAX_SIZE
from flasher.plant.central import Central
from flasher.plant.schema import recipe_event, released_file, released_recipe
from flasher.plant.stations import statuses
from flasher.protocol.text import printable
from flasher.settings.manifest import manifest_path
from flasher.station.given_recipes import Bundle, RecipeFolder, bundle_of, parse_bundle
from flasher.station.recipe import Recipe
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.server import ServerLock

PUBLISHED: Final = "published"
WITHDRAWN: Final = "withdrawn"
DIGITS_MIN: Final = 8
"""Digits that name a digest."""
_EVENTS: Final = text("""
SELECT e.what, e.digest, r.name, r.revision, r.part, coalesce(e.station, '') AS station,
    coalesce(e.socket, '') AS socket, e.at, e.by, e.reason
FROM recipe_event e JOIN released_recipe r USING (digest) ORDER BY e.id
""")


@dataclass(frozen=True)
class RecipeEvent:
    """A publication or a withdrawal, as the database recorded it."""

    what: str
    """published or withdrawn."""
    digest: str
    name: str
    revision: str
    part: str
    station: str
    """Station that it was given to; empty: all."""
    socket: str
    """Socket that it was given to; empty: all."""
    at: datetime
    """By the database's clock."""
    by: str
    """User of the database."""
    reason: str


def publish(
    central: Central,
    loaded: LoadedRecipe,
    stations: Sequence[str],
    sockets: Sequence[str],
    day: date,
) -> Bundle:
    """Give a recipe to stations (none named: all) and their sockets (none named: all). Raises
    UsageError, RecordError.
    """
    _check_links(loaded)
    bundle = bundle_of(loaded)
    try:
        parse_bundle(bundle.to_text(), bundle.digest)
    except ValueError as error:
        raise UsageError(
            f"The recipe cannot be published: {printable(str(error))}.",
            remedy="Name the files in its folder with letters, digits and hyphens.",
        ) from error
    folder = loaded.path.parent
    contents = {}
    for name, sha256 in bundle.files.items():
        contents[sha256] = read(folder / name, FILE_MAX_SIZE)
    _try_out(bundle, contents, day)
    rule = loaded.recipe
    facts = {"name": rule.name, "revision": rule.revision, "part": rule.part}
    with central.writing() as connection:
        _check_known(connection, stations, sockets)
        ServerLock.PUBLISHING.hold(connection)  # two publishers would not see each other's rows
        _check_revision(connection, bundle.digest, rule)
        for sha256, data in contents.items():
            connection.execute(
                insert(released_file).values(sha256=sha256, data=data).on_conflict_do_nothing()
            )
        connection.execute(
            insert(released_recipe)
            .values(digest=bundle.digest, manifest=bundle.to_text(), **facts)
            .on_conflict_do_nothing()
        )
        connection.execute(
            recipe_event.insert().inline(),
            [
                {"what": PUBLISHED, "digest": bundle.digest, "station": station, "socket": socket}
                for station in stations or (None,)
                for socket in sockets or (None,)
            ],
        )
    return bundle


def _check_links(loaded: LoadedRecipe) -> None:
    """Check that each file of the recipe is stored by the name that the recipe uses. Raises
    UsageError.
    """
    rule, folder = loaded.recipe, loaded.path.parent
    names = [loaded.path.name, *([rule.profile] if rule.profile else [])]
    for target in rule.target:
        names += [target.image, target.manifest or str(manifest_path(target.image))]
    for name in names:
        if (folder / name).resolve() != folder.resolve() / name:
            raise UsageError(
                f"{printable(name)} is a link to another file.",
                where=printable(str(loaded.path)),
                remedy="Copy the file itself to this name, then publish the recipe.",
            )


def _try_out(bundle: Bundle, contents: dict[str, bytes], day: date) -> None:
    """Load the recipe from its bundle as a station will. Raises UsageError."""
    with tempfile.TemporaryDirectory(prefix="flasher-publish-") as place:
        folder = RecipeFolder(Path(place))
        try:
            folder.add(bundle, lambda sha256: [contents[sha256]])
        except ValueError as error:
            raise UsageError(
                "A file of the recipe was changed while it was read.", remedy="Publish it again."
            ) from error
        folder.load(bundle.digest, day)


def withdraw(central: Central, digits: str, reason: str) -> RecipeEvent:
    """Withdraw a recipe by its digest, or the beginning of it. Raises UsageError, RecordError."""
    with central.writing() as connection:
        query = select(released_recipe.c.digest).where(
            released_recipe.c.digest.startswith(digits.lower(), autoescape=True)
        )
        found = connection.execute(query.limit(2)).scalars().all()
        if len(found) != 1 or len(digits) < DIGITS_MIN:
            raise UsageError(
                f"{printable(digits)} is not the digest of one published recipe.",
                remedy=f"Name {DIGITS_MIN} or more digits of one in `flasher plant recipes`.",
            )
        values = {"what": WITHDRAWN, "digest": found[0], "reason": reason}
        connection.execute(recipe_event.insert().inline().values(values))
        return _events(connection)[-1]


def events_of(central: Central) -> list[RecipeEvent]:
    """All publications and withdrawals, oldest first. Raises RecordError."""
    with central.reading() as connection:
        return _events(connection)


def _events(connection: Connection) -> list[RecipeEvent]:
    return [RecipeEvent(**row) for row in connection.execute(_EVENTS).mappings()]


def _check_revision(connection: Connection, digest: str, rule: Recipe) -> None:
    """Check that records which name this revision mean one content. Raises UsageError."""
    known = released_recipe.c
    query = select(known.digest).where(
        known.name == rule.name,
        known.part == rule.part,
        known.revision == rule.revision,
        known.digest != digest,
    )
    if other := connection.execute(query.limit(1)).scalar():
        raise UsageError(
            printable(
                f"{rule.name}, revision {rule.revision}, was published with other content:"
                f" {other[:16]}."
            ),
            remedy="Change the revision in the recipe, then publish it.",
        )


def _check_known(connection: Connection, stations: Sequence[str], sockets: Sequence[str]) -> None:
    """Check the named stations, and their sockets as far as they are known. Raises UsageError."""
    known = {each.station: each.recipes for each in statuses(connection)}
    for name in stations:
        if name not in known:
            raise UsageError(
                f"The plant has no station {printable(name)}: {_listed(known)}.",
                remedy="Correct the name, or add the station: flasher plant init --station NAME.",
            )
        own = sorted(each.socket for each in known[name])
        for socket in sockets if own else ():
            if socket not in own:
                raise UsageError(
                    f"{printable(name)} has no socket {printable(socket)}: {_listed(own)}.",
                    remedy="Correct the name. A new socket is known after its station was started.",
                )


def _listed(names: Iterable[str]) -> str:
    shown = ", ".join(map(printable, sorted(names))) or "none"
    return f"there {'are' if ',' in shown else 'is'} {shown}"
