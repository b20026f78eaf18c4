"""Stored plans: for places that random plans seldom reach, and for the planted mistakes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

from flasher.files import parse_toml
from flasher.simulate.plan import Plan, Unsolicited
from flasher.simulate.planting import upgrade_bugs

_CORPUS: Final = Path(__file__).with_name("corpus.toml")


@cache
def corpus() -> Mapping[str, Plan]:
    """Return the plans of the corpus, each by a place that it reaches."""
    table = parse_toml(_CORPUS.read_bytes())["plans"]
    return {place: Plan.parse(line) for place, line in table.items()}


@cache
def parents() -> Sequence[Plan]:
    """Return the plans that random ones are made of."""
    kept = [*corpus().values(), *(Plan.parse(bug.plan) for bug in upgrade_bugs())]
    # A `complete` that no device sent is believed, as its checksum is right, and a short transfer
    # does not show that two devices take part.
    return [
        each
        for each in kept
        if len(each.devices) == 1
        and not any(isinstance(one, Unsolicited) and one.what == "complete" for one in each.events)
    ]
