"""ASCII fields of the protocol: the terminator rule, and texts that break it (5.1, R20)."""

from __future__ import annotations

import datetime

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.protocol.messages import BootVersion
from flasher.protocol.text import (
    FirmwareVersion,
    boot_version_number,
    decode_text,
    encode_text,
    find_firmware_version,
    firmware_version_spans,
    no_formula,
    printable,
)
from tests.loops import each


@each(
    "text, size_bytes, field",
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


@each("text, size_bytes", [("WELLINGS", 8), ("A" * 16, 16), ("", 0)])
def test_a_text_without_room_for_its_terminator_is_refused(text: str, size_bytes: int) -> None:
    with pytest.raises(ValueError, match=f"longer than {size_bytes - 1} characters"):
        encode_text(text, size_bytes)


@each("text", [".", "V1.2", "BM36."])
def test_a_text_with_the_terminator_in_it_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="the terminator of a field"):
        encode_text(text, 16)


@each("text", ["caf\u00e9", "\u7535\u6c60", "a\nb", "a\tb", "\x1b[2J", "\x00", "\x7f"])
def test_a_text_that_is_not_printable_ascii_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="not printable ASCII") as refused:
        encode_text(text, 16)
    assert str(refused.value).isascii()
    assert str(refused.value).isprintable()


@each(
    "field, text",
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


@each(
    "text, shown",
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


# -- versions -------------------------------------------------------------------------------------


@each(
    "older, newer",
    [
        ("V1r0r4_20220512", "V1r0r5_20220512"),
        ("V1r0r9_20220512", "V1r1r0_20220512"),
        ("V1r9r9_20220512", "V2r0r0_20220512"),
        ("V1r0r9_20220512", "V1r0r10_20220512"),  # as numbers, not as texts
        ("V9r0r0_20220512", "V10r0r0_20220512"),
        ("V1r0r4_20220512", "V1r0r4_20220513"),
        ("V1r0r4_20221231", "V1r0r4_20230101"),
        ("V1r0r4_20231231", "V1r0r5_20220101"),  # numbers go before the date
    ],
)
def test_firmware_versions_are_ordered_by_numbers_then_date(older: str, newer: str) -> None:
    first, second = FirmwareVersion.parse(older), FirmwareVersion.parse(newer)
    assert first is not None
    assert second is not None
    assert first < second


def test_a_firmware_version_in_its_parts() -> None:
    assert FirmwareVersion.parse("V1r2r34_20220512") == FirmwareVersion(1, 2, 34, "20220512")
    assert FirmwareVersion.parse("V01r2r3_20220512") == FirmwareVersion.parse("V1r2r3_20220512")


@each(
    "text",
    [
        "",
        "V1.0.0",
        "V1r0r4",
        "V1r0r4_2022",
        "V1r0r4_20221301",
        "V1r0r4_20220532",
        "v1r0r4_20220512",
        "V1r0r4_20220512 ",
        "V1r0r4_20220512\n",
        " V1r0r4_20220512",
        "V123r0r4_20220512",
        "V\u0661r0r4_20220512",
        "\ud800",
    ],
)
def test_a_text_that_breaks_the_naming_rule_is_no_firmware_version(text: str) -> None:
    assert FirmwareVersion.parse(text) is None


_NUMBERS = st.integers(min_value=0, max_value=99)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(numbers=st.tuples(_NUMBERS, _NUMBERS, _NUMBERS), date=st.dates())
def test_what_is_found_in_an_image_can_be_parsed(
    numbers: tuple[int, int, int], date: datetime.date
) -> None:
    day = f"{date.year:04}{date.month:02}{date.day:02}"
    text = "V{}r{}r{}_".format(*numbers) + day
    data = b"\0" + text.encode() + b"\0"
    assert find_firmware_version(data) == text
    assert list(firmware_version_spans(data)) == [(1, 1 + len(text))]
    assert FirmwareVersion.parse(text) == FirmwareVersion(*numbers, day)


def test_the_same_version_twice_is_one_and_two_are_none() -> None:
    one, other = b"V1r0r4_20220512", b"V1r0r5_20220512"
    assert find_firmware_version(one + b"\0" + one) == one.decode()
    assert find_firmware_version(one + b"\0" + other) is None


@each(
    "text, number",
    [
        ("V1.0.0", (1, 0, 0)),
        ("V0.9.8", (0, 9, 8)),
        ("V1.0", None),
        ("V1.0.10", None),
        ("1.0.0", None),
        ("v1.0.0", None),
        ("V1.0.0\n", None),
        ("V\u0661.0.0", None),
        ("", None),
    ],
)
def test_a_boot_version_as_numbers(text: str, number: tuple[int, int, int] | None) -> None:
    assert boot_version_number(text) == number
    assert BootVersion("BMS", text).is_version is (number is not None)


@each(
    "text, cell", [("=1+1", "'=1+1"), ("-A", "'-A"), ("@x", "'@x"), ("RACK 7", "RACK 7"), ("", "")]
)
def test_a_spreadsheet_takes_no_text_for_a_formula(text: str, cell: str) -> None:
    assert no_formula(text) == cell
