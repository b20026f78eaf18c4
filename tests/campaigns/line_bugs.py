"""Plants mistakes in the station, and has the campaign of the line find each of them:
`python -m tests.campaigns.line_bugs`, or with the names of some.

The mistakes are in `line_bugs.toml`. Each is planted in a copy of the package, on which a process
of its own draws stories (`tests.campaigns.line_world`) until one ends in a violation that the
package without the mistake does not have, for at most a minute of computing time; that story is
shrunk. Prints what was found how, and after how long; fails when a mistake is not found.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from tests.campaigns.line_world.play import draw, play, shrink
from tests.campaigns.line_world.stories import Story
from tests.campaigns.line_world.world import STUCK

CHECKOUT: Final = Path(__file__).parents[2]
ACTS: Final = 60
"""Of one story."""
LIMIT_S: Final = 60.0
_BUGS: Final = Path(__file__).with_suffix(".toml")
_YES: Final = "yes"


# -- the mistakes ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Edit:
    file: str
    """In the checkout."""
    old: str
    new: str


@dataclass(frozen=True)
class Bug:
    name: str
    breaks: str
    """Which promise, and how."""
    edits: Sequence[Edit]

    def modules(self) -> dict[str, str]:
        """The changed modules, by their files. Raises ValueError for an edit whose text is not in
        its file exactly once.
        """
        changed: dict[str, str] = {}
        for edit in self.edits:
            text = changed.get(edit.file) or (CHECKOUT / edit.file).read_text("utf-8")
            found = text.count(edit.old)
            if found != 1:
                raise ValueError(f"{self.name}: {edit.old!a} is {found} times in {edit.file}")
            changed[edit.file] = text.replace(edit.old, edit.new)
        return changed


def read_bugs() -> list[Bug]:
    tables = tomllib.loads(_BUGS.read_text("utf-8"))["bug"]
    return [
        Bug(table["name"], table["breaks"], [Edit(**edit) for edit in table["edit"]])
        for table in tables
    ]


def plant(bug: Bug, folder: Path) -> None:
    """Copy the package into a folder, with the mistake."""
    shutil.copytree(CHECKOUT / "flasher", folder / "flasher")
    for file, text in bug.modules().items():
        (folder / file).write_text(text, "utf-8")


# -- the process that has the mistake -------------------------------------------------------------


def hunt(seed: int, limit_s: float, *, shrinks: bool) -> None:
    """Find a story, shrink it, and print it. What is found is asked about on standard input: it
    counts only when the package without the mistake takes it well.
    """
    steps = 0

    def is_ours(story: Story) -> bool:
        _print(story=str(story), kind=found.kind)
        return sys.stdin.readline().strip() == _YES

    while time.process_time() < limit_s:
        found = draw(seed, ACTS)
        seed, steps = seed + 1, steps + len(found.done)
        if found.kind and is_ours(found.story):
            took_s = time.process_time()
            shrunk = shrink(found, is_ours) if shrinks else found
            _print(
                kind=shrunk.kind,
                text=shrunk.text,
                seconds=took_s,
                steps=steps,
                end=str(shrunk.story),
            )
            return
    _print(kind="", text="", seconds=time.process_time(), steps=steps, end="")


def _print(**what: object) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


# -- who starts it, and knows the package as it is ------------------------------------------------


@dataclass(frozen=True)
class Found:
    """What came of a mistake."""

    bug: Bug
    kind: str
    """Of the violation; empty when none was found."""
    text: str
    seconds: float
    """Computing time until it was found, without the shrinking."""
    steps: int
    story: str
    not_ours: int
    """Stories that end badly without the mistake, too."""

    @property
    def acts(self) -> int:
        return len(Story.parse(self.story).acts)

    def lines(self) -> Iterator[str]:
        head = f"{self.bug.name:34} {self.kind or 'NOT FOUND':12} {self.seconds:5.1f} s"
        yield f"{head} {self.steps:6} steps" + (f" {self.acts:3} acts" if self.kind else "")
        yield f"    {self.bug.breaks}"
        if self.text:
            yield f"    {self.text}"
        if self.kind:
            yield f"    {self.story}"
        if self.not_ours:
            yield f"    ({self.not_ours} stories that end so without the mistake were left out)"


_playing = threading.Lock()


def find(bug: Bug, seed: int, limit_s: float, *, shrinks: bool) -> Found:
    with tempfile.TemporaryDirectory() as name:
        plant(bug, Path(name))
        command = [sys.executable, "-m", "tests.campaigns.line_bugs", "--hunt"]
        command += ["--seed", str(seed), "--seconds", str(limit_s)]
        command += [] if shrinks else ["--no-shrink"]
        # The working directory comes first: its package is the one with the mistake.
        environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
        with subprocess.Popen(
            command,
            cwd=name,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            return _converse(process, bug)


def _converse(process: subprocess.Popen[str], bug: Bug) -> Found:
    assert process.stdin is not None
    assert process.stdout is not None
    not_ours = 0
    for line in process.stdout:
        told = json.loads(line)
        if "end" in told:
            return Found(
                bug,
                told["kind"],
                told["text"],
                told["seconds"],
                told["steps"],
                told["end"],
                not_ours,
            )
        with _playing:
            story = Story.parse(told["story"])
            is_ours = not play(story, goes_home=told["kind"] == STUCK).kind
        not_ours += not is_ours
        process.stdin.write(f"{_YES if is_ours else 'no'}\n")
        process.stdin.flush()
    return Found(bug, "", f"Its process ended with code {process.wait()}.", 0.0, 0, "", not_ours)


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bugs", nargs="*", metavar="NAME", help="how names begin; all by default")
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--seed", type=int, default=0, help="of the first story")
    parser.add_argument(
        "--seconds", type=float, default=LIMIT_S, help="computing time for each, without shrinking"
    )
    parser.add_argument("--no-shrink", action="store_true")
    parser.add_argument("--hunt", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.hunt:
        hunt(chosen.seed, chosen.seconds, shrinks=not chosen.no_shrink)
        return 0
    bugs = [bug for bug in read_bugs() if bug.name.startswith(tuple(chosen.bugs) or "")]
    if not bugs:
        parser.error(f"no mistake has such a name: {', '.join(chosen.bugs)}")
    found: list[Found] = []
    with ThreadPoolExecutor(chosen.jobs) as pool:
        search = partial(
            find, seed=chosen.seed, limit_s=chosen.seconds, shrinks=not chosen.no_shrink
        )
        for future in as_completed([pool.submit(search, bug) for bug in bugs]):
            found.append(future.result())
            _say("\n".join([*found[-1].lines(), ""]))
    good = [each for each in found if each.kind]
    _say(f"{len(good)} of {len(bugs)} found")
    if good:
        seconds = statistics.median(each.seconds for each in good)
        steps = statistics.median(each.steps for each in good)
        acts = statistics.median(each.acts for each in good)
        _say(f"medians: {seconds:.1f} s, {steps:g} steps, {acts:g} acts of the shrunk story")
    return int(len(good) < len(bugs))


if __name__ == "__main__":
    sys.exit(main())
