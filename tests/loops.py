"""What tests go through in a loop: tables of rows as one item each, since an item costs more than
what many a row tests; and in the gate a sample of what a sweep goes through.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

SWEEPS = "FLASHER_TEST_SWEEPS"
"""With this variable the tests go through the whole of what they take a sample of in the gate."""
_T = TypeVar("_T")


def sample(of_gate: _T, whole: _T) -> _T:
    """Return how much a test goes through: all of it with `python -m tests.campaigns.sweeps`."""
    return whole if SWEEPS in os.environ else of_gate


def each(names: str, values: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test on every row of a table. Written as `pytest.mark.parametrize`, and stacked like
    it; but all rows are one item, which goes through all of them and names those that failed.

    `names` are the arguments that a row gives, parted by commas: with several, a row is a tuple.
    """
    keys = [name.strip() for name in names.split(",")]
    rows = [dict(zip(keys, row if len(keys) > 1 else (row,), strict=True)) for row in values]

    def decorate(body: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(body)
        def loop(**others: object) -> None:
            failed = []
            for row in rows:
                try:
                    body(**others, **row)
                except Exception as error:  # noqa: BLE001  each row has its say
                    error.add_note(f"with {row}")
                    failed.append(error)
            if failed:
                raise ExceptionGroup(f"{len(failed)} of {len(rows)} rows failed", failed)

        signature = inspect.signature(body)
        rest = [each for name, each in signature.parameters.items() if name not in keys]
        vars(loop)["__signature__"] = signature.replace(parameters=rest)
        return loop

    return decorate
