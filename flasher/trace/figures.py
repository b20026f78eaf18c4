"""Bus usage of a transfer: answer times, turnaround times, repetitions, share of the line rate.

`Transfer` takes messages; `LinkMeter` is a tap that decodes a driver's frames, live or from a
trace. Neither keeps frames: two times remain of each packet, and a `Distribution` of many times.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Final, Self

from flasher.protocol.frame import Frame
from flasher.protocol.spec import Command, Target
from flasher.trace.decoder import Kind, TimedDecoder, TimedEvent, bits_of

_SECONDS: Final = "d"


@dataclass(frozen=True)
class Distribution:
    """Distribution of times in seconds. A percentile is a measured value (nearest rank), never
    interpolated.
    """

    count: int
    minimum_s: float
    median_s: float
    p95_s: float
    p99_s: float
    maximum_s: float

    @classmethod
    def of(cls, values: Iterable[float] | Mapping[float, int]) -> Self | None:
        """Compute the distribution of these seconds, or of value counts; None without values."""
        ranked = Ranked(values)
        if not ranked:
            return None
        return cls(
            len(ranked),
            ranked[0],
            _nearest_rank(ranked, 0.50),
            _nearest_rank(ranked, 0.95),
            _nearest_rank(ranked, 0.99),
            ranked[-1],
        )


class Ranked:
    """Sorted values with their counts, so that millions need little memory."""

    def __init__(self, values: Iterable[float] | Mapping[float, int]) -> None:
        counts = Counter(values)
        self._values = sorted(counts)
        self._ends = list(accumulate(counts[value] for value in self._values))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, rank: int) -> float:
        return self._values[bisect_right(self._ends, rank % len(self))]

    @property
    def median(self) -> float:
        """Middle value, or the mean of the two in the middle."""
        return (self[(len(self) - 1) // 2] + self[len(self) // 2]) / 2


def _nearest_rank(ranked: Ranked, share: float) -> float:
    return ranked[max(0, math.ceil(share * len(ranked)) - 1)]


@dataclass(frozen=True)
class LinkReport:
    """Bus usage of a transfer, over all its attempts; times in seconds."""

    packets: int
    """Packets sent, counted once per attempt."""
    acknowledged: int
    """Packets whose ACK arrived."""
    repetitions: int
    """Repeated packets, within an attempt."""
    naks: int
    """NAKs while packets were sent."""
    line_s: float
    """Wire time of one copy of each acknowledged packet and its ACK, back to back."""
    transfer_s: float
    """Time from the first frame of the first packet to the last ACK, summed over attempts."""
    share_of_line_rate: float | None
    """`line_s` / `transfer_s`: 1 is a bus that never waits; more than 1 is a virtual bus. None
    before the first ACK."""
    host_turnaround: Distribution | None
    """Time from the end of an ACK to the first frame of the next packet; None without samples."""
    device_answer: Distribution | None
    """From a packet's last frame on the wire to the last frame of its ACK or NAK; None without
    samples. Repeated packets are left out: the answer may belong to any copy."""
    unreadable: int | None = None
    """Number of inputs of the adapter that were not frames; None if not counted."""
    refused: int | None = None
    """Number of frames that the adapter refused to send; None if not counted."""


class Transfer:
    """Collects packets and answers over all attempts, in order."""

    def __init__(self, bitrate_bps: int) -> None:
        self._bitrate_bps = bitrate_bps
        self._packets = 0
        self._acknowledged = 0
        self._repetitions = 0
        self._naks = 0
        self._line_bits = 0
        self._past_s = 0.0
        """Transfer time of earlier attempts."""
        self._begin_s: float | None = None
        self._last_ack_s: float | None = None
        self._acked_at_s: float | None = None
        """Time of an ACK that no packet has followed yet."""
        self._number = 0
        """Current packet; 0 before the first one of an attempt."""
        self._highest = 0
        self._copies = 0
        self._bits = 0
        self._left_s = 0.0
        self._is_acked = True
        self._turnarounds = array(_SECONDS)
        self._answers = array(_SECONDS)

    def begin_attempt(self) -> None:
        """Begin another attempt, at update command or request transfer."""
        if self._begin_s is not None and self._last_ack_s is not None:
            self._past_s += self._last_ack_s - self._begin_s
        self._begin_s = self._last_ack_s = self._acked_at_s = None
        self._number = self._highest = self._copies = 0

    def packet(self, number: int, timed: TimedEvent) -> None:
        began_s = timed.began_s(self._bitrate_bps)
        if self._begin_s is None:
            self._begin_s = began_s
        if number > self._highest:
            self._packets += 1
            self._highest = number
        else:
            self._repetitions += 1
        if number == self._number:
            self._copies += 1
        else:
            if self._acked_at_s is not None and number == self._number + 1:
                self._turnarounds.append(max(0.0, began_s - self._acked_at_s))
            self._number, self._copies = number, 1
        self._bits = timed.bits
        self._left_s = timed.left_s(self._bitrate_bps)
        self._is_acked = False
        self._acked_at_s = None

    def answer(self, number: int, timed: TimedEvent, *, is_ack: bool) -> None:
        """Record the answer to a packet; answers to other packets are ignored."""
        if not is_ack:
            self._naks += 1
        if number != self._number or self._is_acked:
            return
        if self._copies == 1:
            self._answers.append(max(0.0, timed.end_s - self._left_s))
        if is_ack:
            self._is_acked = True
            self._acknowledged += 1
            self._line_bits += self._bits + timed.bits
            self._last_ack_s = self._acked_at_s = timed.end_s
        else:
            self._copies = 2  # The next answer may belong to this copy or the next one.

    def report(self) -> LinkReport | None:
        """Return the bus usage so far; None before the first packet."""
        if not self._packets:
            return None
        transfer_s = self._past_s
        if self._begin_s is not None and self._last_ack_s is not None:
            transfer_s += self._last_ack_s - self._begin_s
        line_s = self._line_bits / self._bitrate_bps
        share = line_s / transfer_s if transfer_s > 0 else None
        # On a bus faster than the line, the end of a packet is unknown.
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
    """Driver's tap that measures the transfer to `target`. Call `report` at any time."""

    def __init__(self, target: Target, bitrate_bps: int) -> None:
        self._ids = frozenset((target.request_id, target.answer_id))
        self._decoder = TimedDecoder()
        self._transfer = Transfer(bitrate_bps)
        self._is_over = False

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if frame.can_id not in self._ids or not frame.is_payload:
            return
        for timed in self._decoder.feed(frame, now, bits_of(frame)):
            event = timed.event
            if event.kind is not Kind.MESSAGE:
                continue
            match event.command:
                case Command.UPDATE:
                    self._transfer.begin_attempt()
                    self._is_over = False
                case Command.PACKET:
                    self._transfer.packet(_number(timed), timed)
                case Command.END_OF_TRANSFER:
                    self._is_over = True
                case Command.ACK | Command.NAK if not self._is_over:
                    is_ack = event.command == Command.ACK
                    self._transfer.answer(_number(timed), timed, is_ack=is_ack)

    def report(self) -> LinkReport | None:
        return self._transfer.report()


def _number(timed: TimedEvent) -> int:
    return next(int(field.value) for field in timed.event.fields if field.name == "number")
