"""Log of releases: the hashes of all statements ever built, in a chain with a signed head.

Each release carries the log up to itself. Of two logs that a computer meets, one has to begin with
the other: a maker, or a thief of the keys, cannot show some computers another list of releases.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Final

from flasher.files import parse_json
from flasher.release.envelope import Envelope, envelope_of, json_bytes
from flasher.release.keys import SigningKey

PAYLOAD_TYPE: Final = "application/vnd.welling-flasher.log+json"
LOG_MAX_SIZE: Final = 4 * 1024 * 1024
"""Maximum size of a log in bytes: some 60,000 releases."""
_FORMAT: Final = 1
_HASH: Final = re.compile(r"[0-9a-f]{64}")
_BEGINNING: Final = bytes(32)


@dataclass(frozen=True)
class ReleaseLog:
    """Hashes of statements, and the checkpoint: size and head of the chain, signed."""

    entries: tuple[str, ...] = ()
    checkpoint: Envelope = field(default=Envelope(b"", PAYLOAD_TYPE))

    @property
    def head(self) -> str:
        """Hash over all entries: of the head before, and the entry."""
        chained = reduce(
            lambda head, entry: hashlib.sha256(head + bytes.fromhex(entry)).digest(),
            self.entries,
            _BEGINNING,
        )
        return chained.hex()

    def append(self, payload: bytes, keys: Iterable[SigningKey]) -> ReleaseLog:
        """Return the log with another statement, and a new checkpoint."""
        entry = hashlib.sha256(payload).hexdigest()
        longer = self if entry in self.entries else replace(self, entries=(*self.entries, entry))
        return replace(longer, checkpoint=Envelope(longer.stated, PAYLOAD_TYPE).sign(keys))

    def __contains__(self, payload: bytes) -> bool:
        return hashlib.sha256(payload).hexdigest() in self.entries

    def agrees_with(self, other: Iterable[str]) -> bool:
        """True if one of two lists of entries begins with the other."""
        return all(own == its for own, its in zip(self.entries, other, strict=False))

    def to_bytes(self) -> bytes:
        """Write the log as JSON."""
        document = {
            "format": _FORMAT,
            "entries": list(self.entries),
            "checkpoint": self.checkpoint.document(),
        }
        return json_bytes(document) + b"\n"

    @property
    def stated(self) -> bytes:
        """Size and head, as the checkpoint states them."""
        return json_bytes({"size": len(self.entries), "head": self.head})


def parse_log(raw: bytes) -> ReleaseLog:
    """Parse a log. Raises ValueError, also if its checkpoint is not of these entries."""
    if len(raw) > LOG_MAX_SIZE:
        raise ValueError(f"its log is larger than {LOG_MAX_SIZE} bytes")
    match parse_json(raw):
        case {"format": 1, "entries": list() as entries, "checkpoint": checkpoint, **rest} if (
            not rest and all(isinstance(each, str) and _HASH.fullmatch(each) for each in entries)
        ):
            log = ReleaseLog(tuple(entries), envelope_of(checkpoint, PAYLOAD_TYPE))
        case _:
            raise ValueError("its log has another form")
    if len(set(log.entries)) != len(log.entries):
        raise ValueError("its log has a release twice")
    if log.checkpoint.payload != log.stated:
        raise ValueError("the checkpoint of its log is of other entries")
    return log
