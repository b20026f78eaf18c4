"""Plants mistakes in the running process, to show that a campaign finds them.

A mistake is an edit or two of source files. `Bug.codes` compiles the edited files, `swapped` gives
their code to the functions that they change: wherever a function is referenced, it makes the
mistake. Neither a file nor another process changes. A generator that runs keeps its code.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType
from typing import Final

from flasher.files import parse_toml

ROOT: Final = Path(__file__).parents[2]
"""Directory of the installed package `flasher`."""
_UPGRADE_BUGS: Final = Path(__file__).with_name("planted_bugs.toml")
Codes = dict[FunctionType, CodeType]
"""Functions, each with the code to be exchanged for its own."""


@dataclass(frozen=True)
class Edit:
    """Replacement in a source file; its path begins with `flasher/`."""

    file: str
    old: str
    """Text that is in the file exactly once."""
    new: str


@dataclass(frozen=True)
class Bug:
    """Mistake to plant: a name, a sentence about what it breaks, and its edits."""

    name: str
    breaks: str
    edits: Sequence[Edit]

    def modules(self) -> dict[str, str]:
        """Return the text of each changed file. Raises ValueError for an edit whose text is not in
        its file exactly once.
        """
        changed: dict[str, str] = {}
        for edit in self.edits:
            text = changed.get(edit.file) or _read(edit.file)
            found = text.count(edit.old)
            if found != 1:
                raise ValueError(f"{self.name}: {edit.old!a} is {found} times in {edit.file}")
            changed[edit.file] = text.replace(edit.old, edit.new)
        return changed

    def codes(self) -> Codes:
        """Return the code of each function that the edits change, for `swapped`.

        Raises ValueError if the result is not Python; if they change nothing, or more than bodies
        of functions (constants, tables, parameters); a function that uses other variables of its
        surroundings, or one that is not in this process as in its file.
        """
        changed: Codes = {}
        for file, text in self.modules().items():
            original = _read(file)
            try:
                is_inside = _outside_of_functions(text) == _outside_of_functions(original)
            except SyntaxError as error:
                raise ValueError(f"{self.name}: {file} is not Python any more: {error}") from error
            if not is_inside:
                raise ValueError(f"{self.name}: changes more than bodies of functions in {file}")
            module = import_module(file.removesuffix(".py").replace("/", "."))
            for old, new in zip(_codes(original, file), _codes(text, file), strict=True):
                if _differ(old, new):
                    where = f"{self.name}: {old.co_qualname} in {file}"
                    function = _find(vars(module), old)
                    if function is None:
                        raise ValueError(f"{where} is not in this process as in its file")
                    if new.co_freevars != old.co_freevars:
                        raise ValueError(f"{where} uses other variables of its surroundings")
                    changed[function] = new
        if not changed:
            raise ValueError(f"{self.name}: changes no function")
        return changed


@dataclass(frozen=True)
class UpgradeBug(Bug):
    """Mistake in what makes an upgrade."""

    part: str
    """Where it is: "host", "bootloader", "driver", "bus" or "image"."""
    kind: str
    """Violation with which its plan ends (`flasher.simulate.oracle.Violation`)."""
    plan: str
    """Plan that has no violation without it (`flasher.simulate.plan.Plan`)."""


def upgrade_bugs() -> list[UpgradeBug]:
    """Return the mistakes that a campaign of upgrades has to find."""
    tables = parse_toml(_UPGRADE_BUGS.read_bytes())["bug"]
    return [
        UpgradeBug(
            table["name"],
            table["breaks"],
            [Edit(**edit) for edit in table["edit"]],
            table["part"],
            table["kind"],
            " ".join(table["plan"].split()),
        )
        for table in tables
    ]


@contextmanager
def swapped(codes: Codes) -> Iterator[None]:
    """Plant a mistake for the duration of the block; inside such a block, take it out."""
    _swap(codes)
    try:
        yield
    finally:
        _swap(codes)


def _swap(codes: Codes) -> None:
    for function, code in codes.items():
        codes[function], function.__code__ = function.__code__, code


def _read(file: str) -> str:
    return (ROOT / file).read_text("utf-8")


@cache
def _codes(text: str, file: str) -> Sequence[CodeType]:
    """Codes of the functions and methods of a file with this text."""
    return tuple(_codes_in(compile(text, ROOT / file, "exec", dont_inherit=True)))


@cache
def _outside_of_functions(text: str) -> str:
    """Describe a module without the bodies of its functions and without positions."""
    tree = ast.parse(text)
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = []
        waiting += ast.iter_child_nodes(node)
    return ast.dump(tree)


def _codes_in(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of each function of a module or a class, in order. It contains those of the
    functions inside.
    """
    for each in code.co_consts:
        if isinstance(each, CodeType):
            if each.co_flags & inspect.CO_OPTIMIZED:
                yield each
            else:
                yield from _codes_in(each)


def _find(names: Mapping[str, object], code: CodeType) -> FunctionType | None:
    """Find the function of a module that has this code: plain, decorated, or in a property."""
    *classes, last = code.co_qualname.split(".")
    for each in classes:
        names = vars(names.get(each, object))
    found = names.get(last)
    for part in (found, *(getattr(found, key, None) for key in ("fget", "fset", "fdel", "func"))):
        function = inspect.unwrap(part)  # type: ignore[arg-type]  # it takes any object
        if isinstance(function, FunctionType) and not _differ(function.__code__, code):
            return function
    return None


def _differ(one: CodeType, other: CodeType) -> bool:
    """Compare what two codes do, not where they are."""
    if len(one.co_consts) != len(other.co_consts) or _shape(one) != _shape(other):
        return True
    return any(
        _differ(a, b)
        if isinstance(a, CodeType) and isinstance(b, CodeType)
        else (type(a), a) != (type(b), b)
        for a, b in zip(one.co_consts, other.co_consts, strict=True)
    )


def _shape(code: CodeType) -> tuple[object, ...]:
    variables = code.co_varnames, code.co_freevars, code.co_cellvars
    handlers = getattr(code, "co_exceptiontable", b"")  # PyPy has them in co_code
    return code.co_code, code.co_names, handlers, *variables
