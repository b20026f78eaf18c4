"""Kills the real station process, after every commit and at random moments, and looks each time
whether the records are true: `python -m tests.campaigns.station_kill --times 200`.

After each kill: every run that was shown is in the records with what was shown, every PASS in the
records is true of the unit itself, nothing in the records is damaged. After three kills at the most
a unit is left in peace, and has to pass then.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from flasher.station.records import Store
from flasher.station.records.model import RunState
from tests.campaigns.station_bench import (
    TROUBLES,
    UnitOnBus,
    free_port,
    station_main,
    write_files,
)

KILLS_A_UNIT = 3
RUN_LIMIT_S = 60.0
FIRST_KILL_S = 0.3
LAST_KILL_S = 4.2


class Campaign:
    """Two sockets, and one station process after the other."""

    def __init__(self, folder: Path, seed: int, sockets: int = 2) -> None:
        self.folder = folder
        self.random = random.Random(seed)
        self.counts: Counter[str] = Counter()
        self.problems: list[str] = []
        self._number = 0
        self._proven: set[str] = set()
        write_files(folder)
        ports = [free_port() for _ in range(sockets)]
        (folder / "ports").write_text(" ".join(map(str, ports)), encoding="ascii")
        self.units = {str(at): UnitOnBus(port) for at, port in enumerate(ports, 1)}
        for unit in self.units.values():
            self._next(unit)

    def close(self) -> None:
        for unit in self.units.values():
            unit.close()

    def _next(self, unit: UnitOnBus) -> None:
        self._number += 1
        unit.put(f"W{self._number:07d}")

    def kill_after(self, commit: int) -> bool:
        """Kill after a commit; False when there were fewer."""
        code = self._run(commit=commit)
        self._check()
        return code == -signal.SIGKILL

    def trouble_after(self, commit: int, trouble: str) -> None:
        """Let the records be out of reach for a while after a commit."""
        if self._run(commit=commit, trouble=trouble):
            self.problems.append(f"{trouble} after commit {commit} ended the station")
        self._check()

    def kill_at_random(self) -> None:
        self._run(at_s=self.random.uniform(FIRST_KILL_S, LAST_KILL_S))
        self._check()

    def in_peace(self) -> None:
        """Every unit can be finished."""
        code = self._run()
        self._check()
        if code:
            self.problems.append(f"a station in peace ended with {code}")
        for unit in self.units.values():
            if unit.serial not in self._proven:
                self.problems.append(f"{unit.serial} is stuck: {self._last(unit.serial)}")
            self._next(unit)

    # -- one process ------------------------------------------------------------------------------

    def _run(
        self, commit: int | None = None, at_s: float | None = None, trouble: str | None = None
    ) -> int:
        orders = [f"{name}={unit.serial}" for name, unit in self.units.items() if self._open(unit)]
        if not orders:
            for unit in self.units.values():
                self._next(unit)
            orders = [f"{name}={unit.serial}" for name, unit in self.units.items()]
        words = [sys.executable, "-m", __spec__.name if __spec__ else __name__, "--station"]
        words += [str(self.folder), *orders]
        if commit is not None:
            words += ["--commit", str(commit)]
        if trouble is not None:
            words += ["--trouble", trouble]
        log = (self.folder / "stderr").open("ab")
        with log, subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=log) as process:
            try:
                code = process.wait(RUN_LIMIT_S if at_s is None else at_s)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
                if at_s is None:
                    self.problems.append("a station did not end: " + " ".join(orders))
        self.counts["killed" if code == -signal.SIGKILL else "ended by itself"] += 1
        return code

    def _open(self, unit: UnitOnBus) -> bool:
        return unit.serial not in self._proven

    # -- what has to hold -------------------------------------------------------------------------

    def _check(self) -> None:
        path = self.folder / "records.sqlite"
        if not path.exists():
            return
        with Store.open(str(path), station="looks", create=False, lock_timeout_s=5.0) as store:
            runs = {run.run_id: run for run in store.read.runs()}
            self.problems += [f"{p.where}: {p.what}" for p in store.verify()]
        for row in self._shown():
            number = row.get("began", row.get("ended"))
            run = next((run for run_id, run in runs.items() if run_id == number), None)
            if run is None or run.serial != row["serial"]:
                self.problems.append(f"lost: {row}")
            elif "ended" in row and (run.state, run.code) != (row["outcome"], row["code"]):
                self.problems.append(f"shown {row}, saved {run.state} {run.code}")
        passed = {run.serial for run in runs.values() if run.state is RunState.PASS}
        for unit in self.units.values():
            if unit.serial in passed and unit.serial not in self._proven:
                self._proven.add(unit.serial)
                if not unit.is_made:
                    self.problems.append(f"false PASS of {unit.serial}")
        if passed - self._proven:
            self.problems.append(f"PASS of a unit that was not there: {passed - self._proven}")
        self.counts["PASS proven"] = len(self._proven)
        self.counts["runs"] = len(runs)
        for state in RunState:
            del self.counts[f"runs {state}"]
        states = Counter(run.state for run in runs.values())
        for state, count in states.items():
            self.counts[f"runs {state}"] = count

    def _shown(self) -> list[dict[str, object]]:
        path = self.folder / "shown.jsonl"
        lines = path.read_text(encoding="ascii").splitlines() if path.exists() else []
        return [json.loads(line) for line in lines]

    def _last(self, serial: str) -> str:
        with Store.open(str(self.folder / "records.sqlite"), station="looks") as store:
            last = store.read.unit(serial).last
        return "no run" if last is None else f"{last.run.state} {last.run.code} {last.run.text}"


def campaign(
    folder: Path, times: int, seed: int, *, every_commit: bool = True, trouble: str | None = None
) -> Campaign:
    """Kill the station that often; `every_commit` begins with one kill after each commit. With
    `trouble` it is not killed, but the records cannot be written for a while after a commit.
    """
    made = Campaign(folder, seed)
    try:
        for commit in range(1, times + 1) if trouble else ():
            made.trouble_after(commit, str(trouble))
            if commit % KILLS_A_UNIT == 0:
                made.in_peace()
        if trouble:
            return made
        kills, commit, since = 0, 1, 0
        while kills < times:
            if every_commit:
                every_commit = made.kill_after(commit)
                commit += 1
            else:
                made.kill_at_random()
            kills = made.counts["killed"]
            since += 1
            if since >= KILLS_A_UNIT:
                made.in_peace()
                since = 0
        made.in_peace()
        made.counts["commits of a run with two units"] = commit - 1
    finally:
        made.close()
    return made


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200, help="kills in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--trouble",
        choices=TROUBLES,
        help="in place of kills: the records cannot be written for 3 s, from each commit on",
    )
    parser.add_argument("--station", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--commit", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.station:
        folder = Path(options.station[0])
        orders = dict(order.split("=") for order in options.station[1:])
        trouble = options.trouble or ""
        return station_main(folder, folder / "shown.jsonl", orders, options.commit, trouble)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        made = campaign(Path(name), options.times, options.seed, trouble=options.trouble)
        for what, count in made.counts.items():
            print(f"{what:<34} {count}")  # noqa: T201
        errors = (Path(name) / "stderr").read_text(errors="replace").strip()
    for problem in made.problems:
        print(f"PROBLEM {problem}")  # noqa: T201
    if errors:
        print(errors[-2000:])  # noqa: T201
    print(f"{len(made.problems)} problems, {time.monotonic() - began:.0f} s")  # noqa: T201
    return 1 if made.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
