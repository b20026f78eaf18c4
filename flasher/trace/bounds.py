"""Limits on trace files: size, compression ratio, line length, entries without frames."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BufferedIOBase
from typing import Final, Self

FILE_MAX_SIZE: Final = 1024 * 1024 * 1024
"""Maximum size in bytes, also after unpacking: half a day of a full bus."""
_RATIO_MAX: Final = 50
"""Recordings compress to a tenth; a higher ratio is an attack on memory."""
_UNPACKED_FREE: Final = 1024 * 1024
"""Unpacked bytes allowed for a compressed file of any size."""
_IDLE_MAX: Final = 100_000
_IDLE_PER_FRAME: Final = 10
_LINE_MAX: Final = 65_536
"""Maximum length of a line in bytes. Frames of other networks have the longest lines."""


class UnfitError(Exception):
    """The file is not a trace; the text gives the reason."""

    def __init__(self, text: str, *, remedy: str = "") -> None:
        """`remedy` is for a file of the right format with unsupported content."""
        super().__init__(text)
        self.remedy = remedy


def check_unpacked(pieces: Iterator[bytes], packed_size: int) -> None:
    """Unpack a file of `packed_size` bytes once, before any frame is read.

    Raises UnfitError if it is larger than any recording. Other damage is found by the reader, after
    the frames before it.
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
    """Counts frames and entries of a trace file, to stop at endless entries without frames."""

    def __init__(self) -> None:
        self.frames = 0
        """Number of frames, counted by the caller."""
        self._entries = 0

    def entry(self) -> None:
        """Count a line or an object. Raises UnfitError for too many without a frame (blank lines,
        comments).
        """
        self._entries += 1
        if self._entries > _IDLE_MAX + _IDLE_PER_FRAME * self.frames:
            raise UnfitError(f"{self._entries:,} entries hold {self.frames:,} frames")


class BoundedLines:
    """Lines of a trace file, for python-can's text readers.

    Ends with the line that contains byte number `size`, even if another program appends; None reads
    to the end.
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
        """Do nothing: the caller closes its file."""
