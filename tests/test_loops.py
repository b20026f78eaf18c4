"""A loop over a table fails for every row that does, and says which."""

from __future__ import annotations

import inspect

import pytest

from .loops import each


def test_every_row_is_run_and_those_that_fail_are_named() -> None:
    seen = []

    @each("first", [1, 2, 3])
    @each("second, third", [(10, "a"), (20, "b")])
    def body(fixture: str, first: int, second: int, third: str) -> None:
        seen.append((fixture, first, second, third))
        assert first * second != 40, "too many"

    assert list(inspect.signature(body).parameters) == ["fixture"]
    with pytest.raises(ExceptionGroup, match=r"1 of 3 rows failed") as caught:
        body(fixture="given")
    assert len(seen) == 6
    (outer,) = caught.value.exceptions
    assert isinstance(outer, ExceptionGroup)
    (inner,) = outer.exceptions
    assert isinstance(inner, AssertionError)
    assert (outer.__notes__, inner.__notes__) == (
        ["with {'first': 2}"],
        ["with {'second': 20, 'third': 'b'}"],
    )
