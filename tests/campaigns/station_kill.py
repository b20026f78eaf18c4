"""Kills the real station, and the processes of its sockets, while an operator works at it; and
looks each time whether what was shown is true:

    python -m tests.campaigns.station_kill --times 60 [--seed N]

Nothing of the station is looked into: it is the command `flasher station run`, its event stream and
its scanner. The units are in a process of their own, which knows nothing of flasher; they keep
their paper label, their contents and their numbers. While the station, or the process of a socket,
is dead, units are pulled, put back, exchanged for others and between sockets.

After each kill: every PASS that was shown is one of the records, and every PASS of the records is
one of the unit itself (its serial number, its image); no unit has the number of another one's
label, and none was flashed or written in a run of another label; the processes of the sockets ended
with their station; `flasher station verify` finds nothing. After a few kills the operator is left
in peace, and every unit has to get through.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Final

from flasher.cli.main import main as flasher
from flasher.image.image import Image
from flasher.protocol.spec import BMS
from flasher.settings.manifest import release_of, to_toml
from tests.campaigns.scripted_units import NEW_VERSION, Units, bus_of, free_port
from tests.campaigns.station_operator import Fault, Operator, Place, Station, is_running

KILLS_IN_A_ROW: Final = 3
PEACE_LIMIT_S: Final = 240.0
_KILL_LIMIT_S: Final = 20.0
_MOMENTS_MAX: Final = 24
_WORKERS_END_S: Final = 15.0
_CARDS: Final = 0.4
"""How often the card of a socket waits for its label when a process is killed."""
IMAGE_BYTES: Final = 6000
RECIPE: Final = """\
name = "Campaign"
part = "BAT-36"
revision = "1"
duplicate = "verify-only"

[serial_number]
pattern = 'W[0-9]{7}'
example = "W2605002"

[[target]]
target = "bms"
image = "bms.bin"
sha256 = "SHA256"

[[write]]
target = "bms"
item = "serial-number"
values = ["{serial}"]
manufacturer = true

[[unchanged]]
target = "bms"
item = "physical-id"
"""


def write_files(folder: Path, ports: list[int], image: Image) -> list[str]:
    """Recipe, image, manifest and the station's file; the options that name them."""
    (folder / "bms.bin").write_bytes(image.data)
    manifest = to_toml(release_of(image, BMS))
    (folder / "bms.bin.toml").write_text(manifest, encoding="utf-8")
    recipe = RECIPE.replace("SHA256", image.sha256)
    (folder / "recipe.toml").write_text(recipe, encoding="utf-8")
    lines = ['name = "line"', 'records = "records.sqlite"', 'files = "files"']
    for number, port in enumerate(ports, 1):
        bus = bus_of(port)
        lines += ["", "[[socket]]", f'name = "{number}"']
        lines += [f'{key} = "{bus[key]}"' for key in ("interface", "channel")]
        lines.append(f"bus = {{ port = {port}, hop_limit = {bus['hop_limit']} }}")
    (folder / "sockets.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    sockets = ["--sockets", str(folder / "sockets.toml")]
    return ["--recipe", str(folder / "recipe.toml"), *sockets, "--operator", "jo"]


class Campaign:
    """One station process after the other, one operator, and units that outlive them all."""

    def __init__(
        self,
        folder: Path,
        units: Units,
        ports: list[int],
        seed: int,
        words: list[str],
        image: Image,
    ) -> None:
        self._folder = folder
        self._words = words
        self._random = random.Random(seed)
        places = {str(at): Place(str(at), port) for at, port in enumerate(ports, 1)}
        self.operator = Operator(units, places, image.data, self._random)
        self.counts = self.operator.counts
        self.problems = self.operator.problems
        self._station: Station | None = None
        self._orphans: list[int] = []

    @property
    def kills(self) -> int:
        """Of stations and of workers."""
        return self.counts["kills of the station"] + self.counts["kills of a worker"]

    def kill_once(self, *, worker: bool) -> None:
        """Work up to a moment that chance chooses, and kill."""
        station = self._open()
        operator = self.operator
        moment = operator.moments + self._random.randint(1, _MOMENTS_MAX)
        latest = time.perf_counter() + _KILL_LIMIT_S
        operator.work(lambda: operator.moments >= moment or time.perf_counter() >= latest)
        pause_until = time.perf_counter() + self._random.choice((0.0, 0.01, 0.05, 0.3))
        operator.work(lambda: time.perf_counter() >= pause_until)
        if not worker:
            self._orphans = station.kill()
            self._left("kills of the station")
            self.operator.change_units(tuple(self.operator.places.values()))
            self._check()
            return
        workers = station.workers
        if workers:
            self._kill_worker(station, self._random.choice(workers))

    def _kill_worker(self, station: Station, pid: int) -> None:
        """Units change places while the process of a socket is dead."""
        operator = self.operator
        chosen = operator.choose_card() if self._random.random() < _CARDS else None
        lost = len(operator.lost)
        station.story.note(process="killed")
        subprocess.run(["kill", "-9", str(pid)], check=False)
        self.counts["kills of a worker"] += 1
        latest = time.perf_counter() + _KILL_LIMIT_S
        operator.work(
            lambda: len(operator.lost) > lost or time.perf_counter() >= latest, scans=False
        )
        places = operator.lost[lost:]
        if chosen in places:
            operator.change_after_card(chosen)
        elif places:
            operator.change_units(places)

    def in_peace(self) -> None:
        """Every unit that is in a socket gets through; then the station ends."""
        station = self._open()
        operator = self.operator
        latest = time.perf_counter() + PEACE_LIMIT_S
        operator.work(lambda: operator.is_done or time.perf_counter() >= latest, bring_units=False)
        self.problems += operator.stuck()
        code = station.stop()
        if code not in (0, 12):  # 12: a run that a kill ended is no PASS
            self._wrong(Fault.PROCESS, f"a station in peace ended with {code}")
        self._left("ended by Ctrl-C")
        self._check()

    def _open(self) -> Station:
        if self._station is not None and self._station.process.poll() is not None:
            self._wrong(Fault.PROCESS, f"the station ended: {self._station.process.returncode}")
            self._left("ended by itself")
        if self._station is None:
            self._station = Station(self._folder, *self._words)
            self.operator.begin(self._station)
        return self._station

    def _wrong(self, fault: Fault, what: str) -> None:
        self.problems.append(f"{fault.value}: {what}")

    def _left(self, how: str) -> None:
        self.counts[how] += 1
        self.operator.leave()
        self._station = None

    # -- what has to hold -------------------------------------------------------------------------

    def _check(self) -> None:
        give_up_at = time.perf_counter() + _WORKERS_END_S
        while any(map(is_running, self._orphans)) and time.perf_counter() < give_up_at:
            time.sleep(0.05)
        left = [pid for pid in self._orphans if is_running(pid)]
        self.problems += [
            f"{Fault.PROCESS.value}: {pid} of a socket outlives its station" for pid in left
        ]
        self._orphans = []
        self._check_records()

    def _check_records(self) -> None:
        """What was shown is in the records, and the records hold together."""
        reported = {action: self._ask(action) for action in ("verify", "report")}
        problems = reported["verify"]["problems"]
        for each in problems:
            self._wrong(Fault.RECORDS, f"{each['where']}: {each['what']}")
        found = self.operator.strange_units(reported["report"]["runs"])
        found += self.operator.false_passes(reported["report"]["runs"])
        # What was done to a unit is found again after each kill.
        self.problems += [each for each in found if each not in self.problems]
        runs = {run["run_id"]: run for run in reported["report"]["runs"]}
        for event in self.operator.shown:
            shown = event.get("run", event)  # the whole run in RunEnded
            run = runs.get(shown["run_id"])
            if run is None or run["serial"] != shown["serial"]:
                self._wrong(Fault.LOST, str(event))
            elif shown is not event and run != shown:
                self._wrong(Fault.LOST, f"{event}, saved {run}")
        for what in [each for each in self.counts if each.startswith("saved ")]:
            del self.counts[what]
        states = [run["state"] for run in runs.values()]
        for state in set(states):
            self.counts[f"saved {state}"] = states.count(state)
        passes = sum(event.get("run", {}).get("state") == "pass" for event in self.operator.shown)
        self.counts["saved pass, the kill was before it was shown"] = states.count("pass") - passes

    def _ask(self, action: str) -> dict[str, list[dict[str, str]]]:
        with redirect_stdout(StringIO()) as reported, redirect_stderr(StringIO()):
            flasher(["station", action, "--json", *self._words[2:4]])
        document: dict[str, list[dict[str, str]]] = json.loads(reported.getvalue().splitlines()[-1])
        if "error" in document:
            self._wrong(Fault.RECORDS, f"station {action}: {document['error']}")
        return {"problems": [], "runs": [], **document}


@contextmanager
def campaign(
    folder: Path,
    seed: int,
    *,
    sockets: int = 2,
    image_bytes: int = IMAGE_BYTES,
) -> Iterator[Campaign]:
    """A campaign that is ready to begin."""
    ports = [free_port() for _ in range(sockets)]
    data = b"BMS\0" + NEW_VERSION.encode() + bytes(at % 251 for at in range(image_bytes))
    image = Image.from_bytes(data)
    words = write_files(folder, ports, image)
    with Units(ports, folder / "stderr") as units:
        made = Campaign(folder, units, ports, seed, words, image)
        try:
            yield made
        finally:
            if made._station is not None:
                made._station.kill()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=60, help="kills in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sockets", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="a new folder for records, traces and the story")
    options = parser.parse_args()
    began = time.perf_counter()
    with ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=options.keep is None)
        os.environ["XDG_DATA_HOME"] = str(folder / "data")  # what a station keeps of its own
        made = stack.enter_context(campaign(folder, options.seed, sockets=options.sockets))
        chance = random.Random(options.seed)
        while made.kills < options.times:
            for _ in range(min(KILLS_IN_A_ROW, options.times - made.kills)):
                made.kill_once(worker=chance.random() < 0.4)
            made.in_peace()
            at_s = time.perf_counter() - began
            print(f"{at_s:5.0f} s: {made.kills} kills, {len(made.problems)} problems", flush=True)  # noqa: T201
        for what, count in sorted(made.counts.items()):
            print(f"{what:<40} {count}")  # noqa: T201
        print(f"{'PASS shown, each proven by its unit':<40} {len(made.operator.passed)}")  # noqa: T201
        faults = Counter(problem.partition(":")[0] for problem in made.problems)
        for fault in Fault:
            print(f"{fault.value:<40} {faults[fault.value]}")  # noqa: T201
        for problem in made.problems:
            print(f"PROBLEM {problem}")  # noqa: T201
        errors = (folder / "stderr").read_text(errors="replace").strip()
        print("\n".join(dict.fromkeys(errors.splitlines()))[-2000:])  # noqa: T201
    print(f"{len(made.problems)} problems, {time.perf_counter() - began:.0f} s")  # noqa: T201
    return 1 if made.problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
