"""Flashes 250 kB in a process that is stopped at random moments, and between busy processes:
`python -m tests.campaigns.stalled_host --stopped 60 --busy 20 --seed 1`.

Host and device model are two processes on a multicast bus. SIGSTOP represents all that takes
the computer away: swap, a lid that is closed, a busy station. Each flash has to end with exit code
0 and the image in the device.
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment
from tests.end_to_end.test_processes import bus_words, free_port
from tests.firmware import VECTORS

SIZE_BYTES: Final = 250_000
STOPS_S: Final = (0.5, 2.0, 10.0)
FLASH_S: Final = 8.0
"""About how long a flash takes without stops: they are spread over that."""


def flash(folder: Path, seed: int, stops: Sequence[tuple[float, float]]) -> str:
    """One flash, stopped at each moment for that long; returns what went wrong, or nothing."""
    image = VECTORS + random.Random(seed).randbytes(SIZE_BYTES - len(VECTORS))
    (folder / "image.bin").write_bytes(image)
    (folder / "out.bin").unlink(missing_ok=True)
    bus = bus_words(free_port())
    with (
        MockProcess("-t", "bms", "--save-image", "out.bin", *bus, folder=folder) as mock,
        subprocess.Popen(
            [*FLASHER, "flash", "-t", "bms", *bus, "image.bin"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=clean_environment(),
        ) as process,
    ):
        try:
            for after_s, for_s in stops:
                time.sleep(after_s)
                process.send_signal(signal.SIGSTOP)
                time.sleep(for_s)
                process.send_signal(signal.SIGCONT)
            _, errors = process.communicate(timeout=300)
        finally:
            process.kill()
        if process.returncode:
            return f"exit code {process.returncode}\n{errors}"
        mock.wait_for("image:")
        return "" if (folder / "out.bin").read_bytes() == image else "FALSE: another image"


def _spin() -> None:
    while True:
        pass


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Processes that do nothing but compute."""
    spinning = [multiprocessing.Process(target=_spin, daemon=True) for _ in range(count)]
    for each in spinning:
        each.start()
    try:
        yield
    finally:
        for each in spinning:
            each.kill()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stopped", type=int, default=60, help="flashes that are stopped")
    parser.add_argument("--busy", type=int, default=20, help="flashes beside four busy processes")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        good: Counter[str] = Counter()
        for number in range(options.stopped):
            data = random.Random(options.seed * 1000 + number)
            for_s = STOPS_S[number % len(STOPS_S)]
            stops = [(data.uniform(0.0, FLASH_S / 2), for_s) for _ in range(data.randint(1, 3))]
            wrong = flash(folder, number, stops)
            good[f"stopped for {for_s:g} s"] += not wrong
            bad += bool(wrong)
            if wrong:
                sys.stdout.write(f"flash {number}, stopped {stops}: {wrong}\n")
        with busy(4):
            for number in range(options.busy):
                wrong = flash(folder, number, [])
                good["beside four busy processes"] += not wrong
                bad += bool(wrong)
                if wrong:
                    sys.stdout.write(f"flash {number}, busy: {wrong}\n")
        for what, count in good.items():
            sys.stdout.write(f"{what}: {count} good\n")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
