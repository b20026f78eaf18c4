"""Optional packages (extras) that only some commands need."""

from __future__ import annotations

import importlib.util
from typing import Final

from flasher.errors import ErrorCode, UsageError, how_to_install

_PACKAGES: Final = {
    "cluster": ("distributed",),
    "handover": ("aiomqtt", "httpx2", "procrastinate"),
    "mf4": ("asammdf",),
    "plant": ("alembic", "cryptography", "psycopg", "sqlalchemy"),
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
