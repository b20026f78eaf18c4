"""Texts that a recipe fills in from the scan: `{serial}`, `{lot}`, `{date:%Y%m%d}`, `{match.week}`.

Not Python's own formatting, which reaches into objects: a template is data, and knows these words
and no others. `{{` and `}}` are the brackets themselves.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Final

DATE_DEFAULT: Final = "%Y%m%d"
_DATE_FORM: Final = re.compile(r"(?:%[YymdjGVu]|[0-9A-Za-z_ /-])+")
_PART: Final = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]|[^{}]+")
_GROUP: Final = "match."


@dataclass(frozen=True)
class Scan:
    """What is known of a unit before it is connected."""

    serial: str
    day: date
    """The day of production, where the station stands."""
    lot: str = ""
    groups: Mapping[str, str] = field(default_factory=dict)
    """The named groups of the serial number's pattern."""


def fill(template: str, scan: Scan) -> str:
    """The text of a template. Raises ValueError for a word that it does not know."""
    return "".join(_part(part, scan) for part in _PART.finditer(template))


def check(template: str, groups: Collection[str]) -> None:
    """Raises ValueError for a template that cannot be filled with these groups of the pattern."""
    fill(template, Scan("", date(2000, 1, 1), "", dict.fromkeys(groups, "")))


def uses_lot(template: str) -> bool:
    """True when the template needs a lot."""
    return any(part[1] == "lot" for part in _PART.finditer(template))


def _part(part: re.Match[str], scan: Scan) -> str:
    word = part[1]
    if word is None:
        if part[0] in ("{", "}"):
            raise ValueError(f"a bracket {part[0]} stands alone; write it twice for itself")
        return part[0][0] if part[0] in ("{{", "}}") else part[0]
    name, _, form = word.partition(":")
    if name == "date":
        form = form or DATE_DEFAULT
        if _DATE_FORM.fullmatch(form) is None:
            raise ValueError(f"{{{word}}} is no date: use %Y %y %m %d %j %G %V %u")
        return scan.day.strftime(form)
    if word == "serial":
        return scan.serial
    if word == "lot":
        return scan.lot
    if word.startswith(_GROUP) and word.removeprefix(_GROUP) in scan.groups:
        return scan.groups[word.removeprefix(_GROUP)]
    known = ["{serial}", "{lot}", "{date:%Y%m%d}", *(f"{{match.{g}}}" for g in scan.groups)]
    raise ValueError(f"{{{word}}} is not known: {', '.join(known)}")
