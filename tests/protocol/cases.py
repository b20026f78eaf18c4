"""The case table of complete messages, and the ways to feed a reassembler that tests share."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from flasher.protocol.wire import Damage, DamageReason, Message, Reassembler

INTER_FRAME_TIMEOUT_S: Final = 0.1
HELD_MAX: Final = 264 + 8 + 264
"""One message, one frame, and junk as long as a message."""


class Case(NamedTuple):
    """One vector: a message, its bytes, its CAN payloads."""

    name: str
    message: Message
    wire: bytes
    payloads: list[bytes]


def _load() -> list[Case]:
    path = Path(__file__).parent.parent / "vectors.json"
    return [
        Case(
            vector["name"],
            Message(
                int(vector["can_id"], 16),
                int(vector["mode"], 16),
                int(vector["command"], 16),
                bytes.fromhex(vector["data"]),
            ),
            bytes.fromhex(vector["wire"]),
            [bytes.fromhex(payload) for payload in vector["can_frames"]],
        )
        for vector in json.loads(path.read_text(encoding="utf-8"))["vectors"]
    ]


CASES: Final = _load()


def case(name: str) -> Case:
    """The vector of that name."""
    return next(found for found in CASES if found.name == name)


def make_reassembler(can_id: int) -> Reassembler:
    return Reassembler(can_id, INTER_FRAME_TIMEOUT_S)


def pieces(wire: bytes, size: int) -> list[bytes]:
    """`wire` cut into pieces of `size` bytes, the last one shorter."""
    return [wire[start : start + size] for start in range(0, len(wire), size)]


def feed_all(
    reassembler: Reassembler, payloads: Iterable[bytes], now: float = 0.0
) -> list[Message | Damage]:
    """Everything that a run of payloads yields, all at the same moment."""
    return [found for payload in payloads for found in reassembler.feed(payload, now)]


def drain(reassembler: Reassembler, now: float) -> list[Message | Damage]:
    """What silence until `now` yields."""
    return list(reassembler.tick(now))


def messages_of(found: Sequence[Message | Damage]) -> list[Message]:
    return [item for item in found if isinstance(item, Message)]


def reasons_of(found: Sequence[Message | Damage]) -> list[DamageReason]:
    return [item.reason for item in found if isinstance(item, Damage)]
