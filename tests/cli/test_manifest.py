"""`flasher manifest`: what it writes, what it checks, and what image-info says of it."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.protocol.spec import BMS
from flasher.settings.manifest import read_release
from tests.cli.conftest import SAMPLES, Flasher
from tests.firmware import VECTORS


@pytest.fixture
def image(tmp_path: Path, short_bms: Path) -> Path:
    """A short sample of the BMS, alone in a folder."""
    path = tmp_path / "firmware.hex"
    shutil.copy(short_bms, path)
    return path


@pytest.fixture
def sha256(short_bms: Path) -> str:
    """The hash of its bytes."""
    return hashlib.sha256(short_bms.with_suffix(".bin").read_bytes()).hexdigest()


@pytest.fixture
def manifest(image: Path, flasher: Flasher) -> Path:
    """The manifest of `image`, written by the command."""
    assert flasher("manifest", "create", image, "-t", "bms").code == ExitCode.OK
    return image.with_name("firmware.hex.toml")


# -- create ---------------------------------------------------------------------------------------


def test_create_writes_everything_it_is_given(flasher: Flasher, image: Path, sha256: str) -> None:
    run = flasher(
        "manifest", "create", image, "-t", "bms",
        "--hardware-version", "V1r2r0_*", "--hardware-version", "V1r3r0_20230101",
        "--minimum-boot-version", "V1.0.0", "--previous-from", "V1r0r0_20220512",
        "--previous-except", "V1r0r2_20220601", "--notes", "field trial",
    )  # fmt: skip
    assert run.code == ExitCode.OK
    assert "hardware_versions:     V1r2r0_*, V1r3r0_20230101" in run.out
    assert run.err == ""
    release = read_release(image.with_name("firmware.hex.toml"))
    assert release.target is BMS
    assert release.firmware_version == "V1r0r4_20220512"
    assert (release.size_bytes, release.sha256) == (4096, sha256)
    assert release.hardware_versions == ("V1r2r0_*", "V1r3r0_20230101")
    assert release.minimum_boot_version == "V1.0.0"
    assert release.previous_from == "V1r0r0_20220512"
    assert release.previous_except == ("V1r0r2_20220601",)
    assert release.notes == "field trial"


def test_create_does_not_overwrite_unless_forced(
    flasher: Flasher, image: Path, manifest: Path
) -> None:
    manifest.write_text("precious")
    run = flasher("manifest", "create", image, "-t", "bms")
    assert run.code == ExitCode.USAGE
    assert "exists" in run.err
    assert manifest.read_text() == "precious"
    assert flasher("manifest", "create", image, "-t", "bms", "--force").code == ExitCode.OK
    assert read_release(manifest).target is BMS


def test_force_does_not_waive_the_checks_of_the_image(flasher: Flasher, tmp_path: Path) -> None:
    bad = shutil.copy(SAMPLES / "bad" / "outside_vector.hex", tmp_path)
    run = flasher("manifest", "create", bad, "-t", "bms", "--force")
    assert run.code == ExitCode.IMAGE
    assert "vector" in run.err


def test_create_never_writes_over_the_image(flasher: Flasher, image: Path) -> None:
    before = image.read_bytes()
    run = flasher("manifest", "create", image, "-t", "bms", "-o", image, "--force")
    assert run.code == ExitCode.USAGE
    assert "is the image itself" in run.err
    assert image.read_bytes() == before


@pytest.mark.parametrize("output", ["", "missing/manifest.toml"])
def test_create_states_where_it_cannot_write(flasher: Flasher, image: Path, output: str) -> None:
    run = flasher("manifest", "create", image, "-t", "bms", "-o", image.parent / output)
    assert run.code == ExitCode.USAGE
    assert "[E202]" in run.err
    assert list(image.parent.iterdir()) == [image]


def test_create_warns_when_the_image_names_another_target(flasher: Flasher, image: Path) -> None:
    run = flasher("manifest", "create", image, "-t", "wmc", "-q")
    assert run.code == ExitCode.OK
    assert "warning: the image names the BMS; the manifest says that it is for the WMC" in run.err


def test_create_warns_when_the_image_names_another_target_too(
    flasher: Flasher, tmp_path: Path
) -> None:
    both = tmp_path / "both.bin"
    both.write_bytes(VECTORS + b"\x20BMS_UPD\0WMC_UPD\0\xf0\xf1" * 9)
    document = flasher(
        "manifest", "create", both, "-t", "wmc", "--format", "bin", "--json"
    ).document
    assert document["warnings"] == [
        "the image also names the BMS; the manifest says that it is for the WMC"
    ]


@pytest.mark.parametrize(
    ("option", "value", "reported"),
    [
        ("--firmware-version", "1.0", "Vxrxrx_YYYYMMDD"),
        ("--minimum-boot-version", "V1", "Vx.x.x"),
        ("--previous-from", "V1.0.0", "Vxrxrx_YYYYMMDD"),
        ("--hardware-version", "", "hardware_versions"),
        ("--previous-except", "\x1b", "previous_except"),
    ],
)
def test_create_refuses_values_that_no_manifest_holds(
    flasher: Flasher, image: Path, option: str, value: str, reported: str
) -> None:
    run = flasher("manifest", "create", image, "-t", "bms", option, value)
    assert run.code == ExitCode.USAGE
    assert reported in run.err
    assert "\x1b" not in run.err
    assert list(image.parent.iterdir()) == [image]


def test_create_refuses_another_version_than_the_one_inside(flasher: Flasher, image: Path) -> None:
    run = flasher("manifest", "create", image, "-t", "bms", "--firmware-version", "V2r0r0_20230101")
    assert run.code == ExitCode.IMAGE
    assert "is version V1r0r4_20220512, not V2r0r0_20230101" in run.err


# -- check ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("manifest")
def test_check_states_line_by_line_what_was_checked(
    flasher: Flasher, image: Path, sha256: str
) -> None:
    run = flasher("manifest", "check", image, "-t", "bms")
    assert run.code == ExitCode.OK
    lines = [line.split(":", 1) for line in run.out.splitlines()[1:]]
    assert {label.strip(): reported.strip() for label, reported in lines} == {
        "size_bytes": "4096: agrees",
        "sha256": f"{sha256}: agrees",
        "firmware_version": "V1r0r4_20220512: agrees",
        "target": "BMS: agrees",
        "requested_target": "BMS: agrees",
        "hardware_versions": "not stated: any will do",
        "minimum_boot_version": "not stated: any will do",
        "previous_from": "not stated: any will do",
    }


def test_check_states_what_there_was_nothing_to_check_against(
    flasher: Flasher, tmp_path: Path
) -> None:
    silent = tmp_path / "silent.bin"
    silent.write_bytes(VECTORS + bytes(range(240)))
    flasher(
        "manifest", "create", silent, "-t", "obc", "--firmware-version", "V1r0r4_20220512",
        "--hardware-version", "V1*", "--previous-except", "TEST",
    )  # fmt: skip
    run = flasher("manifest", "check", silent)
    assert run.code == ExitCode.OK
    assert "V1r0r4_20220512: nothing to check against, the image does not say it" in run.out
    assert "OBC: nothing to check against, the image does not say it" in run.out
    assert "OBC: nothing to check against, the command line does not say it" in run.out
    assert "V1*: not checked, only a device can answer it" in run.out
    assert "TEST: not checked, only a device can answer it" in run.out


def test_check_finds_a_changed_image(flasher: Flasher, image: Path, manifest: Path) -> None:
    shutil.copy(SAMPLES / "wmc.hex", image)
    run = flasher("manifest", "check", image)
    assert run.code == ExitCode.IMAGE
    assert "size_bytes:            4096: differs, the image has 11776" in run.out
    assert "[E308]" in run.err
    assert str(manifest) in run.err


@pytest.mark.usefixtures("manifest")
def test_check_holds_the_bytes_to_be_sent(flasher: Flasher, image: Path) -> None:
    part = ("--range", "0x8008000:0x8008800")
    run = flasher("manifest", "check", image, *part)
    assert run.code == ExitCode.IMAGE
    assert "--range" in run.err
    flasher("manifest", "create", image, "-t", "bms", "--force", *part)
    assert flasher("manifest", "check", image, *part).code == ExitCode.OK
    assert flasher("manifest", "check", image).code == ExitCode.IMAGE


@pytest.mark.usefixtures("manifest")
def test_check_refuses_another_target(flasher: Flasher, image: Path) -> None:
    run = flasher("manifest", "check", image, "-t", "wmc")
    assert run.code == ExitCode.WRONG_DEVICE
    assert "requested_target:      BMS: differs, the command line has WMC" in run.out
    assert "[E601]" in run.err


def test_check_refuses_an_image_that_names_another_target(flasher: Flasher, image: Path) -> None:
    flasher("manifest", "create", image, "-t", "wmc")
    run = flasher("manifest", "check", image)
    assert run.code == ExitCode.WRONG_DEVICE
    assert "[E601]" in run.err


def test_check_needs_a_manifest_and_a_right_one(flasher: Flasher, image: Path) -> None:
    run = flasher("manifest", "check", image)
    assert run.code == ExitCode.IMAGE
    assert "[E308]" in run.err
    assert flasher("manifest", "check", image, "--manifest", "none.toml").code == ExitCode.USAGE
    wrong = image.with_name("wrong.toml")
    wrong.write_text("format = 1\ntagret = 'bms'\n")
    run = flasher("manifest", "check", image, "--manifest", wrong)
    assert run.code == ExitCode.IMAGE
    assert "Did you mean target?" in run.err


# -- JSON -----------------------------------------------------------------------------------------


def test_json_of_create_holds_the_release(flasher: Flasher, image: Path, sha256: str) -> None:
    document = flasher("manifest", "create", image, "-t", "mc", "--json").document
    assert (document["ok"], document["exit_code"]) == (True, 0)
    assert document["manifest"] == f"{image}.toml"
    assert document["release"]["target"] == "wmc"
    assert document["release"]["sha256"] == sha256
    assert document["release"]["minimum_boot_version"] is None
    assert len(document["warnings"]) == 1


@pytest.mark.usefixtures("manifest")
def test_json_of_check_holds_every_check_also_of_a_refusal(flasher: Flasher, image: Path) -> None:
    for target, code in (("bms", ExitCode.OK), ("wmc", ExitCode.WRONG_DEVICE)):
        document = flasher("manifest", "check", image, "-t", target, "--json").document
        assert document["exit_code"] == code
        assert document["ok"] is (code == ExitCode.OK)
        assert ("error" in document) is (code != ExitCode.OK)
        results = {check["check"]: check["result"] for check in document["checks"]}
        assert results["sha256"] == "agrees"
        assert results["requested_target"] == ("agrees" if target == "bms" else "differs")
        assert results["hardware_versions"] == "unchecked"


# -- image-info -----------------------------------------------------------------------------------


def test_image_info_states_that_there_is_no_manifest(flasher: Flasher, image: Path) -> None:
    run = flasher("image-info", image)
    assert f"release: no manifest beside it ({image}.toml)" in run.out
    assert "names:   BMS" in run.out
    document = flasher("image-info", image, "--json").document
    assert document["image"]["named_targets"] == ["bms"]
    assert document["manifest"]["found"] is False
    assert document["manifest"]["agrees"] is None


@pytest.mark.usefixtures("manifest")
def test_image_info_states_that_the_manifest_agrees(
    flasher: Flasher, image: Path, sha256: str
) -> None:
    run = flasher("image-info", image)
    assert f"release: {image}.toml: agrees, BMS V1r0r4_20220512" in run.out
    document = flasher("image-info", image, "--json").document
    assert document["manifest"]["agrees"] is True
    assert document["manifest"]["release"]["sha256"] == sha256


def test_image_info_reports_what_is_wrong_and_goes_on(
    flasher: Flasher, image: Path, manifest: Path
) -> None:
    run = flasher("image-info", image, "-t", "obc")
    assert run.code == ExitCode.WRONG_DEVICE
    assert "By its manifest the image is for the BMS, not the OBC." in run.out
    manifest.write_text("format = 7\n")
    run = flasher("image-info", image, "--json")
    assert run.code == ExitCode.OK
    assert run.document["manifest"]["agrees"] is False
    assert "format 7" in run.document["manifest"]["problem"]
    assert run.document["manifest"]["release"] is None


def test_an_image_without_marks_is_reported_as_such(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "data.bin"
    path.write_bytes(bytes(range(1, 200)))
    assert "names:   no target found inside" in flasher("image-info", path).out


def test_hostile_names_are_shown_harmlessly(
    flasher: Flasher, tmp_path: Path, short_bms: Path
) -> None:
    path = tmp_path / "a\x1b[2Jb.hex"
    shutil.copy(short_bms, path)
    for words in (
        ("create", path, "-t", "bms", "--notes", "\x1b[2J"),
        ("check", path),
        ("check", path, "-t", "wmc"),
    ):
        run = flasher("manifest", *words)
        assert "\x1b" not in run.out + run.err
