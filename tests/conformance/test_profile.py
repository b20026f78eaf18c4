"""The profile: allowed content of a file, and error messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.conformance.mock import profile_of_mock
from flasher.conformance.profile import (
    ConformanceProfile,
    Value,
    check_deviations,
    load_profile,
    profile_keys,
)
from flasher.errors import UsageError
from flasher.mock.profile import DeviceProfile


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "p.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_without_a_file_every_key_has_its_default() -> None:
    profile = ConformanceProfile()
    assert profile.choice("tx_02") == "either"
    assert profile.limit("erase_s") == 10.0
    assert profile.number("largest_image_bytes") == 65535 * 128


def test_every_default_is_allowed() -> None:
    given = {path: key.default for path, key in profile_keys().items()}
    assert ConformanceProfile(given).given == given


def test_a_file_gives_values_rationales_and_deviations(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        'tx_02 = "nak_next"\n'
        'tx_12 = { value = "waits", rationale = "charger" }\n'
        "[limits]\nerase_s = 2\n"
        "[device]\nlargest_image_bytes = 0x1000\n"
        '[deviations]\n"TX-03" = "fixed in V1.1.0"\n',
    )
    profile = load_profile(path)
    assert profile.choice("tx_02") == "nak_next"
    assert profile.choice("tx_12") == "waits"
    assert profile.rationales == {"tx_12": "charger"}
    assert profile.limit("erase_s") == 2.0
    assert profile.number("largest_image_bytes") == 4096
    assert profile.deviations == {"TX-03": "fixed in V1.1.0"}


def test_what_is_written_reads_the_same(tmp_path: Path) -> None:
    profile = ConformanceProfile(
        {"tx_02": "nak_next", "limits.erase_s": 2.5, "device.versions": 3},
        {"tx_02": 'says "so"\n'},
        {"RS-01": "three announcements"},
    )
    read = load_profile(write(tmp_path, profile.to_toml()))
    assert read.given == profile.given
    assert read.rationales == profile.rationales
    assert read.deviations == profile.deviations


def test_a_written_default_profile_gives_nothing(tmp_path: Path) -> None:
    assert load_profile(write(tmp_path, ConformanceProfile().to_toml())).given == {}


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("tx_01_lost = 'nak'", "Did you mean tx_01_lost_frame?"),
        ("[limits]\nerase = 1", "Did you mean erase_s?"),
        ("tx_02 = 'never'", "It is either, ack, nak_next"),
        ("tx_02 = 1", "It is either, ack, nak_next"),
        ("[limits]\nerase_s = -1", "It is seconds from 0 to 3600"),
        ("[limits]\nerase_s = true", "It is seconds"),
        ("[device]\nversions = 2.5", "It is a whole number from 1 to 100"),
        ("tx_02 = { value = 'ack', why = 'x' }", "must be a value, or a table"),
        ("limits = 3", "[limits]"),
        ("[deviations]\n'TX-3' = 'x'", "is not a case"),
        ("[deviations]\n'TX-03' = ''", "has no reason"),
        ("[device]\napplication_bytes = 100", "more than device.application_bytes"),
        ("[device]\nreset_data = 'RST'", "second byte"),
        ("tx_02 = ", "TOML"),
    ],
)
def test_what_is_not_allowed_is_refused_with_its_key(
    tmp_path: Path, text: str, reported: str
) -> None:
    with pytest.raises(UsageError) as raised:
        load_profile(write(tmp_path, text))
    assert reported in str(raised.value)


def test_a_file_that_is_not_there_is_a_mistake_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        load_profile(tmp_path / "none.toml")


def test_a_deviation_of_a_case_that_does_not_exist_is_refused() -> None:
    profile = ConformanceProfile(deviations={"RS-10": "why"})
    with pytest.raises(UsageError, match="not a case of the suite"):
        check_deviations(profile, ["RS-01", "RS-02"])


def test_the_mocks_choices_become_the_suites() -> None:
    device = DeviceProfile(
        repeated_packet="nak_next",
        update_in_transfer="ignored",
        upgrade_in_application="silence",
        transfer_timeout_s=2.0,
        application_area_bytes=64 * 1024,
        largest_image_bytes=1000,
    )
    profile = profile_of_mock(device)
    assert profile.choice("tx_02") == "nak_next"
    assert profile.choice("up_08") == "rejected"
    assert profile.choice("up_03") == "silence"
    assert profile.limit("pause_s") == 2.0
    assert profile.number("largest_image_bytes") == 1000
    # The announcement's 20 bytes take about 1.2 ms on the wire.
    assert 0.1985 < profile.limit("window_s") < 0.199


def test_commands_and_addresses_are_written_in_hexadecimal(tmp_path: Path) -> None:
    given: dict[str, Value] = {
        "device.application_address": 0x0800_8000,
        "device.reset_command": 0x4205,
        "device.largest_image_bytes": 4096,
    }
    text = ConformanceProfile(given).to_toml()
    assert "\napplication_address = 0x8008000\n" in text
    assert "\nreset_command = 0x4205\n" in text
    assert "\nlargest_image_bytes = 4096\n" in text
    assert load_profile(write(tmp_path, text)).given == given
