"""What a target profile may set: every key once, with its type, range and help."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from flasher.errors import UsageError, did_you_mean
from flasher.host.options import PACKET_GAP_MAX_S
from flasher.image.plausible import Cpu
from flasher.protocol.spec import COMMAND_SIZE, IMAGE_MAX_SIZE, LENGTH_MAX, TARGETS
from flasher.protocol.timing import Timings

_TIME_LIMIT_S: Final = 3600.0
_TRIES_LIMIT: Final = 1000
_MAY_BE_ZERO: Final = frozenset(
    {
        "boot_version_spacing_s",
        "leftover_boot_version_s",
        "quiet_after_repeat_s",
        "update_spacing_s",
    }
)
"""Timings that may be left out; a timeout of zero would fail at once."""
_DATA_MAX: Final = LENGTH_MAX - COMMAND_SIZE


@dataclass(frozen=True)
class Key:
    """One key: `kind` is bool, int, float, bytes or an enumeration of words; numbers lie in
    `low` to `high`, both included, `low` excluded with `above`.
    """

    kind: type
    text: str
    low: float = 0
    high: float = math.inf
    above: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        if self.kind is bool:
            return "true or false"
        if self.kind is bytes:
            return f"a text in ASCII, or a list of bytes, of {_DATA_MAX} bytes at most"
        if issubclass(self.kind, Enum):
            return " or ".join(f'"{each.value}"' for each in self.kind)
        what = "a whole number" if self.kind is int else "a number"
        start = f"above {self.low:g}" if self.above else f"from {_number(self.low)}"
        return f"{what} {start} to {_number(self.high)}"


def _number(value: float) -> str:
    return f"0x{value:X}" if isinstance(value, int) and value > _TRIES_LIMIT else f"{value:g}"


def _timing(known: dataclasses.Field[Any]) -> Key:
    if isinstance(known.default, int):
        return Key(int, "how often at the most", 1, _TRIES_LIMIT)
    zero_is_fine = known.name in _MAY_BE_ZERO
    return Key(float, "seconds", 0, _TIME_LIMIT_S, above=not zero_is_fine)


GROUPS: Final = ("timings", "application_area", "version_query")
"""Keys that stand in tables of their own."""
KEYS: Final[dict[str, Key]] = {
    "has_upgrade": Key(bool, "upgrade even where the document has cancelled it"),
    "attempts": Key(int, "how often the upgrade may begin", 1, _TRIES_LIMIT),
    "timeout_s": Key(float, "overall deadline", 0, 24 * _TIME_LIMIT_S, above=True),
    "power_up_timeout_s": Key(float, "wait for a power cycle", 0, 24 * _TIME_LIMIT_S, above=True),
    "adapter_return_s": Key(float, "wait for a lost adapter", 0, _TIME_LIMIT_S),
    "cpu": Key(Cpu, "the device's processor; other: no vector table is looked for in images"),
    "low_charge_percent": Key(int, "warn below this state of charge", 0, 100),
    "in_use_ma": Key(int, "a discharge beyond this is a vehicle in use", 0, 0x7FFF),
    "frame_gap_s": Key(float, "silence between the frames of a message", 0, 1.0),
    "packet_gap_s": Key(float, "silence before each packet", 0, PACKET_GAP_MAX_S),
    "nak_next_is_ack": Key(bool, "NAK n+1 after a repeated packet n is ACK n (R10)"),
    "reset_command": Key(int, "restarts into the bootloader (R3)", 0, 0xFFFF),
    "reset_data": Key(bytes, "the data of reset_command"),
    "image_limit_bytes": Key(int, "the largest image", 1, IMAGE_MAX_SIZE),
    "application_area.start": Key(int, "address of the application", 0, 0xFFFF_FFFF),
    "application_area.size_bytes": Key(int, "size of the application's area", 1, 0xFFFF_FFFF),
    "version_query.command": Key(int, "asks for the version", 0, 0xFFFF),
    "version_query.answer_id": Key(int, "CAN id of the answer", 0, 0x7FF),
    "version_query.answer_command": Key(int, "command of the answer", 0, 0xFFFF),
    "version_query.offset": Key(int, "where the text begins in the data", 0, _DATA_MAX),
    "version_query.size_bytes": Key(int, "size of the text", 1, _DATA_MAX),
    **{f"timings.{known.name}": _timing(known) for known in dataclasses.fields(Timings)},
}


def read_value(key: str, value: object, file: str, prefix: str) -> Any:
    """The value of a key as `Profile` holds it. Raises UsageError."""
    known = KEYS[key]
    try:
        return _convert(known, value)
    except (ValueError, TypeError) as error:
        raise UsageError(
            f"{prefix}{key} cannot be {value!a:.60}.",
            where=file,
            remedy=f"It is {known.allowed}: {known.text}.",
        ) from error


def _convert(known: Key, value: object) -> object:
    """Raises ValueError or TypeError."""
    if known.kind is bytes:
        return _bytes(value)
    if issubclass(known.kind, Enum):
        return known.kind(value)
    if known.kind is bool or isinstance(value, bool):
        if known.kind is not bool or not isinstance(value, bool):
            raise TypeError
        return value
    if not isinstance(value, int) and (known.kind is int or not isinstance(value, float)):
        raise TypeError
    if not known.low <= value <= known.high or (known.above and value == known.low):
        raise ValueError
    return float(value) if known.kind is float else value


def _bytes(value: object) -> bytes:
    if isinstance(value, str):
        data = value.encode("ascii")
    elif isinstance(value, list) and not any(isinstance(item, bool) for item in value):
        data = bytes(value)
    else:
        raise TypeError
    if len(data) > _DATA_MAX:
        raise ValueError
    return data


def explain_unknown(key: str, file: str, prefix: str) -> UsageError:
    """The error for a key that is not known, with the one that was probably meant."""
    group, _, name = key.rpartition(".")
    where = f"{prefix}{group}".rstrip(".")
    place = f"in [{where}]" if where else "for every device"
    places = {known.rpartition(".")[2]: known for known in KEYS} | {name: name for name in GROUPS}
    suggestion = did_you_mean(name, places, lambda known: _spelled(places[known], prefix))
    siblings = [known for known in KEYS if known.rpartition(".")[0] == group]
    listed = ", ".join(known.rpartition(".")[2] for known in siblings)
    tables = "" if group else f"; tables: {', '.join(GROUPS)}"
    targets = "" if group or prefix else f", and one for each target: {', '.join(TARGETS)}"
    return UsageError(
        f"The profile has an unknown key {name!a} {place}.",
        where=file,
        remedy=f"{suggestion}Known here: {listed}{tables}{targets}.",
    )


def _spelled(key: str, prefix: str) -> str:
    group, _, name = key.rpartition(".")
    if key in GROUPS:
        return f"the table [{prefix}{key}]"
    return f"{name} in the table [{prefix}{group}]" if group else name
