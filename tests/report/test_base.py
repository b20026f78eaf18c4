"""What every page has, and what no text can do to it."""

from __future__ import annotations

import jinja2
import pytest

from flasher.report.base import counted, percent, render_page, shortened, visible
from tests.loops import each


@each(
    "text, shown",
    [
        ("BMS V1.0.0", "BMS V1.0.0"),
        ("870 \u00b5s \u2013 \u4e2d", "870 \u00b5s \u2013 \u4e2d"),
        ("a\nb\tc", "a\nb\tc"),
        ("\x1b[31m", "\\x1b[31m"),
        ("a\u202eb", "a\\u202eb"),
        ("e\u0301", "e\\u0301"),
        ("\u2028\ue000\udc80", "\\u2028\\ue000\\udc80"),
    ],
)
def test_characters_without_a_shape_of_their_own_are_escaped(text: str, shown: str) -> None:
    assert visible(text) == shown


def test_long_texts_end_in_an_ellipsis() -> None:
    assert shortened("x" * 400) == "x" * 400
    assert shortened("x" * 401) == "x" * 399 + "\u2026"
    assert shortened("abc def", 5) == "abc\u2026"


def test_numbers_and_shares_read_easily() -> None:
    assert counted(65535) == "65,535"
    assert [percent(share) for share in (0, 0.0004, 0.004, 0.0996, 0.874, 1.2)] == [
        "0 %",
        "0 %",
        "0.4 %",
        "10 %",
        "87 %",
        "more than the line carries",
    ]


def test_a_page_that_lacks_a_value_is_not_made() -> None:
    with pytest.raises(jinja2.UndefinedError):
        render_page("explain.html")
