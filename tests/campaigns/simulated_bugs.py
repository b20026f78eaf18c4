"""Plants mistakes in host, driver, bus, image and device model, and has simulated upgrades find
each of them: `python -m tests.campaigns.simulated_bugs`, or with the names of some.

The mistakes are those of `flasher/simulate/planted_bugs.toml`, each with a plan that it spoils.
With each, the plans of the other mistakes are played first, then its own, then random ones, until
one ends in a violation that it does not show without the mistake, for at most `--seconds` of
computing time; a random plan is shrunk. Prints which plan found what, and after how long; fails
when a mistake is not found.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import Final

from flasher.simulate import plan as plans
from flasher.simulate.draw import drawn
from flasher.simulate.planting import UpgradeBug, swapped, upgrade_bugs
from flasher.simulate.play import play
from flasher.simulate.shrink import shows, shrink
from tests.campaigns.hunts import run

LIMIT_S: Final = 10.0
RANDOM: Final = "random"


@dataclass(frozen=True)
class Hunted:
    """What came of a mistake."""

    bug: UpgradeBug
    violation: str
    """Empty when none was found."""
    seconds: float
    """Computing time until it was found, without the shrinking."""
    runs: int
    found_by: str
    """Whose plan: "its own", the name of another mistake, or "random"."""
    plan: str
    faults: int

    @property
    def is_found(self) -> bool:
        return bool(self.violation)

    def lines(self) -> Iterator[str]:
        kind = self.violation.partition(":")[0] or "NOT FOUND"
        head = f"{self.bug.name:44} {self.bug.part:10} {kind:12} {self.seconds:5.1f} s"
        yield f"{head} {self.runs:5} runs {self.faults:2} faults by {self.found_by or 'none'}"
        if self.violation:
            yield f"    {self.violation}"
            yield f"    {self.plan}"
        else:
            yield f"    {self.bug.breaks}"


def hunt(bug: UpgradeBug, seed: int, limit_s: float, *, shrinks: bool) -> Hunted:
    """Play plans with a mistake. What is found counts only if the code without it is right."""
    codes = bug.codes()
    runs = 0
    began_s = time.process_time()

    def is_bad(plan: plans.Plan, kind: str) -> bool:
        if not shows(plan, kind):
            return False
        with swapped(codes):
            return not play(plan).violations

    with swapped(codes):
        for found_by, played in _plans(bug, seed):
            if (took_s := time.process_time() - began_s) >= limit_s:
                break
            runs += 1
            for violation in play(played).violations:
                if violation.is_excused or not is_bad(played, violation.kind):
                    continue
                took_s = time.process_time() - began_s
                is_shrunk = shrinks and found_by == RANDOM
                plan = shrink(played, violation.kind, is_bad=is_bad) if is_shrunk else played
                text = str(next(e for e in play(plan).violations if e.kind == violation.kind))
                faults = len([*plan.events])
                return Hunted(bug, text, took_s, runs, found_by, str(plan), faults)
    return Hunted(bug, "", took_s, runs, "", "", 0)


def _plans(bug: UpgradeBug, seed: int) -> Iterator[tuple[str, plans.Plan]]:
    """Yield plans, each with the name of its mistake."""
    for other in upgrade_bugs():
        if other != bug:
            yield other.name, plans.Plan.parse(other.plan)
    yield "its own", plans.Plan.parse(bug.plan)
    for each in count(seed):
        yield RANDOM, drawn(each)


if __name__ == "__main__":
    sys.exit(
        run(
            __doc__,
            upgrade_bugs(),
            hunt,
            limit_s=LIMIT_S,
            figures={"faults": lambda each: each.faults},
        )
    )
