"""Builds the example bootloader in C as it is, and with each of its planted bugs, and runs the
suite on it: `python -m tests.campaigns.planted_bugs`. Says which case catches which bug, and which
are missed; the one named `none` must pass.

A bug is a patch of a few lines in tests/examples/planted. The first line of its file says what is
wrong. Of the lines up to the patch, `Violates:` names what the protocol demands, `Author:` who
makes such a mistake, and `Missed:` the runs that do not detect it, separated by commas. The
campaign fails when a run detects other bugs than that.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from tests.examples.bootloader import PROFILE, SOURCE, make

PLANTED: Final = Path(__file__).parents[1] / "examples" / "planted"
RUNS: Final = {
    "quick": ("--quick",),
    "full": ("--profile", str(PROFILE)),
}
"""The arguments of the suite: the quick cases with the default profile, and all cases with that of
the example."""
_RUN_MAX_S: Final = 900
DUT: Final = Path(__file__).parents[2] / "flasher" / "conformance" / "dut"


@dataclass(frozen=True)
class Bug:
    name: str
    what: str = ""
    violates: str = ""
    author: str = ""
    missed: frozenset[str] = frozenset()
    """The runs that are known not to detect it."""


NO_BUG: Final = Bug("none", missed=frozenset(RUNS))


def read_bugs() -> list[Bug]:
    """Raises ValueError for a line before a patch that is none of those above."""
    return [_read(patch) for patch in sorted(PLANTED.glob("*.patch"))]


def _read(patch: Path) -> Bug:
    what, *lines = patch.read_text("utf-8").partition("\n--- ")[0].splitlines()
    about = dict(line.split(": ", 1) for line in lines)
    missed = frozenset(about.pop("Missed", "").replace(",", " ").split())
    violates, author = about.pop("Violates", ""), about.pop("Author", "")
    if about or not missed <= RUNS.keys():
        raise ValueError(f"{patch.name}: the lines before the patch are not understood")
    return Bug(patch.stem, what, violates, author, missed)


def plant(bug: Bug, folder: Path) -> Path:
    """The sources with a bug, in a folder of their own."""
    sources = folder / bug.name
    shutil.copytree(SOURCE, sources, ignore=shutil.ignore_patterns("build"))
    if bug is not NO_BUG:
        command = ["patch", "--silent", "-p1", "-d", str(sources)]
        command += ["-i", str(PLANTED / f"{bug.name}.patch")]
        subprocess.run(command, check=True, capture_output=True)
    return sources


@dataclass(frozen=True)
class Outcome:
    """What the suite reports of a bootloader."""

    bug: Bug
    found: dict[str, dict[str, str]]
    """By the run and the id of each case that failed, what it found first."""
    took_s: float

    @property
    def surprises(self) -> list[str]:
        """The runs that detect it although they are known not to, or the other way round."""
        return [run for run, by in self.found.items() if bool(by) is (run in self.bug.missed)]

    def lines(self, *, verbose: bool) -> Iterator[str]:
        for run, by in self.found.items():
            found = ", ".join(by) or ("passed" if self.bug is NO_BUG else "MISSED")
            surprise = "  (unexpected)" if run in self.surprises else ""
            yield f"{self.bug.name:40} {run:5} {found}{surprise}"
            if verbose:
                yield from (f"    {case}: {what:.200}" for case, what in by.items())


def try_out(bug: Bug, folder: Path, runs: Sequence[str]) -> Outcome:
    """Some runs of the suite on a build with sanitizers."""
    sources = plant(bug, folder)
    make("host", sources / "build", f"DUT={DUT}", source=sources)
    began = time.perf_counter()
    found = {run: _failures(sources / "build" / "boot", RUNS[run]) for run in runs}
    shutil.rmtree(sources)
    return Outcome(bug, found, time.perf_counter() - began)


def _failures(subject: Path, arguments: Sequence[str]) -> dict[str, str]:
    command = [sys.executable, "-m", "flasher", "conformance", "-t", "bms", "--json"]
    command += ["--subject", str(subject), *arguments]
    ran = subprocess.run(
        command, capture_output=True, text=True, timeout=_RUN_MAX_S, check=False, cwd=subject.parent
    )
    report = json.loads(ran.stdout)["report"]
    found = {
        result["id"]: f"{check['expected']}; got {check['got']}"
        for result in report["results"]
        if result["status"] == "fail"
        for check in result["findings"][:1]
    }
    stopped = report["not_upgradable"] or report["stopped"]
    return found or ({"before the first case": stopped} if stopped else {})


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bugs", nargs="*", metavar="BUG", help="numbers or names; all by default")
    parser.add_argument("--run", choices=RUNS, help="this one only")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="what was found first")
    arguments = parser.parse_args()
    bugs = [NO_BUG, *read_bugs()]
    chosen = [bug for bug in bugs if bug.name.startswith(tuple(arguments.bugs) or "")]
    runs = [arguments.run] if arguments.run else list(RUNS)
    os.nice(5)
    found: Counter[tuple[str, str]] = Counter()
    surprises = 0
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(arguments.jobs) as pool:
        for outcome in pool.map(partial(try_out, folder=Path(name), runs=runs), chosen):
            surprises += bool(outcome.surprises)
            for run, by in outcome.found.items():
                found[outcome.bug.author, run] += bool(by)
            lines = outcome.lines(verbose=arguments.verbose)
            sys.stdout.write("".join(f"{line}\n" for line in lines))
            sys.stdout.flush()
    for author, count in Counter(bug.author for bug in chosen if bug is not NO_BUG).items():
        by_run = ", ".join(f"{found[author, run]} by the {run} run" for run in runs)
        sys.stdout.write(f"{author or 'of the first thirty'}: {count} bugs, found {by_run}\n")
    sys.stdout.write(f"{surprises} of {len(chosen)} are not as expected\n")
    return 1 if surprises else 0


if __name__ == "__main__":
    sys.exit(main())
