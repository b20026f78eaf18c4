"""Interrupts the upgrade of a whole bike at random moments, and gives the same command again:
`python -m tests.campaigns.whole_bike --runs 20`.

Three device models in processes of their own on udp_multicast, and `flasher flash --bike` in
another. In turn the command is interrupted by Ctrl-C, killed, or the device that is in its transfer
loses its power, and comes back in its bootloader. At the end the time of the whole bike is compared
with that of three commands. A seed gives the same moments each time.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.errors import ExitCode
from flasher.history import FlashHistory
from tests.end_to_end.processes import (
    FLASHER,
    MockProcess,
    clean_environment,
    lines_until,
    run_flasher,
    run_here,
)
from tests.end_to_end.test_processes import bus_words, free_port
from tests.firmware import VECTORS

TARGETS: Final = ("obc", "wmc", "bms")
VERSION: Final = b"V2r0r1_20260102\0"
SIGNALS: Final = {"Ctrl-C": signal.SIGINT, "kill": signal.SIGKILL}
POWER_CUT: Final = "power cut"


class Bike:
    """Three device models, each a process, and a folder with a set of images for them."""

    def __init__(self, folder: Path, packets: int) -> None:
        self.folder = folder
        self.bus = bus_words(free_port())
        self._packets = packets
        self._stack = ExitStack()
        self._mocks: dict[str, ExitStack] = {}

    def __enter__(self) -> Bike:
        self._stack.__enter__()
        for target in TARGETS:
            self.start(target)
        return self

    def __exit__(self, *_: object) -> None:
        for mock in self._mocks.values():
            mock.close()

    def start(self, target: str, *more: str) -> None:
        """Start a device, in the place of one that runs."""
        if target in self._mocks:
            self._mocks[target].close()
        self._mocks[target] = stack = ExitStack()
        words = ("-t", target, "--save-image", f"out-{target}.bin", *more, *self.bus)
        stack.enter_context(MockProcess(*words, folder=self.folder))

    def new_images(self, seed: str) -> None:
        """Write a set of new images, and forget what the devices received."""
        draw = random.Random(seed)
        tables = []
        for target in TARGETS:
            (self.folder / f"out-{target}.bin").unlink(missing_ok=True)
            body = draw.randbytes(self._packets * 128 - len(VECTORS) - len(VERSION) - 5)
            (self.folder / f"{target}.bin").write_bytes(VECTORS + VERSION + body)
            tables.append(f'[[target]]\ntarget = "{target}"\nimage = "{target}.bin"\n')
        (self.folder / "bike.toml").write_text("\n".join(tables))

    def was_flashed(self, target: str) -> bool:
        """Whether a device has received an image of the set."""
        return (self.folder / f"out-{target}.bin").exists()

    def lacks(self) -> list[str]:
        """Devices without the images of the set."""
        return [
            target
            for target in TARGETS
            if not (out := self.folder / f"out-{target}.bin").exists()
            or out.read_bytes() != (self.folder / f"{target}.bin").read_bytes()
        ]

    @property
    def words(self) -> tuple[str, ...]:
        return ("flash", "--bike", "bike.toml", *self.bus)

    def interrupted(self, act: str, after_s: float) -> None:
        """Run the command, and interrupt it so long after it has opened the bus."""
        with subprocess.Popen(
            [*FLASHER, *self.words],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            cwd=self.folder,
            env=clean_environment(),
        ) as process:
            assert process.stderr is not None
            lines_until(process.stderr, "on udp_multicast")
            try:
                process.communicate(timeout=after_s)
            except subprocess.TimeoutExpired:
                if act == POWER_CUT:
                    running = FlashHistory().flashes()[0][-1]
                    if running.ended is None and running.reached is not None:
                        self.start(running.began.target, "--no-app")
                    process.send_signal(signal.SIGINT)
                else:
                    process.send_signal(SIGNALS[act])
                process.communicate()


@dataclass(frozen=True)
class Trial:
    """One interruption: where the upgrade was, and what the same command did then."""

    act: str
    at: str
    exit_code: int
    lacks: tuple[str, ...]
    took_s: float
    stderr: str

    @property
    def is_good(self) -> bool:
        return self.exit_code == ExitCode.OK and not self.lacks


def trial(bike: Bike, seed: str, act: str, after_s: float) -> Trial:
    """Interrupt the command, then give it again."""
    if bike.was_flashed("bms"):  # it reports the version of the set, and would be left alone
        bike.start("bms")
    bike.new_images(seed)
    before = len(FlashHistory().flashes()[0])
    bike.interrupted(act, after_s)
    flashes = FlashHistory().flashes()[0][before:]
    at = "before the first device"
    if flashes:
        last = flashes[-1]
        phase = last.reached and f"{last.reached.phase} {last.reached.packet}"
        at = f"{last.began.target}: {phase or (last.ended and last.ended.what) or 'identify'}"
    began_at = time.perf_counter()
    again = run_here(*bike.words, folder=bike.folder)
    took_s = time.perf_counter() - began_at
    return Trial(act, at, again.returncode, tuple(bike.lacks()), took_s, again.stderr)


def whole_s(bike: Bike, seed: str) -> float:
    """Seconds of the whole bike by one command."""
    bike.new_images(seed)
    bike.start("bms")
    began_at = time.perf_counter()
    done = run_flasher(*bike.words, folder=bike.folder)
    took_s = time.perf_counter() - began_at
    assert done.returncode == 0, done.stderr
    assert not bike.lacks()
    return took_s


def singles_s(bike: Bike, seed: str) -> float:
    """Seconds of three commands, one for each device."""
    bike.new_images(seed)
    began_at = time.perf_counter()
    for target in TARGETS:
        words = ("flash", f"{target}.bin", "-t", target, *bike.bus)
        done = run_flasher(*words, folder=bike.folder)
        assert done.returncode == 0, done.stderr
    took_s = time.perf_counter() - began_at
    assert not bike.lacks()
    return took_s


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def trials(bike: Bike, runs: int, seed: int, limit_s: float) -> list[Trial]:
    draw = random.Random(seed)
    acts = (*SIGNALS, POWER_CUT)
    found = []
    for number in range(runs):
        # One moment in each part of the whole time.
        moment_s = limit_s * (number + draw.random()) / runs
        made = trial(bike, f"{seed}-{number}", acts[number % len(acts)], moment_s)
        verdict = "done" if made.is_good else f"FAILED, exit {made.exit_code}, lacks {made.lacks}"
        say(f"{number + 1:3}  {made.act:9}  {made.at:28}  {verdict}  {made.took_s:.1f} s")
        if not made.is_good:
            say(made.stderr)
        found.append(made)
    return found


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--packets", type=int, default=120)
    options = parser.parse_args(arguments)
    with (
        tempfile.TemporaryDirectory() as folder,
        Bike(Path(folder), options.packets) as bike,
    ):
        whole = [whole_s(bike, f"whole-{each}") for each in range(3)]
        singles = [singles_s(bike, f"single-{each}") for each in range(3)]
        say(f"one command: {min(whole):.1f} s, three commands: {min(singles):.1f} s (best of 3)")
        found = trials(bike, options.runs, options.seed, min(whole) - 1.0)
    good = sum(each.is_good for each in found)
    say(f"{good} of {len(found)} interruptions: the same command again, done")
    return 0 if good == len(found) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
