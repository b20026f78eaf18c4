"""Flashes over python-can's real slcan and an adapter that damages lines, says nonsense and is
pulled out: `python -m tests.campaigns.slcan --runs 200`.

Every run has a seed. Half of them damage 0.4 % of the lines in both directions, half 1 %; in a
quarter the adapter is pulled out and plugged in again. Others talk on the bus. A run that fails is
repeated without faults, as the same command would. An internal error or a false claim fails it all.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher import api, events
from flasher.errors import ExitCode, FlasherError
from flasher.image.image import Image
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING
from tests.end_to_end.lawicel import Damage, Lawicel
from tests.end_to_end.stage import SMALL, image_of

SHARES: Final = (0.004, 0.01)
PACKETS: Final = 60
TRAFFIC_EVERY_S: Final = 0.02
TRAFFIC: Final = (
    Frame(0x720, bytes.fromhex("55AA0C0612040000")),  # the battery's faults
    Frame(0x720, bytes.fromhex("0000A1B2C3D4F0")),
    Frame(0x712, bytes.fromhex("55AA110230090000")),  # the motor asks for the battery
    Frame(0x712, bytes.fromhex("0000F0")),
)
INTERNAL: Final = "internal error"
FALSE: Final = "false claim"
GOOD: Final = "good"


@dataclass(frozen=True)
class Trial:
    """What became of one flash."""

    seed: int
    share: float
    ending: str
    unreadable: int
    was_lost: bool
    duration_s: float
    again: str = ""
    """How the same command ended without faults, after a failure."""
    report: str = ""


def trial(seed: int) -> Trial:
    """One flash with its faults, and one without them where it has failed."""
    draw = random.Random(seed)
    share = SHARES[seed % len(SHARES)]
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=SMALL)
    image = image_of(PACKETS, seed=seed)
    with tempfile.TemporaryDirectory() as folder, Lawicel(Path(folder, "port")) as adapter:
        # Terminals change their owners between the processes of this campaign.
        os.environ["XDG_STATE_HOME"] = folder
        adapter.damage = Damage(share, draw.randrange(2**32))
        adapter.damage_of_computer = Damage(share, draw.randrange(2**32))
        adapter.traffic = talk()
        if draw.random() < 0.25:
            away_s = draw.uniform(0.1, 3.0)
            adapter.at_frame[draw.randrange(1, PACKETS * 18)] = lambda: adapter.pull(away_s)
        began = time.perf_counter()
        with adapter.device(device):
            ending, unreadable, was_lost, report = flash(adapter, device, image)
            duration_s, again = time.perf_counter() - began, ""
            if ending not in (GOOD, INTERNAL, FALSE):
                adapter.damage = adapter.damage_of_computer = lambda line: line
                adapter.at_frame.clear()
                again = flash(adapter, device, image)[0]
    return Trial(seed, share, ending, unreadable, was_lost, duration_s, again, report)


def talk() -> Callable[[], list[Frame]]:
    """What others say, a frame at a time."""
    count, next_at = 0, time.perf_counter()

    def say() -> list[Frame]:
        nonlocal count, next_at
        if time.perf_counter() < next_at:
            return []
        next_at = time.perf_counter() + TRAFFIC_EVERY_S
        count += 1
        return [TRAFFIC[count % len(TRAFFIC)]]

    return say


def flash(adapter: Lawicel, device: MockDevice, image: Image) -> tuple[str, int, bool, str]:
    """How one flash ends, what was unreadable, whether the adapter was lost."""
    seen: list[object] = []
    unreadable = 0
    try:
        with api.connect(interface="slcan", channel=str(adapter.port), sleep_after_open=0.0) as bus:
            try:
                result = bus.device("bms").upgrade(image, on_event=seen.append)
            finally:
                unreadable = bus.link.health().unreadable
        is_claimed = result.exit_code is ExitCode.OK
        has_it = device.stored_image == image.data
        error = result.error()
        ending = GOOD if error is None else f"exit {result.exit_code:d}: {error.what}"
        if is_claimed and not has_it:
            ending = FALSE
        report = ""
    except FlasherError as failure:
        ending, report = f"exit {failure.exit_code:d}: {failure.what.split(':')[0]}", str(failure)
    except Exception:  # noqa: BLE001  that is what is counted
        ending, report = INTERNAL, traceback.format_exc()
    was_lost = any(isinstance(event, events.AdapterLost) for event in seen)
    return ending, unreadable, was_lost, report


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=4)
    chosen = parser.parse_args()
    logging.disable()
    say = sys.stdout.write
    seeds = range(chosen.first, chosen.first + chosen.runs)
    with ProcessPoolExecutor(chosen.jobs) as pool:
        trials = list(pool.map(trial, seeds))
    for share in SHARES:
        of_share = [each for each in trials if each.share == share]
        good = [each for each in of_share if each.ending == GOOD]
        unreadable = sum(each.unreadable for each in of_share)
        lost = [each for each in of_share if each.was_lost]
        slowest_s = max((each.duration_s for each in of_share), default=0.0)
        say(f"{share:.1%} damaged: {len(good)} of {len(of_share)} good, {unreadable} unreadable, ")
        say(f"adapter lost in {len(lost)}, ")
        say(f"{sum(each.ending == GOOD for each in lost)} of these good, ")
        say(f"the longest took {slowest_s:.1f} s\n")
        for ending, count in Counter(each.ending for each in of_share).most_common():
            say(f"    {count:4}  {ending}\n")
    failed = [each for each in trials if each.again]
    say(f"{len(failed)} failed; the same command without faults: ")
    say(f"{dict(Counter(each.again for each in failed))}\n")
    bad = [each for each in trials if each.ending in (INTERNAL, FALSE)]
    for each in bad:
        say(f"seed {each.seed}: {each.ending}\n{each.report}\n")
    say(f"{sum(each.ending == INTERNAL for each in bad)} internal errors, ")
    say(f"{sum(each.ending == FALSE for each in bad)} false claims\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
