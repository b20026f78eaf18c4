"""Sparse memory: pieces of bytes at addresses, joined to an image with filled gaps.

Memory use does not depend on the address range: two bytes four gigabytes apart take two bytes.
Pieces may arrive in any order and may repeat, but not contradict each other.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.image.image import AddressSpan
from flasher.protocol.spec import IMAGE_MAX_SIZE, PACKET_COUNT_MAX, PACKET_FILLER

PIECES_MAX: Final = 32_768
"""Maximum number of separate pieces, more than any linker makes. Limits time and memory."""
_NAMED_SPANS_MAX: Final = 8


class SparseBytes:
    """Sorted pieces of bytes without overlaps, limited to the addresses of `window`."""

    def __init__(self, source: str, window: tuple[int, int] | None = None) -> None:
        self.source = source
        self.window = window
        self._starts: list[int] = []
        self._pieces: list[bytearray] = []
        self._seen: tuple[int, int] | None = None
        self.size_bytes = 0

    def add(self, start: int, data: bytes, place: Callable[[int], str]) -> None:
        """Add `data` at address `start`; `place` maps an address to a line or section for messages.

        Raises ImageError for bytes that contradict earlier ones, and when a limit is exceeded.
        """
        if not data:
            return
        if self.window:
            self.note(start, start + len(data))
            data = data[max(0, self.window[0] - start) : max(0, self.window[1] - start)]
            start = max(start, self.window[0])
        end = start + len(data)
        if self._starts and self._end(-1) == start:  # usual case: data follows the last piece
            self._insert(len(self._starts), start, data)
            return
        index = max(0, bisect_right(self._starts, start) - 1)
        while start < end:
            if index < len(self._starts) and self._end(index) <= start:
                index += 1
                continue
            if index == len(self._starts) or self._starts[index] >= end:
                free = end
            else:
                free = self._starts[index]
            if free > start:
                index = self._insert(index, start, data[: free - start])
                data = data[free - start :]
                start = free
            else:
                common = min(end, self._end(index)) - start
                self._compare(index, start, data[:common], place)
                data = data[common:]
                start += common

    def leaves_out(self, start: int, end: int) -> bool:
        """Return True, and record the range, if all its addresses are outside the window."""
        if self.window is None or (start < self.window[1] and self.window[0] < end):
            return False
        self.note(start, end)
        return True

    def note(self, start: int, end: int) -> None:
        """Record that the file has bytes from `start` up to `end`, for messages."""
        low, high = self._seen or (start, end)
        self._seen = min(low, start), max(high, end)

    def spans(self) -> tuple[AddressSpan, ...]:
        """Return the contiguous address ranges with bytes, ascending."""
        spans: list[AddressSpan] = []
        for start, piece in zip(self._starts, self._pieces, strict=True):
            if spans and spans[-1].end == start:
                spans[-1] = AddressSpan(spans[-1].start, spans[-1].size_bytes + len(piece))
            else:
                spans.append(AddressSpan(start, len(piece)))
        return tuple(spans)

    def pieces(self) -> Iterator[tuple[int, bytes]]:
        """Yield the pieces with their addresses, ascending."""
        for start, piece in zip(self._starts, self._pieces, strict=True):
            yield start, bytes(piece)

    def join(self, fill_gaps_up_to: int) -> tuple[bytes, int]:
        """Join all bytes from the first address (that of the window, if any) to the last, with gaps
        filled with FF (R8). Return them with the first address.

        Raises ImageError if there are no bytes, if a gap is larger than `fill_gaps_up_to` bytes, or
        if the result exceeds the largest image.
        """
        spans = self.spans()
        if not spans:
            raise self._empty()
        first = self.window[0] if self.window else spans[0].start
        end = first
        for span in spans:
            if span.start - end > fill_gaps_up_to:
                raise self._gap(end, span.start, spans)
            end = span.end
        if end - first > IMAGE_MAX_SIZE:
            raise too_large_error(self.source, end - first)
        parts: list[bytes | bytearray] = []
        end = first
        for start, piece in zip(self._starts, self._pieces, strict=True):
            parts += (bytes((PACKET_FILLER,)) * (start - end), piece)
            end = start + len(piece)
        return b"".join(parts), first

    def _end(self, index: int) -> int:
        return self._starts[index] + len(self._pieces[index])

    def _insert(self, index: int, start: int, data: bytes) -> int:
        """Insert `data` before piece `index` or append it there; return the next index."""
        self.size_bytes += len(data)
        if self.size_bytes > IMAGE_MAX_SIZE:
            raise too_large_error(self.source, self.size_bytes, more=True)
        if index and self._end(index - 1) == start:
            self._pieces[index - 1] += data
            return index
        if len(self._pieces) == PIECES_MAX:
            raise scattered_error(self.source)
        # Not joined to the next piece: that would copy it each time for a file in descending order.
        self._starts.insert(index, start)
        self._pieces.insert(index, bytearray(data))
        return index + 1

    def _compare(self, index: int, start: int, data: bytes, place: Callable[[int], str]) -> None:
        offset = start - self._starts[index]
        there = self._pieces[index][offset : offset + len(data)]
        if there == data:
            return
        at = next(at for at, (old, new) in enumerate(zip(there, data, strict=True)) if old != new)
        address = start + at
        raise ImageError(
            f"{self.source} has different bytes for the same address 0x{address:08X}: "
            f"first {there[at]:02X}, then {data[at]:02X}",
            where=place(address),
            cause="two overlapping builds or parts were merged into one file",
            remedy="Make the file again from one build.",
            code=ErrorCode.IMAGE_CONFLICT,
        )

    def _empty(self) -> ImageError:
        if not (self._seen and self.window):
            return empty_error(self.source)
        start, end = self.window
        low, high = self._seen
        return ImageError(
            f"{self.source} contains no bytes in the range 0x{start:08X}:0x{end:08X}",
            where=f"its bytes are between 0x{low:08X} and 0x{high:08X}",
            remedy="Correct --range START:END.",
            code=ErrorCode.IMAGE_EMPTY,
        )

    def _gap(self, start: int, end: int, spans: tuple[AddressSpan, ...]) -> ImageError:
        named = ", ".join(str(span) for span in spans[:_NAMED_SPANS_MAX])
        if len(spans) > _NAMED_SPANS_MAX:
            named += f" and {len(spans) - _NAMED_SPANS_MAX} more"
        remedy = "Choose the application with --range START:END."
        if spans[-1].end - min(start, spans[0].start) <= IMAGE_MAX_SIZE:
            remedy += f" Or fill the gap with FF by --fill-gaps-up-to {end - start}."
        return ImageError(
            f"{self.source} has a gap of {end - start} bytes between 0x{start:08X} and 0x{end:08X}",
            where=f"segments {named}",
            cause="option bytes, external flash or a bootloader besides the application",
            remedy=remedy,
            code=ErrorCode.IMAGE_GAP,
        )


def empty_error(source: str) -> ImageError:
    """Create the error for an image without bytes (R9)."""
    return ImageError(
        f"{source} is empty: it contains no bytes to send",
        cause="the build or the conversion that made it failed",
        remedy="Make the file again.",
        code=ErrorCode.IMAGE_EMPTY,
    )


def scattered_error(source: str) -> ImageError:
    """Create the error for too many separate pieces."""
    return ImageError(
        f"{source} contains more than {PIECES_MAX} separate pieces of data",
        cause="the file is damaged, or was not made by a linker",
        remedy="Make the file again. Or choose part of it with --range START:END.",
        code=ErrorCode.IMAGE_GAP,
    )


def too_large_error(source: str, size_bytes: int, *, more: bool = False) -> ImageError:
    """Create the error for more than 65535 packets (R9); with `more`, the size is a lower bound."""
    return ImageError(
        f"{source} is too large: {'at least ' if more else ''}{size_bytes} bytes to send, "
        f"and {PACKET_COUNT_MAX} packets hold {IMAGE_MAX_SIZE}",
        cause="it is not a firmware image, or contains more than the application",
        remedy="Choose the application with --range START:END (a raw binary needs --base too).",
        code=ErrorCode.IMAGE_TOO_LARGE,
    )
