"""Write of a data item: plan, result and read-back comparison.

A write succeeds if general feedback confirms it and the item reads back as written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flasher.errors import ErrorCode, FlasherError, UsageError, VerificationError
from flasher.host.items import (
    Writable,
    check_content,
    find_item,
    make_content,
    meaningful_fields,
    writable,
)
from flasher.protocol.fields import Content, label
from flasher.protocol.spec import BMS, WELLING, Dialect, Target
from flasher.validation import json_keys


@json_keys("old new read_back")
@dataclass(frozen=True)
class FieldChange:
    """Field of a write: old, new and read-back value; null if unknown."""

    name: str
    unit: str
    # Its value before, as wanted and as read back, each safe to show.
    old: str | None
    new: str
    read_back: str | None

    @property
    def differs(self) -> bool:
        """True if the field reads back differently than written."""
        return self.read_back is not None and self.read_back != self.new


@dataclass(frozen=True)
class WritePlan:
    """Item and content to write, planned without a bus."""

    target: Target
    dialect: Dialect
    writable: Writable
    content: Content


@dataclass(frozen=True)
class WriteResult:
    """Result of a write. Contents are None if not answered."""

    plan: WritePlan
    old: Content | None
    is_confirmed: bool
    read_back: Content | None

    @property
    def changes(self) -> tuple[FieldChange, ...]:
        """Old, new and read-back value of each field."""
        return field_changes(self.plan, self.old, self.read_back)

    @property
    def differences(self) -> tuple[FieldChange, ...]:
        """Fields that read back differently than written."""
        return tuple(change for change in self.changes if change.differs)

    def error(self) -> FlasherError | None:
        """Create the error for the result; None if it was confirmed and reads back as written."""
        name, node = self.plan.writable.name, self.plan.target.node.name
        different = self.differences
        if different:
            first = different[0]
            confirmed = "confirmed" if self.is_confirmed else "did not confirm"
            return VerificationError(
                f"The {node} {confirmed} the new {name}, but reads back {first.name}"
                f" {first.read_back!r} instead of {first.new!r}.",
                cause="the device refuses the value, or it is not writable in this state",
                remedy="Read it again after a power cycle; the old value may be in force.",
                code=ErrorCode.WRITE_DIFFERS,
            )
        if self.is_confirmed and self.read_back is not None:
            return None
        missing = "read it back" if self.is_confirmed else "confirm it"
        known = "; it does read back as written" if self.read_back is not None else ""
        return VerificationError(
            f"The {node} was sent the new {name} but did not {missing}{known}.",
            cause="the device went away, or it does not take this write",
            remedy=f"Check with: flasher read {name} -t {self.plan.target.name}",
            code=ErrorCode.WRITE_DIFFERS,
        )


def plan_write(
    name: str,
    values: Sequence[object],
    target: Target = BMS,
    *,
    dialect: Dialect = WELLING,
    manufacturer: bool = False,
) -> WritePlan:
    """Plan a write from one value per field, or from one complete content.

    Raises UsageError for an unknown name, for values that do not fit, and for items reserved for
    the manufacturer unless `manufacturer` is set.
    """
    chosen = find_item(name, writable(target, dialect), target, "write")
    if chosen.item.manufacturer_only and not manufacturer:
        raise UsageError(
            f"The document reserves writing the {chosen.name} for the manufacturer.",
            remedy="Add --manufacturer if that is you.",
        )
    if len(values) == 1 and isinstance(values[0], chosen.item.content):
        content: Content = values[0]
        check_content(chosen, content)
    else:
        content = make_content(chosen, values)
    return WritePlan(target, dialect, chosen, content)


def field_changes(
    plan: WritePlan, old: Content | None, read_back: Content | None = None
) -> tuple[FieldChange, ...]:
    """Return the fields of a write with their values before and after it."""
    return tuple(
        FieldChange(
            name=label(name, codec),
            unit=codec.unit,
            old=None if old is None else codec.show(getattr(old, name)),
            new=codec.show(getattr(plan.content, name)),
            read_back=None if read_back is None else codec.show(getattr(read_back, name)),
        )
        for name, codec in meaningful_fields(type(plan.content))
    )
