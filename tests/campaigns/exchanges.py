"""Units that change places at any moment of a run, and units that stay on lines good and bad:
`python -m tests.campaigns.exchanges [--count N] [--first SEED]`.

One simulated run for each seed, on virtual time. A unit that stays on a line that loses nothing
passes, whatever its bootloader is like. A unit with a number of its maker's never passes for
another one; it is written to only where it came at the moment of the run's own restart. What each
run ended as is counted; exit code 1 when something does not hold.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Final

from flasher.mock.model import MockDevice
from flasher.mock.table import BootloaderState
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, WMC
from flasher.station.records.model import RunResult
from flasher.station.worker import IDLE_S
from tests.station.factory import BMS_VERSION, USUAL
from tests.station.test_exchanges import (
    BLANK,
    OF_MAKER,
    TWO_TARGETS,
    Exchange,
    with_larger_image,
)
from tests.station.unit_bench import NEW_UNIT, WRITES, UnitBench

GAPS_S: Final = (0.3, 0.5, 1.0, 3.5, 8.0)
SAVES_S: Final = (0.1, 0.4, 2.0)
LOSSES: Final = (0.0, 0.0, 0.002, 0.01, 0.03)
"""The shares of frames that a line loses."""
_IDENTIFIED: Final = ("step", "identify", "PASS", "")
_RESTARTS: Final = frozenset(
    {BootloaderState.RESTARTING, BootloaderState.ANNOUNCING, BootloaderState.STARTING}
)


def profile_of(chance: random.Random) -> dict[str, object]:
    """What a unit is like."""
    change: dict[str, object] = {}
    if chance.random() < 0.3:
        change["after_complete"] = "restarts"
    if chance.random() < 0.3:
        change["reset_in_bootloader"] = "restarts"
    if chance.random() < 0.4:
        change["reset_delay_s"] = chance.choice((0.0, 0.5, 2.0))
    if chance.random() < 0.3:
        change["window_s"] = chance.choice((0.0, 1.0))
    return change


def stays(folder: Path, seed: int) -> tuple[str, str]:
    """A unit that stays: what the run ended as, and what does not hold."""
    chance = random.Random(seed)
    loss = chance.choice(LOSSES)
    profile = replace(NEW_UNIT, **profile_of(chance))  # type: ignore[arg-type]
    has_controller = chance.random() < 0.3

    def disturb(frame: Frame, _now: float) -> tuple[Frame, ...]:
        at = chance.random()
        return () if at < loss else (frame, frame) if at > 0.995 else (frame,)

    text, targets = (TWO_TARGETS, (BMS, WMC)) if has_controller else (USUAL + WRITES, (BMS,))
    bench = UnitBench(folder, text, profile, targets=targets, disturbance=disturb)
    bench.recipe = with_larger_image(bench.recipe)
    if chance.random() < 0.2:
        bench.put(
            MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile, has_application=False)
        )

    def save() -> None:
        until = bench.clock.now() + (chance.choice(SAVES_S) if chance.random() < 0.2 else 0.0)
        while bench.clock.now() < until:
            bench.bus.advance(min(until, bench.clock.now() + IDLE_S))
            bench.unit_run.listen_meanwhile()

    bench.journal.on_note = save
    result = bench.run()
    wrong = f"stayed: {result}" if loss == 0 and result.code != "OK" else ""
    return f"stays, {loss:.1%} lost: {result.code}", wrong


def is_exchanged(folder: Path, seed: int) -> tuple[str, str]:
    """A unit that is pulled after it was identified, and another one put in."""
    chance = random.Random(seed)
    numbers = chance.choice((BLANK, OF_MAKER))
    first = replace(NEW_UNIT, **profile_of(chance))  # type: ignore[arg-type]
    second = replace(first, factory_version=BMS_VERSION) if chance.random() < 0.5 else first
    gap_s = chance.choice(GAPS_S)
    world = Exchange(folder, numbers, gap_s=gap_s, first=first, second=second)
    after_s = chance.uniform(0, 3 + 2 * first.reset_delay_s)
    bench = world.bench
    pulled_in: list[BootloaderState] = []
    identified_at: list[float] = []

    def is_time() -> bool:
        now = bench.clock.now()
        if not identified_at and _IDENTIFIED in bench.journal.rows:
            identified_at.append(now)
        is_over = ("step", "verify", "PASS", "") in bench.journal.rows
        is_due = bool(identified_at) and now >= identified_at[0] + after_s and not is_over
        if is_due:
            pulled_in.append(world.first.state)
        return is_due

    def save() -> None:
        until = bench.clock.now() + (chance.choice(SAVES_S) if chance.random() < 0.3 else 0.0)
        while bench.clock.now() < until:
            bench.bus.advance(min(until, bench.clock.now() + 0.02))
            world.look()
            bench.unit_run.listen_meanwhile()

    world.when = is_time
    bench.journal.on_note = save
    result = bench.run()
    if not pulled_in:
        return "not exchanged: " + result.code, "" if result.code == "OK" else f"{result}"
    kind = "blank" if numbers is BLANK else "maker's number"
    return f"exchanged, {kind}: {result.code}", _wrong(world, result, pulled_in[0], kind)


def _wrong(world: Exchange, result: RunResult, state: BootloaderState, kind: str) -> str:
    own = world.second.profile.serial_number
    is_numbered = world.kept("serial number") != own
    is_touched = is_numbered or world.second.erase_count > 0
    if kind != "blank" and (is_numbered or result.code == "OK"):
        return f"passed for another one: {result}"
    if is_touched and state not in _RESTARTS and result.code != "OK":
        return f"written to, pulled while {state.value}: {result}"
    if result.code == "OK" and state not in _RESTARTS | {BootloaderState.APPLICATION}:
        return f"passed, pulled while {state.value}: {result}"
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    chosen = parser.parse_args()
    logging.disable(logging.CRITICAL)
    ended: Counter[str] = Counter()
    wrong = 0
    with tempfile.TemporaryDirectory() as made:
        for seed in range(chosen.first, chosen.first + chosen.count):
            run = stays if seed % 2 else is_exchanged
            how, what = run(Path(made), seed)
            ended[how] += 1
            if what:
                wrong += 1
                print(f"seed {seed}: {what}")  # noqa: T201
    for how, count in sorted(ended.items()):
        print(f"{count:6}  {how}")  # noqa: T201
    print(f"{wrong} of {chosen.count} do not hold")  # noqa: T201
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
