"""From the station's file and a recipe to what the process of each socket is given."""

from __future__ import annotations

from collections.abc import Sequence

from flasher.station.adapters import Resolved
from flasher.station.messages import VirtualUnits, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe


def worker_setups(
    sockets: Sequence[Resolved],
    recipe: LoadedRecipe,
    *,
    first_number: int = 1,
    speed: float = 1.0,
) -> tuple[WorkerSetup, ...]:
    """One setup a socket. Virtual units are numbered from `first_number` on, no number twice; they
    run `speed` times as fast as real ones.
    """
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    return tuple(
        WorkerSetup(
            each.config.name,
            recipe.path,
            files,
            each.bus,
            None
            if each.config.mock is None
            else VirtualUnits(each.config.mock, first_number + at, len(sockets), speed),
            each.config.power,
        )
        for at, each in enumerate(sockets)
    )
