"""How well a transfer uses the bus: measured live by a tap, or out of a trace by the same code.

`Transfer` takes messages, `LinkMeter` is the tap that makes messages of a driver's frames. Frames
are not kept; of each packet there remain two times.
"""

from __future__ import annotations

from array import array
from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.spec import Command, Target
from flasher.trace.decoder import Kind
from flasher.trace.figures import Distribution, LinkReport
from flasher.trace.pieces import Piece, Pieces, bits_of

_SECONDS: Final = "d"


class Transfer:
    """Collects packets and their answers, over all attempts. Give it messages in order."""

    def __init__(self, bitrate_bps: int) -> None:
        self._bitrate_bps = bitrate_bps
        self._packets = 0
        self._acknowledged = 0
        self._repetitions = 0
        self._naks = 0
        self._line_bits = 0
        self._past_s = 0.0
        """Transfer time of the attempts before this one."""
        self._begin_s: float | None = None
        self._last_ack_s: float | None = None
        self._acked_at_s: float | None = None
        """The ACK that the next packet has not followed yet."""
        self._number = 0
        """The packet in work; 0 before the first one of an attempt."""
        self._highest = 0
        self._copies = 0
        self._bits = 0
        self._left_s = 0.0
        self._is_acked = True
        self._turnarounds = array(_SECONDS)
        self._answers = array(_SECONDS)

    def begin_attempt(self) -> None:
        """The device asks for packet 1, or is told to prepare for it."""
        if self._begin_s is not None and self._last_ack_s is not None:
            self._past_s += self._last_ack_s - self._begin_s
        self._begin_s = self._last_ack_s = self._acked_at_s = None
        self._number = self._highest = self._copies = 0

    def packet(self, number: int, piece: Piece) -> None:
        """A packet was sent."""
        if self._begin_s is None:
            self._begin_s = piece.begin_s
        if number > self._highest:
            self._packets += 1
            self._highest = number
        else:
            self._repetitions += 1
        if number == self._number:
            self._copies += 1
        else:
            if self._acked_at_s is not None and number == self._number + 1:
                self._turnarounds.append(max(0.0, piece.begin_s - self._acked_at_s))
            self._number, self._copies = number, 1
        self._bits = piece.bits
        self._left_s = piece.left_s(self._bitrate_bps)
        self._is_acked = False
        self._acked_at_s = None

    def answer(self, number: int, piece: Piece, *, is_ack: bool) -> None:
        """The device answered a packet; what does not answer the one in work is ignored."""
        if not is_ack:
            self._naks += 1
        if number != self._number or self._is_acked:
            return
        if self._copies == 1:
            self._answers.append(max(0.0, piece.end_s - self._left_s))
        if is_ack:
            self._is_acked = True
            self._acknowledged += 1
            self._line_bits += self._bits + piece.bits
            self._last_ack_s = self._acked_at_s = piece.end_s
        else:
            self._copies = 2  # Whatever comes now may answer this copy or the next one.

    def report(self) -> LinkReport | None:
        """The figures so far; None before the first packet."""
        if not self._packets:
            return None
        transfer_s = self._past_s
        if self._begin_s is not None and self._last_ack_s is not None:
            transfer_s += self._last_ack_s - self._begin_s
        line_s = self._line_bits / self._bitrate_bps
        share = line_s / transfer_s if transfer_s > 0 else None
        # Where frames take less time than on the line, nobody knows when a packet had left.
        is_no_line = share is not None and share > 1
        return LinkReport(
            packets=self._packets,
            acknowledged=self._acknowledged,
            repetitions=self._repetitions,
            naks=self._naks,
            line_s=line_s,
            transfer_s=transfer_s,
            share_of_line_rate=share,
            host_turnaround=Distribution.of(self._turnarounds),
            device_answer=None if is_no_line else Distribution.of(self._answers),
        )


class LinkMeter:
    """A driver's tap that measures the transfer to `target`; `report` at any time."""

    def __init__(self, target: Target, bitrate_bps: int) -> None:
        self._ids = frozenset((target.request_id, target.answer_id))
        self._pieces = Pieces()
        self._transfer = Transfer(bitrate_bps)
        self._is_over = False

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Take one frame."""
        if frame.can_id not in self._ids or not frame.is_payload:
            return
        for piece in self._pieces.feed(frame, now, bits_of(frame)):
            seen = piece.seen
            if seen.kind is not Kind.MESSAGE:
                continue
            match seen.command:
                case Command.UPDATE:
                    self._transfer.begin_attempt()
                    self._is_over = False
                case Command.PACKET:
                    self._transfer.packet(_number(piece), piece)
                case Command.END_OF_TRANSFER:
                    self._is_over = True
                case Command.ACK | Command.NAK if not self._is_over:
                    is_ack = seen.command == Command.ACK
                    self._transfer.answer(_number(piece), piece, is_ack=is_ack)

    def report(self) -> LinkReport | None:
        """The figures so far; None before the first packet."""
        return self._transfer.report()


def _number(piece: Piece) -> int:
    return next(int(field.value) for field in piece.seen.fields if field.name == "number")
