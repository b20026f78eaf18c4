"""Fetches a station's recipes and withdrawals from the plant's database.

A part of the process that sends: units never wait for it. A recipe is in the station's folder as a
whole or not at all, with the content that its digest states; a full disk or a lost connection
leaves what was there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final

from sqlalchemy import text as sql

from flasher.i18n import text
from flasher.image.load import FILE_MAX_SIZE
from flasher.plant.central import Central
from flasher.plant.release_functions import PIECE_BYTES
from flasher.protocol.text import printable
from flasher.station.given_recipes import (
    Given,
    GivenRecipe,
    RecipeFolder,
    parse_bundle,
)
from flasher.station.recipe_offers import needed
from flasher.station.records.database import Database
from flasher.station.records.errors import RecordError
from flasher.station.records.queries import Records

FETCH_S: Final = 10.0
"""Interval at which the plant is asked."""
_RECIPES: Final = sql("SELECT plant_recipes(:held)")
_MANIFEST: Final = sql("SELECT plant_recipe_manifest(:digest)")
_PIECE: Final = sql("SELECT plant_recipe_piece(:digest, :sha256, :start)")


@dataclass(frozen=True)
class Fetched:
    """Result of one look at the plant's recipes."""

    recipes: tuple[GivenRecipe, ...]
    withdrawn: tuple[str, ...]
    new: tuple[str, ...]
    """Digests of the recipes that were fetched now."""


class Fetcher:
    """Fetches recipes for the sockets of a station into its folder."""

    def __init__(
        self,
        central: Central,
        records: Database,
        folder: RecipeFolder,
        station: str,
        sockets: Sequence[str],
    ) -> None:
        self._central = central
        self._records = records
        self._folder = folder
        self._station = station
        self._sockets = sockets

    def close(self) -> None:
        self._central.close()
        self._records.close()

    def fetch(self) -> Fetched:
        """Ask the plant, and fetch what is new or damaged. Raises RecordError if the plant cannot
        be reached, the list cannot be saved, or a recipe in use is not here any more.
        """
        kept = needed(Records(self._records), self._station, self._sockets)
        with self._central.reading() as connection:
            held = {"held": [*self._folder.digests(), *kept]}
            answer = connection.execute(_RECIPES, held).scalar_one()
        before = Given()
        with suppress(RecordError):  # a list that cannot be read is written again
            before = self._folder.given()
        withdrawn = frozenset(map(str, answer["withdrawn"]))
        recipes, new = [], []
        for given in self._newest(answer["published"]):
            if given.digest in withdrawn:
                continue
            fault = ""
            if not self._folder.is_whole(given.digest):
                fault = self._fetch_one(given.digest)
                new += [] if fault else [given.digest]
            recipes.append(replace(given, fault=fault))
        given_now = Given(tuple(recipes), withdrawn)
        if given_now != before:
            self._folder.save_given(given_now)
        # The station may be about to approve one that was given a moment ago.
        self._folder.keep({*(each.digest for each in (*recipes, *before.recipes)), *kept})
        for digest in sorted(kept.difference(each.digest for each in recipes)):
            if not self._folder.is_whole(digest):
                if fault := self._fetch_one(digest):
                    raise RecordError(
                        f"The copy of the recipe {digest} is missing or damaged, and the station"
                        f" needs it at its next start. {fault}",
                        where=self._central.shown,
                        remedy="Approve another recipe of the plant before the station ends.",
                    )
                new.append(digest)
        return Fetched(tuple(recipes), tuple(sorted(withdrawn)), tuple(new))

    def _newest(self, published: Sequence[dict[str, Any]]) -> list[GivenRecipe]:
        """The newest publication for each socket, together for equal recipes."""
        found: dict[str, GivenRecipe] = {}
        for socket in self._sockets:
            fitting = [each for each in published if each["socket"] in (None, socket)]
            if fitting:
                newest = max(fitting, key=lambda each: int(each["id"]))
                digest = str(newest["digest"])
                at = datetime.fromisoformat(newest["at"]).isoformat(timespec="seconds")
                given = found.setdefault(digest, GivenRecipe(digest, (), at, newest["by"]))
                found[digest] = replace(given, sockets=(*given.sockets, socket))
        return list(found.values())

    def _fetch_one(self, digest: str) -> str:
        """Fetch a recipe; returns why it is not here, or ""."""
        try:
            with self._central.reading() as connection:
                manifest = connection.execute(_MANIFEST, {"digest": digest}).scalar_one()
            self._folder.add(
                parse_bundle(manifest or "", digest), lambda sha256: self._pieces(digest, sha256)
            )
        except ValueError as error:
            return text("The plant's copy is refused: {why}.", why=printable(str(error)))
        except RecordError as error:
            return text("It was not fetched: {why}", why=error.what)
        return ""

    def _pieces(self, digest: str, sha256: str) -> Iterator[bytes]:
        """A file in pieces, each in a transaction of its own with its time limit."""
        start = 0
        while True:
            named = {"digest": digest, "sha256": sha256, "start": start}
            with self._central.reading() as connection:
                piece = bytes(connection.execute(_PIECE, named).scalar() or b"")
            start += len(piece)
            if start > FILE_MAX_SIZE:
                raise ValueError(f"a file is larger than {FILE_MAX_SIZE:,} bytes")
            yield piece
            if len(piece) < PIECE_BYTES:
                return
