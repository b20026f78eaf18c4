"""Timings in seconds and numbers of tries: the documents' own, and the defaults of R12.

Hosts and device models take a `Timings`; a product with other values replaces fields.
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
    """The tool stops repeating an application command after this time (chapter 3)."""
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
    """Maximum number of transmissions of a packet (R12)."""
    end_tries: Tries = 3
    """Maximum number of transmissions of end of transfer without an answer (R12)."""
    boot_watch_s: Pause = 0.025
    """Time between boot version and update command in which a second bootloader can be detected
    (R27): half of the time to the next announcement."""
    update_spacing_s: Pause = 0.03
    """Minimum time between two update commands (R2)."""
    leftover_boot_version_s: Pause = 0.06
    """A boot version within this time after request transfer is a leftover of the burst (R11)."""
    announcing_on_s: Timeout = 1.0
    """A device that still announces itself this long after its first announcement since end of
    transfer did not accept the image (R11). Five times as long as a burst, so that a doubled
    announcement, or a second pass through the bootloader, erases no good image."""
    quiet_after_repeat_s: Pause = 0.05
    """Silence required after a repetition before the next message (R10)."""
    application_start_timeout_s: Timeout = 5.0
    """From a lost final answer to the version answer of the new application (not in R12: as long as
    a restart may take in the other direction)."""


DEFAULT_TIMINGS = Timings()
