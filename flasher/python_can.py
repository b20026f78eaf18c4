"""Import of python-can without asammdf, which takes 0.5 s and is needed for .mf4 files only."""

from __future__ import annotations

import importlib
import sys
from typing import Any

_KEPT_OUT = "can" not in sys.modules and "asammdf" not in sys.modules
if _KEPT_OUT:
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # an import of it fails
try:
    import can  # noqa: TID251  the one place
finally:
    if _KEPT_OUT:
        del sys.modules["asammdf"]

__all__ = ["can", "load_mf4"]


def load_mf4() -> None:
    """Enable .mf4 files in python-can, if asammdf is installed."""
    module: Any = can.io.mf4
    if module.asammdf is None:
        # The classes that python-can has handed out look in their module too.
        importlib.reload(module)
