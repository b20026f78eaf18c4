"""Loads the recipes that the plant has given, in a thread, and offers them to the station.

    offers = RecipeOffers(folder, sockets, check, station.offer)
    with offers.watching(): ...

Loading a recipe takes a moment; the station's thread, which all sockets wait for, never does it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from flasher.errors import FlasherError, UsageError
from flasher.i18n import text
from flasher.log import log_event
from flasher.station.given_recipes import Given, GivenRecipe, RecipeFolder
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import AuditEvent
from flasher.station.records.queries import Records

LOOK_S: Final = 1.0
_RETRY_LOOKS: Final = 30
"""Looks after which a recipe with a problem is loaded again: a key may be trusted by now."""
SCAN_DIGITS: Final = 12
"""Digits of a digest in the scan that approves a recipe."""


@dataclass(frozen=True)
class Offer:
    """A recipe that the plant has given for sockets of this station."""

    given: GivenRecipe
    loaded: LoadedRecipe | None = field(repr=False)
    """None: it cannot be used."""
    problem: str = ""
    """Why it cannot be used."""


@dataclass(frozen=True)
class Offers:
    """What the plant offers now, and what it has withdrawn."""

    offers: tuple[Offer, ...] = ()
    withdrawn: frozenset[str] = frozenset()


Check = Callable[[LoadedRecipe], None]
"""Raises FlasherError for a recipe that does not fit the station: its badges, labels, adapters."""


class RecipeOffers:
    """Watches the folder of the given recipes. `give` is called in the thread of the watch."""

    def __init__(
        self,
        folder: RecipeFolder,
        sockets: Sequence[str],
        check: Check,
        give: Callable[[Offers], None],
    ) -> None:
        self._folder = folder
        self._sockets = sockets
        self._check = check
        self._give = give
        self._seen: Given | None = None
        self._last = Offers()
        """What was given last."""
        self._looks = 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Watch in a thread while the block runs."""
        over = threading.Event()

        def watch() -> None:
            while not over.is_set():
                try:
                    self.look()
                except Exception as error:  # noqa: BLE001  the next look may succeed
                    log_event(error)
                over.wait(LOOK_S)

        thread = threading.Thread(target=watch, name="recipes", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def look(self) -> None:
        """Load and offer what changed. Raises RecordError."""
        given = self._folder.given()
        self._looks += 1
        has_problem = any(each.problem for each in self._last.offers)
        if given == self._seen and not (has_problem and self._looks % _RETRY_LOOKS == 0):
            return
        found = [
            self._offer(each) for each in given.recipes if set(each.sockets) & set(self._sockets)
        ]
        offers = Offers(tuple(found), given.withdrawn)
        if self._seen is None or offers != self._last:
            self._give(offers)
        self._seen, self._last = given, offers

    def _offer(self, given: GivenRecipe) -> Offer:
        if given.fault:
            return Offer(given, None, given.fault)
        known = (each.loaded for each in self._last.offers if each.given.digest == given.digest)
        loaded = next(known, None)
        if loaded is None:
            try:
                loaded = self._folder.load(given.digest, datetime.now().astimezone().date())
                self._check(loaded)
            except FlasherError as error:
                return Offer(given, None, problem_of(error))
        return Offer(given, loaded)


def problem_of(error: FlasherError) -> str:
    """The first fault of an error, or the error itself."""
    for fault in error.faults if isinstance(error, UsageError) else ():
        return text("{place}: {what}", place=fault.place, what=fault.what)
    return error.what


def approved(read: Records, station: str) -> Mapping[str, Mapping[str, Any]]:
    """The newest approval by socket, as the station's audit trail has it. Raises RecordError."""
    found: dict[str, Mapping[str, Any]] = {}
    for data in read.noted(station, AuditEvent.RECIPE_APPROVED):
        found |= dict.fromkeys(data.get("sockets", ()), data)
    return found


def used(read: Records, station: str) -> Mapping[str, Mapping[str, Any]]:
    """The recipe in use by socket, as the station's audit trail has it. Raises RecordError."""
    return {str(data.get("socket")): data for data in read.noted(station, AuditEvent.RECIPE_USED)}


def needed(read: Records, station: str, sockets: Collection[str]) -> frozenset[str]:
    """Digests of the recipes that these sockets use, or will use. Raises RecordError."""
    found = [
        data
        for by_socket in (approved(read, station), used(read, station))
        for socket, data in by_socket.items()
        if socket in sockets
    ]
    return frozenset(str(data["digest"]) for data in found if data.get("digest"))
