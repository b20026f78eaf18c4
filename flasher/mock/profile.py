"""Device profile: choices of the device model where the documents leave them open.

Cases of the conformance suite marked P name these choices. An option's type gives its allowed
values, the docstring after it its help; `flasher.settings.device_model` sets options from texts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Annotated, Literal, Self, get_args, get_origin, get_type_hints

from flasher.errors import UsageError, did_you_mean
from flasher.protocol.spec import (
    IMAGE_MAX_SIZE,
    PACKET_DATA_SIZE,
    VERSION_FIELD_SIZE,
    Dialect,
)
from flasher.protocol.text import encode_text
from flasher.validation import Parsed

_NO_QUERIES = "none"
_SUFFIXES = {"K": 1024, "M": 1024 * 1024}


def _read_seconds(value: str | float) -> float:
    seconds = float(value)
    if not 0 <= seconds < math.inf:
        raise ValueError
    return seconds


def _read_number(value: str | int) -> int:
    if isinstance(value, str):
        factor = _SUFFIXES.get(value[-1:].upper(), 1)
        value = int(value[:-1] if factor > 1 else value, 0) * factor
    if value < 0:
        raise ValueError
    return value


def _read_number_or_none(value: str | int | None) -> int | None:
    is_none = value is None or (isinstance(value, str) and value.lower() == "none")
    return None if value is None or is_none else _read_number(value)


Seconds = Annotated[float, Parsed("a number from 0 on, as 0.05", _read_seconds)]
Number = Annotated[int, Parsed("a number from 0 on, as 2048, 0x800 or 2K", _read_number)]
NumberOrNone = Annotated[
    int | None, Parsed("a number from 0 on, as 2048, 0x800 or 2K, or none", _read_number_or_none)
]


@dataclass(frozen=True, kw_only=True)
class DeviceProfile:
    """Options of a device model; the defaults are this project's readings.

    Raises UsageError for an invalid value.
    """

    # Reset and announcements.
    reset_in_bootloader: Literal["ignored", "restarts"] = "ignored"
    """Reset that reaches the announcing bootloader (RS-02, R18)."""
    without_application: Literal["announces", "listens"] = "announces"
    """After the burst, with no application to start: goes on announcing, or is silent (RS-03)."""
    window_s: Seconds = 0.2
    """Time of listening after the last announcement (UP-04)."""
    reset_delay_s: Seconds = 0.05
    """Time from reset or power-up to the first announcement."""
    boot_version: str = "V1.0.0"
    """Version text of the bootloader, 6 characters."""

    # Update command and transfer.
    update_in_transfer: Literal["starts_over", "ignored"] = "starts_over"
    """Update command in the middle of a transfer (UP-08)."""
    bad_packet: Literal["nak_expected", "nak_received", "silence"] = "nak_expected"
    """Damaged or impossible packet: NAK with the number wanted, or the one it names (TX-01)."""
    repeated_packet: Literal["ack", "nak_next"] = "ack"
    """The packet stored last, again: ACK n, or NAK n+1 (TX-02, R10)."""
    older_packet: Literal["ack", "nak", "silence"] = "ack"
    """A packet stored before the last one (TX-03)."""
    pause_in_transfer: Literal["announces", "waits"] = "announces"
    """A pause longer than transfer_timeout_s: waits on, or announces again (TX-12)."""
    transfer_timeout_s: Seconds = 5.0
    """The pause that pause_in_transfer is about."""
    reset_in_transfer: Literal["ignored", "restarts"] = "ignored"
    """Reset during an upgrade (TX-13)."""

    # End.
    image_checksum: Literal["none", "crc32"] = "none"
    """Crc32: an image's last four bytes are the CRC-32 of the rest (EN-04, R7)."""
    repeated_end: Literal["same_answer", "silence"] = "same_answer"
    """End of transfer again, once answered (EN-02)."""
    refused_hold_s: Seconds = 1.0
    """Time from refusing an image to announcing again."""
    after_complete: Literal["starts", "restarts"] = "starts"
    """Starts the new application at once, or through the bootloader (EN-03)."""
    start_delay_s: Seconds = 0.1
    """Time from complete to the start of the new application."""

    # Application.
    upgrade_in_application: Literal["general_feedback", "silence"] = "general_feedback"
    """Upgrade message that reaches the running application (R17)."""
    model: str = "BM36"
    """Model text of the version information."""
    serial_number: str = "W2605001"
    """Serial number text of the version information."""
    hardware_version: str = "V1r2r0_20220512"
    """Hardware text of the version information."""
    factory_version: str = "V1r0r0_20220512"
    """Version of the first application."""
    dialect: Literal["welling", "motinova"] = "welling"
    """Document that its application speaks by."""
    older_battery: Literal["no", "yes"] = "no"
    """Yes: no state of health, no answer to 732 5300 and 742 5200 (section 6)."""
    silent_queries: str = "none"
    """Commands not answered, as 3800,732:5000: of all ids, or of one; separated by commas."""
    battery_use: Literal["riding", "resting"] = "resting"
    """Rides and charges in turn, or rests: a vehicle in use is not upgraded."""
    battery_seed: Number = 1
    """Seed of the random differences between the cells."""
    faults: Number = 0
    """Faults set from the start: 32 bits of the fault message (CAN id 720, command 1204)."""
    idle_shutdown: Literal["off", "on"] = "off"
    """Switches off after 30 min with an idle bus and a small pack current (table 5)."""

    # Memory.
    application_area_bytes: Number = 8 * 1024 * 1024
    """Size of the application area, whole pages: room for the largest image."""
    largest_image_bytes: NumberOrNone = None
    """Largest image taken; none: the whole area."""
    page_size_bytes: Number = 2048
    """Size of a page, the unit of erasing."""
    program_unit_bytes: Number = 8
    """Size of the unit of programming; divides the size of a packet."""
    erased_pages: Literal["needed", "all"] = "needed"
    """Pages of the application area erased for an image."""
    erase_time_s: Seconds = 0.002
    """Time to erase one page."""
    program_time_s: Seconds = 0.001
    """Time to program one packet, or the final record."""

    @property
    def image_limit_bytes(self) -> int:
        """Maximum size of an accepted image, in bytes."""
        limit = self.largest_image_bytes
        area = min(self.application_area_bytes, IMAGE_MAX_SIZE)
        return area if limit is None else min(limit, area)

    def speaking(self, dialect: Dialect) -> Self:
        """Return the same profile with an application of this dialect."""
        return replace(self, dialect=dialect.name)  # type: ignore[arg-type]

    def is_silent_to(self, can_id: int, command: int) -> bool:
        """True for a query or write listed in `silent_queries`."""
        return (None, command) in self._silent or (can_id, command) in self._silent

    @cached_property
    def _silent(self) -> frozenset[tuple[int | None, int]]:
        if self.silent_queries in {"", _NO_QUERIES}:
            return frozenset()
        return frozenset(map(_parse_query, self.silent_queries.split(",")))

    def __post_init__(self) -> None:
        for key, words in _choices().items():
            word = getattr(self, key)
            if word not in words:
                hint = did_you_mean(word, words)
                raise UsageError(
                    f"{key} cannot be {word!a}.", remedy=f"{hint}It is {', '.join(words)}."
                )
        for key, value in vars(self).items():
            if isinstance(value, int | float) and not 0 <= value < math.inf:
                raise UsageError(f"{key} is a number from 0 on, not {value}")
        self._check_sizes()
        for key in ("model", "serial_number", "hardware_version", "factory_version"):
            try:
                encode_text(getattr(self, key), VERSION_FIELD_SIZE)
            except ValueError as error:
                raise UsageError(f"{key}: {error}") from error
        if len(self.boot_version) != 6 or not self.boot_version.isascii():
            raise UsageError(f"boot_version is 6 ASCII characters, not {self.boot_version!a}")
        if not self.transfer_timeout_s:
            raise UsageError("transfer_timeout_s is greater than 0")
        if self.faults >> 32:
            raise UsageError(f"faults are 32 bits, not 0x{self.faults:X}")
        _ = self._silent

    def _check_sizes(self) -> None:
        unit, page = self.program_unit_bytes, self.page_size_bytes
        if not unit or PACKET_DATA_SIZE % unit:
            raise UsageError(f"program_unit_bytes divides {PACKET_DATA_SIZE}; {unit} does not")
        if not page or page % PACKET_DATA_SIZE:
            raise UsageError(f"page_size_bytes is a multiple of {PACKET_DATA_SIZE}, not {page}")
        area = self.application_area_bytes
        if not area or area % page:
            raise UsageError(f"application_area_bytes is a multiple of {page}, not {area}")


@cache  # evaluating the types takes longer than all that is checked by them
def _choices() -> dict[str, tuple[str, ...]]:
    """Allowed words of every option that is a choice."""
    hints = get_type_hints(DeviceProfile).items()
    return {key: get_args(hint) for key, hint in hints if get_origin(hint) is Literal}


def _parse_query(text: str) -> tuple[int | None, int]:
    """Parse `COMMAND` or `ID:COMMAND`, in hexadecimal, as (CAN id or None, command)."""
    can_id, _, command = text.strip().rpartition(":")
    try:
        return (int(can_id, 16) if can_id else None), int(command, 16)
    except ValueError:
        raise UsageError(
            f"silent_queries: {text!a} is not a command", remedy="Write 3800 or 732:5000."
        ) from None
