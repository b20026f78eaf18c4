"""Where a station keeps what is no part of its records: its signing key, and the heads of its audit
chain.

Whoever can write the database but has no key cannot make a chain that verifies. The chain alone
cannot tell that its end was cut off, or that it is an older copy of itself; a file in another place
that only grows can.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from platformdirs import user_data_path

from flasher.station.records.heads import HeadsFile


@dataclass(frozen=True)
class Keeping:
    """Where the signing key of a station is kept, and the heads of its chain; None: the place of
    this user, and beside the key.
    """

    keys: Path | None = None
    heads: Path | None = None

    @property
    def keys_folder(self) -> Path:
        return self.keys or user_data_path("flasher", appauthor=False) / "station"

    @property
    def heads_folder(self) -> Path:
        return self.heads or self.keys_folder

    def key_file(self, station: str, records_id: str) -> Path:
        return self.keys_folder / _file_name(station, records_id, ".key")

    def heads_file(self, station: str, records_id: str) -> HeadsFile:
        return HeadsFile(self.heads_folder / _file_name(station, records_id, ".heads"))

    def kept_heads(self, records_id: str, stations: Iterable[str]) -> dict[str, HeadsFile]:
        """The heads that are kept of these records, by station; also of stations that the records
        do not name. Raises RecordError.
        """
        found = {name: self.heads_file(name, records_id) for name in stations}
        if self.heads_folder.is_dir():
            for path in sorted(self.heads_folder.glob("*.heads")):
                first = HeadsFile(path).first()
                if first is not None and path == self.heads_file(first.station, records_id).path:
                    found[first.station] = HeadsFile(path)
        return {name: file for name, file in found.items() if file.last() is not None}


def _file_name(station: str, records_id: str, suffix: str) -> str:
    """The name of a station's file for these records: unlike for unlike stations."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", station)[:40]
    mark = hashlib.sha256(f"{records_id} {station}".encode()).hexdigest()[:12]
    return f"{plain}-{mark}{suffix}"
