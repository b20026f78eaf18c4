"""Command line of the campaigns that have to find planted mistakes."""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from typing import Protocol, TypeVar

from flasher.simulate.planting import Bug


class Hunted(Protocol):
    """What came of a mistake."""

    @property
    def is_found(self) -> bool: ...
    @property
    def seconds(self) -> float: ...

    def lines(self) -> Iterator[str]: ...


SomeBug = TypeVar("SomeBug", bound=Bug)
SomeHunted = TypeVar("SomeHunted", bound=Hunted)


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def run(
    about: str | None,
    bugs: Sequence[SomeBug],
    hunt: Callable[..., SomeHunted],
    *,
    limit_s: float,
    figures: dict[str, Callable[[SomeHunted], float]],
) -> int:
    """Hunt for the mistakes that the arguments name, `hunt(bug, seed=, limit_s=, shrinks=)` for
    each; print what was found, and the medians of `figures` by their names. Return 1 if a mistake
    was not found.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bugs", nargs="*", metavar="NAME", help="how names begin; all by default")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument(
        "--seconds", type=float, default=limit_s, help="computing time for each, without shrinking"
    )
    parser.add_argument("--no-shrink", action="store_true")
    chosen = parser.parse_args()
    bugs = [bug for bug in bugs if bug.name.startswith(tuple(chosen.bugs) or "")]
    if not bugs:
        parser.error(f"no mistake has such a name: {', '.join(chosen.bugs)}")
    found: list[SomeHunted] = []
    with ProcessPoolExecutor(chosen.jobs, initializer=partial(os.nice, 10)) as pool:
        search = partial(
            hunt, seed=chosen.seed, limit_s=chosen.seconds, shrinks=not chosen.no_shrink
        )
        for future in as_completed([pool.submit(search, bug) for bug in bugs]):
            found.append(future.result())
            say("\n".join([*found[-1].lines(), ""]))
    good = [each for each in found if each.is_found]
    say(f"{len(good)} of {len(bugs)} found")
    if good:
        seconds = statistics.median(each.seconds for each in good)
        others = (
            f", {statistics.median(map(figure, good)):g} {name}" for name, figure in figures.items()
        )
        say(f"medians: {seconds:.1f} s" + "".join(others))
    return int(len(good) < len(bugs))
