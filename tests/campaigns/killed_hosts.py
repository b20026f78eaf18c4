"""Kills the host's process at random moments of a flash, and gives the same command again:
`python -m tests.campaigns.killed_hosts --runs 100`.

Host and device are two processes on udp_multicast. The device is the one that is hardest to get
back: its session never ends, and it ignores a reset meanwhile. It is not switched off and on: one
process is the device of all runs. In every fourth run the command that is given again is killed as
well. A seed gives the same moments each time.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.errors import ExitCode
from flasher.history import Flash, FlashHistory
from tests.end_to_end.processes import (
    FLASHER,
    MockProcess,
    clean_environment,
    lines_until,
    run_flasher,
)
from tests.end_to_end.test_host_killed import IMPATIENT, NEVER_ENDS
from tests.end_to_end.test_processes import bus_words, free_port
from tests.firmware import VECTORS

PACKETS: Final = 120
GAP: Final = ("--packet-gap", "0.01")
"""So that a moment is likely to lie in the transfer."""
TWICE: Final = 4
"""In every such run the second process is killed too."""


@dataclass(frozen=True)
class Trial:
    """One run: how far the killed process had come, and what the last one did."""

    number: int
    killed_at: tuple[str, ...]
    exit_code: int
    is_image_there: bool
    asked_for_power: bool
    went_into_silence: bool
    took_s: float
    stderr: str

    @property
    def is_good(self) -> bool:
        return self.exit_code == ExitCode.OK and self.is_image_there and not self.asked_for_power


def image(seed: int) -> bytes:
    return VECTORS + random.Random(seed).randbytes(PACKETS * 128 - 21)


def where(flash: Flash) -> str:
    """How far a flash came that was to be killed, as the history knows it."""
    if flash.ended is not None:
        return "too late"
    if flash.reached is None:
        return "before the update command"
    packet = flash.reached.packet
    return f"{flash.reached.phase}, packet {packet}" if packet else flash.reached.phase


def killed_after(seconds: float | None, words: Sequence[str], folder: Path) -> float:
    """Run a command, and kill it so long after it has opened the bus (None: let it end). Returns
    how long it ran from there.
    """
    with subprocess.Popen(
        [*FLASHER, *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        cwd=folder,
        env=clean_environment(),
    ) as process:
        assert process.stderr is not None
        lines_until(process.stderr, "on udp_multicast")
        began_at = time.perf_counter()
        try:
            process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        return time.perf_counter() - began_at


def trial(number: int, seed: int, whole_s: float, bus: Sequence[str], folder: Path) -> Trial:
    """Kill, once or twice, then give the same command again."""
    draw = random.Random(f"{seed}-{number}")
    data = image(draw.randrange(1 << 30))
    (folder / "image.bin").write_bytes(data)
    stored = folder / "out.bin"
    stored.unlink(missing_ok=True)
    flash = ("flash", "-t", "bms", *bus, "image.bin")
    moments = [draw.uniform(0.0, whole_s)]
    if number % TWICE == 0:
        moments.append(draw.uniform(0.0, whole_s + 10.0))
    before = len(FlashHistory().flashes()[0])
    killed: list[Flash] = []
    for moment in moments:
        is_first, at_s = not killed, moment
        while True:
            killed_after(at_s, (*flash, *GAP), folder)
            killed = FlashHistory().flashes()[0][before:]
            if not is_first or killed[-1].ended is None:
                break
            before, at_s = before + len(killed), 0.7 * at_s  # the computer was faster than before
    stored.unlink(missing_ok=True)
    began_at = time.perf_counter()
    done = run_flasher(*flash, folder=folder)
    took_s = time.perf_counter() - began_at
    give_up_at = time.perf_counter() + 5.0
    while not stored.exists() and time.perf_counter() < give_up_at:
        time.sleep(0.05)
    is_there = stored.exists() and stored.read_bytes() == data
    return Trial(
        number,
        tuple(map(where, killed)),
        done.returncode,
        is_there,
        "power-cycle" in done.stderr,
        "in an open session" in done.stderr,
        took_s,
        done.stderr,
    )


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=23)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument(
        "--impatient", action="store_true", help="with a profile of short limits: ten times faster"
    )
    parser.add_argument("--verbose", action="store_true", help="show the last process's output")
    options = parser.parse_args()
    bus = bus_words(free_port())
    trials: list[Trial] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ |= {
            "XDG_DATA_HOME": str(folder / "data"),
            "XDG_STATE_HOME": str(folder / "state"),
            "FLASHER_BUNDLE_DIR": str(folder / "bundles"),
        }
        if options.impatient:
            (folder / "flasher.toml").write_text(IMPATIENT)
        (folder / "image.bin").write_bytes(image(0))
        serving = ("-t", "bms", *NEVER_ENDS, "--save-image", "out.bin", *bus)
        with MockProcess(*serving, folder=folder):
            whole_s = killed_after(None, ("flash", "-t", "bms", *bus, *GAP, "image.bin"), folder)
            say(f"an undisturbed flash takes {whole_s:.1f} s on the bus; seed {options.seed}")
            for number in range(options.first, options.first + options.runs):
                trials.append(each := trial(number, options.seed, whole_s, bus, folder))
                killed = " and ".join(each.killed_at)
                how = "by the update command into the silence" if each.went_into_silence else ""
                verdict = "good" if each.is_good else f"BAD, exit code {each.exit_code}"
                say(f"{number}: killed {killed}: {verdict} {how} {each.took_s:.1f} s")
                if not each.is_good or options.verbose:
                    say(each.stderr)
    counts = Counter(phase.partition(",")[0] for each in trials for phase in each.killed_at)
    good = sum(each.is_good for each in trials)
    silent = sum(each.went_into_silence for each in trials)
    say(f"killed: {', '.join(f'{count} {phase}' for phase, count in counts.most_common())}")
    say(f"{good} of {len(trials)} good, {silent} of them by the update command into the silence")
    return int(good < len(trials))


if __name__ == "__main__":
    sys.exit(main())
