"""Each test opens records of its own; what SQLAlchemy compiles for one is good for all of them."""

from __future__ import annotations

from functools import partial
from typing import Any

from sqlalchemy import Dialect

from flasher.station.records import database, server


class _Compiled(dict[tuple[Any, ...], Any]):
    """Compiled statements of every engine of a back end: by the statement, whosever dialect."""

    def get(self, key: tuple[Any, ...], default: Any = None) -> Any:
        return super().get(_statement(key), default)

    def __setitem__(self, key: tuple[Any, ...], compiled: Any) -> None:
        super().__setitem__(_statement(key), compiled)


def _statement(key: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(part for part in key if not isinstance(part, Dialect))


def share() -> None:
    """Let all records that this process opens from now on compile each statement once."""
    for module in (database, server):
        options = {"compiled_cache": _Compiled()}
        make = partial(module.create_engine, execution_options=options)
        module.create_engine = make  # type: ignore[attr-defined]
