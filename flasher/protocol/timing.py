"""Timeouts, intervals and numbers of tries, as documented or by default (R12).

Hosts and device models take a `Timings`; a target profile replaces single values.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Annotated

from flasher.protocol.spec import BOOT_VERSION_BURST
from flasher.validation import NumberRange

Timeout = Annotated[float, NumberRange(gt=0, le=3600)]
"""Timeout in seconds; zero would expire at once."""
Pause = Annotated[float, NumberRange(ge=0, le=3600)]
Tries = Annotated[int, NumberRange(ge=1, le=1000)]


@dataclass(frozen=True)
class Timings:
    """Timeouts, intervals and numbers of tries of host and device."""

    # Given by the documents.
    command_repeat_s: Timeout = 0.2
    """Interval at which the tool repeats an application command (3.4)."""
    command_timeout_s: Timeout = 1.0
    """Time after which the tool stops repeating an application command (3.4)."""
    boot_version_spacing_s: Pause = 0.05
    """Interval between boot versions of a bootloader (figure 2)."""

    # Readings.
    inter_frame_timeout_s: Timeout = 0.1
    """Maximum time between two frames of a message (R12)."""
    boot_version_timeout_s: Timeout = 5.0
    """Time from reset to the first boot version (R12)."""
    request_transfer_timeout_s: Timeout = 10.0
    """Time from update command to request transfer, while the device erases its flash (R12)."""
    ack_timeout_s: Timeout = 0.5
    """Time from a packet to its ACK or NAK (R12)."""
    complete_timeout_s: Timeout = 10.0
    """Time from end of transfer to complete (R12)."""
    packet_tries: Tries = 5
    """Maximum number of transmissions of one packet (R12)."""
    end_tries: Tries = 3
    """Maximum number of transmissions of end of transfer without an answer (R12)."""
    boot_watch_s: Pause = 0.025
    """Wait between boot version and update command in which a second bootloader can be detected
    (R27): half of the interval between boot versions."""
    update_spacing_s: Pause = 0.03
    """Minimum time between two update commands (R2)."""
    leftover_boot_version_s: Pause = 0.06
    """A boot version so soon after request transfer belongs to the announcement before it (R11)."""
    announcing_on_s: Timeout = 1.0
    """A device that still sends boot versions this long after its first one since end of transfer
    did not accept the image (R11). Five bursts long: a doubled announcement, or a second pass
    through the bootloader, must not cause a good image to be erased."""
    quiet_after_repeat_s: Pause = 0.05
    """Silence required after a repetition before the next message (R10)."""
    application_start_timeout_s: Timeout = 5.0
    """From a lost final answer to the version answer of the new application (not in R12: as long as
    a restart may take in the other direction)."""

    @property
    def burst_s(self) -> float:
        """Silence after which a bootloader has ended its announcement, in seconds."""
        return BOOT_VERSION_BURST * self.boot_version_spacing_s


DEFAULT_TIMINGS = Timings()


@dataclass
class Announcing:
    """Boot versions of a device whose application is awaited: one that starts it sends a burst, one
    without any goes on, perhaps with pauses (R11, R14). Two restarts make two bursts, then silence.
    """

    timings: Timings = DEFAULT_TIMINGS
    first_at: float = inf
    last_at: float = -inf
    """Times of the first and last boot version, in seconds."""
    count: int = 0
    """Number of boot versions, also of those forgotten."""
    _longest_pause_s: float = 0.0

    def note(self, now: float) -> None:
        """Record a boot version."""
        if self.has_begun:
            self._longest_pause_s = max(self._longest_pause_s, now - self.last_at)
        self.first_at, self.last_at = min(self.first_at, now), now
        self.count += 1

    def forget(self) -> None:
        """Start over."""
        self.first_at, self.last_at, self._longest_pause_s = inf, -inf, 0.0

    @property
    def has_begun(self) -> bool:
        return self.first_at < inf

    @property
    def lasted_s(self) -> float:
        """Time from the first to the last one."""
        return max(0.0, self.last_at - self.first_at)

    @property
    def judged_at(self) -> float:
        """Time at which those that have begun have ended or go on; -inf without any."""
        if not self.has_begun:
            return -inf
        return self.first_at + self.timings.announcing_on_s + 2 * self.timings.burst_s

    def goes_on(self, now: float) -> bool:
        """Return True if they have gone on beyond a burst, also without their longest pause, in
        which the device may have hung or restarted, and the silence since is no longer than that.
        """
        pause_s, silence_s = self._longest_pause_s, now - self.last_at
        has_ended = silence_s > pause_s + self.timings.burst_s
        return not has_ended and self.lasted_s - pause_s >= self.timings.announcing_on_s
