"""Optional packages (extras) that only some commands need."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from typing import Final

from flasher.errors import ErrorCode, UsageError

_PACKAGES: Final = {
    "cluster": ("distributed",),
    "mf4": ("asammdf",),
    "station": ("alembic", "argon2", "babel", "cryptography", "segno", "sqlalchemy", "stdnum"),
    "web": ("itsdangerous", "pygal", "starlette", "uvicorn"),
}
"""Python packages of each extra."""


def need(what: str, extra: str) -> None:
    """Raise UsageError if packages of an extra are missing."""
    missing = [name for name in _PACKAGES[extra] if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"{what} needs packages that are not installed: {', '.join(missing)}.",
            remedy=how_to_install(extra),
            code=ErrorCode.PACKAGE_MISSING,
        )


def how_to_install(extra: str) -> str:
    """Return the command that installs the packages of an extra into the running Python."""
    words = [sys.executable, "-m", "pip", "install", "-c", ".ci/constraints.txt", f".[{extra}]"]
    return f"In the checkout: {shlex.join(words)}"
