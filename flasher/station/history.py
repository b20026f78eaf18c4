"""What a unit's records mean for its next run: what it was before, and what is done already."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import RunDetails, RunState, UnitLife, WriteRecord
from flasher.station.run_model import Texts, flash_value, write_key
from flasher.station.unit_reads import BEFORE

_OPEN: Final = frozenset({RunState.INTERRUPTED, RunState.ERROR, RunState.ABORTED})
FLASH: Final = "flash"


@dataclass(frozen=True)
class Before:
    """The fields of `RunOrder` of these names."""

    known_before: Texts = field(default_factory=dict)
    flashed_before: frozenset[str] = frozenset()
    written_before: Texts = field(default_factory=dict)


def before_of(life: UnitLife | None, recipe: LoadedRecipe, *, is_reworked: bool = False) -> Before:
    """What the next run of a unit has to know. A verdict ends a story: what came before the last
    PASS or FAIL is not the state in which this run finds the unit. But what must not change is
    held until a PASS: a run that failed after its first write may be what changed it. Only for a
    unit that `is_reworked` it is read anew.
    """
    if life is None:
        return Before()
    runs = list(life.runs)
    since = next((at for at, run in reversed(list(enumerate(runs))) if not _is_open(run)), -1)
    still_open = runs[since + 1 :]
    passed_at = [at for at, run in enumerate(runs) if run.run.state is RunState.PASS]
    passed = runs[passed_at[-1]] if passed_at else None
    unfinished = runs[passed_at[-1] + 1 :] if passed_at else runs
    bound = still_open if is_reworked else unfinished
    return Before(
        _known(bound), _flashed(still_open, recipe), {} if passed is None else _written(passed)
    )


def _is_open(run: RunDetails) -> bool:
    return run.run.state in _OPEN


def _known(runs: Sequence[RunDetails]) -> dict[str, str]:
    """What must not change, as the first of these runs that wrote anything read it."""
    known: dict[str, str] = {}
    for run in runs:
        if not run.writes:
            continue
        for step in run.steps:
            for each in step.measurements:
                if each.name.startswith(BEFORE) and each.text is not None:
                    known.setdefault(each.name.removeprefix(BEFORE), each.text)
    return known


def _flashed(runs: Sequence[RunDetails], recipe: LoadedRecipe) -> frozenset[str]:
    """Targets whose last flash in these runs was of this image, and was read back."""
    last: dict[str, WriteRecord] = {}
    for run in runs:
        last |= {write.target: write for write in run.writes if write.what == FLASH}
    wanted = {each.name: flash_value(each.version, each.image.sha256) for each in recipe.targets}
    return frozenset(
        name
        for name, write in last.items()
        if write.value == wanted.get(name) and write.read_back is not None
    )


def _written(run: RunDetails) -> dict[str, str]:
    return {
        write_key(write.target, write.what): write.value
        for write in run.writes
        if write.what != FLASH
    }
