"""Bounds beyond which a check of a station is an alert."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Bounds:
    """Bounds of `alerts`, and the defaults of the options of the command line."""

    yield_min_percent: float = 90.0
    """Units of the current shift that passed in their last run."""
    units_min: int = 20
    """Fewer units of the shift do not judge its yield."""
    silent_s: float = 300.0
    repeats: int = 5
    """Runs of a socket, one after the other, with the same code."""
    repeats_within_s: float = 86_400.0
    """Older runs are not counted."""
    unsent_s: float = 3600.0
    """Age of the oldest record that waits."""
    clock_s: float = 5.0
    disk_bytes: int = 500 * 1024 * 1024


USUAL_BOUNDS: Final = Bounds()
