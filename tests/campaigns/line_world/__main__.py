"""Stories of a line on virtual time: `python -m tests.campaigns.line_world --steps 100000`.

Each story is drawn from a seed and judged; a violation is shrunk to a story of one line, which
`--replay LINE` plays with all that is shown; - reads it from standard input. The package says what
a story may hold, and what has to hold in it. `python -m tests.campaigns.line_bugs` plants
mistakes in the station, to see what this finds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, suppress
from functools import partial
from math import inf

from tests.campaigns.line_world.play import Played, draw, play, shrink
from tests.campaigns.line_world.stories import Story

ACTS: int = 60
"""Of one story."""


def say(line: str = "") -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def played(seed: int, *, acts: int, shrinks: bool) -> tuple[int, Played, int]:
    """The seed, the story as it is to be shown, and the steps that were played."""
    found = draw(seed, acts)
    steps = len(found.done)
    return seed, shrink(found) if found.kind and shrinks else found, steps


def replay(line: str) -> int:
    found = play(Story.parse(line), say)
    say()
    say(found.text or "no violation")
    return int(bool(found.kind))


def results(chosen: argparse.Namespace) -> Generator[tuple[int, Played, int], None, None]:
    work = partial(played, acts=chosen.acts, shrinks=not chosen.no_shrink)
    seeds = range(chosen.seed, chosen.seed + -(-chosen.steps // chosen.acts))
    if chosen.jobs == 1:
        yield from map(work, seeds)
        return
    pool = ProcessPoolExecutor(chosen.jobs, initializer=partial(os.nice, 10))
    try:
        yield from pool.map(work, seeds, chunksize=4)
    finally:
        pool.shutdown(cancel_futures=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--acts", type=int, default=ACTS, help="steps of one story")
    parser.add_argument("--seed", type=int, default=0, help="of the first story")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=inf, help="end after so long")
    parser.add_argument("--most", type=int, default=5, help="end after so many violations")
    parser.add_argument("--no-shrink", action="store_true")
    parser.add_argument("--replay", metavar="LINE", help="play this story; - reads it from stdin")
    chosen = parser.parse_args()
    if chosen.replay is not None:
        return replay(sys.stdin.read() if chosen.replay == "-" else chosen.replay)
    began = time.perf_counter()
    steps = bad = stories = 0
    following = chosen.seed
    seen: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    with closing(results(chosen)) as found_ones, suppress(KeyboardInterrupt):
        for seed, found, count in found_ones:
            steps, stories, following = steps + count, stories + 1, seed + 1
            seen += found.seen or Counter()
            if found.kind:
                bad += 1
                kinds[found.kind] += 1
                acts = len(found.story.acts)
                say(f"{found.text}\n  seed {seed}, {acts} acts\n  {found.story}\n")
            took_s = time.perf_counter() - began
            if stories % 100 == 0:
                pace = 60 * steps / took_s
                say(f"{steps} steps, {pace:,.0f} a minute, {bad} violations; next seed {following}")
            if bad >= chosen.most or took_s > 60 * chosen.minutes:
                break
    took_s = time.perf_counter() - began
    say(
        f"{steps} steps in {stories} stories, {60 * steps / took_s:,.0f} a minute; {bad} violations"
    )
    for kind, count in kinds.most_common():
        say(f"  {count} {kind}")
    for what, count in seen.most_common():
        say(f"{count:8} {what}")
    say(f"Seeds {chosen.seed} to {following - 1}; --seed {following} goes on.")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
