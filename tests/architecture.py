"""The drawing of the packages in docs/explanation/architecture.md, made from the imports.

    python -m tests.architecture

draws it anew; a test holds it against the code.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

_ROOT: Final = Path(__file__).parents[1]
PAGE: Final = _ROOT / "docs" / "explanation" / "architecture.md"
_MARKED: Final = re.compile(r"(<!-- packages -->\n).*?(<!-- end of packages -->)", re.DOTALL)
_EVERYWHERE: Final = frozenset({
    "documents", "errors", "events", "wording", "log", "files", "validation", "history",
    "python_can",
})  # fmt: skip
"""Small modules that many import: their arrows would hide the drawing."""


@cache
def imports() -> dict[str, set[str]]:
    """Which package or top-level module of flasher imports which others."""
    package = _ROOT / "flasher"
    found: dict[str, set[str]] = {}
    for path in package.rglob("*.py"):
        name = path.relative_to(package).with_suffix("").parts[0]
        if name in ("__init__", "__main__"):
            continue
        uses = found.setdefault(name, set())
        uses |= set(_uses(ast.parse(path.read_text(encoding="utf-8"))))
    return {name: uses & found.keys() - {name} for name, uses in found.items()}


def _uses(tree: ast.Module) -> Iterator[str]:
    for node in _statements(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "flasher":
            parts = (node.module or "").split(".")[1:]
            yield from parts[:1] or [each.name for each in node.names]
        elif isinstance(node, ast.Import):
            for each in node.names:
                if each.name.startswith("flasher."):
                    yield each.name.split(".")[1]


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements, also those of functions; an import is in no expression."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        nested = getattr(node, part, ())
        for each in nested if isinstance(nested, list) else ():
            yield each
            yield from _statements(each)


def drawing() -> str:
    """A Mermaid graph; an arrow that follows from others is left out."""
    edges = {
        name: {use for use in uses if use not in _EVERYWHERE}
        for name, uses in sorted(imports().items())
        if name not in _EVERYWHERE
    }
    lines = ["```mermaid", "flowchart TD"]
    for name, uses in edges.items():
        around = {far for use in uses for far in _reached(edges, use)}
        lines += [f"    {name} --> {use}" for use in sorted(uses - around)]
    return "\n".join([*lines, "```", ""])


def _reached(edges: dict[str, set[str]], start: str) -> set[str]:
    reached: set[str] = set()
    waiting = list(edges.get(start, ()))
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += edges.get(name, ())
    return reached


def page(text: str) -> str:
    """docs/explanation/architecture.md with its drawing made anew."""
    return _MARKED.sub(lambda match: f"{match[1]}{drawing()}{match[2]}", text)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
