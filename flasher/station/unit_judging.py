"""What a unit says, held against what the recipe and the manifest allow; and in words."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Final

from flasher.host.identity import Check
from flasher.host.write import WritePlan, field_changes
from flasher.station import codes
from flasher.station.codes import Code
from flasher.station.records.model import Measurement
from flasher.station.run_model import StepFailedError
from flasher.station.unit_device import Identified, UnitDevice

SERIAL_ITEM: Final = "serial-number"
"""The item that gives a unit its number."""
_OF_CHECK: Final = {
    Check.HARDWARE: codes.WRONG_HARDWARE,
    Check.DOWNGRADE: codes.OLD_VERSION,
    Check.PREVIOUS: codes.OLD_VERSION,
    Check.IN_USE: codes.IN_USE,
}


def code_of(check: Check) -> Code:
    """The code of a check that speaks against the unit."""
    return _OF_CHECK.get(check, codes.NOT_FOR_DEVICE)


def check_texts(allowed: Sequence[str], found: str | None, code: Code) -> None:
    """Hold what a device says against patterns of a recipe. Raises StepFailedError."""
    if not allowed or found is None:
        return
    # Only * has a meaning in these patterns.
    plain = [each.replace("[", "[[]").replace("?", "[?]") for each in allowed]
    if not any(fnmatchcase(found, each) for each in plain):
        raise StepFailedError(code, f"It has {found}, the recipe lists {', '.join(allowed)}.")


def check_measured(measured: Sequence[Measurement]) -> None:
    """Hold measurements against their limits. Raises StepFailedError."""
    for each in measured:
        if not each.is_within:
            raise StepFailedError(codes.LIMIT, f"{each.name} is {_shown(each)}.")


def wanted_text(plan: WritePlan) -> str:
    """What is written, as the records show it."""
    return ", ".join(change.new for change in field_changes(plan, None))


def said_of(name: str, found: Identified) -> list[Measurement]:
    """What a device told of itself, as measurements without limits."""
    version = found.seen.version
    words = ("model", "serial_number", "hardware_version", "firmware_version")
    texts = {word: getattr(version, word, None) for word in words}
    return [
        Measurement(f"{name} {word.replace('_', ' ')}", text=str(text))
        for word, text in texts.items()
        if text is not None
    ]


def state_words(device: UnitDevice, found: Identified) -> str:
    """What a device is doing."""
    if found.is_in_bootloader:
        return f"in its bootloader {device.watcher.version}".strip()
    if found.seen.version is None:
        return "cannot be asked" if device.version_request is None else "silent"
    return found.seen.firmware_version or "answers"


def _shown(each: Measurement) -> str:
    if each.value is None:
        return f"{each.text!a}, expected is {each.expected!a}"
    low = "" if each.low is None else f"from {each.low:g} "
    high = "" if each.high is None else f"to {each.high:g}"
    return f"{each.value:g} {each.unit}; allowed is {low}{high}".strip()
