"""How many sockets a station can serve: `python -m tests.benchmarks.station_sockets`.

Each socket is a process with a simulated bus at the pace of 250 kbit/s, and flashes the whole
sample image. The device models run in the same processes: real adapters need less.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from flasher.image.load import load
from flasher.protocol.spec import BMS
from flasher.settings.manifest import release_of, to_toml
from flasher.station.config import MockUnits
from flasher.station.events import RunEnded, RunStarted, StationEvent, StepEnded
from flasher.station.messages import VirtualUnits, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe, load_recipe
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import RunState, StepName
from flasher.station.records.store import Store
from flasher.station.station import Station, StationOptions

SAMPLE = Path(__file__).parents[2] / "firmware_samples" / "bms.hex"
RECIPE = """\
name = "Benchmark"
part = "BAT-36"
revision = "1"

[serial_number]
pattern = 'W[0-9]{{7}}'
example = "W2605002"

[[target]]
target = "bms"
image = "bms.hex"
sha256 = "{sha256}"

[[write]]
target = "bms"
item = "serial-number"
values = ["{{serial}}"]
manufacturer = true
"""


def make_recipe(folder: Path) -> LoadedRecipe:
    (folder / "bms.hex").write_bytes(SAMPLE.read_bytes())
    image = load(folder / "bms.hex")
    (folder / "bms.hex.toml").write_text(to_toml(release_of(image, BMS)), encoding="utf-8")
    path = folder / "recipe.toml"
    path.write_text(RECIPE.format(sha256=image.sha256), encoding="utf-8")
    return load_recipe(path)


class Measured:
    """One station with so many sockets, each with so many units. `beside` gets its records."""

    def __init__(
        self,
        sockets: int,
        units: int,
        name: str = "benchmark",
        beside: Callable[[Path], AbstractContextManager[None]] = lambda _records: nullcontext(),
    ) -> None:
        self._name, self._beside = name, beside
        self.flash_s: list[float] = []
        self.run_s: list[float] = []
        self.beside_s: list[float] = []
        """Of each unit: from its begin to its saved end, without its steps."""
        self._steps_s: dict[str, float] = {}
        self._begun_s: dict[str, float] = {}
        self.bad = 0
        self.wall_s = self.cpu_s = self.station_cpu_s = 0.0
        self._wanted = sockets * units
        with tempfile.TemporaryDirectory() as folder:
            self._measure(Path(folder), sockets, units)

    def _measure(self, folder: Path, sockets: int, units: int) -> None:
        recipe = make_recipe(folder)
        files = {str(path): sha256 for path, sha256 in recipe.files.items()}
        setups = [
            WorkerSetup(
                str(at + 1),
                recipe.path,
                files,
                None,
                # All begin together, when all processes are there: the worst case.
                VirtualUnits(
                    MockUnits(), at + 1, sockets, arrive_after_s=2.0 + sockets, count=units
                ),
            )
            for at in range(sockets)
        ]
        cpu_before, own_before = _children_cpu_s(), time.process_time()
        key_locations = KeyLocations(folder / "keys")
        records = folder / "records.sqlite"
        with (
            Store.open(str(records), station=self._name, key_locations=key_locations) as store,
            self._beside(records),
        ):
            options = StationOptions(scans_labels=True)
            station = Station(
                store, recipe, setups, operator="jo", on_event=self._hear, options=options
            )
            began = time.perf_counter()
            station.run(until=lambda: len(self.run_s) + self.bad >= self._wanted)
            self.wall_s = time.perf_counter() - began
        self.cpu_s = _children_cpu_s() - cpu_before
        self.station_cpu_s = time.process_time() - own_before

    def _hear(self, event: StationEvent) -> None:
        now = time.perf_counter()
        match event:
            case RunStarted():
                self._begun_s[event.serial], self._steps_s[event.serial] = now, 0.0
            case StepEnded():
                self._steps_s[event.serial] += event.duration_s
                if event.step is StepName.FLASH:
                    self.flash_s.append(event.duration_s)
            case RunEnded():
                if event.run.state is RunState.PASS:
                    self.run_s.append(event.run.duration_s or 0.0)
                    taken_s = now - self._begun_s[event.serial]
                    self.beside_s.append(taken_s - self._steps_s[event.serial])
                else:
                    self.bad += 1


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sockets", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--units", type=int, default=2, help="units in each socket")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores; times in seconds, against one socket alone")
    print("sockets  flash median     longest          run median       ", end="")
    print("beside steps  CPU/unit  station CPU/unit")
    alone: Measured | None = None
    for sockets in options.sockets:
        found = Measured(sockets, options.units)
        alone = alone or found
        flash, run = statistics.median(found.flash_s), statistics.median(found.run_s)
        base, base_run = statistics.median(alone.flash_s), statistics.median(alone.run_s)
        count = len(found.run_s)
        print(
            f"{sockets:>7}  {flash:6.2f} ({flash / base - 1:+6.1%})"
            f"  {max(found.flash_s):6.2f} ({max(found.flash_s) / base - 1:+6.1%})"
            f"  {run:6.2f} ({run / base_run - 1:+6.1%})"
            f"  {statistics.median(found.beside_s):12.3f}"
            f"  {found.cpu_s / count:7.2f}  {found.station_cpu_s / count:9.3f}"
            + (f"  {found.bad} NOT PASSED" if found.bad else ""),
            flush=True,
        )


if __name__ == "__main__":
    main()
