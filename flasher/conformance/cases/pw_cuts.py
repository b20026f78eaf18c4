"""Where PW cuts the power: after which frame of which message of an upgrade."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.wire import (
    packet_count,
)

PACKET_FRAMES: Final = 18
"""CAN frames of one packet."""
_ALL_PACKETS: Final = 8
"""Up to so many packets, an upgrade is cut at each of its frames."""
_BETWEEN_MAX: Final = 6
"""Beyond, so many of those between the first and the last one are cut, at a frame by the seed."""
FAR_PACKET: Final = 64
"""Beyond it a cut costs so much time on a real bus that only some are made."""
_FEW_FRAMES: Final = (1, 9, 17, 18)


class Cut(NamedTuple):
    """Power is cut after so many frames of a message: the `packet` of that number (from 1), or,
    with packet 0, the update command; the number of packets plus one is the end.
    """

    packet: int
    frames: int


def cuts_at_frames(bench: Bench, image: bytes) -> Iterator[Cut]:
    """Every frame of every message; of a large image's packets between the first and the last one
    some, by chance.
    """
    for frames in range(1, len(bench.encoder.update(len(image))) + 1):
        yield Cut(0, frames)
    total = packet_count(len(image))
    for frames in range(1, PACKET_FRAMES + 1):
        yield Cut(1, frames)
    if total <= _ALL_PACKETS:
        between = [Cut(at, one) for at in range(2, total) for one in range(1, PACKET_FRAMES + 1)]
    else:
        numbers = sorted(bench.random.sample(range(2, min(total, FAR_PACKET)), _BETWEEN_MAX))
        between = [Cut(at, bench.random.randint(1, PACKET_FRAMES)) for at in numbers]
    yield from between
    if total > 1:
        for frames in _FEW_FRAMES if total > FAR_PACKET else range(1, PACKET_FRAMES + 1):
            yield Cut(total, frames)
    for frames in range(1, len(bench.encoder.end()) + 1):
        yield Cut(total + 1, frames)


def name_of(cut: Cut, total: int) -> str:
    """The cut in words; `total` is the number of packets."""
    what = {0: "the update command", total + 1: "end of transfer"}
    return f"after frame {cut.frames} of {what.get(cut.packet, f'packet {cut.packet}')}"
