"""Optional packages (extras) that only some commands need."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import wraps
from importlib import import_module
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


class Actions:
    """Actions of a group, whose modules in `package` need an extra and are imported when called."""

    def __init__(self, package: str, what: str, extra: str) -> None:
        self._package, self._what, self._extra = package, what, extra

    def documents(self, name: str) -> tuple[type, ...]:
        """Return the types of the `--json` documents and lines, for the schema. For `__getattr__`
        of the group's module: AttributeError for any other name.
        """
        if name not in ("DOCUMENTS", "LINES"):
            raise AttributeError(name)
        found: tuple[type, ...] = getattr(import_module(f"{self._package}.documents"), name)
        return found

    def call(self, action: str, *args: object, **named: object) -> int:
        """Run an action ("module.function") and return its exit code. Raises UsageError when the
        extra is not installed.
        """
        need(self._what, self._extra)
        module, _, name = action.partition(".")
        code: int = getattr(import_module(f"{self._package}.{module}"), name)(*args, **named)
        return code

    def calls(
        self, action: str, *, also: tuple[str, str] | None = None
    ) -> Callable[[Callable[[], None]], Callable[..., int]]:
        """Make a declaration, of which only the docstring counts, call an action with the output
        and the options by their names. `also`: arguments of `need` for one more extra.
        """

        def decorate(declared: Callable[[], None]) -> Callable[..., int]:
            @wraps(declared)
            def run(output: object, **options: object) -> int:
                if also is not None:
                    need(*also)
                return self.call(action, output, **options)

            return run

        return decorate
