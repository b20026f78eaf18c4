"""Readable and writable data items of a device, by name: serial number, user strings, memory, ...

An item's name is the catalogue's title with dashes ("serial-number"). A writable item without its
own query (serial number, model) is read as a field of the version information.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from flasher.errors import UsageError, did_you_mean
from flasher.protocol import catalogue
from flasher.protocol.catalogue import Item
from flasher.protocol.contents import Empty
from flasher.protocol.fields import (
    BytesField,
    Codec,
    Content,
    DateField,
    ReservedField,
    WireText,
    label,
)
from flasher.protocol.spec import Dialect, Mode, Node, Target

_DATE: Final = re.compile(r"([0-9]{4})-?([0-9]{2})-?([0-9]{2})")


@dataclass(frozen=True)
class Readable:
    """Readable item: its query, and one field of the answer (empty for all fields)."""

    name: str
    item: Item
    field: str = ""

    @property
    def content(self) -> type[Content]:
        """Content type of the answer. Raises ValueError for an item without answer."""
        answer = catalogue.answer_of(self.item)
        if answer is None:
            raise ValueError(f"{self.item.name} has no answer")
        return answer.content


@dataclass(frozen=True)
class Writable:
    """Writable item, and the readable item that reads it back."""

    name: str
    item: Item
    read_back: Readable

    @property
    def fields(self) -> tuple[tuple[str, Codec], ...]:
        """Name and codec of each value to write."""
        return meaningful_fields(self.item.content)


def meaningful_fields(content: type[Content]) -> tuple[tuple[str, Codec], ...]:
    """Return name and codec of each field that is not reserved."""
    return tuple(
        (name, codec) for name, codec in content.LAYOUT if not isinstance(codec, ReservedField)
    )


def readable(target: Target, dialect: Dialect) -> dict[str, Readable]:
    """Return the readable items of a target by name, without memory."""
    queries = {
        name: Readable(name, item)
        for name, item in _named(target, dialect, Mode.READ)
        if item.content is Empty
    }
    single = {}
    for name, item in _named(target, dialect, Mode.WRITE):
        found = None if name in queries else _holder(item, queries)
        if found is not None:
            single[name] = found
    return queries | single


def writable(target: Target, dialect: Dialect) -> dict[str, Writable]:
    """Return the writable items of a target by name."""
    reads = readable(target, dialect)
    return {
        name: Writable(name, item, reads[name])
        for name, item in _named(target, dialect, Mode.WRITE)
    }


def _named(target: Target, dialect: Dialect, mode: Mode) -> list[tuple[str, Item]]:
    verb = f"{mode.name.lower()} "
    return [
        (item.title.removeprefix(verb).replace(" ", "-"), item)
        for item in catalogue.ITEMS
        if (item.sender, item.receiver, item.mode) == (Node.CDL, target.node, mode)
        and item.title.startswith(verb)
        and dialect in item.dialects
    ]


def _holder(item: Item, queries: Mapping[str, Readable]) -> Readable | None:
    """Find the query whose answer contains the only field that `item` writes."""
    (field, codec), *more = meaningful_fields(item.content)
    for query in queries.values():
        if not more and (field, codec) in query.content.LAYOUT:
            return Readable(field.replace("_", "-"), query.item, field)
    return None


NamedItem = TypeVar("NamedItem", Readable, Writable)


def find_item(name: str, among: Mapping[str, NamedItem], target: Target, verb: str) -> NamedItem:
    """Find an item by name. Raises UsageError with the closest name."""
    wanted = name.lower().replace("_", "-").replace(" ", "-")
    if wanted in among:
        return among[wanted]
    if not among:
        raise UsageError(
            f"The documents give the tool nothing to {verb} in the {target.node.name}.",
            remedy="Use -t bms; `flasher scan` shows what the other devices send by themselves.",
        )
    hint = did_you_mean(wanted, among)
    raise UsageError(
        f"There is nothing called {name!a} to {verb} in the {target.node.name}.",
        remedy=f"{hint}There are: {', '.join(among)}.",
    )


# -- values from a person -------------------------------------------------------------------------


def make_content(writable: Writable, values: Sequence[object]) -> Content:
    """Create the content of a write from one value per field: text, a date (YYYYMMDD), or bytes in
    hexadecimal.

    Raises UsageError if a value is missing, superfluous, or does not fit its field.
    """
    fields = writable.fields
    names = " ".join(label(name, codec).upper().replace(" ", "_") for name, codec in fields)
    if len(values) != len(fields):
        given = "no value was" if not values else f"{len(values)} were"
        raise UsageError(
            f"{writable.name} takes {len(fields)} value{'s' * (len(fields) > 1)}; {given} given.",
            remedy=f"Write: flasher write {writable.name} {names}",
        )
    by_name = {
        name: _value(label(name, codec), codec, value)
        for (name, codec), value in zip(fields, values, strict=True)
    }
    return check_content(writable, writable.item.content(**by_name))


def check_content(writable: Writable, content: Content) -> Content:
    """Return the content as it is read back. Raises UsageError if a value does not fit."""
    try:
        return content.from_data(content.data())
    except ValueError as error:
        raise UsageError(f"{writable.name}: {error}.") from error


def _value(name: str, codec: Codec, value: object) -> Any:
    is_bytes = isinstance(codec, BytesField)
    wanted = f"{codec.size_bytes} bytes in hexadecimal" if is_bytes else "a text"
    if isinstance(codec, DateField) and isinstance(value, str):
        return check_date(value)
    if is_bytes and isinstance(value, str):
        try:
            return bytes.fromhex(value.removeprefix("0x").replace(":", " "))
        except ValueError as error:
            raise UsageError(f"{name}: {value!a} is not {wanted}.") from error
    if not isinstance(value, bytes | bytearray if is_bytes else str | WireText):
        raise UsageError(f"{name}: {value!a} is not {wanted}.")
    return value


def check_date(text: str) -> str:
    """Convert a date to YYYYMMDD. Raises UsageError for an invalid date."""
    match = _DATE.fullmatch(text)
    if match is None:
        raise UsageError(f"date: {text!a} is not a date YYYYMMDD.")
    try:
        datetime.date(*map(int, match.groups()))
    except ValueError as error:
        raise UsageError(f"date: {text!a} is not in the calendar: {error}.") from error
    return "".join(match.groups())
