"""Figures of many measured times, and the link report that is made of them.

Nothing here keeps the values: a distribution is what is left of them when they have been counted.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True)
class Distribution:
    """How a number of times are spread; all in seconds. A percentile is a value that was measured
    (the nearest rank), never one between two.
    """

    count: int
    minimum_s: float
    median_s: float
    p95_s: float
    p99_s: float
    maximum_s: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Self | None:
        """The distribution of these seconds; None when there are none."""
        ranked = sorted(values)
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


def _nearest_rank(ranked: list[float], share: float) -> float:
    return ranked[max(0, math.ceil(share * len(ranked)) - 1)]


@dataclass(frozen=True)
class LinkReport:
    """How a transfer used the bus, over all its attempts; times in seconds."""

    packets: int
    """Packets that were sent, each once for every attempt."""
    acknowledged: int
    """Those of them whose ACK came."""
    repetitions: int
    """Copies of a packet beyond the first one of its attempt."""
    naks: int
    """NAKs while packets were sent."""
    line_s: float
    """One copy of each acknowledged packet and its ACK, one right after the other on the wire."""
    transfer_s: float
    """From the first frame of the first packet to the last ACK, the attempts added up."""
    share_of_line_rate: float | None
    """`line_s` / `transfer_s`: 1 is a bus that never waits. More than 1 on a bus that is none.
    None while nothing was acknowledged."""
    host_turnaround: Distribution | None
    """From the last frame of an ACK to the first frame of the next packet; None without any."""
    device_answer: Distribution | None
    """From a packet's last frame on the wire to the last frame of its ACK or NAK; None without
    any. What was sent more than once is left out: nobody knows which copy was answered."""
