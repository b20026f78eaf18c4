"""Computes how long the suite waits, from all times of the profile that bear on it.

A device that uses every limit to its end is right, so no wait is shorter than the limits that it
covers; cases and `init` take their waits from here or from the profile, never as numbers.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Final

from flasher.conformance.wire import PACKET_FRAMES, packet_count

if TYPE_CHECKING:  # the profile needs the validation library, which the list of cases does not
    from flasher.conformance.profile import ConformanceProfile

_WINDOW_MAX_S: Final = 1.0
"""Longest window to assume when the profile does not define it (up_04)."""
_INCOMPLETE: Final = 2
"""A device waits for the rest of a message at most this many times the gap that it accepts."""
_LATE_VERSION: Final = 4
_NO_PAUSE: Final = 0.75
"""This share of limits.pause_s is no pause, even if a few messages take their time before it."""
_STALL_LEAST_S: Final = 0.005
"""A scheduler gives other programs about this much time."""
_FRAME_BITS: Final = 135
"""Bits of an 8-byte frame with all possible stuff bits and the interframe space."""


class Waits:
    """Waits for a device of this profile, in seconds."""

    def __init__(self, profile: ConformanceProfile, bitrate_bps: int) -> None:
        self._profile = profile
        self._limit = profile.limit
        self._bitrate_bps = bitrate_bps

    @property
    def burst_s(self) -> float:
        """Longest duration of announcements and window together."""
        limit, count = self._limit, self._profile.number("versions")
        spacing_s = limit("version_spacing_s") + limit("version_spacing_tolerance_s")
        window_s = limit("window_s") + limit("window_tolerance_s")
        if self._profile.choice("up_04") == "either":
            window_s = max(window_s, _WINDOW_MAX_S)
        return (count - 1) * spacing_s + window_s

    @property
    def restart_s(self) -> float:
        """Longest time from a restart, through the bootloader, to an application that answers."""
        return self._limit("first_version_s") + self.burst_s + self._limit("start_s")

    @cached_property  # it is asked for each frame
    def stall_s(self) -> float:
        """Shortest pause of this program that can make a device miss a message, or look late."""
        limit = self._limit
        windows_s = (limit("window_s") / 2, limit("version_spacing_tolerance_s"))
        return float(max(min(limit("inter_frame_s"), *windows_s), _STALL_LEAST_S))

    @property
    def next_version_s(self) -> float:
        """How long to wait for the next boot version of a burst; RS-01 judges its time."""
        spacing_s, off_s = map(self._limit, ("version_spacing_s", "version_spacing_tolerance_s"))
        return max(_LATE_VERSION * spacing_s, spacing_s + off_s)

    @property
    def incomplete_s(self) -> float:
        """After this time no partial message is left in the device."""
        return _INCOMPLETE * self._limit("inter_frame_s")

    @property
    def settle_s(self) -> float:
        """From the last frame of damaged or incomplete messages to the last answer to them: the
        device notices that the rest is missing, and then takes as long as for any answer. No
        partial message is left in it then.
        """
        return self.incomplete_s + self._limit("ack_s")

    @property
    def silence_s(self) -> float:
        """How long the bus must be quiet to count as silent: any answer would have arrived."""
        return max(self._limit("silence_s"), self._limit("feedback_s"), self.settle_s)

    @property
    def silence_in_transfer_s(self) -> float:
        """The same in a transfer."""
        return self.in_transfer_s(self.silence_s)

    def in_transfer_s(self, for_s: float) -> float:
        """As much of `for_s` as does not become a pause that ends a transfer (tx_12)."""
        if self._profile.choice("tx_12") == "waits":
            return for_s
        return min(for_s, _NO_PAUSE * self._limit("pause_s"))

    @property
    def answer_s(self) -> float:
        """Longest time to the answer to any message."""
        names = ("first_version_s", "erase_s", "ack_s", "complete_s", "start_s")
        return max(map(self._limit, names))

    @property
    def packet_s(self) -> float:
        """Longest time of a packet on the bus."""
        return PACKET_FRAMES * _FRAME_BITS / self._bitrate_bps

    def upgrade_s(self, image_bytes: int) -> float:
        """Longest duration of an upgrade from a running application to a running application,
        including a pause that ends a transfer before it.
        """
        names = ("pause_s", "feedback_s", "first_version_s", "erase_s", "complete_s", "start_s")
        packet_s = self.packet_s + self._limit("ack_s")
        return self.burst_s + sum(map(self._limit, names)) + packet_count(image_bytes) * packet_s
