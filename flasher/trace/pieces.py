"""Messages with the time that they took: what a decoder alone does not tell.

A time stamp means different things: adapters stamp a received frame when it has ended, a recorder
of our own stamps a sent frame when the adapter accepted it, and a queue accepts a whole message at
once. `Piece.left_s` copes with both: frames whose stamps lie closer together than they can be on
the wire were accepted, not sent, and their message ended when the wire could have carried it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from flasher.protocol.bittime import fixed_bits, frame_bits
from flasher.protocol.frame import Frame
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.trace.decoder import BusEvent, Decoder, Kind

_LONG_ID_BITS: Final = 20
"""What a 29-bit id adds to a frame: 18 id bits, SRR and r1."""
_ERROR_FRAME_BITS: Final = 20
"""About what an error frame takes: flags, delimiter, interframe space."""
_ACCEPTED_SHARE: Final = 0.9
"""Frames that take less of their wire time than this, stamp to stamp, bear times of acceptance."""


def bits_of(frame: Frame) -> int:
    """Bit times of any frame; without stuff bits where only the base format's are known exactly."""
    if frame.is_error:
        return _ERROR_FRAME_BITS
    if frame.is_extended:
        return fixed_bits(len(frame.data)) + _LONG_ID_BITS
    return frame_bits(frame)


@dataclass(frozen=True, slots=True)
class Piece:
    """One thing seen, with the first of its frames and the bits of all of them."""

    seen: BusEvent
    begin_s: float
    """Stamp of the first frame."""
    end_s: float
    """Stamp of the last frame."""
    bits: int
    first_bits: int
    """Bits of the first frame alone."""

    def left_s(self, bitrate_bps: int) -> float:
        """When the last frame had left the wire, as well as the stamps tell."""
        between_s = (self.bits - self.first_bits) / bitrate_bps
        if self.end_s - self.begin_s >= _ACCEPTED_SHARE * between_s:
            return self.end_s
        return max(self.end_s, self.begin_s + self.bits / bitrate_bps)


@dataclass(slots=True)
class _Open:
    """Frames of one id since its last piece."""

    begin_s: float
    first_bits: int
    bits: int = 0
    end_s: float = field(default=0.0)


class Pieces:
    """Takes the frames of a bus in the order of time, gives what they say."""

    def __init__(
        self, inter_frame_timeout_s: float = DEFAULT_TIMINGS.inter_frame_timeout_s
    ) -> None:
        self._decoder = Decoder(inter_frame_timeout_s)
        self._open: dict[int, _Open] = {}

    def feed(self, frame: Frame, now: float, bits: int) -> Iterator[Piece]:
        """What was cut short before `now`, then what the frame completed."""
        due = self._decoder.deadline()
        if due is not None and due < now:
            yield from self._cut_short(now)
        is_ours = frame.is_payload
        if is_ours:
            held = self._open.get(frame.can_id)
            if held is None:
                held = self._open[frame.can_id] = _Open(now, bits)
            held.bits += bits
            held.end_s = now
        for seen in self._decoder.feed(frame, now):
            yield self._piece(seen, bits)

    def finish(self, now: float) -> Iterator[Piece]:
        """What is left unfinished at the end."""
        yield from self._cut_short(now + 2 * DEFAULT_TIMINGS.inter_frame_timeout_s)

    def _cut_short(self, now: float) -> Iterator[Piece]:
        while (due := self._decoder.deadline()) is not None and due < now:
            for seen in self._decoder.tick(due):
                yield self._piece(seen, 0)

    def _piece(self, seen: BusEvent, bits: int) -> Piece:
        held = None
        if seen.kind not in (Kind.FOREIGN, Kind.ERROR_FRAME):
            # A second piece out of the same frame begins and ends with it.
            held = self._open.pop(seen.can_id, None)
        if held is None:
            return Piece(seen, seen.at, seen.at, bits, bits)
        return Piece(seen, held.begin_s, held.end_s, held.bits, held.first_bits)
