"""Plants mistakes in the station, and has the campaign of the line find each of them:
`python -m tests.campaigns.line_bugs`, or with the names of some.

The mistakes are in `line_bugs.toml`, each with a story that it spoils. One is planted by giving the
functions that it changes their other code; with it stories are drawn (`tests.campaigns.line_world`)
until one ends in a violation that the station without the mistake does not have, for at most a
minute of computing time; that story is shrunk. Prints what was found how, and after how long;
fails when a mistake is not found.
"""

from __future__ import annotations

import argparse
import inspect
import os
import statistics
import sys
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType
from typing import Final

from tests.campaigns.line_world.play import draw, play, shrink
from tests.campaigns.line_world.stories import Story
from tests.campaigns.line_world.world import STUCK

CHECKOUT: Final = Path(__file__).parents[2]
ACTS: Final = 60
"""Of one story."""
LIMIT_S: Final = 60.0
_BUGS: Final = Path(__file__).with_suffix(".toml")
Codes = dict[FunctionType, CodeType]


# -- the mistakes ---------------------------------------------------------------------------------


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
    kind: str
    """Of the violation with which its story ends."""
    story: str
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

    def codes(self) -> Codes:
        """The code of each function that it changes."""
        changed: Codes = {}
        for file, text in self.modules().items():
            module = import_module(file.removesuffix(".py").replace("/", "."))
            for name, code in _codes_in(compile(text, module.__file__ or file, "exec")):
                function = _function(vars(module), name)
                if function is not None and _differ(function.__code__, code):
                    changed[function] = code
        return changed


def _codes_in(code: CodeType) -> Iterator[tuple[str, CodeType]]:
    """The functions of a module or a class, by their qualified names."""
    for each in code.co_consts:
        if isinstance(each, CodeType):
            if each.co_flags & inspect.CO_OPTIMIZED:
                yield each.co_qualname, each
            else:
                yield from _codes_in(each)


def _function(names: Mapping[str, object], name: str) -> FunctionType | None:
    *classes, last = name.split(".")
    for each in classes:
        names = vars(names.get(each, object))
    found = names.get(last)
    found = found.fget if isinstance(found, property) else found
    found = inspect.unwrap(getattr(found, "__func__", found))  # type: ignore[arg-type]
    return found if isinstance(found, FunctionType) else None


def _differ(one: CodeType, other: CodeType) -> bool:
    """Compares what they do, not where they are."""
    mine, theirs = one.co_consts, other.co_consts
    if (one.co_code, one.co_names, len(mine)) != (other.co_code, other.co_names, len(theirs)):
        return True
    return any(
        _differ(a, b) if isinstance(a, CodeType) and isinstance(b, CodeType) else a != b
        for a, b in zip(mine, theirs, strict=True)
    )


@contextmanager
def swapped(codes: Codes) -> Iterator[None]:
    """Functions have this code, or, in a story with it, their own again."""
    _swap(codes)
    try:
        yield
    finally:
        _swap(codes)


def _swap(codes: Codes) -> None:
    for function, code in codes.items():
        codes[function], function.__code__ = function.__code__, code


def read_bugs() -> list[Bug]:
    tables = tomllib.loads(_BUGS.read_text("utf-8"))["bug"]
    return [
        Bug(
            table["name"],
            table["breaks"],
            table["kind"],
            " ".join(table["story"].split()),
            [Edit(**edit) for edit in table["edit"]],
        )
        for table in tables
    ]


# -- the search -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """What came of a mistake."""

    bug: Bug
    kind: str
    """Of the violation; empty when none was found."""
    text: str
    seconds: float
    """Computing time until it was found, without the shrinking."""
    steps: int
    story: str
    not_ours: int
    """Stories that end badly without the mistake, too."""

    @property
    def acts(self) -> int:
        return len(Story.parse(self.story).acts)

    def lines(self) -> Iterator[str]:
        head = f"{self.bug.name:34} {self.kind or 'NOT FOUND':12} {self.seconds:5.1f} s"
        yield f"{head} {self.steps:6} steps" + (f" {self.acts:3} acts" if self.kind else "")
        yield f"    {self.bug.breaks}"
        if self.text:
            yield f"    {self.text}"
        if self.kind:
            yield f"    {self.story}"
        if self.not_ours:
            yield f"    ({self.not_ours} stories that end so without the mistake were left out)"


def find(bug: Bug, seed: int, limit_s: float, *, shrinks: bool) -> Found:
    """Draw stories with a mistake. What is found counts only when the station without it takes it
    well.
    """
    codes = bug.codes()
    steps = not_ours = 0
    began_at = time.process_time()

    def is_ours(story: Story) -> bool:
        with swapped(codes):
            return not play(story, goes_home=found.kind == STUCK).kind

    with swapped(codes):
        while (took_s := time.process_time() - began_at) < limit_s:
            found = draw(seed, ACTS)
            seed, steps = seed + 1, steps + len(found.done)
            if found.kind and is_ours(found.story):
                took_s = time.process_time() - began_at
                shrunk = shrink(found, is_ours) if shrinks else found
                story = str(shrunk.story)
                return Found(bug, shrunk.kind, shrunk.text, took_s, steps, story, not_ours)
            not_ours += bool(found.kind)
    return Found(bug, "", "", took_s, steps, "", not_ours)


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bugs", nargs="*", metavar="NAME", help="how names begin; all by default")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--seed", type=int, default=0, help="of the first story")
    parser.add_argument(
        "--seconds", type=float, default=LIMIT_S, help="computing time for each, without shrinking"
    )
    parser.add_argument("--no-shrink", action="store_true")
    chosen = parser.parse_args()
    bugs = [bug for bug in read_bugs() if bug.name.startswith(tuple(chosen.bugs) or "")]
    if not bugs:
        parser.error(f"no mistake has such a name: {', '.join(chosen.bugs)}")
    found: list[Found] = []
    with ProcessPoolExecutor(chosen.jobs, initializer=partial(os.nice, 10)) as pool:
        search = partial(
            find, seed=chosen.seed, limit_s=chosen.seconds, shrinks=not chosen.no_shrink
        )
        for future in as_completed([pool.submit(search, bug) for bug in bugs]):
            found.append(future.result())
            _say("\n".join([*found[-1].lines(), ""]))
    good = [each for each in found if each.kind]
    _say(f"{len(good)} of {len(bugs)} found")
    if good:
        seconds = statistics.median(each.seconds for each in good)
        steps = statistics.median(each.steps for each in good)
        acts = statistics.median(each.acts for each in good)
        _say(f"medians: {seconds:.1f} s, {steps:g} steps, {acts:g} acts of the shrunk story")
    return int(len(good) < len(bugs))


if __name__ == "__main__":
    sys.exit(main())
