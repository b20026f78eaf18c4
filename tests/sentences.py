"""Finds the English sentences in modules whose errors, notes and stories a page can show.

A string constant is a sentence as it is; an f-string is one with its values as {name}. A page finds
the sentence of a text again by this form (`flasher.translation`).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parent.parent / "flasher"
_SHOWN: Final = (
    "procedures", "files", "bus/adapter", "bus/bit_rate", "bus/health", "bus/lock", "bus/opening",
    "bus/simulated", "host/event_text", "host/guard", "host/identity", "host/outcome",
    "host/query", "host/session", "host/upgrade", "host/verify", "image/cortexm", "image/elf",
    "image/load", "image/plausible", "image/records", "image/release", "image/segments",
    "settings/bike_set", "settings/manifest",
    "trace/blf", "trace/bounds", "trace/explain", "trace/mf4", "trace/observed_upgrade",
    "trace/pcapng",
    "trace/reader", "trace/source", "trace/steps", "trace/verdict", "report/base",
    "report/chart", "report/explain_page", "report/sequence", "station/certificate_check",
    "station/continuity", "station/recipe", "station/power", "station/sealed", "station/stories",
    "station/unit_*", "station/worker", "station/records/errors", "station/records/examination",
    "station/records/files", "station/records/proof", "station/records/queries",
    "web/archive", "web/bench", "web/bench_backup", "web/bench_bike",
    "web/bench_compare", "web/series", "web/supervisor", "cli/look/info", "cli/upgrade/bench_page",
)  # fmt: skip
_NOT_SHOWN: Final = (
    "text", "wording_of", "json_keys", "compile", "debug", "info", "warning", "exception",
    "typeerror", "runtimeerror", "assertionerror", "keyerror",
)  # fmt: skip
"""Calls with strings that are in the catalogue already, or that no page shows."""
_SENTENCE: Final = re.compile(
    r"[A-Za-z]{2,}.* .*[a-z]{2,}|^[A-Za-z]{3,}:? \{|\}[:,;]? [A-Za-z]{3,}"
)
_CODE: Final = re.compile(r"SELECT |PRAGMA |<|\.\w+ |text/|chmod |cp |\{\w+:%")


def spoken() -> Iterator[str]:
    """Every sentence, with its values in braces."""
    for path in sorted({path for each in _SHOWN for path in ROOT.glob(f"{each}.py")}):
        tree = ast.parse(path.read_text("utf-8"))
        for sentence in _strings(tree):
            bare = re.sub(r"\{[^{}]*\}", "{}", sentence)
            if _SENTENCE.search(bare) and not _CODE.match(sentence):
                yield sentence.strip()


def _strings(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return  # a docstring
    if isinstance(node, ast.Call) and _name(node.func) in _NOT_SHOWN:
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value.replace("{}", "{value}")
    if isinstance(node, ast.JoinedStr):
        yield _template(node)
        for part in node.values:
            if isinstance(part, ast.FormattedValue):
                yield from _strings(part.value)
        return
    for child in ast.iter_child_nodes(node):
        yield from _strings(child)


def _template(node: ast.JoinedStr) -> str:
    parts: list[str] = []
    names: dict[str, str] = {}
    for part in node.values:
        if isinstance(part, ast.Constant):
            parts.append(str(part.value).replace("{", "{{").replace("}", "}}"))
            continue
        assert isinstance(part, ast.FormattedValue)
        name = names.setdefault(ast.unparse(part.value), _name(part.value))
        taken = [each for each in names.values() if each == name]
        if len(taken) > 1:
            name = names[ast.unparse(part.value)] = f"{name}_{len(names)}"
        spec = "".join(
            getattr(each, "value", "")
            for each in getattr(part.format_spec, "values", ())
            if isinstance(each, ast.Constant)
        )
        parts.append(f"{{{name}{':' if spec else ''}{spec}}}")
    return "".join(parts)


def _name(value: ast.AST) -> str:
    """A name for a value: of its variable, attribute or function's argument."""
    match value:
        case ast.Name(id=name):
            return name.strip("_").lower()
        case ast.Attribute(attr="name" | "value" | "words", value=inner):
            return _name(inner)
        case ast.Attribute(attr=name):
            return name.strip("_").lower()
        case ast.Call(args=[first, *_]):
            return _name(first)
        case ast.IfExp() | ast.BinOp() if any(
            isinstance(each, ast.Constant) and each.value == "s" for each in ast.walk(value)
        ):
            return "s"
        case ast.IfExp(body=inner) | ast.Call(func=inner) | ast.Subscript(value=inner):
            return _name(inner)
        case ast.BinOp(left=inner) | ast.BoolOp(values=[inner, *_]):
            return _name(inner)
        case _:
            return "value"
