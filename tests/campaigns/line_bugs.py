"""Mistakes planted in the station, as data: `line_bugs.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

CHECKOUT: Final = Path(__file__).parents[2]
_BUGS: Final = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True)
class Edit:
    file: str
    """In the checkout."""
    old: str
    new: str


@dataclass(frozen=True)
class Bug:
    name: str
    breaks: str
    """Which promise, and how."""
    edits: Sequence[Edit]

    def modules(self) -> dict[str, str]:
        """The changed modules, by their files. Raises ValueError for an edit whose text is not in
        its file exactly once.
        """
        changed: dict[str, str] = {}
        for edit in self.edits:
            text = changed.get(edit.file) or (CHECKOUT / edit.file).read_text("utf-8")
            found = text.count(edit.old)
            if found != 1:
                raise ValueError(f"{self.name}: {edit.old!a} is {found} times in {edit.file}")
            changed[edit.file] = text.replace(edit.old, edit.new)
        return changed


def read_bugs() -> list[Bug]:
    tables = tomllib.loads(_BUGS.read_text("utf-8"))["bug"]
    return [
        Bug(table["name"], table["breaks"], [Edit(**edit) for edit in table["edit"]])
        for table in tables
    ]
