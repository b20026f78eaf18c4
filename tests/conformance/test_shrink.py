"""The shrinker that walks and exported tests share."""

from __future__ import annotations

from flasher.conformance.shrink import shrink


def test_only_what_shows_the_fault_is_left() -> None:
    found = shrink(range(40), lambda fewer: fewer if {3, 30} <= set(fewer) else None, tries=60)
    assert found == [3, 30]


def test_what_an_attempt_returns_is_taken() -> None:
    """A walk may end before its last steps."""
    found = shrink(
        list("abcdef"), lambda fewer: fewer[: fewer.index("b") + 1] if "b" in fewer else None,
        tries=60,
    )  # fmt: skip
    assert found == ["b"]


def test_it_ends_after_so_many_tries_and_when_it_is_over() -> None:
    tried: list[list[int]] = []

    def attempt(fewer: list[int]) -> None:
        tried.append(fewer)

    assert shrink(range(8), attempt, tries=3) == list(range(8))
    assert len(tried) == 3
    assert shrink(range(8), attempt, tries=60, is_over=lambda: len(tried) == 5) == list(range(8))
    assert len(tried) == 5
