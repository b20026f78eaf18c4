"""The release manifest: read strictly, compared with the image, reads back as written."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ImageError, UsageError, WrongDeviceError
from flasher.files import TOML_MAX_SIZE
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.release import Release, check_target
from flasher.protocol.spec import BMS, IMAGE_MAX_SIZE, OBC, WMC
from flasher.settings.manifest import (
    STATEMENTS,
    find_release,
    manifest_path,
    read_release,
    release_of,
    to_toml,
)
from tests.loops import each

VERSION = "V1r0r4_20220512"
IMAGE = Image.from_bytes(b"BMS\0" + VERSION.encode() + bytes(200), source="firmware.bin")
LEAST = f'format = 1\ntarget = "bms"\nsize_bytes = {IMAGE.size_bytes}\nsha256 = "{IMAGE.sha256}"\n'


def written(folder: Path, text: str | bytes, name: str = "firmware.bin.toml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return path


def release(**changes: Any) -> Release:
    return replace(release_of(IMAGE, BMS, source="firmware.bin.toml"), **changes)


# -- writing and reading --------------------------------------------------------------------------


def test_a_manifest_reads_back_as_it_was_written(tmp_path: Path) -> None:
    full = release_of(
        IMAGE,
        BMS,
        source=str(tmp_path / "firmware.bin.toml"),
        hardware_versions=["V1r2r0_20220512", "V1r3*"],
        minimum_boot_version="V1.0.0",
        previous_from="V1r0r0_20220512",
        previous_except=["V1r0r2_20220601"],
        notes='two lines,\n"quoted" \u00fc',
    )
    assert full.firmware_version == VERSION
    assert read_release(written(tmp_path, to_toml(full))) == full


def test_what_is_not_stated_is_left_out(tmp_path: Path) -> None:
    bare = replace(release(), firmware_version=None)
    text = to_toml(bare)
    assert text == LEAST
    assert read_release(written(tmp_path, text)) == replace(
        bare, source=str(tmp_path / "firmware.bin.toml")
    )


def test_every_statement_of_a_release_has_a_key() -> None:
    assert {field.name for field in fields(Release)} == {*STATEMENTS, "source"}


def test_other_names_upper_case_and_a_byte_order_mark_are_read(tmp_path: Path) -> None:
    text = LEAST.replace('"bms"', '"PBU"').replace(IMAGE.sha256, IMAGE.sha256.upper())
    found = read_release(written(tmp_path, b"\xef\xbb\xbf" + text.encode()))
    assert found.target is OBC
    assert found.sha256 == IMAGE.sha256


def test_the_manifest_lies_beside_its_image(tmp_path: Path) -> None:
    image = tmp_path / "firmware.bin"
    assert manifest_path(image) == tmp_path / "firmware.bin.toml"
    assert find_release(image) is None
    beside = written(tmp_path, LEAST)
    other = written(tmp_path, LEAST.replace("bms", "wmc"), "other.toml")
    found, given = find_release(image), find_release(image, other)
    assert found is not None
    assert given is not None
    assert (found.target, found.source) == (BMS, str(beside))
    assert (given.target, given.source) == (WMC, str(other))


# -- refusals -------------------------------------------------------------------------------------

WRONG: list[tuple[str, str, str]] = [
    ("", "does not state its format", "not a manifest"),
    (LEAST.replace("format = 1", "format = 2\nunheard_of = 5"), "has the format 2", "newer"),
    (LEAST.replace("format = 1", "format = true"), "has the format True", "not a manifest"),
    (LEAST.replace("format = 1", 'format = "1"'), "has the format '1'", "format = 1"),
    (LEAST + "hardware_version = []", "unknown key 'hardware_version'", "hardware_versions?"),
    (LEAST + "Sha265 = 1", "unknown key 'Sha265'", "Did you mean sha256?"),
    (LEAST + "[wmc]\nx = 1", "unknown key 'wmc'", "Known are: format, target"),
    ("format = 1", "has no target and no size_bytes and no sha256", "again"),
    (LEAST.replace('"bms"', '"hmi"'), "target cannot be 'hmi'", "one of wmc, bms, obc"),
    (LEAST.replace('"bms"', "2"), "target cannot be 2", "one of wmc"),
    ("format = 1\nsize_bytes = 0", "size_bytes cannot be 0", f"from 1 to {IMAGE_MAX_SIZE}"),
    ("format = 1\nsize_bytes = true", "size_bytes cannot be True", "whole number"),
    ("format = 1\nsize_bytes = 1.5", "size_bytes cannot be 1.5", "whole number"),
    (f"format = 1\nsize_bytes = {IMAGE_MAX_SIZE + 1}", "size_bytes cannot be", "whole number"),
    ('format = 1\nsha256 = "12"', "sha256 cannot be '12'", "64 hex digits"),
    ('format = 1\nfirmware_version = "1.0"', "firmware_version cannot", "Vxrxrx_YYYYMMDD"),
    ('format = 1\nminimum_boot_version = "V1.0"', "minimum_boot_version cannot", "Vx.x.x"),
    ('format = 1\nprevious_from = ""', "previous_from cannot be ''", "Vxrxrx_YYYYMMDD"),
    ('format = 1\nhardware_versions = "V1"', "hardware_versions cannot be 'V1'", "a list of texts"),
    ("format = 1\nprevious_except = [1]", "previous_except[0] cannot be 1", "a text of printable"),
    ('format = 1\nhardware_versions = ["\\u001b[2J"]', "hardware_versions[0] cannot", "\\x1b"),
    ("format = 1\nnotes = 1979-05-27", "notes cannot be datetime", "a text"),
    ("format = ", "is not a readable TOML file", "quotes"),
    (f"format = {'9' * 5000}", "is not a readable TOML file", "quotes"),
    (f"format = {'[' * 5000}", "is not a readable TOML file", "quotes"),
]


@pytest.mark.parametrize(("text", "what", "more"), WRONG)
def test_what_breaks_the_rules_is_refused_by_name(
    tmp_path: Path, text: str, what: str, more: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ImageError) as refused:
        read_release(path)
    reported = str(refused.value)
    assert what in reported
    assert more in reported
    assert str(path) in reported
    assert reported.replace("\n", "").isprintable()


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="is not a readable TOML file"):
        read_release(written(tmp_path, b"\xff\xfe\x00"))


def test_a_file_that_is_far_too_large_is_not_read(tmp_path: Path) -> None:
    path = written(tmp_path, LEAST + "#" * TOML_MAX_SIZE)
    with pytest.raises(ImageError, match="too large"):
        read_release(path)


def test_what_is_no_file_is_refused_and_never_waited_for(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is a directory"):
        read_release(tmp_path)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(UsageError, match="not a regular file"):
            read_release(tmp_path / "pipe")


def test_a_file_that_cannot_be_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    path = written(tmp_path, LEAST)
    monkeypatch.setattr(os, "open", denied)
    with pytest.raises(ImageError, match="cannot be read: Permission denied"):
        read_release(path)


def test_a_manifest_that_is_named_must_exist(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no file of this name"):
        find_release(tmp_path / "firmware.bin", tmp_path / "none.toml")


def test_a_link_that_leads_nowhere_is_not_taken_for_no_manifest(tmp_path: Path) -> None:
    manifest_path(tmp_path / "firmware.bin").symlink_to(tmp_path / "gone.toml")
    with pytest.raises(UsageError, match="there is no file of this name"):
        find_release(tmp_path / "firmware.bin")


# -- the bytes ------------------------------------------------------------------------------------


def test_the_bytes_it_was_made_of_agree() -> None:
    release().check_bytes(IMAGE)
    assert [finding.agrees for finding in release().findings(IMAGE)] == [True] * 4


@each(
    "changes, key",
    [
        ({"size_bytes": 1}, "size_bytes is 1 there"),
        ({"sha256": "0" * 64}, "sha256 is 000"),
        ({"firmware_version": "V1r0r5_20220512"}, "firmware_version is V1r0r5"),
    ],
)
def test_bytes_that_differ_are_refused_with_both_values(
    changes: dict[str, object], key: str
) -> None:
    with pytest.raises(ImageError, match=key) as refused:
        release(**changes).check_bytes(IMAGE)
    assert "the bytes to send have" in refused.value.where


def test_each_statement_comes_with_the_bytes() -> None:
    other = replace(IMAGE, data=b"OBC" + IMAGE.data[3:])
    findings = release().findings(other)
    compared = {each.key: (each.stated, each.found, each.agrees) for each in findings}
    size = str(IMAGE.size_bytes)
    assert compared["target"] == ("BMS", "OBC", False)
    assert compared["size_bytes"] == (size, size, True)
    assert compared["sha256"] == (IMAGE.sha256, other.sha256, False)
    assert compared["firmware_version"] == (VERSION, VERSION, True)


def test_an_image_is_shown_without_its_bytes() -> None:
    assert "data" not in repr(IMAGE)


def test_one_changed_bit_is_found() -> None:
    other = replace(IMAGE, data=IMAGE.data[:-1] + b"\x01")
    with pytest.raises(ImageError, match="sha256"):
        release().check_bytes(other)


def test_the_bytes_to_be_sent_count_and_not_the_file(tmp_path: Path) -> None:
    file = tmp_path / "firmware.bin"
    file.write_bytes(bytes(range(256)) * 4)
    whole, part = load(file, base=0x1000), load(file, base=0x1000, range_=(0x1100, 0x1200))
    release_of(part, BMS).check_bytes(part)
    with pytest.raises(ImageError, match="size_bytes"):
        release_of(part, BMS).check_bytes(whole)
    file.write_bytes(b"changed meanwhile")
    release_of(whole, BMS).check_bytes(whole)


def test_an_image_without_a_version_contradicts_none() -> None:
    silent = Image.from_bytes(bytes(64))
    made = release_of(silent, BMS, firmware_version=VERSION)
    made.check_bytes(silent)
    by_key = {finding.key: finding.agrees for finding in made.findings(silent)}
    assert by_key["firmware_version"] is None
    assert by_key["target"] is None


def test_a_release_is_not_made_with_another_version_than_the_one_inside() -> None:
    with pytest.raises(ImageError, match=f"is version {VERSION}, not V2r0r0_20220512"):
        release_of(IMAGE, BMS, firmware_version="V2r0r0_20220512")


def test_a_release_is_not_made_of_values_that_would_not_read_back() -> None:
    with pytest.raises(ValueError, match=r"Vx\.x\.x"):
        release_of(IMAGE, BMS, minimum_boot_version="1.0.0")
    with pytest.raises(ValueError, match="notes cannot be"):
        release_of(IMAGE, BMS, notes="\udcff")


# -- the target -----------------------------------------------------------------------------------


def test_the_right_target_passes_with_and_without_a_manifest() -> None:
    check_target(IMAGE, release(), BMS)
    check_target(IMAGE, None, BMS)
    check_target(Image.from_bytes(bytes(64)), None, WMC)


def test_another_target_than_the_manifests_is_refused() -> None:
    with pytest.raises(WrongDeviceError, match="is for the BMS, not the WMC"):
        check_target(Image.from_bytes(bytes(64)), release(), WMC)


def test_a_name_inside_the_image_speaks_against_another_target() -> None:
    with pytest.raises(WrongDeviceError, match="names the BMS inside, not the OBC"):
        check_target(IMAGE, None, OBC)
    with pytest.raises(WrongDeviceError, match="image names the BMS inside, not the OBC"):
        check_target(IMAGE, release(target=OBC), OBC)


# -- the device -----------------------------------------------------------------------------------


@each(
    "patterns, text, fits",
    [
        ((), "anything", True),
        (("V1r2r0_20220512",), "V1r2r0_20220512", True),
        (("V1r2r0_20220512",), "V1r2r0_20220513", False),
        (("V1r2r0_20220512",), "v1r2r0_20220512", False),
        (("V1r2*",), "V1r2r0_20220512", True),
        (("V1r2*",), "V1r3r0_20220512", False),
        (("X", "*_2022*"), "V1r3r0_20220512", True),
        (("*",), "", True),
        (("V1r?",), "V1r2", False),
        (("V1r?",), "V1r?", True),
        (("V[12]*",), "V1r2", False),
        (("V[12]*",), "V[12]r2", True),
    ],
)
def test_hardware_fits_by_exact_text_or_star(
    patterns: tuple[str, ...], text: str, *, fits: bool
) -> None:
    assert release(hardware_versions=patterns).fits_hardware(text) is fits


def test_a_hostile_pattern_is_answered_at_once() -> None:
    pattern = "*a" * 40 + "b"
    assert not release(hardware_versions=(pattern,)).fits_hardware("a" * 64)


@each(
    "text, fits",
    [
        ("V1r0r0_20220512", True),
        ("V1r0r3_20220801", False),
        ("V0r9r9_20230101", False),
        ("V1r0r0_20220511", False),
        ("TEST", False),
    ],
)
def test_the_rule_on_the_previous_version(text: str, *, fits: bool) -> None:
    ruled = release(previous_from="V1r0r0_20220512", previous_except=("V1r0r3_20220801",))
    assert ruled.fits_previous(text) is fits


def test_without_a_rule_any_previous_version_will_do() -> None:
    assert release().fits_previous("TEST")
    assert not release(previous_except=("TEST",)).fits_previous("TEST")
