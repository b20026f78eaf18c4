"""Write transactions whose audit rows are signed, and management of the station's key."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import cached_property
from pathlib import Path
from threading import Lock

from flasher.errors import UsageError
from flasher.protocol.text import printable
from flasher.station.records import chain
from flasher.station.records.database import Database, records_id_of
from flasher.station.records.errors import (
    KeyMissingError,
    NotFoundError,
    RecordError,
    RecordsCutError,
)
from flasher.station.records.heads import ChainHead, HeadsFile
from flasher.station.records.keys import KeyLocations
from flasher.station.records.places import Copying, Place, lasts
from flasher.station.records.signatures import SigningKey, fingerprint


class Signer:
    """Signing key and chain heads of one station. `begin` loads or creates them."""

    def __init__(
        self,
        database: Database,
        station: str,
        now: Callable[[], datetime],
        key_locations: KeyLocations,
    ) -> None:
        self._database = database
        self._station = station
        self._now = now
        self.key_locations = key_locations
        self._key: SigningKey | None = None
        self._unkept: list[ChainHead] = []
        self._heads_lock = Lock()
        self.copies: list[Copying] = []
        """Background copies to the other places, while this process runs as the station."""

    @cached_property
    def records_id(self) -> str:
        with self._database.reading() as connection:
            return records_id_of(connection)

    @property
    def key_file(self) -> Path:
        return self.key_locations.key_file(self._station, self.records_id)

    @property
    def public(self) -> str:
        """The current public key. Raises NotFoundError before the chain has begun."""
        with self._database.reading() as connection:
            found = chain.key_in_force(connection, self._station)
        if found is None:
            raise NotFoundError(
                f"{printable(self._station)} has not signed anything in these records.",
                remedy="Its key is made when the station first runs. Name its file with --sockets.",
            )
        return found

    def begin(self) -> None:
        """Load the key; for a new chain, create the key and the first row.

        Raises KeyMissingError, RecordsCutError if rows with stored heads are missing,
        RecordError.
        """
        for place, last in self._lasts():
            if self._is_missing(last):
                raise RecordsCutError(
                    f"These records lack rows that {self._station} wrote until {last.at}: an"
                    " older copy, or their end was cut off.",
                    where=self._database.location.shown,
                    cause=f"audit row {last.number} is stored in {place.shown}",
                    remedy="Put the right records back (flasher station verify names what is"
                    " missing); if they are lost: flasher station accept restored"
                    " --reason TEXT.",
                )
        self._load()
        if not self.copies:
            self.copies = [self._copying(place) for place in self.key_locations.elsewhere]
            for each in self.copies:
                each.begin()

    def wait_for_copies(self) -> None:
        """Wait for a limited time until the other places have all heads."""
        for each in self.copies:
            each.wait()

    def unkept(self) -> list[str]:
        """Other places that lack the last heads because they cannot be reached."""
        return [each.shown for each in self.copies if each.is_behind]

    def close(self) -> None:
        """Stop copying heads; the next start copies the rest."""
        for each in self.copies:
            each.end()
        self.copies = []

    @contextmanager
    def writing(self) -> Iterator[chain.Trail]:
        """Open a write transaction that can append to the chain; on disk, with its head stored,
        when the block ends without an error. Raises RecordError: then it may be tried again.
        """
        if self._key is None:
            raise RecordError(
                "This process is not the station: it has not looked for interrupted runs.",
                remedy="Call recover() first.",
            )
        with self._database.writing() as connection:
            trail = chain.Trail(connection, self._station, self._key)
            yield trail
        self._unkept += trail.heads
        with self._heads_lock:
            some = list(self._unkept)  # those of earlier commits too that could not be kept
            if some:
                self.heads_file.append(some, trail.key)
                del self._unkept[: len(some)]
        for each in self.copies:
            each.wake()

    def rotate(self, operator: str) -> None:
        """Replace the key with a new one, and delete the old one."""
        path, following = self.key_file, self._following()
        following.unlink(missing_ok=True)  # of a rotation that was not committed
        key = SigningKey.make(following)
        with self.writing() as trail:
            trail.append(self._now(), chain.KEY_ROTATED, {"key": key.public, "by": operator})
        following.replace(path)
        self._key = key

    def replace_lost(self, operator: str, reason: str) -> None:
        """Replace a lost key with a new one. Raises UsageError if it is not lost."""
        path = self.key_file
        try:
            self._load()
        except KeyMissingError:
            pass
        else:
            raise UsageError(
                f"The key is not lost: {printable(str(path))}.",
                remedy="If others may have it: flasher station key --rotate.",
            )
        if path.exists():
            lost = path.with_name(path.name + ".unusable")
            path.replace(lost)
        self._key = SigningKey.make(path)
        with self.writing() as trail:
            data = {"key": self._key.public, "by": operator, "reason": reason}
            trail.append(self._now(), chain.KEY_LOST, data)

    def accept_restored(self, operator: str, reason: str) -> int:
        """Accept that rows with stored heads are lost; their number. Raises UsageError if none
        is.
        """
        kept = [place for place, last in self._lasts() if self._is_missing(last)]
        if not kept:
            raise UsageError(
                "Nothing is missing: the records hold the last row of which a head is kept.",
                remedy="Start the station.",
            )
        with self._database.reading() as connection:
            numbers = [
                head.number
                for place in kept
                for head in place.of(self._station, self.records_id).entries()
                if isinstance(head, ChainHead)
                and chain.hash_at(connection, self._station, head.number) != head.hash
            ]
        self._load()
        with self.writing() as trail:
            lost = {"lost_from": min(numbers), "lost_to": max(numbers)}
            trail.append(self._now(), chain.RESTORED, {**lost, "by": operator, "reason": reason})
        return lost["lost_to"] - lost["lost_from"] + 1

    # -- the key and the heads --------------------------------------------------------------------

    def _load(self) -> None:
        with self._database.reading() as connection:
            public = chain.key_in_force(connection, self._station)
        path, following = self.key_file, self._following()
        loaded = SigningKey.load(path)
        if public is None:
            self._key = loaded or SigningKey.make(path)
            with self.writing() as trail:
                trail.begin(self._now(), self.records_id)
            return
        if loaded is None or loaded.public != public:
            # A rotation was committed but not completed.
            loaded = SigningKey.load(following)
            if loaded is None or loaded.public != public:
                raise KeyMissingError(
                    f"The signing key of {self._station} (fingerprint {fingerprint(public)}) is"
                    " not there.",
                    where=printable(str(path)),
                    remedy="Put the file back, or name its folder with --keys; if it is lost:"
                    " flasher station key --lost --reason TEXT.",
                )
            following.replace(path)
        self._key = loaded

    @cached_property
    def heads_file(self) -> HeadsFile:
        return self.key_locations.beside_key.of(self._station, self.records_id)

    def _lasts(self) -> Iterator[tuple[Place, ChainHead]]:
        """Last heads of the places that can be reached. Raises RecordError, UsageError."""
        here = self.heads_file.last()
        if here is not None:
            yield self.key_locations.beside_key, here
        for place, last in lasts(self.key_locations.elsewhere, self._station, self.records_id):
            if isinstance(last, ChainHead):
                yield place, last

    def _copying(self, place: Place) -> Copying:
        source = self.key_locations.beside_key.of(self._station, self.records_id)
        target = place.of(self._station, self.records_id)
        return Copying(source, place, target, self._key_now)

    def _key_now(self) -> SigningKey:
        assert self._key is not None  # noqa: S101  copying begins after it was loaded
        return self._key

    def _following(self) -> Path:
        return self.key_file.with_suffix(".new")

    def _is_missing(self, head: ChainHead) -> bool:
        """True for a head whose audit row is missing and was not accepted as lost."""
        with self._database.reading() as connection:
            if chain.hash_at(connection, self._station, head.number) == head.hash:
                return False
            lost = chain.accepted_losses(connection, self._station)
            return not any(head.number in each for each in lost)
