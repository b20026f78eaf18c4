"""Builds the example bootloader in C as it is, and with each of its planted bugs, and runs the
whole suite on it: `python -m tests.campaigns.planted_bugs`. Says which case catches which bug, and
which are missed; the one named `none` must pass.

A bug is a patch of a line or two in tests/examples/planted; its first line says what is wrong.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.examples.bootloader import PROFILE, SOURCE, make

NO_BUG = "none"
PLANTED = Path(__file__).parents[1] / "examples" / "planted"
_RUN_MAX_S = 600
_DUT = Path(__file__).parents[2] / "flasher" / "conformance" / "dut"


@dataclass(frozen=True)
class Outcome:
    """What the suite said of a bootloader."""

    name: str
    found: dict[str, str]
    """What the cases that failed found first, by their ids."""
    took_s: float

    @property
    def is_right(self) -> bool:
        """A bug was caught, or nothing was held against what has none."""
        return bool(self.found) is (self.name != NO_BUG)

    @property
    def line(self) -> str:
        by = ", ".join(self.found) or ("passed" if self.is_right else "MISSED")
        return f"{self.name:36} {self.took_s:5.1f} s  {by}"


def plant(bug: str, folder: Path) -> Path:
    """The sources with a bug, in a folder of their own."""
    sources = folder / bug
    shutil.copytree(SOURCE, sources, ignore=shutil.ignore_patterns("build"))
    if bug != NO_BUG:
        command = ["patch", "--silent", "-p1", "-d", str(sources)]
        command += ["-i", str(PLANTED / f"{bug}.patch")]
        subprocess.run(command, check=True, capture_output=True)
    return sources


def run(name: str, sources: Path, arguments: list[str]) -> Outcome:
    """The suite on a build with sanitizers."""
    make("host", sources / "build", f"DUT={_DUT}", source=sources)
    began = time.perf_counter()
    command = [sys.executable, "-m", "flasher", "conformance", "-t", "bms", "--json"]
    command += ["--subject", str(sources / "build" / "boot"), "--profile", str(PROFILE), *arguments]
    ran = subprocess.run(
        command, capture_output=True, text=True, timeout=_RUN_MAX_S, check=False, cwd=sources
    )
    took_s = time.perf_counter() - began
    report = json.loads(ran.stdout)["report"]
    found = {
        result["id"]: f"{check['expected']}; got {check['got']}"
        for result in report["results"]
        if result["status"] == "fail"
        for check in result["findings"][:1]
    }
    stopped = report["not_upgradable"] or report["stopped"]
    if stopped and not found:
        found = {"before the first case": stopped}
    return Outcome(name, found, took_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bugs", nargs="*", metavar="BUG", help="numbers or names; all by default")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="what was found first")
    parser.add_argument("--quick", action="store_true", help="the quick cases only")
    arguments = parser.parse_args()
    bugs = [NO_BUG, *sorted(patch.stem for patch in PLANTED.glob("*.patch"))]
    chosen = [bug for bug in bugs if bug.startswith(tuple(arguments.bugs) or "")]
    options = ["--quick"] if arguments.quick else []
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(arguments.jobs) as pool:
        folder = Path(name)
        outcomes = pool.map(lambda bug: run(bug, plant(bug, folder), options), chosen)
        right = 0
        for outcome in outcomes:
            right += outcome.is_right
            lines = [outcome.line]
            if arguments.verbose:
                lines += [f"    {case}: {what:.200}" for case, what in outcome.found.items()]
            sys.stdout.write("\n".join(lines) + "\n")
            sys.stdout.flush()
    sys.stdout.write(f"{right} of {len(chosen)} as they should be\n")
    sys.exit(0 if right == len(chosen) else 1)


if __name__ == "__main__":
    main()
