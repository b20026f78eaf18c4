"""Check digits, patterns and templates: the texts of a scan."""

from __future__ import annotations

import time
from datetime import date

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.station.pattern import CHECKS, TEXT_MAX, WAYS_MAX, Pattern
from flasher.station.recipe import Scan, check_template, fill, uses_lot
from tests.loops import each

STANDARD_EXAMPLES = {
    "luhn": ["79927398713", "4111111111111111"],
    "gtin": ["4006381333931", "73513537", "036000291452", "00012345600012"],
    "mod11-2": ["07940", "000000012146438X"],
    "mod11-10": ["07945"],
    "mod37-2": ["G123489654321Y"],
    "mod37-36": ["A12425GABC1234002M"],
    "mod97-10": ["79444", "3214282912345698765432161182"],
}


@each("method, texts", STANDARD_EXAMPLES.items())
def test_a_check_digit_agrees_with_the_examples_of_its_standard(
    method: str, texts: list[str]
) -> None:
    assert all(CHECKS[method](text) for text in texts)


def test_every_method_has_a_known_answer() -> None:
    assert set(STANDARD_EXAMPLES) == set(CHECKS)


@each("method", CHECKS)
def test_a_wrong_character_is_found_at_any_place(method: str) -> None:
    for text in STANDARD_EXAMPLES[method]:
        for place, char in enumerate(text):
            for other in "0123456789":
                if other != char and char.isdecimal():
                    wrong = text[:place] + other + text[place + 1 :]
                    assert not CHECKS[method](wrong), wrong


@each("method", CHECKS)
@each("text", ["", "0", "\u0661\u0662", "12 4", "12-4", "\x00\x00\x00"])
def test_what_is_no_number_has_no_right_check_digit(method: str, text: str) -> None:
    assert not CHECKS[method](text)


def test_a_pattern_gives_its_groups_for_the_whole_text_only() -> None:
    pattern = Pattern(r"W(?P<year>[0-9]{2})(?P<letter>[A-F]?)\d{2,3}")
    assert pattern.match("W26A123") == {"year": "26", "letter": "A"}
    assert pattern.match("W2612") == {"year": "26", "letter": ""}
    assert pattern.match("xW2612") is None
    assert pattern.match("W2612\n") is None
    assert pattern.match("W26\u0661\u0662") is None  # digits of another script


@each(
    "text",
    ["(A+)+", "A*", "A{2,}", "(?:AB){2}", "(?P<a>x)(?P=a)", r"(x)\1", "(?=x)x", "(?i)x", "A{3}{3}",
     "A{65}", "A{5,2}", "(A", "A)", "A??", "[A", r"\q", "(?P<a>x)(?P<a>x)", "A" * 201],
)  # fmt: skip
def test_a_pattern_that_could_take_long_or_is_wrong_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        Pattern(text)


def test_the_ways_to_read_a_text_are_bounded() -> None:
    Pattern("[0-9]{0,9}" * 4)
    with pytest.raises(ValueError, match="ways"):
        Pattern("[0-9]{0,9}" * 4 + "A?")
    with pytest.raises(ValueError, match="ways"):
        Pattern("(A|AA)" * 14)


@pytest.mark.slow
@settings(max_examples=60)
@given(
    st.lists(st.sampled_from(["A", "[AB]{0,3}", "A?", "(A|AA)", "A{1,2}", "."]), max_size=9),
    st.integers(0, TEXT_MAX),
)
def test_no_pattern_that_is_taken_is_slow(pieces: list[str], count: int) -> None:
    try:
        pattern = Pattern("".join(pieces))
    except ValueError as error:
        assert str(WAYS_MAX) in str(error)  # noqa: PT017  most patterns are fine
        return
    began = time.perf_counter()
    pattern.match("A" * count + "!")
    assert time.perf_counter() - began < 0.25


SCAN = Scan("W2605002", date(2026, 5, 17), "L7", {"week": "05"})


@each(
    "template, text",
    [
        ("{serial}", "W2605002"),
        ("{date:%Y%m%d}", "20260517"),
        ("{date}", "20260517"),
        ("{date:%y-%j}", "26-137"),
        ("{lot}/{match.week}", "L7/05"),
        ("{{serial}}", "{serial}"),
        ("plain", "plain"),
    ],
)
def test_a_template_is_filled_from_the_scan(template: str, text: str) -> None:
    assert fill(template, SCAN) == text


@each(
    "template",
    ["{", "}", "{}", "{serial.__class__}", "{serial!r}", "{match.none}", "{0}", "{date:%s}",
     "{date:%Y%m%d%n}", "{match}", "{serial:>99999999}", "{{{"],
)  # fmt: skip
def test_a_template_reaches_nothing_but_the_scan(template: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        check_template(template, ["week"])


def test_it_is_known_whether_a_template_needs_a_lot() -> None:
    assert uses_lot("x{lot}")
    assert not uses_lot("{{lot}}")
