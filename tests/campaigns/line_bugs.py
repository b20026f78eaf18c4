"""Plants mistakes in the station, and has the campaign of the line find each of them:
`python -m tests.campaigns.line_bugs`, or with the names of some.

The mistakes are in `line_bugs.toml`, each with a story that it spoils. With one planted
(`flasher.simulate.planting`) stories are drawn (`tests.campaigns.line_world`) until one ends in a
violation that the station without the mistake does not have, for at most a minute of computing
time; that story is shrunk. Prints what was found how, and after how long;
fails when a mistake is not found.
"""

from __future__ import annotations

import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.simulate.planting import Bug, Edit, swapped
from tests.campaigns.hunts import run
from tests.campaigns.line_world.play import draw, play, shrink
from tests.campaigns.line_world.stories import Story
from tests.campaigns.line_world.world import STUCK

ACTS: Final = 60
"""Of one story."""
LIMIT_S: Final = 60.0
_BUGS: Final = Path(__file__).with_suffix(".toml")


# -- the mistakes ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineBug(Bug):
    kind: str
    """Of the violation with which its story ends."""
    story: str


def read_bugs() -> list[LineBug]:
    tables = tomllib.loads(_BUGS.read_text("utf-8"))["bug"]
    return [
        LineBug(
            table["name"],
            table["breaks"],
            [Edit(**edit) for edit in table["edit"]],
            table["kind"],
            " ".join(table["story"].split()),
        )
        for table in tables
    ]


# -- the search -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """What came of a mistake."""

    bug: LineBug
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

    @property
    def is_found(self) -> bool:
        return bool(self.kind)

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


def find(bug: LineBug, seed: int, limit_s: float, *, shrinks: bool) -> Found:
    """Draw stories with a mistake. What is found counts only when the station without it takes it
    well.
    """
    codes = bug.codes()
    steps = not_ours = 0
    began_at = time.process_time()

    def is_ours(story: Story) -> bool:
        with swapped(codes):
            return not play(story, goes_home=found.kind == STUCK).kind

    with swapped(codes):
        while (took_s := time.process_time() - began_at) < limit_s:
            found = draw(seed, ACTS)
            seed, steps = seed + 1, steps + len(found.done)
            if found.kind and is_ours(found.story):
                took_s = time.process_time() - began_at
                shrunk = shrink(found, is_ours) if shrinks else found
                story = str(shrunk.story)
                return Found(bug, shrunk.kind, shrunk.text, took_s, steps, story, not_ours)
            not_ours += bool(found.kind)
    return Found(bug, "", "", took_s, steps, "", not_ours)


if __name__ == "__main__":
    sys.exit(
        run(
            __doc__,
            read_bugs(),
            find,
            limit_s=LIMIT_S,
            figures={"steps": lambda each: each.steps, "acts of the story": lambda each: each.acts},
        )
    )
