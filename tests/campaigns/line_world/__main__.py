"""Stories of a line on virtual time: `python -m tests.campaigns.line_world --steps 100000`.

Each story is drawn from a seed and judged; a violation is shrunk to a story of one line, which
`--replay LINE` plays with all that is shown; - reads it from standard input. The package says what
a story may hold, and what has to hold in it. Processes and ledger are those of `flasher simulate`.
`python -m tests.campaigns.line_bugs` plants mistakes in the station, to see what this finds.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from functools import partial
from math import inf
from pathlib import Path

from flasher.cli.stop import Stop, stop_on_signal
from flasher.errors import FlasherError
from flasher.simulate.campaign import Batch, Result
from flasher.simulate.ledger import Ledger
from flasher.simulate.workers import KILLED, run
from tests.campaigns.line_world.campaign import STEPS, Stories, play_batch, stories_key
from tests.campaigns.line_world.play import draw, play, shrink
from tests.campaigns.line_world.stories import Story

ACTS: int = 60
"""Of one story."""
_PROGRESS_S = 60.0


def say(line: str = "") -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def replay(line: str) -> int:
    try:
        story = Story.parse(line)
    except ValueError as error:
        sys.exit(f"The story cannot be read: {error}.")
    found = play(story, say)
    say()
    say(found.text or "no violation")
    return int(bool(found.kind))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--acts", type=int, default=ACTS, help="steps of one story")
    parser.add_argument("--seed", type=int, default=0, help="of the first story")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--minutes", type=float, default=inf, help="end after so long")
    parser.add_argument("--most", type=int, default=5, help="end after so many violations")
    parser.add_argument("--no-shrink", action="store_true")
    parser.add_argument("--ledger", type=Path, help="save what is done, and go on with the rest")
    parser.add_argument("--replay", metavar="LINE", help="play this story; - reads it from stdin")
    return parser.parse_args()


def summary(total: Result, steps_before: int, took_s: float) -> str:
    steps = total.endings.get(STEPS, 0)
    pace, bad = 60 * (steps - steps_before) / took_s, total.violation_count
    return f"{steps} steps in {total.runs} stories, {pace:,.0f} a minute; {bad} violations"


def campaign(chosen: argparse.Namespace, ledger: Ledger | None, stopped: Stop) -> Result:
    """Play the stories that the ledger lacks, and report each violation; return the sum."""
    batch = whole(chosen)
    total = Result(batch.campaign) if ledger is None else ledger.result
    steps_before = total.endings.get(STEPS, 0)
    began_s = shown_s = time.perf_counter()

    def is_over() -> bool:
        is_late = time.perf_counter() - began_s > 60 * chosen.minutes
        return is_late or total.violation_count >= chosen.most or stopped()

    def add(batch: Batch, result: Result) -> None:
        nonlocal total, shown_s
        total += result
        if ledger is not None:
            ledger.add(batch, result)
        for each in result.violations:
            say(f"{each.kind}: {each.text}\n  seed {each.seed}\n  {each.plan}\n")
        now_s = time.perf_counter()
        if now_s - shown_s > _PROGRESS_S:
            shown_s = now_s
            say(summary(total, steps_before, now_s - began_s))

    run(
        [batch] if ledger is None else ledger.left([batch]),
        chosen.jobs,
        on_result=add,
        is_stopped=is_over,
        run_one=partial(play_batch, acts=chosen.acts),
    )
    say(summary(total, steps_before, time.perf_counter() - began_s))
    return total


def whole(chosen: argparse.Namespace) -> Batch:
    return Stories(stories_key(chosen.acts), chosen.seed, -(-chosen.steps // chosen.acts))


def main() -> int:
    chosen = arguments()
    if chosen.replay is not None:
        return replay(sys.stdin.read() if chosen.replay == "-" else chosen.replay)
    with stop_on_signal(lambda: say("Ending.")) as stopped, ExitStack() as files:
        ledger = None
        if chosen.ledger is not None:
            batch = whole(chosen)
            opened = Ledger(chosen.ledger, batch.first, batch.count, batch.campaign)
            ledger = files.enter_context(opened)
        total = campaign(chosen, ledger, stopped)
        for each in total.violations:
            if each.kind != KILLED and not (chosen.no_shrink or stopped()):
                found = shrink(draw(each.seed, chosen.acts))
                say(f"seed {each.seed}, {len(found.story.acts)} acts: {found.text}")
                say(f"  {found.story}\n")
    for what, count in sorted(total.endings.items(), key=lambda each: -each[1]):
        say(f"{count:8} {what}")
    return int(total.violation_count > 0)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except FlasherError as error:
        sys.exit(str(error))
