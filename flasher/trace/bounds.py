"""How much is read of a file that says it is a trace."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BufferedIOBase
from typing import Final, Self

FILE_MAX_SIZE: Final = 1024 * 1024 * 1024
"""In bytes, also of what a packed file unpacks to: half a day on a full bus."""
_RATIO_MAX: Final = 50
"""Recordings pack to a tenth; what packs better than this was made to fill a memory."""
_UNPACKED_FREE: Final = 1024 * 1024
"""In bytes: so much may come out of the smallest packed file."""
_IDLE_MAX: Final = 100_000
_IDLE_PER_FRAME: Final = 10
_LINE_MAX: Final = 65_536
"""In bytes. The longest lines are frames of other networks."""


class UnfitError(Exception):
    """The content is none of a trace; the text says why."""

    def __init__(self, text: str, *, remedy: str = "") -> None:
        """`remedy` is for a file that is what its suffix says, and holds what is not read."""
        super().__init__(text)
        self.remedy = remedy


def check_unpacked(pieces: Iterator[bytes], packed_size: int) -> None:
    """Unpack a file of `packed_size` bytes before anything is read out of it.

    Raises UnfitError when more comes out than of any recording. Any other damage is met again,
    behind the frames in front of it.
    """
    most = min(FILE_MAX_SIZE, max(_UNPACKED_FREE, _RATIO_MAX * packed_size))
    size = 0
    with suppress(EOFError, OSError, zlib.error, UnfitError):
        for piece in pieces:
            size += len(piece)
            if size > most:
                break
    if size > most:
        raise UnfitError(f"it unpacks to more than {most:,} bytes")


class Bounds:
    """Counts what is read of one file, and ends it where no trace would go on."""

    def __init__(self) -> None:
        self.frames = 0
        """Counted by whoever takes them."""
        self._entries = 0

    def entry(self) -> None:
        """A line or an object more was seen. Raises UnfitError when there are too many between the
        frames: blank lines, comments.
        """
        self._entries += 1
        if self._entries > _IDLE_MAX + _IDLE_PER_FRAME * self.frames:
            raise UnfitError(f"{self._entries:,} entries hold {self.frames:,} frames")


class Lines:
    """The lines of a file as python-can's readers of text take them from an open file.

    It ends with the line in which byte number `size` stands, whatever another program adds after
    it; None reads to the end.
    """

    def __init__(self, source: BufferedIOBase, size: int | None, bounds: Bounds) -> None:
        self._source = source
        self._left = math.inf if size is None else size
        self._bounds = bounds

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        raw = self._source.readline(_LINE_MAX) if self._left > 0 else b""
        if not raw:
            raise StopIteration
        self._left -= len(raw)
        self._bounds.entry()
        if len(raw) == _LINE_MAX:
            raise UnfitError(f"a line is longer than {_LINE_MAX:,} bytes")
        if b"\0" in raw:
            raise UnfitError("it holds NUL bytes: text in UTF-16, or no text")
        return raw.decode("utf-8-sig")

    def close(self) -> None:
        """Whoever opened the file closes it."""
