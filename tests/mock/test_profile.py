"""The options of the device model: their values, how a user sets them, what is refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.mock.profile import DeviceProfile
from flasher.settings.device_model import describe_options, set_option
from tests.loops import each

DEFAULT = DeviceProfile()


@each(
    "key, text, value",
    [
        ("repeated_packet", "nak_next", "nak_next"),
        ("boot_version", "V9.8.7", "V9.8.7"),
        ("window_s", "0.5", 0.5),
        ("application_area_bytes", "0x8000", 32768),
        ("application_area_bytes", "512K", 524288),
        ("application_area_bytes", "8M", 8388608),
        ("application_area_bytes", "0x2K", 2048),
        ("largest_image_bytes", "1000", 1000),
        ("largest_image_bytes", "none", None),
        ("largest_image_bytes", "0", 0),
    ],
)
def test_an_option_is_set_from_text(key: str, text: str, value: object) -> None:
    profile = set_option(DEFAULT, key, text)
    assert getattr(profile, key) == value
    assert dataclasses.replace(profile, **{key: getattr(DEFAULT, key)}) == DEFAULT


def test_an_unknown_option_is_answered_with_the_closest_and_all_known_ones() -> None:
    with pytest.raises(UsageError) as caught:
        set_option(DEFAULT, "repeated_paket", "ack")
    assert "'repeated_paket'" in caught.value.what
    assert "Did you mean repeated_packet?" in caught.value.remedy
    assert "erase_time_s" in caught.value.remedy


def test_an_unknown_value_is_answered_with_the_closest_and_all_allowed_ones() -> None:
    with pytest.raises(UsageError) as caught:
        set_option(DEFAULT, "older_packet", "silent")
    assert "'silent'" in caught.value.what
    assert "Did you mean silence? It is ack, nak, silence" in caught.value.remedy


def test_a_value_like_none_of_the_allowed_ones_gets_no_suggestion() -> None:
    with pytest.raises(UsageError) as caught:
        set_option(DEFAULT, "older_packet", "xyz")
    assert caught.value.remedy.startswith("It is ack, nak, silence: ")


@each(
    "key, text",
    [
        ("window_s", "soon"),
        ("window_s", "nan"),
        ("window_s", "inf"),
        ("window_s", "-1"),
        ("application_area_bytes", "2.5"),
        ("application_area_bytes", "K"),
        ("application_area_bytes", ""),
        ("largest_image_bytes", "-1"),
    ],
)
def test_a_number_that_is_none_or_out_of_range_is_refused_by_name(key: str, text: str) -> None:
    with pytest.raises(UsageError, match=f"^{key} cannot be .*"):
        set_option(DEFAULT, key, text)


@each(
    "change, problem",
    [
        ({"program_unit_bytes": 3}, "program_unit_bytes divides 128; 3 does not"),
        ({"program_unit_bytes": 0}, "program_unit_bytes divides 128"),
        ({"page_size_bytes": 100}, "page_size_bytes is a multiple of 128"),
        ({"page_size_bytes": 0}, "page_size_bytes is a multiple of 128"),
        ({"application_area_bytes": 3000}, "application_area_bytes is a multiple of 2048"),
        ({"application_area_bytes": 0}, "application_area_bytes is a multiple of 2048"),
        ({"boot_version": "V1.2.34"}, "boot_version is 6 ASCII characters"),
        ({"boot_version": "V1.2.\u00e4"}, "boot_version is 6 ASCII characters"),
        ({"model": "BM.36"}, "model: "),
        ({"serial_number": "W" * 16}, "serial_number: "),
        ({"factory_version": "V1\n"}, "factory_version: "),
        ({"transfer_timeout_s": 0.0}, "transfer_timeout_s is greater than 0"),
    ],
)
def test_values_that_no_device_could_have_are_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        DeviceProfile(**change)


def test_every_option_is_described_with_its_default_first_and_in_one_line() -> None:
    described = describe_options()
    assert [key for key, _, _ in described] == [
        field.name for field in dataclasses.fields(DeviceProfile)
    ]
    values = {key: allowed for key, allowed, _ in described}
    assert values["repeated_packet"] == "ack | nak_next"
    assert values["older_packet"] == "ack | nak | silence"
    assert values["erase_time_s"] == "0.002"
    assert values["largest_image_bytes"] == "none"
    assert all(text and "\n" not in text for _, _, text in described)


def test_every_value_that_is_described_can_be_set() -> None:
    for key, allowed, _ in describe_options():
        for text in allowed.split(" | "):
            assert str(getattr(set_option(DEFAULT, key, text), key)) in {text, "None"}


@each(
    "area, largest, limit",
    [(2048, None, 2048), (2048, 100, 100), (2048, 9999, 2048), (16 << 20, None, 8_388_480)],
)
def test_the_largest_image_is_bounded_by_area_option_and_protocol(
    area: int, largest: int | None, limit: int
) -> None:
    profile = DeviceProfile(application_area_bytes=area, largest_image_bytes=largest)
    assert profile.image_limit_bytes == limit


def test_a_profile_made_in_a_program_is_checked_as_one_that_is_read() -> None:
    with pytest.raises(UsageError, match="older_battery cannot be 'yse'") as caught:
        DeviceProfile(older_battery="yse")  # type: ignore[arg-type]  # as a program may
    assert "Did you mean yes?" in caught.value.remedy
    with pytest.raises(UsageError, match="program_time_s is a number from 0 on, not -1"):
        DeviceProfile(program_time_s=-1.0)
