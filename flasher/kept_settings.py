"""Settings of a device: items that may be written, saved before an upgrade, restored after it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Unpack

from flasher.api import CallOptions, Device
from flasher.errors import (
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    WrongDeviceError,
)
from flasher.host.items import Writable, make_content, readable, writable
from flasher.host.write import plan_write
from flasher.procedures import DeviceInfo
from flasher.protocol.fields import Content
from flasher.protocol.spec import Dialect, Target

_SERIAL: Final = "serial-number"


class SettingState(Enum):
    """What became of a setting."""

    KEPT = "kept"
    """It reads as before."""
    RESTORED = "restored"
    """It had changed, was written, and reads back as before."""
    CHANGED = "changed"
    """It has changed, and the documents reserve writing it for the manufacturer."""
    NOT_RESTORED = "not_restored"
    """It has changed, and could not be written."""
    UNKNOWN = "unknown"
    """It was not answered."""


@dataclass(frozen=True)
class SettingResult:
    """A setting after an upgrade."""

    name: str
    state: SettingState
    detail: str = ""
    """Why it could not be read or written; may be empty."""


@dataclass(frozen=True)
class Setting:
    """Value of a writable item."""

    shown: Mapping[str, str]
    """Fields as shown, by which two values are compared."""
    content: Content | None
    """Content to write; None for items that only the manufacturer may write, and for a text that
    a backup has in escaped form only."""


def settings_of(target: Target, dialect: Dialect) -> dict[str, Writable]:
    """Return the items of a target that a tool may write."""
    items = writable(target, dialect)
    return {name: each for name, each in items.items() if not each.item.manufacturer_only}


def settings_in(found: DeviceInfo) -> dict[str, Setting]:
    """Return the writable items of a device's answers."""
    answers = {reading.item: reading.answer for reading in found.readings}
    values: dict[str, Setting] = {}
    for name, entry in writable(found.target, found.dialect).items():
        answer = answers.get(entry.read_back.item)
        if answer is not None:
            shown = {field: codec.show(getattr(answer, field)) for field, codec in entry.fields}
            is_whole = isinstance(answer, entry.item.content)
            is_free = not entry.item.manufacturer_only
            values[name] = Setting(shown, answer if is_whole and is_free else None)
    return values


def settings_of_items(
    items: Mapping[str, Mapping[str, Any] | None], target: Target, dialect: Dialect
) -> dict[str, Setting]:
    """Return the settings in the items of a backup. Raises UsageError for a value that its item
    cannot have, LookupError for a missing field.
    """
    queries = {
        each.item: name for name, each in readable(target, dialect).items() if not each.field
    }
    values: dict[str, Setting] = {}
    for name, entry in writable(target, dialect).items():
        fields = items.get(queries[entry.read_back.item])
        if fields is None:
            continue
        given = [fields[field] for field, _ in entry.fields]
        shown = {field: str(value) for (field, _), value in zip(entry.fields, given, strict=True)}
        content = None
        if entry.item.manufacturer_only:
            shown = {field: codec.show(shown[field]) for field, codec in entry.fields}
        # An escape cannot be distinguished from a backslash of the text.
        elif not any("\\" in each for each in shown.values()):
            content = make_content(entry, given)
            shown = {field: codec.show(getattr(content, field)) for field, codec in entry.fields}
        values[name] = Setting(shown, content)
    return values


def restore_settings(
    device: Device,
    before: Mapping[str, Setting],
    *,
    allow_other_unit: bool = False,
    **watch: Unpack[CallOptions],
) -> Iterator[SettingResult]:
    """Compare the settings with those before, and write back those that changed and may be written.

    Raises NoAnswerError for a silent device, WrongDeviceError for another serial number than before
    unless `allow_other_unit`, InterruptedByUserError, and BusError for a failed adapter.
    """
    dialect, node = device.profile.dialect, device.target.node.name
    free = settings_of(device.target, dialect)
    now = settings_in(device.identify(**watch))
    if not now:
        raise NoAnswerError(
            f"The {node} answers no query: nothing was written.",
            remedy="A device in its bootloader needs an upgrade first: see flasher info.",
        )
    serials = [
        ", ".join(each[_SERIAL].shown.values()) if _SERIAL in each else "" for each in (before, now)
    ]
    if not allow_other_unit and (serials[0] != serials[1] or not serials[0].strip()):
        was, is_now = (ascii(each) if each.strip() else "none" for each in serials)
        raise WrongDeviceError(
            f"The {node} has the serial number {is_now}, and the settings are of {was}: nothing "
            "was written.",
            cause="another unit is connected, the upgrade has lost the serial number, or the unit "
            "never reported one",
            remedy="Connect the unit that they are of; flasher backup restore --force writes them "
            "to this one.",
        )
    for name, setting in before.items():
        present = now.get(name)
        if present is not None and present.shown == setting.shown:
            yield SettingResult(name, SettingState.KEPT)
        elif setting.content is not None:
            content = None if present is None else present.content
            yield _restored(device, name, setting.content, content, **watch)
        elif present is None:
            yield SettingResult(name, SettingState.UNKNOWN)
        elif name in free:
            why = "The backup has it in escaped form: write it with flasher write."
            yield SettingResult(name, SettingState.NOT_RESTORED, why)
        else:
            yield SettingResult(name, SettingState.CHANGED)


def _restored(
    device: Device, name: str, value: Content, now: Content | None, **watch: Unpack[CallOptions]
) -> SettingResult:
    plan = plan_write(name, [value], device.target, dialect=device.profile.dialect)
    try:
        error = device.write_planned(plan, now, **watch).error()
    except InterruptedByUserError:
        raise
    except FlasherError as failure:
        error = failure
    if error is not None:
        return SettingResult(name, SettingState.NOT_RESTORED, error.what)
    return SettingResult(name, SettingState.RESTORED)
