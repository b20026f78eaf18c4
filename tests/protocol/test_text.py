"""ASCII fields of the protocol: the terminator rule, and texts that break it (5.1, R20)."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.protocol.text import decode_text, encode_text, printable


@pytest.mark.parametrize(
    ("text", "size_bytes", "field"),
    [
        ("BM36", 16, b"BM36.           "),
        ("V1r2r3_20220512", 16, b"V1r2r3_20220512."),
        ("WELLING", 8, b"WELLING."),
        ("WUXI", 8, b"WUXI.   "),
        ("", 8, b".       "),
        ("A B", 8, b"A B.    "),
    ],
)
def test_a_text_ends_with_a_dot_and_is_filled_with_spaces(
    text: str, size_bytes: int, field: bytes
) -> None:
    assert encode_text(text, size_bytes) == field
    assert decode_text(field) == text


@pytest.mark.parametrize(("text", "size_bytes"), [("WELLINGS", 8), ("A" * 16, 16), ("", 0)])
def test_a_text_without_room_for_its_terminator_is_refused(text: str, size_bytes: int) -> None:
    with pytest.raises(ValueError, match=f"longer than {size_bytes - 1} characters"):
        encode_text(text, size_bytes)


@pytest.mark.parametrize("text", [".", "V1.2", "BM36."])
def test_a_text_with_the_terminator_in_it_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="which ends a field"):
        encode_text(text, 16)


@pytest.mark.parametrize(
    "text", ["caf\u00e9", "\u7535\u6c60", "a\nb", "a\tb", "\x1b[2J", "\x00", "\x7f"]
)
def test_a_text_that_is_not_printable_ascii_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not printable ASCII") as refused:
        encode_text(text, 16)
    assert str(refused.value).isascii()
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("field", "text"),
    [
        (b"FULLFIELDOFTEXT!", "FULLFIELDOFTEXT!"),
        (b"NO END  ", "NO END"),
        (b"A.B.    ", "A.B."),
        (b"A.\x00\x00\x00\x00\x00\x00", r"A.\x00\x00\x00\x00\x00\x00"),
        (b"\x00" * 4, r"\x00\x00\x00\x00"),
        (b"\xff" * 2, r"\xff\xff"),
        (b"V1.2.3", "V1.2.3"),
        (b"\x1b[2J.  ", r"\x1b[2J"),
        (b"\r\nOK.  ", r"\r\nOK"),
        (b"caf\xe9.", r"caf\xe9"),
        (b"        ", ""),
        (b"", ""),
    ],
)
def test_a_field_that_breaks_the_rule_is_shown_as_it_is(field: bytes, text: str) -> None:
    assert decode_text(field) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain <text> & more", "plain <text> & more"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\tb\rc\nd", r"a\tb\rc\nd"),
        ("\x7f\x80\x9b", r"\x7f\x80\x9b"),
        ("\u00e9\u7535", r"\xe9\u7535"),
        ("\u202eright to left", r"\u202eright to left"),
        ("\U0001f600", r"\U0001f600"),
        ("\ud800", r"\ud800"),
        ("", ""),
    ],
)
def test_everything_but_printable_ascii_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown


@settings(max_examples=200, deadline=None, derandomize=True)
@given(field=st.binary(max_size=64))
def test_any_bytes_are_shown_in_printable_ascii(field: bytes) -> None:
    shown = decode_text(field)
    assert shown.isascii()
    assert all(char.isprintable() for char in shown)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(text=st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=15))
def test_a_text_that_keeps_the_rule_comes_back(text: str) -> None:
    kept = text.replace(".", "").rstrip()
    assert decode_text(encode_text(kept, 16)) == kept
