"""Takes the host's adapter away for a moment in the middle of upgrades, and counts the good ends
that need no power cycle: `python -m tests.campaigns.lost_contact --runs 60`.

The device is the one that is hardest to get back: its session never times out, and it ignores a
reset in its bootloader. Everything is simulated and seeded: a seed gives the same run each time.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from flasher.errors import FlasherError
from flasher.wording import wording
from tests.end_to_end.stage import SMALL, Stage, image_of

AWAY_S: Final = 0.3
WANTED: Final = 57
"""Of 60 runs."""
STUBBORN: Final = replace(
    SMALL,
    pause_in_transfer="waits",
    reset_in_bootloader="ignored",
    reset_in_transfer="ignored",
    update_in_transfer="starts_over",
)


class Fault(Enum):
    """What happens, and when."""

    ADAPTER_IN_TRANSFER = "adapter lost in the transfer"
    ADAPTER_ANYWHERE = "adapter lost anywhere in the upgrade"
    BUS_OFF_ANYWHERE = "bus-off anywhere in the upgrade"


@dataclass(frozen=True)
class Trial:
    """One upgrade with a fault in it."""

    seed: int
    at_s: float
    ending: str
    attempts: int
    duration_s: float
    is_good: bool
    is_honest: bool
    """A good end was claimed exactly when the device has the image."""


class At:
    """On the bus for its timer only: lets something happen at a time."""

    done = False

    def __init__(self, at_s: float, happens: Callable[[], None]) -> None:
        self._at_s: float | None = at_s
        self._happens = happens

    def receive(self, frame: object, now: float) -> None:
        pass

    def tick(self, now: float) -> None:
        if self._at_s is not None and now >= self._at_s:
            self._at_s = None
            self._happens()

    def deadline(self) -> float | None:
        return self._at_s

    def next_frame(self, now: float) -> None:
        return None

    def frame_sent(self, now: float) -> None:
        pass

    def cancel(self, now: float) -> None:
        pass

    def take_events(self) -> tuple[object, ...]:
        return ()


def stage_and_packets(draw: random.Random) -> tuple[Stage, int]:
    """A device and the size of its image, in packets. Erasing takes 5 ms to 1 s."""
    page_s = draw.choice([0.002, 0.02, 0.1])
    return Stage(profile=replace(STUBBORN, erase_time_s=page_s)), draw.randrange(40, 120)


def undisturbed(seed: int) -> tuple[float, float, float]:
    """When the transfer of a run begins and ends, and when the whole session ends, in seconds."""
    stage, packets = stage_and_packets(random.Random(seed))
    times: list[float] = []
    stage.at_packet[1] = lambda: times.append(stage.clock.now())
    result = stage.flash(image_of(packets))
    assert result.ok, result.outcome
    return times[0], times[0] + (result.outcome.statistics.transfer_s or 0.0), stage.clock.now()


def trial(fault: Fault, seed: int, away_s: float = AWAY_S) -> Trial:
    """One upgrade whose adapter is away for `away_s` at a random moment."""
    begins_s, ends_s, over_s = undisturbed(seed)
    draw = random.Random(seed)
    stage, packets = stage_and_packets(draw)
    image = image_of(packets)
    in_transfer = fault is Fault.ADAPTER_IN_TRANSFER
    at_s = draw.uniform(begins_s, ends_s) if in_transfer else draw.uniform(0.0, over_s)
    lose = stage.bus.bus_off if fault is Fault.BUS_OFF_ANYWHERE else stage.bus.unplug
    stage.bus.attach(At(at_s, lambda: lose(away_s)))
    attempts, is_ok = 0, False
    try:
        result = stage.flash(image)
    except FlasherError as error:
        ending = f"{type(error).__name__}: {error.what} ({error.where})"
    else:
        attempts, is_ok = result.outcome.statistics.attempts, result.exit_code == 0
        ending = f"{wording(result.outcome.ending)} ({result.outcome.where})"
    has_it = stage.has == image.data
    return Trial(
        seed, at_s, ending, attempts, stage.clock.now(), is_ok and has_it, has_it or not is_ok
    )


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--away", type=float, default=AWAY_S, metavar="S")
    options = parser.parse_args()
    failed = False
    for fault in Fault:
        seeds = range(options.first_seed, options.first_seed + options.runs)
        trials = [trial(fault, seed, options.away) for seed in seeds]
        good = [each for each in trials if each.is_good]
        again = sum(each.attempts > 1 for each in good)
        longest_s = max((each.duration_s for each in good), default=0.0)
        _say(
            f"{fault.value}: {len(good)} of {len(trials)} good "
            f"({again} began again; the longest took {longest_s:.1f} s)"
        )
        for each in trials:
            if not each.is_good:
                _say(f"  seed {each.seed}, at {each.at_s:.3f} s: {each.ending}")
            if not each.is_honest:
                _say(f"  seed {each.seed}: SAID TO BE GOOD, AND IS NOT")
        failed |= len(good) * 60 < WANTED * len(trials) or not all(t.is_honest for t in trials)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
