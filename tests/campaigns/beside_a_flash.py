"""Flashes 400 kB again and again while others ask the same device, and counts what survives:
`python -m tests.campaigns.beside_a_flash --runs 20`.

First with processes on a multicast bus: `flasher read`, `info`, `scan` and `doctor` run again and
again beside each flash, and so does a program that knows no lock. Then on the simulated bus, whose
frames have their exact times: there a query hits the packets in their middle.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Final

from flasher import events
from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from flasher.wording import wording
from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment, run_flasher
from tests.end_to_end.stage import SMALL, Speaker, Stage, image_of
from tests.end_to_end.stranger import QUERY, Stranger
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
"""Of the commands beside a flash, and just behind its end."""
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
                said = flash.stdout.read()
                trouble = flash.stderr.read()
            over.set()
        for asker in askers:
            asker.join()
        counts["foreign queries reported"] += said.count('"ForeignQuery"')
        counts["messages sent again"] += said.count('"MessageRepeated"')
        if flash.returncode:
            return f"exit code {flash.returncode}: {trouble}"
        mock.wait_for("image:")
    if odd:
        return odd[0]
    return "" if (folder / "out.bin").read_bytes() == image else "the device has another image"


def on_the_simulated_bus(
    seed: int, counts: Counter[str], *, every_s: float = ASKS_EVERY_S, packets: int = 3200
) -> str:
    """One flash at exact bus times, with a query about every `every_s`; returns what went wrong."""
    draw = random.Random(seed)
    profile = replace(SMALL, application_area_bytes=512 * 1024)
    stage = Stage(profile=profile)
    frames = [Frame(0x752, part) for part in QUERY]
    stranger = _Asking(draw, every_s, frames)
    stage.at_packet[1] = lambda: stranger.begin(stage.clock.now())
    stage.bus.attach(stranger)
    image = image_of(packets, seed=seed)
    result = stage.flash(image)
    counts["queries"] += stranger.asked
    counts["messages sent again"] += len(stage.seen(events.MessageRepeated))
    counts["attempts more"] += len(stage.seen(events.AttemptStarted))
    if not result.ok:
        return f"{wording(result.outcome.ending)} ({result.outcome.where})"
    return "" if stage.has == image.data else "the device has another image"


class _Asking(Speaker):
    """Sends its frames one right after the other, then waits about `every_s`."""

    def __init__(self, draw: random.Random, every_s: float, frames: list[Frame]) -> None:
        super().__init__(*frames, every_s=every_s, begins_at=float("inf"))
        self._draw = draw
        self._pause_s = every_s

    @property
    def asked(self) -> int:
        """How often it asked."""
        return self._sent // len(self._frames)

    def begin(self, now: float) -> None:
        """The first question comes soon."""
        self._next = now + self._draw.uniform(0.0, self._pause_s)

    def tick(self, now: float) -> None:
        self._is_due = True
        is_last = self._sent % len(self._frames) == len(self._frames) - 1
        self._next = now + (self._draw.uniform(0.5, 1.5) * self._pause_s if is_last else 0.0005)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--every", type=float, default=ASKS_EVERY_S, metavar="S")
    parser.add_argument("--simulated-only", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.runs)
    failed = 0
    if not options.simulated_only:
        counts: Counter[str] = Counter()
        with tempfile.TemporaryDirectory() as folder:
            troubles = [beside_processes(Path(folder), seed, counts) for seed in seeds]
        failed += _tell("processes on a multicast bus", troubles, counts)
    counts = Counter()
    troubles = [on_the_simulated_bus(seed, counts, every_s=options.every) for seed in seeds]
    failed += _tell(f"simulated bus, a query every {options.every:g} s", troubles, counts)
    return int(failed > 0)


def _tell(what: str, troubles: list[str], counts: Counter[str]) -> int:
    bad = [trouble for trouble in troubles if trouble]
    lines = [f"{what}: {len(troubles) - len(bad)} of {len(troubles)} good", *bad]
    lines += [f"  {name}: {count:,}" for name, count in sorted(counts.items())]
    sys.stdout.write("\n".join(lines) + "\n")
    return len(bad)


if __name__ == "__main__":
    sys.exit(main())
