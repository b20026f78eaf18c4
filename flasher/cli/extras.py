"""Packages that only some commands need."""

from __future__ import annotations

import importlib.util
from typing import Final

from flasher.errors import UsageError

_PACKAGES: Final = {
    "station": ("argon2", "cryptography", "segno", "sqlalchemy", "stdnum"),
    "web": ("babel", "itsdangerous", "pygal", "starlette", "uvicorn"),
}
"""By the extra that brings them."""


def need(what: str, extra: str) -> None:
    """Raises UsageError without the packages of an extra."""
    missing = [name for name in _PACKAGES[extra] if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(
            f"{what} needs packages that are not installed: {', '.join(missing)}.",
            remedy=f"In the checkout: pip install -c .ci/constraints.txt '.[{extra}]'",
        )
