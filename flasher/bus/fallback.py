"""The bus as a file of settings names it: the last of the places that do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Fallback:
    """python-can's keywords for one adapter. Each holds where no option, variable or file of
    python-can's has it; none of them, where these name an adapter of another interface.
    """

    bus: Mapping[str, Any]
    source: str
    """The file, safe to show."""
