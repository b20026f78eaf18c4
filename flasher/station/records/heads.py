"""The heads of audit chains, kept outside of the records: one line for each row.

The chain alone cannot tell that its end was cut off, or that it is an older copy of itself. A file
that only grows, in another place, can.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from flasher.files import opened, parse_json
from flasher.protocol.text import printable
from flasher.station.records.errors import RecordError, mapped
from flasher.station.records.files import sync_folder

MAX_SIZE: Final = 256 * 1024 * 1024
"""In bytes: some 200,000 units."""


@dataclass(frozen=True)
class Head:
    """The end of a station's chain at some moment, signed."""

    station: str
    number: int
    """Of the audit row in the station's chain, from 1."""
    at: str
    hash: str
    signature: str
    key: str
    """The public key, in hexadecimal digits."""


class HeadsFile:
    """The kept heads of one station; `append` is the only change that is ever made."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, heads: Iterable[Head]) -> None:
        """Add a line for each; on disk when this returns. Raises RecordError."""
        lines = b"".join(
            json.dumps(asdict(head), sort_keys=True).encode("ascii") + b"\n" for head in heads
        )
        with mapped(printable(str(self.path)), writes=True):
            is_new = not self.path.exists()
            if is_new:
                self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
            with os.fdopen(handle, "rb+", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                if size:
                    file.seek(size - 1)
                    if file.read(1) != b"\n":
                        lines = b"\n" + lines  # behind half a line, which a crash has left
                file.write(lines)
                os.fsync(file.fileno())
            if is_new:
                sync_folder(self.path.parent)

    def read(self) -> tuple[Head | int, ...]:
        """The heads in the order in which they were kept; in place of a line that is no head its
        number, from 1. Empty without a file. Raises RecordError, UsageError for what is no file.
        """
        if not self.path.exists():
            return ()
        # A station may add to it meanwhile.
        with opened(self.path, MAX_SIZE, error=RecordError, may_grow=True) as (file, size):
            lines = file.read(size).splitlines()
        return tuple(_heads(lines))


def _heads(lines: list[bytes]) -> Iterator[Head | int]:
    for number, line in enumerate(lines, 1):
        try:
            head = Head(**parse_json(line))
        except (ValueError, TypeError):
            yield number
        else:
            yield head if isinstance(head.number, int) else number
