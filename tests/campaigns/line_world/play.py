"""Plays stories, draws them, and shrinks those that end in a violation."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf
from typing import Final

from flasher.conformance.shrink import shrink as shrink_items
from tests.campaigns.line_world import stories
from tests.campaigns.line_world.draw import Teller, setup_of
from tests.campaigns.line_world.promises import Violation
from tests.campaigns.line_world.stories import Story, time_of
from tests.campaigns.line_world.world import STUCK, World

TRIES: Final = 400
"""Maximum number of stories that are played to shrink one."""
_GRID_S: Final = (1.0, 0.5, 0.1, 0.01, 0.001)


@dataclass(frozen=True)
class Played:
    """A story that was played, and what came of it."""

    story: Story
    """Up to a violation, with acts that were skipped: each moment at which somebody looked counts.
    """
    done: Sequence[stories.Act] = ()
    """Its acts that were not skipped."""
    kind: str = ""
    """Of the violation; empty without one."""
    text: str = ""
    seen: Counter[str] | None = None


def play(
    story: Story, log: Callable[[str], None] | None = None, *, goes_home: bool = True
) -> Played:
    """Play a story as it is written, then bring every unit home, or wait for the ends of runs."""
    with World(story, log) as world:
        return _played(world, iter(story.acts), goes_home=goes_home)


def draw(seed: int, steps: int, log: Callable[[str], None] | None = None) -> Played:
    """Draw a story of so many acts, and play it at once."""
    chance = random.Random(seed)
    with World(setup_of(chance), log) as world:
        return _played(world, Teller(chance, world).acts(), steps)


def _played(
    world: World, acts: Iterator[stories.Act], steps: float = inf, *, goes_home: bool = True
) -> Played:
    tried: list[stories.Act] = []
    done: list[stories.Act] = []
    kind = text = ""

    def go(acts: Iterator[stories.Act], steps: float = inf) -> None:
        for act in acts:
            tried.append(act)
            done.append(act)
            if not world.do(act):
                done.pop()
            if len(done) >= steps or world.now > 20.0 * steps:
                return

    kept, is_on_its_way = (tried, done), False
    try:
        go(acts, steps)
        kept, is_on_its_way = (tried.copy(), done.copy()), True
        go(world.way_home() if goes_home else world.end_of_runs())
    except Violation as violation:
        kind, text = violation.kind, str(violation)
        if reason := world.exchanges.reason_of(violation):
            world.seen[f"undetectable: {reason}"] += 1
            kind = text = ""
        has_acted = not is_on_its_way or len(tried) > len(kept[0])
        if kind not in ("", STUCK) and has_acted:
            # What was done on the way home belongs to it, and the time until it was seen.
            is_later = bool(tried) and world.now > time_of(tried[-1])
            end = [stories.Look(when=stories.at(world.now))] if is_later else []
            kept = [*tried, *end], [*done, *end]
    return Played(replace(world.setup, acts=kept[0]), kept[1], kind, text, world.seen)


# -- shrinking -------------------------------------------------------------------------------------


def shrink(
    found: Played, accepts: Callable[[Story], bool] = lambda _story: True, most: int = TRIES
) -> Played:
    """A shorter story with a violation of the same kind, one that is accepted."""
    tries = 0

    def is_bad(story: Story) -> Played | None:
        nonlocal tries
        tries += 1
        if tries > most:
            return None
        # What is seen in the story itself needs no way home, which takes the most time.
        played = play(story, goes_home=found.kind == STUCK)
        return played if played.kind == found.kind and accepts(played.story) else None

    best = is_bad(found.story)
    if best is None:
        return found  # it would not be the same when it is played again
    best = is_bad(replace(best.story, acts=best.done)) or best
    best = _without_acts(best, is_bad)
    best = _simpler_setup(best, is_bad)
    best = _rounder(best, is_bad)
    return _without_acts(best, is_bad)


def _without_acts(best: Played, is_bad: Callable[[Story], Played | None]) -> Played:
    def attempt(acts: Sequence[stories.Act]) -> Sequence[stories.Act] | None:
        nonlocal best
        found = is_bad(replace(best.story, acts=acts))
        best = found or best
        return None if found is None else best.story.acts

    shrink_items(best.story.acts, attempt, tries=TRIES)
    return best


def _simpler_setup(best: Played, is_bad: Callable[[Story], Played | None]) -> Played:
    used = {getattr(act, "unit", None) for act in best.story.acts}
    people = {getattr(act, "by", None) for act in best.story.acts}
    units = [each for each in best.story.units if each.label in used]
    best = is_bad(replace(best.story, units=units)) or best
    left = [each for each in best.story.people if each.name in people]
    best = is_bad(replace(best.story, people=left)) or best
    for number in range(len(best.story.units)):
        for change in (
            {"number": "none"}, {"application": "old"}, {"pace": "fast"}, {"answers": True},
        ):  # fmt: skip
            simpler = list(best.story.units)
            simpler[number] = replace(simpler[number], **change)
            if simpler != list(best.story.units):
                best = is_bad(replace(best.story, units=simpler)) or best
    for sockets in range(1, best.story.line.sockets):
        line = replace(best.story.line, sockets=sockets)
        found = is_bad(replace(best.story, line=line))
        if found is not None:
            return found
    return best


def _rounder(best: Played, is_bad: Callable[[Story], Played | None]) -> Played:
    """Times that a person can read: first all at once, then one by one."""
    for grid in _GRID_S:
        acts = _on_grid(best.story.acts, grid)
        found = is_bad(replace(best.story, acts=acts)) if _are_apart(acts) else None
        if found is not None:
            best = found
            break
    shift = time_of(best.story.acts[0]) - 3.0 if best.story.acts else 0.0
    if shift > 0:
        moved = [replace(each, when=stories.at(time_of(each) - shift)) for each in best.story.acts]
        best = is_bad(replace(best.story, acts=moved)) or best
    for number in range(len(best.story.acts)):
        for grid in _GRID_S:
            acts = list(best.story.acts)
            acts[number] = _on_grid([acts[number]], grid)[0]
            if acts == list(best.story.acts):
                break
            found = is_bad(replace(best.story, acts=acts)) if _are_apart(acts) else None
            if found is not None and len(found.done) == len(acts):
                best = found
                break
    return best


def _are_apart(acts: Sequence[stories.Act]) -> bool:
    """True when each act has a later time than the one before."""
    return all(time_of(one) < time_of(other) for one, other in pairwise(acts))


def _on_grid(acts: Sequence[stories.Act], grid_s: float) -> list[stories.Act]:
    return [replace(each, when=stories.at(round(time_of(each) / grid_s) * grid_s)) for each in acts]
