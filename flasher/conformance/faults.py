"""What happens to frames on their way: a fault for one frame, by its place in the traffic."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class FaultKind(Enum):
    """What happens to the frame."""

    DROP = "dropped"
    DOUBLE = "doubled"
    DELAY = "delayed"
    SWAP = "swapped with the next one"


@dataclass(frozen=True)
class Fault:
    """One fault: the `index`-th frame (from 0) since `Line.disturb`, of those that are sent, or,
    with `incoming`, of those that arrive (these can be dropped and doubled only).

    `delay_s` is for delays.
    """

    kind: FaultKind
    index: int
    incoming: bool = False
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        if self.incoming and self.kind not in (FaultKind.DROP, FaultKind.DOUBLE):
            raise ValueError(f"a frame that arrives cannot be {self.kind.value}")

    def __str__(self) -> str:
        """As a step of a case."""
        side = "received" if self.incoming else "sent"
        return f"frame {self.index + 1} {side} is {self.kind.value}"
