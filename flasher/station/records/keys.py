"""Paths of a station's signing key and of the heads of its audit chain, outside the records.

Whoever can write the database but lacks the key cannot make a chain that verifies. The chain alone
cannot show that its end was cut off, or that it is an older copy; heads in another, append-only
place can. Heads beside the key show it only if no other user can write there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from platformdirs import user_data_path

from flasher.station.records.places import (
    PATIENCE_S,
    FolderPlace,
    Place,
    call_all,
    file_name,
    place_of,
)


@dataclass(frozen=True)
class KeyLocations:
    """Folder of a station's signing key (None: the user's default), and further places for the
    heads of its chain: folders and URLs of PostgreSQL servers.
    """

    keys: Path | None = None
    heads: tuple[str, ...] = ()

    def __reduce__(self) -> tuple[type[KeyLocations], tuple[Path | None, tuple[str, ...]]]:
        """Pickled for another process without open connections."""
        return KeyLocations, (self.keys, self.heads)

    @property
    def keys_folder(self) -> Path:
        return self.keys or user_data_path("flasher", appauthor=False) / "station"

    @cached_property
    def beside_key(self) -> FolderPlace:
        return FolderPlace(self.keys_folder)

    @cached_property
    def elsewhere(self) -> tuple[Place, ...]:
        """The places apart from the key's folder. Raises UsageError for an invalid URL."""
        here = self.keys_folder.resolve()
        places = [place_of(text) for text in dict.fromkeys(self.heads)]
        folders = [each.folder for each in places if isinstance(each, FolderPlace)]
        # A share that does not answer is not the key's folder.
        resolved = call_all([folder.resolve for folder in folders], PATIENCE_S)
        same = [folder for folder, found in zip(folders, resolved, strict=True) if found == here]
        return tuple(e for e in places if not (isinstance(e, FolderPlace) and e.folder in same))

    def key_file(self, station: str, records_id: str) -> Path:
        return self.keys_folder / file_name(station, records_id, ".key")

    def examined_files(self, records_id: str) -> tuple[Path, Path]:
        """Paths of the examined part of these records and of the examiner's key."""
        note = self.keys_folder / file_name("examined", records_id, ".examined")
        return note, note.with_suffix(".verifier")
