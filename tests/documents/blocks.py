"""The blocks of a page."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
LANGUAGES: Final = frozenset({"sh", "console", "python", "toml"})
"""Of blocks that are run, or say why not."""
_FENCE: Final = re.compile(r"^```([\w-]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_MARKS: Final = re.compile(r"((?:<!-- [^\n]*-->\n)+)\Z")
_MARK: Final = re.compile(r"<!-- ([a-z ]+): (.*?) -->\n")


@dataclass(frozen=True)
class Block:
    """One block of code."""

    line: int
    language: str
    text: str
    marks: Mapping[str, str]


def pages() -> list[Path]:
    """Every page that is written by hand or drawn."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def blocks(text: str) -> Iterator[Block]:
    """The blocks of a page that are to be run."""
    for match in _FENCE.finditer(text):
        if match[1] not in LANGUAGES:
            continue
        above = _MARKS.search(text[: match.start()])
        marks = dict(_MARK.findall(above[1])) if above else {}
        yield Block(text.count("\n", 0, match.start()) + 1, match[1], match[2], marks)
