"""CAN frame type of the engines, independent of any adapter library."""

from __future__ import annotations

from typing import Final, NamedTuple

STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF


class Frame(NamedTuple):
    """One CAN frame: 11-bit `can_id` and 0 to 8 bytes of `data`.

    A named tuple for speed: each packet is 18 frames.
    """

    can_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False
    is_echo: bool = False
    """Own frame that the adapter returned after sending it; marked by the link."""

    def as_echo(self) -> Frame:
        """Return this frame marked as an echo; `_replace` takes three times as long."""
        return Frame(self[0], self[1], self[2], self[3], self[4], is_echo=True)

    @property
    def is_payload(self) -> bool:
        """True for a classic data frame with at least one byte; only these carry the protocol."""
        return not (self[2] or self[3] or self[4]) and bool(self[1])
