"""Real time and real processes: units that keep their paper label, number and image are pulled, and
others are put in, in the middle of a run or between the scans of cards and labels:

    python -m tests.campaigns.pulled_units [--count N] [--lines N] [--sockets N] [--seed N]

The units are the scripted ones (`scripted_units`), in a process of their own on udp_multicast, one
bus for each socket. `--count` trials are single runs that are disturbed, `--lines` trials belong to
a station's process with cards, labels, two scanners and two pages (`crossed_scans`); two stations
work at a time, one with two sockets and one with three. A table tells what each scenario ended as.
The exit code is 1 when a label ended on another unit: a PASS of a unit with another paper label, a
unit with the number of another one's label, or one that was flashed or written in a run of another
label.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import sys
import tempfile
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from flasher.api import connect
from flasher.image.image import Image
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS
from flasher.settings.manifest import release_of
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Claim, RunId, RunKind, RunResult, RunState
from flasher.station.unit_run import UnitRun
from tests.campaigns.crossed_scans import Line, Scenario, line_of, make_plan
from tests.campaigns.scripted_units import NEW_VERSION, Units, bus_of, free_port
from tests.campaigns.station_operator import Fault
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
_ON_ANOTHER: Final = (Fault.UNTRUE, Fault.MISBOUND)
"""A label ended on another unit."""
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
        order = Claim(RunId(1), RunKind.PRODUCTION, SERIAL, DAY)
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
            return f"{Fault.UNTRUE.value}: passed"
        if second["serial"] != self.own[1] or second["done"]:
            return f"{Fault.MISBOUND.value}: second unit, {second['serial']!r} {second['done']}"
        return ""


Table = dict[str, Counter[str]]
"""How often each scenario ended as what."""


class Trials:
    """Takes numbers of trials for several threads, and keeps what came of them."""

    def __init__(self, count: int) -> None:
        self._numbers = iter(range(count))
        self._lock = threading.Lock()
        self.ended: Table = defaultdict(Counter)
        self.problems: list[str] = []

    def take(self) -> int | None:
        with self._lock:
            return next(self._numbers, None)

    def note(self, scenario: str, ending: str, problems: Sequence[str] = ()) -> None:
        with self._lock:
            self.ended[scenario][ending] += 1
            self.problems += problems
            for problem in problems:
                print(f"PROBLEM {problem}", flush=True)  # noqa: T201

    @property
    def done(self) -> int:
        return sum(count for endings in self.ended.values() for count in endings.values())


def disturb_runs(folder: Path, sockets: int, seed: int, trials: Trials) -> None:
    """Trials of single runs, one after the other in each socket."""
    lock = threading.Lock()
    recipe = recipe_in(folder)
    ports = [free_port() for _ in range(sockets)]

    def work(port: int, units: Units) -> None:
        while (number := trials.take()) is not None:
            chance = random.Random(seed * 1_000_003 + number)
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
            is_early = trial.exchange is None
            where = "before anything was exchanged" if is_early else where
            ending = f"{result.code}: {result.text}" if is_early else result.code
            problem = f"run {number}, {kind}, {where}, {trial.gap_s} s: {what}; {result}"
            trials.note(f"pulled {where.strip()}", ending, [problem] if what else [])

    with Units(ports, folder / "units.log") as units:
        _in_threads([lambda port=port: work(port, units) for port in ports])  # type: ignore[misc]


def cross_scans(folder: Path, seed: int, trials: Trials, first: int, only: Scenario | None) -> None:
    """Trials of two stations."""

    def work(line: Line) -> None:
        while line.is_running and (number := trials.take()) is not None:
            plan = make_plan(first + number, seed, only)
            known = len(line.problems)
            ending = line.play(plan)
            trials.note(plan.scenario.value, ending, line.problems[known:])

    lines = [line_of(folder / str(sockets), sockets, seed + sockets) for sockets in (2, 3)]
    with ExitStack() as stack:
        for line in lines:
            stack.enter_context(line)
        _in_threads([lambda line=line: work(line) for line in lines])  # type: ignore[misc]
    for line in lines:
        trials.problems += line.judged


def _in_threads(works: Sequence[Callable[[], None]]) -> None:
    threads = [threading.Thread(target=work) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150, help="single runs that are disturbed")
    parser.add_argument("--lines", type=int, default=150, help="trials with cards and labels")
    parser.add_argument("--first", type=int, default=0, help="number of the first of --lines")
    parser.add_argument("--sockets", type=int, default=3, help="of the single runs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=[each.name.lower() for each in Scenario])
    parser.add_argument("--keep", type=Path, help="a new folder for records and traces")
    chosen = parser.parse_args()
    logging.disable(logging.CRITICAL)
    runs, lines = Trials(chosen.count), Trials(chosen.lines)
    only = None if chosen.only is None else Scenario[chosen.only.upper()]
    with tempfile.TemporaryDirectory() as made:
        folder = chosen.keep or Path(made)
        folder.mkdir(parents=True, exist_ok=chosen.keep is None)
        os.environ["XDG_DATA_HOME"] = str(folder / "data")  # what a station keeps of its own
        if chosen.count:
            disturb_runs(folder, chosen.sockets, chosen.seed, runs)
        if chosen.lines:
            cross_scans(folder, chosen.seed, lines, chosen.first, only)
    for scenario, endings in sorted({**runs.ended, **lines.ended}.items()):
        print(f"{sum(endings.values()):4}  {scenario}")  # noqa: T201
        for ending, count in endings.most_common():
            print(f"          {count:4}  {ending}")  # noqa: T201
    problems = runs.problems + lines.problems
    for problem in problems:
        print(f"PROBLEM {problem}")  # noqa: T201
    done, wanted = runs.done + lines.done, chosen.count + chosen.lines
    misbound = sum(any(fault.value in each for fault in _ON_ANOTHER) for each in problems)
    print(f"{misbound} labels on another unit, {len(problems)} problems, {done} trials")  # noqa: T201
    return 1 if problems or done < wanted else 0


if __name__ == "__main__":
    sys.exit(main())
