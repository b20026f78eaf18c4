"""Runs each package's own tests on mutants of it: `python -m tests.campaigns.mutants --count 150
--seed 1`, or `--all --module flasher/driver.py`. Prints the mutants that survive, and the scores.

A mutant is one change of one statement. Not changed is what tests of behaviour cannot see: texts,
annotations, decorators, bases, assertions (`raise RuntimeError` is one), `__all__`, the declaration
of attributes in `__init__` (their values are changed), the order of the table's moves. The checkout
stays as it is: mutants live in a copy in a temporary folder. The tests that run a changed line are
tried, the quickest first. A mutant is killed by a failed test, and by far more computing time or
memory than its package's tests need. Tests marked `no_cover` are left out: they play random worlds
and take longer than all others together.

`mutants_excused.txt` lists the mutants that nothing can tell from the original, with reasons.
"""

from __future__ import annotations

import argparse
import ast
import builtins
import functools
import json
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import coverage
import hypothesis  # loaded here once, not in each process that is forked
import pytest

import flasher.cli.main  # noqa: F401  for the libraries: a process loads its own flasher again

CHECKOUT: Final = Path(__file__).parents[2]
EXCUSED: Final = Path(__file__).with_name("mutants_excused.txt")
OWN_TESTS: Final = {
    "flasher/bus/echoes.py": ("tests/bus/test_echoes.py",),
    "flasher/driver.py": ("tests/bus/test_driver.py", "tests/api/test_async.py"),
    "flasher/host": (
        "tests/host",
        "tests/peers",
        "tests/api/test_requests.py",
        "tests/cli/test_progress.py",
        "tests/cli/test_read_write.py",
        "tests/cli/test_two_devices.py",
        "tests/test_wording.py",
    ),
    "flasher/image": ("tests/image",),
    "flasher/protocol": ("tests/protocol", "tests/peers"),
}
"""The tests that are a package's own."""
REQUIRED: Final = 0.95
QUICKEST_TESTS: Final = 30
"""As many are tried before the others are collected."""
MEMORY_BYTES: Final = 4 << 30
WAIT_S: Final = 900
"""A mutant that waits and does not compute is killed after this."""
CONTEXT: Final = 60
"""Characters of a long line that are shown on each side of what is changed."""
MEASURED: Final = "measured.json"
OUTPUT: Final = "output.txt"

# -- what is changed ------------------------------------------------------------------------------

COMPARISONS: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
UNORDERED: Final = ("_do", "run.also_listen_on", "run.listen_always")
"""Functions whose arguments may stand in any order."""
OPPOSITES: Final = {"min": "max", "max": "min", "any": "all", "all": "any"}
CONDITIONS: Final = ("test", "ifs", "guard")
UNSEEN: Final = ("annotation", "returns", "decorator_list", "bases", "keywords", "type_params")
"""Fields of functions, classes and annotated names."""
REMOVED: Final = (ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Delete, ast.Expr, ast.Raise)


def changed_expressions(node: ast.AST) -> Iterator[ast.expr]:
    """As replacements of an expression."""
    match node:
        case ast.Compare(ops=operators):
            for place, operator in enumerate(operators):
                for other in COMPARISONS[type(operator)]:
                    ops = [*operators[:place], other(), *operators[place + 1 :]]
                    yield ast.Compare(node.left, ops, node.comparators)
        case ast.BoolOp():
            yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        case ast.UnaryOp(op=ast.Not()):
            yield node.operand
        case ast.BinOp() if type(node.op) in OPERATORS and not is_type(node):
            yield ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
        case ast.Constant(value=value):
            yield from map(ast.Constant, changed_constants(value))
        case ast.Call(func=ast.Name(id=name)) if name in OPPOSITES:
            yield ast.Call(ast.Name(OPPOSITES[name]), node.args, node.keywords)
        case ast.Call(args=args) if ast.unparse(node.func) not in UNORDERED:
            for place, (one, two) in enumerate(pairwise(args)):
                if not is_text(one) and not is_text(two) and ast.dump(one) != ast.dump(two):
                    swapped = [*args[:place], two, one, *args[place + 2 :]]
                    yield ast.Call(node.func, swapped, node.keywords)


def changed_constants(value: object) -> list[float]:
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1]
    return [value * 2, value / 2] if isinstance(value, float) and value else []


def changed_statements(node: ast.AST) -> Iterator[ast.stmt]:
    """As replacements of a statement of a function."""
    match node:
        case ast.Return(value=ast.Constant(value=None | bool())):
            pass  # None is as false; the value is changed by itself
        case ast.Return(value=ast.expr()):
            yield ast.Return(ast.Constant(None))
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()
        case ast.AugAssign() if type(node.op) in OPERATORS:
            yield ast.AugAssign(node.target, OPERATORS[type(node.op)](), node.value)
    if isinstance(node, REMOVED):
        yield ast.Pass()


def is_type(node: ast.AST) -> bool:
    """A union of types, such as `Message | None`."""
    match node:
        case ast.BinOp(op=ast.BitOr()):
            return is_type(node.left) and is_type(node.right)
        case ast.Subscript():
            return is_type(node.value)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            is_class_name = name[:1].isupper() and not name.isupper()
            return is_class_name or isinstance(getattr(builtins, name, None), type)
    return isinstance(node, ast.Constant) and node.value is None


def is_declared(node: ast.AST, names: tuple[str, ...]) -> bool:
    """The declaration of an attribute."""
    return isinstance(node, ast.Assign | ast.AnnAssign) and names[-1] == "__init__"


def is_text(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value=str()) | ast.JoinedStr() | ast.Call(func=ast.Name(id="say")):
            return True
    return False


def is_unseen(node: ast.AST) -> bool:
    match node:
        case ast.JoinedStr() | ast.Assert() | ast.Expr(value=ast.Constant()):
            return True
        case ast.Expr(value=ast.Call(func=ast.Name("assert_never"))):
            return True
        case ast.Raise(exc=ast.Call(func=ast.Name("RuntimeError"))):
            return True
        case ast.Assign(targets=[ast.Name("__all__")]) | ast.AnnAssign(value=None):
            return True
        case ast.If(test=ast.Name("TYPE_CHECKING")):
            return True
        case ast.ClassDef():
            return any(ast.unparse(base).startswith("Protocol") for base in node.bases)
    return False


@dataclass(frozen=True)
class Mutant:
    """One change of a module."""

    path: str
    key: tuple[str, ...]
    """Path and place in the module, then the change: no line numbers."""
    lines: range
    """Of the statement, or of the head of a compound one."""
    write: Callable[[], str]
    """Gives the changed module."""

    def __str__(self) -> str:
        place, *diff = self.key
        where = place.removeprefix(self.path)
        return "\n    ".join([f"{self.path}:{self.lines.start}{where}", *diff])


class Module:
    """Finds the mutants of a module."""

    def __init__(self, path: str, text: str) -> None:
        self._path = path
        self._tree = ast.parse(text)
        self._alike: Counter[tuple[str, ...]] = Counter()

    def mutants(self) -> Iterator[Mutant]:
        return self._mutants(self._tree, (), self._tree)

    def _mutants(self, node: ast.AST, names: tuple[str, ...], around: ast.AST) -> Iterator[Mutant]:
        """`names` are of the functions and classes around a node, `around` is the innermost
        statement.
        """
        for field, value in ast.iter_fields(node):
            if field in UNSEEN and not isinstance(node, ast.Call):
                continue
            children = value if isinstance(value, list) else [value]
            for place, child in enumerate(children):
                if not isinstance(child, ast.AST) or is_unseen(child):
                    continue
                others: list[ast.AST] = [*changed_expressions(child)]
                if field in CONDITIONS and isinstance(child, ast.Name | ast.Attribute | ast.Call):
                    others.append(ast.UnaryOp(ast.Not(), child))
                if names and not isinstance(node, ast.ClassDef) and not is_declared(child, names):
                    others += changed_statements(child)
                is_statement = isinstance(child, ast.stmt | ast.match_case)
                statement = child if is_statement else around
                before = ast.unparse(statement) if others else ""
                for other in others:
                    whole = [*children[:place], other, *children[place + 1 :]]
                    new = whole if isinstance(value, list) else other
                    write = functools.partial(unparse_changed, node, field, new)
                    after = ast.unparse(other) if is_statement else write(statement)
                    key = self._key(names, before, after)
                    write_all = functools.partial(write, self._tree)
                    yield Mutant(self._path, key, head_lines(statement), write_all)
                inside = names
                if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                    inside = (*names, child.name)
                yield from self._mutants(child, inside, statement)

    def _key(self, names: tuple[str, ...], before: str, after: str) -> tuple[str, ...]:
        """Mutants of one place that look alike are numbered."""
        place = " ".join([self._path, ".".join(names)]).strip()
        key = (place, *short_diff(before, after))
        self._alike[key] += 1
        count = self._alike[key]
        return key if count == 1 else (f"{place} #{count}", *key[1:])


def alike_characters(one: str, two: str) -> int:
    pairs = enumerate(zip(one, two, strict=False))
    return next((at for at, (a, b) in pairs if a != b), min(len(one), len(two)))


def short_diff(before: str, after: str) -> list[str]:
    """The line that differs, or of a long one what is near the difference."""
    alike = alike_characters(before, after)
    tail = alike_characters(before[alike:][::-1], after[alike:][::-1])
    begin = max(before.rfind("\n", 0, alike) + 1, alike - CONTEXT)
    lines = []
    for sign, text in (("-", before), ("+", after)):
        differs, rest = text[begin : len(text) - tail], text[len(text) - tail :]
        line = differs + rest.partition("\n")[0][:CONTEXT]
        lines.append(f"{sign} {' '.join(line.split())}")
    return lines


def unparse_changed(node: ast.AST, field: str, value: object, tree: ast.AST) -> str:
    """`tree` as text, with another value in a field of one of its nodes."""
    kept = getattr(node, field)
    setattr(node, field, value)
    try:
        return ast.unparse(tree)
    finally:
        setattr(node, field, kept)


def head_lines(statement: Any) -> range:
    first = getattr(statement, "pattern", statement).lineno
    body = getattr(statement, "body", None)
    return range(first, max(first + 1, body[0].lineno if body else statement.end_lineno + 1))


def read_excused() -> dict[tuple[str, ...], str]:
    """The reason for each mutant that nothing can tell from the original."""
    reasons = {}
    for entry in EXCUSED.read_text().split("\n\n"):
        lines = [line for line in entry.splitlines() if line and not line.startswith("#")]
        key = tuple(line for line in lines if not line.startswith(" "))
        if key:
            reasons[key] = " ".join(line.strip() for line in lines if line.startswith(" "))
    return reasons


# -- how it is tested -----------------------------------------------------------------------------


class Measured:
    """A pytest plugin that measures how long each test takes and which lines it runs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._took_s: dict[str, float] = defaultdict(float)
        self._coverage = coverage.Coverage(data_file=None, include=[f"{folder}/flasher/*"])
        self._coverage.start()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._coverage.switch_context(nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._took_s[report.nodeid] += report.duration

    def pytest_sessionfinish(self) -> None:
        self._coverage.stop()
        data = self._coverage.get_data()
        tests = {
            str(Path(path).relative_to(self._folder)): data.contexts_by_lineno(path)
            for path in data.measured_files()
        }
        spent_s = time.process_time()
        (self._folder / MEASURED).write_text(json.dumps([self._took_s, tests, spent_s]))


class Chosen:
    """A pytest plugin that runs some tests only, in this order."""

    def __init__(self, tests: Sequence[str]) -> None:
        self._places = {test: place for place, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._places]
        items.sort(key=lambda item: self._places[item.nodeid])


class Ground:
    """A copy of the checkout, in which the tests of a package run."""

    def __init__(self, folder: Path, package: str) -> None:
        self._folder = folder
        self._tests = OWN_TESTS[package]
        self._limit_s = self._test_s = WAIT_S
        if self._run(self._tests, lambda: Measured(folder), keeps_bytecode=True):
            output = (folder / OUTPUT).read_text(errors="replace")
            sys.exit(f"The tests of {package} fail without any mutant:\n{output[-3000:]}")
        took_s, self._covering, spent_s = json.loads((folder / MEASURED).read_text())
        self._took_s: dict[str, float] = took_s
        self._limit_s = 10 + 2 * int(spent_s)
        self._test_s = 10 + int(8 * max(took_s.values()))

    def kills(self, mutant: Mutant) -> bool:
        by_line = self._covering.get(mutant.path, {})
        runs = [by_line[str(line)] for line in mutant.lines if str(line) in by_line]
        if not runs:
            return False
        first = sorted(
            {test for tests in runs for test in tests if test}, key=self._took_s.__getitem__
        )
        quick = first[:QUICKEST_TESTS]
        module = self._folder / mutant.path
        original, times = module.read_bytes(), module.stat()
        module.write_text(mutant.write())
        try:
            # What runs at import may change any test.
            is_killed = self._fails(quick) if first else bool(self._run(self._tests))
            return is_killed or (first != quick and self._fails(first))
        finally:
            module.write_bytes(original)
            os.utime(module, ns=(times.st_atime_ns, times.st_mtime_ns))  # for its bytecode

    def _fails(self, tests: Sequence[str]) -> bool:
        files = sorted({test.partition("::")[0] for test in tests})
        return bool(self._run(files, lambda: Chosen(tests)))

    def _run(
        self,
        tests: Sequence[str],
        plugin: Callable[[], object] = object,
        *,
        keeps_bytecode: bool = False,
    ) -> int | None:
        """Run tests in a process of their own; returns its exit code."""

        def child() -> None:
            sys.dont_write_bytecode = not keeps_bytecode
            resource.setrlimit(resource.RLIMIT_CPU, (self._limit_s, self._limit_s + 5))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
            with (self._folder / OUTPUT).open("wb") as output:
                os.dup2(output.fileno(), 1)
                os.dup2(output.fileno(), 2)
            os.chdir(self._folder)
            os.environ["PYTHONPATH"] = sys.path[0] = str(self._folder)
            for name in [*sys.modules]:
                if name.partition(".")[0] in {"flasher", "tests"}:
                    del sys.modules[name]
            # A busy machine is no failure.
            hypothesis.settings.register_profile("mutants", deadline=None)
            hypothesis.settings.load_profile("mutants")
            words = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
            words += ["-m", "not no_cover", "-W", "ignore:Module already imported"]
            words += ["--basetemp", str(self._folder / "temporary"), "--timeout", str(self._test_s)]
            sys.exit(int(pytest.main([*words, *tests], plugins=[plugin()])))

        process = multiprocessing.get_context("fork").Process(target=child)
        process.start()
        process.join(WAIT_S)
        process.kill()
        process.join()
        return process.exitcode


def every_mutant(folder: Path) -> dict[str, list[Mutant]]:
    """All mutants of each package."""
    found: dict[str, list[Mutant]] = {}
    for package in OWN_TESTS:
        place = folder / package
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            module = Module(str(path.relative_to(folder)), path.read_text())
            found.setdefault(package, []).extend(module.mutants())
    return found


def say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def score(what: str, outcomes: Counter[str]) -> str:
    counted = outcomes["killed"] + outcomes["survived"]
    share = outcomes["killed"] / counted if counted else 1.0
    also = f", {outcomes['excused']} excused" if outcomes["excused"] else ""
    return f"{what:24} {outcomes['killed']:5} of {counted:5} killed: {share:.1%}{also}"


def try_all(
    ground: Ground, package: str, mutants: Sequence[Mutant], excused: Set[tuple[str, ...]]
) -> Counter[str]:
    """Run a package's tests on its mutants; print those that survive, and wrong excuses."""
    outcomes: Counter[str] = Counter()
    for number, mutant in enumerate(mutants, 1):
        is_killed = ground.kills(mutant)
        is_excused = mutant.key in excused and not is_killed
        outcomes["excused" if is_excused else "killed" if is_killed else "survived"] += 1
        if mutant.key in excused and is_killed:
            say(f"EXCUSED, BUT KILLED {mutant}")
        elif not is_killed and not is_excused:
            say(f"SURVIVED {mutant}")
        if number % 50 == 0:
            say(f"... {number} of {len(mutants)}: {score(package, outcomes)}")
    return outcomes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150, help="mutants that are drawn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="all mutants instead")
    parser.add_argument("--module", default=".", metavar="PATH", help="a file or folder only")
    arguments = parser.parse_args()
    reasons = read_excused()
    outcomes: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        skipped = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "dist")
        shutil.copytree(CHECKOUT, folder, ignore=skipped, dirs_exist_ok=True)
        mutants = every_mutant(folder)
        stale = reasons.keys() - {mutant.key for group in mutants.values() for mutant in group}
        for key in [*stale, *(key for key, reason in reasons.items() if not reason)]:
            say("\n    ".join(["NO SUCH MUTANT, OR NO REASON", *key]))
        places = [
            mutant.key
            for group in mutants.values()
            for mutant in group
            if Path(mutant.path).is_relative_to(arguments.module)
        ]
        if not arguments.all:
            places = random.Random(arguments.seed).sample(places, min(arguments.count, len(places)))
        drawn = set(places)
        for package, group in mutants.items():
            if chosen := [mutant for mutant in group if mutant.key in drawn]:
                ground = Ground(folder, package)
                outcomes[package] = try_all(ground, package, chosen, reasons.keys())
    for package, counted in outcomes.items():
        say(score(package, counted))
    together = sum(outcomes.values(), Counter[str]())
    say(score("all", together))
    is_good = together["killed"] >= REQUIRED * (together["killed"] + together["survived"])
    sys.exit(0 if is_good and not stale else 1)


if __name__ == "__main__":
    main()
