"""Real time and real processes: units that keep their number and image are pulled in the middle of
a run, and another one is put in: `python -m tests.campaigns.pulled_units`, with `--count N`,
`--sockets N` and `--seed N`.

The units are the scripted ones (`scripted_units`), in a process of their own on udp_multicast, one
bus for each socket; each socket runs one trial after the other. It counts what the runs ended as;
exit code 1 when a run passed, or when the second unit was written to.
"""

from __future__ import annotations

import argparse
import logging
import random
import sys
import tempfile
import threading
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from flasher.api import connect
from flasher.image.image import Image
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS
from flasher.settings.manifest import release_of
from flasher.station.messages import RunOrder, RunResult
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import RunId, RunKind, RunState
from flasher.station.unit_run import UnitRun
from tests.campaigns.scripted_units import NEW_VERSION, Units, bus_of, free_port
from tests.station.factory import DAY, SERIAL, USUAL, make_recipe
from tests.station.unit_bench import Notes

GAPS_S: Final = (0.3, 0.5, 1.0, 3.5)
OWN_NUMBERS: Final = {"blank": ("", ""), "maker's number": ("MK-1", "MK-2")}
WRITE: Final = """
[[write]]
target = "bms"
item = "serial-number"
values = ["{serial}"]
manufacturer = true
"""
NOTES: Final = (
    ("step", "identify", "PASS", ""),
    ("intent", "bms", "flash"),
    ("step", "flash bms", "PASS", ""),
    ("intent", "bms", "serial-number"),
    ("step", "write", "PASS", ""),
    ("step", "restart", "PASS", ""),
)
"""Between which steps a unit is pulled."""
_PACKETS: Final = 100
_FRAMES_OF_PACKET: Final = 18


def recipe_in(folder: Path) -> LoadedRecipe:
    """A recipe with an image that the scripted units name."""
    recipe = make_recipe(folder, USUAL + WRITE)
    image = Image.from_bytes((b"BMS\0" + NEW_VERSION.encode()).ljust(_PACKETS * 128, b"\0"))
    target = replace(recipe.targets[0], image=image, release=release_of(image, BMS))
    return replace(recipe, targets=(target,))


@dataclass
class Trial:
    """One run, and the moment in it at which the units change places."""

    units: Units
    lock: threading.Lock
    """The process of the units takes one order at a time."""
    port: int
    names: tuple[str, str]
    own: tuple[str, str]
    share: float | None
    note: tuple[str, ...]
    gap_s: float
    journal: Notes = field(default_factory=Notes)
    exchange: threading.Thread | None = None
    sent: int = 0
    """Frames; nearly all are those of packets."""

    def run(self, recipe: LoadedRecipe) -> RunResult:
        with self.lock:
            self.units.put(self.names[0], self.port, self.own[0])
        self.journal.on_note = self._look_at_notes
        order = RunOrder(RunId(1), RunKind.PRODUCTION, SERIAL, DAY)
        with connect("welling", holder=None, **bus_of(self.port)) as connection:
            result = UnitRun(
                order, recipe, connection, self.journal, taps=(self._look_at_frame,)
            ).run()
        if self.exchange is not None:
            self.exchange.join()
        return result

    def _look_at_notes(self) -> None:
        if self.share is None and self.journal.rows[-1] == self.note:
            self._begin()

    def _look_at_frame(self, frame: Frame, *, sent: bool, now: float) -> None:
        self.sent += sent
        if self.share is not None and self.sent >= self.share * _PACKETS * _FRAMES_OF_PACKET:
            self._begin()

    def _begin(self) -> None:
        if self.exchange is None:
            self.exchange = threading.Thread(target=self._change)
            self.exchange.start()

    def _change(self) -> None:
        with self.lock:
            self.units.out(self.names[0])
        threading.Event().wait(self.gap_s)
        with self.lock:
            self.units.put(self.names[1], self.port, self.own[1])

    def wrong(self, result: RunResult) -> str:
        """What does not hold."""
        if self.exchange is None:
            return ""  # the run ended before: these units forget a session after 0.5 s
        with self.lock:
            second = self.units.look(self.names[1])
            self.units.out(self.names[1])
        if result.outcome is RunState.PASS:
            return "passed"
        if second["serial"] != self.own[1] or second["image"]:
            return f"the second unit was written to: {second['serial']}"
        return ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--sockets", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    logging.disable(logging.CRITICAL)
    ended: Counter[str] = Counter()
    problems: list[str] = []
    numbers = iter(range(chosen.count))
    lock, taking = threading.Lock(), threading.Lock()

    def work(port: int, units: Units, recipe: LoadedRecipe) -> None:
        while True:
            with taking:
                number = next(numbers, None)
            if number is None:
                return
            chance = random.Random(chosen.seed * 1_000_003 + number)
            kind = chance.choice(sorted(OWN_NUMBERS))
            share = chance.choice((0.2, 0.5, 0.9, None))
            names = (f"{number} first", f"{number} second")
            trial = Trial(
                units, lock, port, names, OWN_NUMBERS[kind], share,
                chance.choice(NOTES), chance.choice(GAPS_S),
            )  # fmt: skip
            result = trial.run(recipe)
            where = f"at {share:.0%} of the flash" if share is not None else " ".join(trial.note)
            what = trial.wrong(result)
            with taking:
                where = where if trial.exchange is not None else "before anything was exchanged"
                ended[f"{kind}, {where}: {result.code}"] += 1
                if what:
                    problems.append(f"{number}, {kind}, {where}, {trial.gap_s} s: {what}; {result}")

    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        recipe = recipe_in(folder)
        ports = [free_port() for _ in range(chosen.sockets)]
        with Units(ports, folder / "units.log") as units:
            threads = [threading.Thread(target=work, args=(port, units, recipe)) for port in ports]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
    for how, count in sorted(ended.items()):
        print(f"{count:6}  {how}")  # noqa: T201
    for problem in problems:
        print(problem)  # noqa: T201
    done = sum(ended.values())
    print(f"{len(problems)} of {done} do not hold")  # noqa: T201
    return 1 if problems or done < chosen.count else 0


if __name__ == "__main__":
    sys.exit(main())
