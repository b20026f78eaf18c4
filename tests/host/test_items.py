"""What may be read and written by name, and what a person may give as its value."""

from __future__ import annotations

import pytest

from flasher.errors import UsageError
from flasher.host.items import Readable, find_item, make_content, readable, writable
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import ProductionInformation, VersionInformation
from flasher.protocol.spec import BMS, OBC, WELLING
from tests.loops import each

READS, WRITES = readable(BMS, WELLING), writable(BMS, WELLING)


def test_what_has_no_query_of_its_own_is_a_field_of_an_answer() -> None:
    assert READS["serial-number"].field == "serial_number"
    assert READS["serial-number"].content is VersionInformation
    assert READS["version-information"].field == ""
    assert READS["production-information"].field == "", "three fields are no single one"


def test_what_is_not_answered_has_no_content() -> None:
    with pytest.raises(ValueError, match="has no answer"):
        _ = Readable("feedback", BY_KEY[0x725, 0x5503]).content


@each("name", ["user-string-1", "User_String_1", "USER STRING 1"])
def test_a_name_is_found_however_it_is_written(name: str) -> None:
    assert find_item(name, WRITES, BMS, "write") is WRITES["user-string-1"]


def test_a_name_that_is_not_there_is_answered_with_the_closest_and_all() -> None:
    with pytest.raises(UsageError) as refused:
        find_item("serial-nunber", READS, BMS, "read")
    assert refused.value.what == "There is nothing called 'serial-nunber' to read in the BMS."
    assert "serial-number?" in refused.value.remedy
    assert "There are: physical-id, check-code" in refused.value.remedy
    with pytest.raises(UsageError) as refused:
        find_item("serial-number", readable(OBC, WELLING), OBC, "read")
    assert refused.value.what == "The documents give the tool nothing to read in the OBC."
    assert "-t bms" in refused.value.remedy


@each(
    "name, values, data",
    [
        ("user-string-1", ["RACK 7"], b"RACK 7.".ljust(16)),
        ("check-code", ["5a" * 12], b"\x5a" * 12),
        ("check-code", ["0x" + "5a" * 12], b"\x5a" * 12),
        ("check-code", [":".join(["5a"] * 12)], b"\x5a" * 12),
        ("check-code", [b"\x5a" * 12], b"\x5a" * 12),
        ("production-information", ["ACME", "SUZHOU", "2026-05-17"],
         b"ACME.   SUZHOU. 20260517" + bytes(8)),
    ],
)  # fmt: skip
def test_a_value_is_read_as_its_field_has_it(name: str, values: list[object], data: bytes) -> None:
    assert make_content(WRITES[name], values).data() == data


@each(
    "name, values, error",
    [
        ("user-string-1", [], "user-string-1 takes 1 value; no value was given."),
        ("user-string-1", ["a", "b"], "user-string-1 takes 1 value; 2 were given."),
        ("production-information", ["ACME"], "takes 3 values; 1 were given."),
        ("check-code", ["xyz"], "'xyz' is not 12 bytes in hexadecimal."),
        ("check-code", ["5a" * 11], "check-code: "),
        ("production-information", ["A", "B", "20260230"], "20260230' is not in the calendar"),
        ("production-information", ["A", "B", "soon"], "date: 'soon' is not a date YYYYMMDD."),
        ("user-string-1", ["x" * 17], "user-string-1: "),
    ],
)  # fmt: skip
def test_a_value_that_does_not_fit_is_refused_by_name(
    name: str, values: list[object], error: str
) -> None:
    with pytest.raises(UsageError) as refused:
        make_content(WRITES[name], values)
    assert error in refused.value.what


def test_a_missing_value_is_answered_with_the_whole_command() -> None:
    with pytest.raises(UsageError) as refused:
        make_content(WRITES["production-information"], [])
    assert refused.value.remedy == (
        "Write: flasher write production-information MANUFACTURER PLACE DATE"
    )


def test_reserved_fields_are_not_asked_for() -> None:
    assert [name for name, _ in WRITES["production-information"].fields] == [
        "manufacturer", "place", "date",
    ]  # fmt: skip
    assert len(ProductionInformation.LAYOUT) == 4
