"""What a device may choose where the document leaves it open: one frozen dataclass.

The cases of the conformance suite marked P name these choices. An option's allowed values are its
type, its help stands beside it, and both the command line and the tests read them from here.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal, get_args, get_origin, get_type_hints

from flasher.errors import UsageError
from flasher.protocol.spec import (
    IMAGE_MAX_SIZE,
    PACKET_DATA_SIZE,
    VERSION_FIELD_SIZE,
    WELLING,
)
from flasher.protocol.text import encode_text

_HELP = "help"
_NO_QUERIES = "none"
_SUFFIXES = {"K": 1024, "M": 1024 * 1024}


def _option(default: object, text: str) -> Any:
    """A field with its help."""
    return dataclasses.field(default=default, metadata={_HELP: text})


@dataclass(frozen=True, kw_only=True)
class DeviceProfile:
    """The choices of one product; the defaults are this project's readings.

    The metadata of a field holds its help. Raises UsageError when a value is not allowed.
    """

    # Reset and announcements.
    reset_in_bootloader: Literal["ignored", "restarts"] = _option(
        "ignored", "reset that reaches the announcing bootloader (RS-02, R18)"
    )
    without_application: Literal["announces", "listens"] = _option(
        "announces",
        "after the burst, with no application to start: goes on announcing, or is silent (RS-03)",
    )
    window_s: float = _option(0.2, "how long it listens after its last announcement (UP-04)")
    reset_delay_s: float = _option(0.05, "from reset or power to the first announcement")
    boot_version: str = _option("V1.0.0", "version text of the bootloader, 6 characters")

    # Update command and transfer.
    update_in_transfer: Literal["starts_over", "ignored"] = _option(
        "starts_over", "update command in the middle of a transfer (UP-08)"
    )
    bad_packet: Literal["nak_expected", "nak_received", "silence"] = _option(
        "nak_expected",
        "damaged or impossible packet: NAK with the number wanted, or the one it names (TX-01)",
    )
    repeated_packet: Literal["ack", "nak_next"] = _option(
        "ack", "the packet stored last, again: ACK n, or NAK n+1 (TX-02, R10)"
    )
    older_packet: Literal["ack", "nak", "silence"] = _option(
        "ack", "a packet stored before the last one (TX-03)"
    )
    pause_in_transfer: Literal["announces", "waits"] = _option(
        "announces", "a pause longer than transfer_timeout_s: waits on, or announces again (TX-12)"
    )
    transfer_timeout_s: float = _option(5.0, "the pause that pause_in_transfer is about")
    reset_in_transfer: Literal["ignored", "restarts"] = _option(
        "ignored", "reset during an upgrade (TX-13)"
    )

    # End.
    image_checksum: Literal["none", "crc32"] = _option(
        "none", "crc32: an image's last four bytes are the CRC-32 of the rest (EN-04, R7)"
    )
    repeated_end: Literal["same_answer", "silence"] = _option(
        "same_answer", "end of transfer again, once answered (EN-02)"
    )
    refused_hold_s: float = _option(1.0, "from refusing an image to announcing again")
    after_complete: Literal["starts", "restarts"] = _option(
        "starts", "starts the new application at once, or through the bootloader (EN-03)"
    )
    start_delay_s: float = _option(0.1, "from complete to the start of the new application")

    # Application.
    upgrade_in_application: Literal["general_feedback", "silence"] = _option(
        "general_feedback", "upgrade message that reaches the running application (R17)"
    )
    model: str = _option("BM36", "model text of the version information")
    serial_number: str = _option("W2605001", "serial number text of the version information")
    hardware_version: str = _option("V1r2r0_20220512", "hardware text of the version information")
    factory_version: str = _option("V1r0r0_20220512", "version of the first application")
    dialect: Literal["welling", "motinova"] = _option(
        WELLING.name, "document that its application speaks by"
    )
    older_battery: Literal["no", "yes"] = _option(
        "no", "yes: no state of health, no answer to 732 5300 and 742 5200 (section 6)"
    )
    silent_queries: str = _option(
        "none", "commands not answered, as 3800,732:5000: of all ids, or of one; parted by commas"
    )
    battery_use: Literal["riding", "resting"] = _option(
        "resting", "rides and charges in turn, or rests: a vehicle in use is not upgraded"
    )
    battery_seed: int = _option(1, "decides how the cells differ")
    faults: int = _option(0, "faults that are set from the start, as the 32 bits of 720 1204")
    idle_shutdown: Literal["off", "on"] = _option(
        "off",
        "switches off when the bus was idle for 30 min and the pack current small throughout (5.1)",
    )

    # Memory.
    application_area_bytes: int = _option(
        8 * 1024 * 1024, "size of the application area, whole pages: room for the largest image"
    )
    largest_image_bytes: int | None = _option(None, "largest image taken; none: the whole area")
    page_size_bytes: int = _option(2048, "what is erased at once")
    program_unit_bytes: int = _option(8, "what is programmed at once; divides a packet")
    erased_pages: Literal["needed", "all"] = _option(
        "needed", "pages of the application area erased for an image"
    )
    erase_time_s: float = _option(0.002, "time to erase one page")
    program_time_s: float = _option(0.001, "time to program one packet, or the final record")

    @property
    def image_limit_bytes(self) -> int:
        """Size of the largest image that is accepted."""
        limit = self.largest_image_bytes
        area = min(self.application_area_bytes, IMAGE_MAX_SIZE)
        return area if limit is None else min(limit, area)

    def is_silent_to(self, can_id: int, command: int) -> bool:
        """True for a query or write that `silent_queries` names."""
        return (None, command) in self._silent or (can_id, command) in self._silent

    @cached_property
    def _silent(self) -> frozenset[tuple[int | None, int]]:
        if self.silent_queries in {"", _NO_QUERIES}:
            return frozenset()
        return frozenset(map(_parse_query, self.silent_queries.split(",")))

    def __post_init__(self) -> None:
        for key, hint in _hints().items():
            _check(key, hint, getattr(self, key))
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


def set_option(profile: DeviceProfile, key: str, text: str) -> DeviceProfile:
    """`profile` with the option `key` set to what `text` says, as `flasher mock --set KEY=VALUE`.

    Whole numbers take 0x and the suffixes K and M. Raises UsageError, naming what is known, for
    an unknown key and for a value that is not allowed.
    """
    hints = _hints()
    if key not in hints:
        raise UsageError(
            f"the device model has no option {key!a}",
            where="--set",
            remedy=_suggest(key, list(hints)),
        )
    change: dict[str, Any] = {key: _parse(key, hints[key], text)}
    return dataclasses.replace(profile, **change)


def describe_options() -> list[tuple[str, str, str]]:
    """All options as (key, allowed values with the default first, one line of help)."""
    hints = _hints()
    return [
        (field.name, _describe_values(hints[field.name], field.default), field.metadata[_HELP])
        for field in dataclasses.fields(DeviceProfile)
    ]


# -- values ---------------------------------------------------------------------------------------


@cache  # evaluating them takes longer than all that is checked by them
def _hints() -> dict[str, Any]:
    """The types of all options."""
    return get_type_hints(DeviceProfile)


def _is_choice(hint: object) -> bool:
    return get_origin(hint) is Literal


def _is_optional(hint: object) -> bool:
    return isinstance(hint, types.UnionType)


def _check(key: str, hint: object, value: Any) -> None:
    if _is_choice(hint):
        if value not in get_args(hint):
            raise UsageError(
                f"{key} cannot be {value!a}", where=key, remedy=_suggest(value, get_args(hint))
            )
    elif isinstance(value, int | float) and not (0 <= value < math.inf):
        raise UsageError(f"{key} is a number from 0 on, not {value}", where=key)


def _parse(key: str, hint: object, text: str) -> object:
    if hint is str or _is_choice(hint):
        return text
    if _is_optional(hint) and text.lower() == "none":
        return None
    try:
        return float(text) if hint is float else _parse_size(text)
    except ValueError:
        raise UsageError(
            f"{key} is a number, not {text!a}",
            where="--set",
            remedy="write a number such as 0.05" if hint is float else "write 2048, 0x800 or 2K",
        ) from None


def _parse_query(text: str) -> tuple[int | None, int]:
    """`COMMAND` or `ID:COMMAND`, both in hexadecimal, as (id or None, command)."""
    can_id, _, command = text.strip().rpartition(":")
    try:
        return (int(can_id, 16) if can_id else None), int(command, 16)
    except ValueError:
        raise UsageError(
            f"silent_queries: {text!a} is no command", remedy="write 3800 or 732:5000"
        ) from None


def _parse_size(text: str) -> int:
    factor = _SUFFIXES.get(text[-1:].upper(), 1)
    return int(text[:-1] if factor > 1 else text, 0) * factor


def _describe_values(hint: object, default: object) -> str:
    if _is_choice(hint):
        others = [value for value in get_args(hint) if value != default]
        return " | ".join([str(default), *others])
    return "none" if default is None else str(default)


def _suggest(word: object, known: list[str] | tuple[str, ...]) -> str:
    close = difflib.get_close_matches(str(word), known, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}known: {', '.join(known)}"
