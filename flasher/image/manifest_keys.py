"""What a release manifest may state: every key once, with what it takes and a word on it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from flasher.errors import ImageError, did_you_mean
from flasher.protocol.spec import IMAGE_MAX_SIZE, TARGETS, Target, find_target
from flasher.protocol.text import (
    BOOT_VERSION_FORM,
    FIRMWARE_VERSION_FORM,
    FirmwareVersion,
    boot_version_number,
)

FORMAT_KEY: Final = "format"
FORMAT_VERSION: Final = 1
_SHA256: Final = re.compile(r"[0-9a-fA-F]{64}")


@dataclass(frozen=True)
class Key:
    """One key; `read` gives the value as `Release` holds it, or raises ValueError or TypeError."""

    allowed: str
    text: str
    read: Callable[[Any], object]
    required: bool = False


def read_value(key: str, value: object) -> Any:
    """The value of a key as `Release` holds it. Raises ValueError saying what is allowed."""
    known = KEYS[key]
    try:
        return known.read(value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{key} cannot be {value!a:.60}, it is {known.allowed}") from error


def explain_unknown(key: str, shown: str) -> ImageError:
    """The error for a key that is not known, with the one that was probably meant."""
    names = (FORMAT_KEY, *KEYS)
    suggestion = did_you_mean(key.lower(), names)
    return ImageError(
        f"The manifest has an unknown key {key!a:.60}.",
        where=shown,
        remedy=f"{suggestion}Known are: {', '.join(names)}.",
    )


def _target(value: object) -> Target:
    found = find_target(_text(value))
    if found is None:
        raise ValueError
    return found


def _size(value: object) -> int:
    if type(value) is not int:  # true and false are integers too
        raise TypeError
    if not 1 <= value <= IMAGE_MAX_SIZE:
        raise ValueError
    return value


def _sha256(value: object) -> str:
    if not _SHA256.fullmatch(_text(value)):
        raise ValueError
    return _text(value).lower()


def _notes(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    value.encode("utf-8")  # an argument that is no text in UTF-8 arrives with lone surrogates
    return value


def _text(value: object) -> str:
    """A text as a device sends them: printable ASCII, not empty."""
    if not isinstance(value, str):
        raise TypeError
    if not (value and value.isascii() and value.isprintable()):
        raise ValueError
    return value


def _texts(value: object) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise TypeError
    return tuple(_text(item) for item in value)


def _firmware_version(value: object) -> str:
    if FirmwareVersion.parse(_text(value)) is None:
        raise ValueError
    return _text(value)


def _boot_version(value: object) -> str:
    if boot_version_number(_text(value)) is None:
        raise ValueError
    return _text(value)


_FIRMWARE_VERSION: Final = f"a text of the form {FIRMWARE_VERSION_FORM}"
KEYS: Final[dict[str, Key]] = {
    "target": Key(
        f"one of {', '.join(TARGETS)}", "the device that the image is for", _target, required=True
    ),
    "firmware_version": Key(_FIRMWARE_VERSION, "the version inside the image", _firmware_version),
    "size_bytes": Key(
        f"a whole number from 1 to {IMAGE_MAX_SIZE}", "bytes to be sent", _size, required=True
    ),
    "sha256": Key("64 hex digits", "of the bytes to be sent", _sha256, required=True),
    "hardware_versions": Key(
        "a list of texts", "hardware that it fits; * stands for any text", _texts
    ),
    "minimum_boot_version": Key(
        f"a text of the form {BOOT_VERSION_FORM}",
        "the oldest bootloader that may receive it",
        _boot_version,
    ),
    "previous_from": Key(
        _FIRMWARE_VERSION, "the oldest running version that it may replace", _firmware_version
    ),
    "previous_except": Key("a list of texts", "running versions that it must not replace", _texts),
    "notes": Key("a text", "what a person should know", _notes),
}
"""In the order in which they are written."""
