"""One process is the station: a lock that ends with the process, however it ends."""

from __future__ import annotations

import importlib
import os
import re
from pathlib import Path
from typing import IO

from flasher.protocol.text import printable
from flasher.station.records.errors import StationBusyError, mapped


class StationLock:
    """Held from `acquire` until `release` or the end of the process."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None

    @classmethod
    def of(cls, station: str, folder: Path) -> StationLock:
        """The lock of a station, beside its attachments."""
        return cls(folder / f"station-{re.sub(r'[^A-Za-z0-9_-]', '_', station)}.lock")

    @property
    def is_held(self) -> bool:
        """True when this process is the station."""
        return self._file is not None

    def acquire(self) -> None:
        """Become the station. Raises StationBusyError when another process is."""
        if self._file is not None:
            return
        shown = printable(str(self._path))
        with mapped(shown, writes=True):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            file = self._path.open("a+", encoding="ascii")
        try:
            _lock(file)
        except OSError as error:
            file.close()
            raise StationBusyError(
                "Another process is this station already.",
                where=shown,
                remedy="Use the station that runs, or end it first.",
            ) from error
        self._file = file

    def release(self) -> None:
        """Let another process be the station."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _lock(file: IO[str]) -> None:
    """Raises OSError when another process holds it. Each system has a module of its own for it."""
    if os.name == "nt":
        windows = importlib.import_module("msvcrt")
        windows.locking(file.fileno(), windows.LK_NBLCK, 1)
    else:
        unix = importlib.import_module("fcntl")
        unix.flock(file, unix.LOCK_EX | unix.LOCK_NB)
