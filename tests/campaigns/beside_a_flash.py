"""Flashes 400 kB again and again while others ask the same device, and counts what survives:
`python -m tests.campaigns.beside_a_flash --runs 20`.

Processes on a multicast bus: `flasher read`, `info`, `scan` and `doctor` run again and again beside
each flash, and so does a program that knows no lock. Queries at exact bus times are in plans of
`flasher simulate` (`tool`).
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from typing import Final

from flasher.errors import ExitCode
from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment, run_flasher
from tests.end_to_end.stranger import Stranger
from tests.end_to_end.test_processes import GROUP, free_port
from tests.firmware import VECTORS

SIZE_BYTES: Final = 400 * 1024
COMMANDS: Final = {
    "read": ("read", "version-information", "-t", "bms"),
    "info": ("info", "-t", "bms"),
    "scan": ("scan",),
    "doctor": ("doctor", "--listen", "0.2"),
}
_EXPECTED: Final = frozenset({ExitCode.OK, ExitCode.BUS, ExitCode.NO_ANSWER})
"""Exit codes of the commands during a flash, and just after its end."""
ASKS_EVERY_S: Final = 0.2
"""As the documents let a tool repeat a command (4.3)."""


def beside_processes(folder: Path, seed: int, counts: Counter[str]) -> str:
    """One flash among processes; returns what went wrong, or nothing."""
    image = VECTORS + random.Random(seed).randbytes(SIZE_BYTES - len(VECTORS))
    (folder / "image.bin").write_bytes(image)
    options = ("--bus-kwargs", "hop_limit=0", "--bus-kwargs", f"port={free_port()}")
    bus = ("-i", "udp_multicast", "-c", GROUP, *options)
    words = ("flash", "-t", "bms", "--verify", "none", "--json", "--events", "--no-bundle", *bus)
    over = threading.Event()
    odd: list[str] = []

    def ask_again_and_again(name: str) -> None:
        while not over.is_set():
            done = run_flasher(*COMMANDS[name], *bus, folder=folder)
            counts[f"{name}: exit code {done.returncode}"] += 1
            if done.returncode not in _EXPECTED:
                odd.append(f"{name}: exit code {done.returncode}: {done.stderr}")

    with MockProcess("-t", "bms", "--save-image", "out.bin", *bus, folder=folder) as mock:
        flash = subprocess.Popen(
            [*FLASHER, *words, "image.bin"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=clean_environment(),
        )
        askers = [threading.Thread(target=ask_again_and_again, args=(name,)) for name in COMMANDS]
        with flash:
            assert flash.stdout is not None
            assert flash.stderr is not None
            for line in flash.stdout:
                if '"number": 1,' in line:
                    break
            for asker in askers:
                asker.start()
            with Stranger(bus, ASKS_EVERY_S):
                reported = flash.stdout.read()
                trouble = flash.stderr.read()
            over.set()
        for asker in askers:
            asker.join()
        counts["foreign queries reported"] += reported.count('"ForeignQuery"')
        counts["messages sent again"] += reported.count('"MessageRepeated"')
        if flash.returncode:
            return f"exit code {flash.returncode}: {trouble}"
        mock.wait_for("image:")
    if odd:
        return odd[0]
    return "" if (folder / "out.bin").read_bytes() == image else "the device has another image"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.runs)
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        troubles = [beside_processes(Path(folder), seed, counts) for seed in seeds]
    bad = [trouble for trouble in troubles if trouble]
    lines = [f"{len(troubles) - len(bad)} of {len(troubles)} good", *bad]
    lines += [f"  {name}: {count:,}" for name, count in sorted(counts.items())]
    sys.stdout.write("\n".join(lines) + "\n")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
