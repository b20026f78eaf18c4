"""Append-only files with the heads of a station's audit chain.

A large file is closed by a signed checkpoint, and the next one begins with a copy of it:
`NAME.heads`, `NAME.heads.000002`, and so on. Starting a station reads only the end of the last
one.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from flasher.files import opened, parse_json
from flasher.protocol.text import printable
from flasher.station.records.errors import RecordError, mapped
from flasher.station.records.files import sync_folder
from flasher.station.records.signatures import SEGMENT, SigningKey, is_signed

SEGMENT_MAX_BYTES: Final = 4 * 1024 * 1024
"""Size at which a segment is closed: some 12,000 audit rows."""
_TAIL_BYTES: Final = 64 * 1024
_NO_SEGMENT: Final = "0" * 64
"""Previous hash of the first checkpoint."""
_NUMBER: Final = re.compile(r"[0-9]{6,}")


@dataclass(frozen=True)
class ChainHead:
    """The signed last row of a station's chain at some moment."""

    station: str
    number: int
    """Number of the audit row in the station's chain, from 1."""
    at: str
    hash: str
    signature: str
    key: str
    """Public key in hexadecimal digits."""


@dataclass(frozen=True)
class Checkpoint:
    """Signed last line of a closed segment."""

    segment: int
    """Number of the segment, from 1."""
    head: ChainHead
    """Last head in the segment."""
    sha256: str
    """Hash of all bytes of the segment before the checkpoint."""
    previous: str
    """SHA-256 of the previous checkpoint, so that no segment can be left out."""
    key: str
    signature: str = ""

    @property
    def signed_text(self) -> str:
        return json.dumps(self._body, sort_keys=True)

    @property
    def line(self) -> str:
        return json.dumps({"checkpoint": self._body, "signature": self.signature}, sort_keys=True)

    @property
    def _body(self) -> dict[str, Any]:
        found = asdict(self)
        del found["signature"]
        return found


@dataclass(frozen=True)
class HeadsFault:
    """A fault in the files, with file and line."""

    where: str
    what: str


@dataclass(frozen=True)
class Position:
    """Position in the files from which to continue reading."""

    segment: int = 1
    offset: int = 0


class HeadsFile:
    """The heads of one station in a folder; files only grow, by `append`. `path` is the first
    segment, which may have any size in records of an older flasher.
    """

    def __init__(self, path: Path, segment_max_bytes: int = SEGMENT_MAX_BYTES) -> None:
        self.path = path
        self._max_bytes = segment_max_bytes
        self._last = 0
        """Number of the last segment found."""

    def append(self, heads: Iterable[ChainHead], key: SigningKey) -> None:
        """Append heads, on disk. `key` signs the checkpoint of a full segment. Raises
        RecordError.
        """
        lines = [json.dumps(asdict(head), sort_keys=True) for head in heads]
        with mapped(printable(str(self.path)), writes=True):
            is_known = bool(self._last)
            number = self._last_segment()
            path = self._segment(number)
            checkpoint = None
            if path.exists() and path.stat().st_size >= self._max_bytes:
                checkpoint = self._closed(number, key)
                number += checkpoint is not None
            elif number > 1 and not is_known and self._last_entry(number) is None:
                checkpoint = self._closed(number - 1, key)  # a crash left it without its beginning
            if checkpoint is not None:
                lines.insert(0, checkpoint)
            _write(self._segment(number), lines)
            self._last = number

    def last(self) -> ChainHead | None:
        """The last head; None if there is none. Raises RecordError, UsageError."""
        for number in range(self._last_segment(), 0, -1):
            found = self._last_entry(number)
            if found is not None:
                return found.head if isinstance(found, Checkpoint) else found
        return None

    def first(self) -> ChainHead | None:
        """The oldest head. Raises as `last`."""
        return next((each for each in self.entries() if isinstance(each, ChainHead)), None)

    def entries(self, after: int = 0) -> Iterator[ChainHead | Checkpoint | HeadsFault]:
        """All entries in order. Closed segments up to audit row `after` are skipped, and so is an
        incomplete last line, which a station may be writing. Raises as `last`.
        """
        previous = _NO_SEGMENT
        last = self._last_segment()
        for number in range(1, last + 1):
            is_closed = number < last
            if not self._segment(number).exists():
                if is_closed or number > 1:
                    yield HeadsFault(self._shown(number), "it is missing")
                continue
            if is_closed and after:
                end = self._last_entry(number)
                if isinstance(end, Checkpoint) and end.head.number <= after:
                    previous = _hash_of(end.line)
                    continue
            for entry in self._checked(number, previous, is_closed=is_closed):
                if isinstance(entry, Checkpoint):
                    previous = _hash_of(entry.line)
                yield entry

    def of_row(self, number: int) -> tuple[ChainHead, ...]:
        """The heads of one audit row: several if older records were restored. Checkpoints at the
        start of segments lead to the one segment to read. Raises as `last`.
        """
        count = self._last_segment()
        at = bisect_left(range(1, count + 1), number, key=self._begins_after)
        lines = self._lines(Position(max(at, 1)), is_one=True)
        named = f'"number": {number},'.encode("ascii")  # thousands of others are not parsed
        some = (_parsed(line) for _, line in lines if named in line)
        heads = (entry for entry in some if isinstance(entry, ChainHead))
        return tuple(head for head in heads if head.number == number)

    def since(self, position: Position) -> Iterator[tuple[ChainHead, Position]]:
        """The heads after a position, each with the position after it. Raises as `last`."""
        for after, line in self._lines(position):
            entry = _parsed(line)
            if isinstance(entry, ChainHead):
                yield entry, after

    def position_after(self, head: ChainHead) -> Position | None:
        """The position after a head, searched from the end; None without it. Raises as `last`."""
        for number in range(self._last_segment(), 0, -1):
            for after, line in self._lines(Position(number), is_one=True):
                if _parsed(line) == head:
                    return after
        return None

    # -- segments ---------------------------------------------------------------------------------

    def _segment(self, number: int) -> Path:
        return self.path if number == 1 else self.path.with_name(f"{self.path.name}.{number:06}")

    def _shown(self, number: int) -> str:
        return printable(str(self._segment(number)))

    def _last_segment(self) -> int:
        if not self._last or self._segment(self._last + 1).exists():
            name = f"{self.path.name}."
            found = self.path.parent.glob(f"{name}*") if self.path.parent.is_dir() else ()
            ends = (path.name.removeprefix(name) for path in found)
            self._last = max([1, *(int(end) for end in ends if _NUMBER.fullmatch(end))])
        return self._last

    def _closed(self, number: int, key: SigningKey) -> str | None:
        """Close a segment if needed; returns its checkpoint line, None without a head."""
        end = self._last_entry(number)
        if isinstance(end, Checkpoint):
            return end.line
        if end is None:
            return None
        path = self._segment(number)
        with opened(path, None, error=RecordError, may_grow=True) as (file, size):
            file.seek(size - 1)
            is_whole_line = file.read(1) == b"\n"
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256")
        if not is_whole_line:  # half a line, which a crash has left
            digest.update(b"\n")
        before = _NO_SEGMENT
        if number > 1:
            lines = self._lines(Position(number), is_one=True)
            before = _hash_of(next((line for _, line in lines), b"").decode("ascii", "replace"))
        made = Checkpoint(number, end, digest.hexdigest(), before, key.public)
        line = replace(made, signature=key.sign(made.signed_text, SEGMENT)).line
        _write(path, [line])
        return line

    def _begins_after(self, number: int) -> int:
        """Last audit row before a segment."""
        line = next((line for _, line in self._lines(Position(number), is_one=True)), b"")
        entry = _parsed(line)
        return entry.head.number if isinstance(entry, Checkpoint) else 0

    def _last_entry(self, number: int) -> ChainHead | Checkpoint | None:
        path = self._segment(number)
        if not path.exists():
            return None
        with opened(path, None, error=RecordError, may_grow=True) as (file, size):
            length = min(size, _TAIL_BYTES)
            while True:
                file.seek(size - length)
                for line in reversed(file.read(length).splitlines()):
                    entry = _parsed(line)
                    if entry is not None:
                        return entry
                if length == size:
                    return None
                length = min(size, length * 8)

    def _checked(
        self, number: int, previous: str, *, is_closed: bool
    ) -> Iterator[ChainHead | Checkpoint | HeadsFault]:
        """Entries and faults of one segment."""
        digest, last, entry, is_first = hashlib.sha256(), None, None, True
        where = self._shown(number)
        for count, (_, line) in enumerate(self._lines(Position(number), is_one=True), 1):
            entry = _parsed(line)
            if entry is None:
                yield HeadsFault(where, f"line {count} is not a head")
            elif is_first and number > 1:
                is_first = False
                if _hash_of(line.decode("ascii", "replace")) != previous:
                    yield HeadsFault(
                        where, "it does not begin with the checkpoint of the previous one"
                    )
                if isinstance(entry, ChainHead):
                    yield entry
            elif isinstance(entry, ChainHead):
                last = entry
                yield entry
            else:
                stated = (entry.segment, entry.head, entry.sha256, entry.previous)
                found = (number, last, digest.hexdigest(), previous)
                is_whole = is_signed(entry.signed_text, entry.signature, entry.key, SEGMENT)
                if stated != found or not is_whole:
                    yield HeadsFault(where, "it was changed after it was closed")
                yield entry
            digest.update(line + b"\n")
        if is_closed and not isinstance(entry, Checkpoint):
            yield HeadsFault(where, "its end is missing")

    def _lines(
        self, position: Position, *, is_one: bool = False
    ) -> Iterator[tuple[Position, bytes]]:
        """Complete lines with the position after each, of this segment (`is_one`) or all from it
        on.
        """
        for number in range(position.segment, self._last_segment() + 1):
            path = self._segment(number)
            if path.exists():
                at = position.offset if number == position.segment else 0
                # A station may add to it meanwhile.
                with opened(path, None, error=RecordError, may_grow=True) as (file, size):
                    file.seek(at)
                    while at < size and (line := file.readline(size - at)).endswith(b"\n"):
                        at += len(line)
                        yield Position(number, at), line[:-1]
            if is_one:
                return


def _write(path: Path, lines: list[str]) -> None:
    data = "".join(f"{line}\n" for line in lines).encode("ascii")
    is_new = not path.exists()
    if is_new:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
    with os.fdopen(handle, "rb+", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size:
            file.seek(size - 1)
            if file.read(1) != b"\n":
                data = b"\n" + data  # after half a line, which a crash has left
        try:
            rest = memoryview(data)
            while rest:  # a disk that gets full takes a part first, without an error
                rest = rest[file.write(rest) :]
            os.fsync(file.fileno())
        except OSError:
            with suppress(OSError):  # the next entry must not follow half a line
                file.truncate(size)
            raise
    if is_new:
        sync_folder(path.parent)


def _parsed(line: bytes) -> ChainHead | Checkpoint | None:
    """Parse a line; None if it is not an entry."""
    try:
        found = parse_json(line)
        if "checkpoint" in found:
            body = found["checkpoint"]
            return Checkpoint(**body | {"head": _head(body["head"])}, signature=found["signature"])
        return _head(found)
    except (ValueError, TypeError, KeyError):
        return None


def _head(found: Any) -> ChainHead:
    """Parse a head. Raises TypeError, ValueError."""
    head = ChainHead(**found)
    if type(head.number) is not int:
        raise ValueError("the number of a head is not a number")
    return head


def _hash_of(line: str) -> str:
    return hashlib.sha256(line.encode("ascii", "replace")).hexdigest()
