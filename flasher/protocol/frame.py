"""A CAN frame as flasher's engines see it, free of any adapter's library."""

from __future__ import annotations

from typing import Final, NamedTuple

STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF


class Frame(NamedTuple):
    """One CAN frame: 11-bit `can_id` and 0 to 8 bytes of `data`.

    A named tuple, not a dataclass: a packet is 18 of them and they are made in the hot path.
    """

    can_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False
    is_echo: bool = False
    """It is one's own, given back by the adapter when it had left; the link marks it."""

    @property
    def is_payload(self) -> bool:
        """True for a classic data frame with at least one byte: the only kind that carries the
        protocol.
        """
        return not (self[2] or self[3] or self[4]) and bool(self[1])
