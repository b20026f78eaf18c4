"""Shrinks a sequence that shows a fault to a shorter one that still does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


def shrink(
    items: Sequence[T],
    attempt: Callable[[list[T]], Sequence[T] | None],
    *,
    tries: int,
    is_over: Callable[[], bool] = lambda: False,
) -> list[T]:
    """Leave out items, half of them first, as long as the rest shows the fault.

    `attempt` gets a shorter sequence and returns what of it shows the fault, or None. `is_over` is
    asked after each attempt.
    """
    best, size = list(items), max(len(items) // 2, 1)
    while size and tries:
        start, was_shorter = 0, False
        while start < len(best) and tries:
            tries -= 1
            again = attempt(best[:start] + best[start + size :])
            if again is None:
                start += size
            else:
                best, was_shorter = list(again), True
            if is_over():
                return best
        if not was_shorter:
            size //= 2
    return best
