"""Timings in seconds and tries, each stated once: the documents' own, and the defaults of R12.

`Timings` is what a host or a device model is given; a product that needs other values replaces
fields, nothing else holds a copy of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from flasher.validation import NumberRange

Timeout = Annotated[float, NumberRange(gt=0, le=3600)]
"""A timeout of zero would fail at once."""
Pause = Annotated[float, NumberRange(ge=0, le=3600)]
Tries = Annotated[int, NumberRange(ge=1, le=1000)]


@dataclass(frozen=True)
class Timings:
    """Timings of both sides of the upgrade."""

    # Given by the documents.
    command_repeat_s: Timeout = 0.2
    """The tool repeats an application command at this interval (chapter 3)."""
    command_timeout_s: Timeout = 1.0
    """The tool gives an application command up after this time (chapter 3)."""
    boot_version_spacing_s: Pause = 0.05
    """Time between two announcements of a bootloader (figure 2)."""

    # Readings.
    inter_frame_timeout_s: Timeout = 0.1
    """Frames of one message follow each other within this time (R12)."""
    boot_version_timeout_s: Timeout = 5.0
    """From reset to the first boot version (R12)."""
    request_transfer_timeout_s: Timeout = 10.0
    """From the update command to request transfer: the device may be erasing (R12)."""
    ack_timeout_s: Timeout = 0.5
    """From a packet to its ACK or NAK (R12)."""
    complete_timeout_s: Timeout = 10.0
    """From end of transfer to complete (R12)."""
    packet_tries: Tries = 5
    """How often a packet is sent at the most (R12)."""
    end_tries: Tries = 3
    """How often end of transfer is sent at the most while nothing answers it (R12)."""
    boot_watch_s: Pause = 0.025
    """So long after a boot version a second bootloader may show itself before the update command is
    sent (R27): half of the time to the next announcement, which one that goes on needs."""
    update_spacing_s: Pause = 0.03
    """An update command follows the one before not sooner than this (R2)."""
    leftover_boot_version_s: Pause = 0.06
    """A boot version up to this long after request transfer is a leftover of the burst (R11)."""
    announcing_on_s: Timeout = 1.0
    """Announcements that still come this long after the first one since end of transfer are those
    of a device that did not accept (R11): five times as long as a burst takes, so that a doubled
    announcement, or a second pass through the bootloader, erases no good image."""
    quiet_after_repeat_s: Pause = 0.05
    """After a repetition the next message waits for this much silence (R10)."""
    application_start_timeout_s: Timeout = 5.0
    """From a lost final answer to the version answer of the new application (not in R12: as long
    as a restart may take in the other direction)."""


DEFAULT_TIMINGS = Timings()
