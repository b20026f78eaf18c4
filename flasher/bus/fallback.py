"""Adapter settings of a settings file, for what options, variables and python-can leave open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fallback:
    """python-can's keywords for one adapter. Each applies unless an option, a variable or a file of
    python-can sets it; none applies if these name another interface.
    """

    bus: Mapping[str, Any]
    source: str
    """Name of the settings file, escaped."""
