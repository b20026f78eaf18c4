"""Two units wait in two sockets, the station starts, and only the label of the second one's unit is
scanned meanwhile, without a card:

    python -m tests.campaigns.station_starts --times 50

It must never run in the first socket, and it must get through by what the screen says.
"""

from __future__ import annotations

import argparse
import os
import random
import tempfile
import time
from pathlib import Path
from typing import Final

from tests.campaigns.station_kill import Campaign, campaign

_LIMIT_S: Final = 40.0
_AGAIN_S: Final = 1.0


def start_once(made: Campaign, number: int, chance: random.Random) -> None:
    """One start; what is wrong is added to the problems."""
    operator = made.operator
    first, second = operator.places.values()
    label = f"W{number:07d}"
    if not first.unit:
        operator._own["W9000000"] = ""
        operator._put("W9000000", first)
    operator._own[label] = chance.choice(("", label))
    operator._put(label, second)
    station = made._open()
    pause_until = time.perf_counter() + chance.uniform(0.0, 4.0)
    operator.work(lambda: time.perf_counter() >= pause_until, bring_units=False, scans=False)
    give_up_at = time.perf_counter() + _LIMIT_S
    while label not in operator.passed and time.perf_counter() < give_up_at:
        if operator._scan(label):
            if operator._wants_card():
                operator._scan(f"SOCKET {second.name}")
            operator._see_run(label, second, lambda: False)
            operator.work(
                lambda: label in operator.passed or time.perf_counter() >= give_up_at,
                bring_units=False,
                scans=False,
            )
        else:
            made.counts["refused, and scanned again"] += 1
            until = time.perf_counter() + _AGAIN_S
            operator.work(lambda until=until: time.perf_counter() >= until, scans=False)  # type: ignore[misc]
    if label not in operator.passed:
        made.problems.append(f"{label} did not get through: {second.state} {second.text}")
    station.stop()
    made._left("starts")
    made._check()
    operator._take_out(second)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        os.environ["XDG_DATA_HOME"] = str(Path(name) / "data")
        with campaign(Path(name), options.seed) as made:
            for number in range(1, options.times + 1):
                start_once(made, number, chance)
                print(f"{number} starts, {len(made.problems)} problems", flush=True)  # noqa: T201
            for what, count in sorted(made.counts.items()):
                print(f"{what:<40} {count}")  # noqa: T201
            for problem in made.problems:
                print(f"PROBLEM {problem}")  # noqa: T201
            return 1 if made.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
