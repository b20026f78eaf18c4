"""Recipes: read strictly, checked before a shift, frozen while they run."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from flasher.errors import UsageError
from flasher.protocol.spec import BMS, WMC
from flasher.station.recipe_file import load_checked, load_recipe
from flasher.station.records.model import StepName, Verified
from tests.station.factory import (
    BMS_VERSION,
    DAY,
    HEAD,
    IMAGES,
    SERIAL,
    SERIAL_NUMBER,
    USUAL,
    make_recipe,
    target_table,
    write_recipe,
)

SERIAL_WRITE = """
[[write]]
target = "bms"
item = "serial-number"
values = ["{serial}"]
manufacturer = true
"""


def reported(folder: Path, text: str) -> str:
    """Everything that is wrong with a recipe, as text."""
    with pytest.raises(UsageError) as caught:
        load_checked(write_recipe(folder, text), DAY)
    return "\n".join(map(str, caught.value.faults))


def test_a_good_recipe_is_read_with_its_images(tmp_path: Path) -> None:
    text = USUAL + target_table(WMC) + SERIAL_WRITE + "\n[step.flash]\ntries = 3\n"
    loaded = make_recipe(tmp_path, text)
    assert [target.name for target in loaded.targets] == ["bms", "wmc"]
    assert [target.required for target in loaded.targets] == [
        Verified.VERSION,
        Verified.COMPLETED,
    ]
    assert loaded.required is Verified.COMPLETED
    assert loaded.targets[0].version == BMS_VERSION
    assert loaded.targets[0].image.data == IMAGES[BMS].data
    assert loaded.recipe.rule(StepName.FLASH).tries == 3
    assert loaded.recipe.rule(StepName.WRITE).tries == 1
    (write,) = loaded.recipe.write
    plan = loaded.write_plan(write, loaded.scan(SERIAL, DAY))
    assert plan.writable.name == "serial-number"
    assert SERIAL in str(plan.content)


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (lambda t: "revison = '4'\n" + t, "revison: unknown key. Did you mean revision?"),
        (
            lambda t: t.replace("image =", "imge ="),
            "target[0].imge: unknown key. Did you mean image",
        ),
        (lambda t: t.replace('"bms"', '"bmx"'), "unknown target 'bmx'"),
        (lambda t: t.replace("[0-9]{3}", "[0-9]*"), "is not allowed here"),
        (lambda t: t.replace('"W2605002"', '"W26"'), "does not fit the pattern"),
        (lambda t: t.replace("bms.bin", "none.bin"), "none.bin"),
        (lambda t: t.replace(IMAGES[BMS].sha256, "0" * 64), "the image has"),
        (lambda t: t + target_table(BMS), "a target is named twice"),
        (lambda t: t + "verify = 'memory'\n", "only with its base"),
        (lambda t: t + SERIAL_WRITE.replace("{serial}", "{seral}"), "unknown placeholder {seral}"),
        (
            lambda t: t + SERIAL_WRITE.replace("{serial}", "{\\tserial}"),
            "unknown placeholder {\\tserial}",
        ),
        (lambda t: t + SERIAL_WRITE.replace("{serial}", "{serial}" * 3), "longer than 15"),
        (lambda t: t + SERIAL_WRITE.replace("manufacturer = true", ""), "for the manufacturer"),
        (lambda t: t + SERIAL_WRITE.replace("serial-", "seral-"), "Did you mean serial-number"),
        (lambda t: t + SERIAL_WRITE.replace('"bms"', '"wmc"'), "which has no [[target]]"),
        (lambda t: t + SERIAL_WRITE + SERIAL_WRITE, "written twice"),
        (lambda t: t + SERIAL_WRITE.replace("{serial}", "{lot}"), "units may have no lot"),
        (
            lambda t: t + SERIAL_WRITE + '[[unchanged]]\ntarget="bms"\nitem="serial-number"\n',
            "is written by this recipe",
        ),
        (
            lambda t: (
                t + '[[limit]]\ntarget="bms"\nitem="running-information"\nfield="volts"\nlow=1\n'
            ),
            "has no field 'volts'",
        ),
        (
            lambda t: (
                t + '[[limit]]\ntarget="bms"\nitem="version-information"\nfield="model"\nlow=1\n'
            ),
            "not a number: give expected",
        ),
        (lambda t: t + "[golden]\nserial_numbers=['X']\nevery_h=8\n", "does not fit the pattern"),
        (lambda t: t + "[golden]\nserial_numbers=['W2600001']\n", "shift_starts or every_h"),
        (lambda t: t + "[step.flsh]\ntries=2\n", "step.flsh"),
        (lambda t: t + "[step.flash]\ntries=1000\n", "step.flash.tries"),
        (lambda t: "allow_completed_not_read_back=false\n" + t + target_table(WMC), "read back"),
        (lambda t: t + target_table(WMC, "verify = 'version'\n"), "asked for its version"),
        (lambda t: t + target_table(WMC, "verify = 'memory'\n"), "cannot be read"),
        (lambda t: t + "x = [", "not a TOML file"),
        (lambda t: t.replace("[[target]]", "[target]"), "target"),
    ],
)
def test_what_is_wrong_with_a_recipe_is_named(tmp_path: Path, change: object, finding: str) -> None:
    assert callable(change)
    assert finding in reported(tmp_path, change(USUAL))


def test_all_findings_are_reported_at_once(tmp_path: Path) -> None:
    text = reported(tmp_path, "x = 1\ny = 2\n" + USUAL.replace('revision = "4"', ""))
    assert text.count("unknown key") == 2
    assert "has no revision" in text


@pytest.mark.parametrize("name", ["/etc/passwd", "../bms.bin", "a/../../b", "C:\\x", "\\\\h\\x"])
def test_a_recipe_reaches_nothing_outside_of_its_folder(tmp_path: Path, name: str) -> None:
    text = USUAL.replace('image = "bms.bin"', f"image = '{name}'")
    assert "is outside of the recipe's folder" in reported(tmp_path, text)


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder, outside = tmp_path / "recipe", tmp_path / "outside.bin"
    folder.mkdir()
    path = write_recipe(folder)
    outside.write_bytes(IMAGES[BMS].data)
    (folder / "bms.bin").unlink()
    (folder / "bms.bin").symlink_to(outside)
    with pytest.raises(UsageError, match="leads out of the recipe"):
        load_recipe(path)


def test_a_manifest_that_disagrees_with_its_image_is_found(tmp_path: Path) -> None:
    path = write_recipe(tmp_path)
    manifest = tmp_path / "bms.bin.toml"
    manifest.write_text(manifest.read_text().replace(IMAGES[BMS].sha256, "1" * 64))
    with pytest.raises(UsageError, match="not the image of its manifest"):
        load_checked(path, DAY)


def test_a_missing_recipe_is_an_error_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        load_checked(tmp_path / "none.toml", DAY)


@pytest.mark.parametrize("name", ["recipe.toml", "bms.bin", "bms.bin.toml"])
def test_a_change_on_disk_is_noticed(tmp_path: Path, name: str) -> None:
    loaded = make_recipe(tmp_path)
    assert loaded.is_unchanged()
    path = tmp_path / name
    before = path.stat()
    path.write_bytes(path.read_bytes() + b" ")
    assert not loaded.is_unchanged()
    path.write_bytes(path.read_bytes()[:-1])
    assert path.stat().st_size == before.st_size
    assert loaded.is_unchanged()
    path.unlink()
    assert not loaded.is_unchanged()


def test_a_loaded_recipe_is_frozen(tmp_path: Path) -> None:
    loaded = make_recipe(tmp_path)
    with pytest.raises(ValidationError, match="frozen"):
        loaded.recipe.name = "other"


def test_a_profile_of_the_working_directory_does_not_matter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flasher.toml").write_text("attempts = 9\n")
    monkeypatch.chdir(tmp_path)
    assert make_recipe(tmp_path).targets[0].profile.attempts != 9


def test_a_device_without_an_upgrade_is_reported_before_the_line_runs(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text("[bms]\nhas_upgrade = false\n")
    assert "has no upgrade" in reported(tmp_path, "profile = 'own.toml'\n" + USUAL)


def test_a_profile_of_the_recipe_gives_the_version_query(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(
        "[wmc.version_query]\ncommand = 0x3300\nanswer_id = 0x715\nanswer_command = 0x1540\n"
        "offset = 48\nsize_bytes = 16\n"
    )
    text = "profile = 'own.toml'\nallow_completed_not_read_back = false\n" + USUAL
    loaded = make_recipe(tmp_path, text + target_table(WMC))
    assert loaded.required is Verified.VERSION


RANGE = SERIAL_NUMBER + 'number_group = "number"\nnumber_min = 2\nnumber_max = 100\n'


@pytest.mark.parametrize(
    ("serial", "why"),
    [("W2605001", "is not from 2 to 100"), ("W2605101", "not from"), ("W260500", "pattern")],
)
def test_a_scan_outside_of_the_range_is_no_serial_number(
    tmp_path: Path, serial: str, why: str
) -> None:
    loaded = make_recipe(tmp_path, HEAD + RANGE + target_table(BMS))
    assert loaded.scan("W2605100", DAY).groups["number"] == "100"
    with pytest.raises(ValueError, match=why):
        loaded.scan(serial, DAY)


def test_a_check_digit_and_the_lot_stand_in_groups(tmp_path: Path) -> None:
    text = (
        HEAD
        + "[serial_number]\npattern = '(?P<lot>L[0-9]{2})-(?P<digits>[0-9]{11})'\n"
        + "example = 'L07-79927398713'\ncheck_digit = 'luhn'\ncheck_group = 'digits'\n"
        + "lot_group = 'lot'\n"
        + target_table(BMS)
    )
    loaded = make_recipe(tmp_path, text)
    assert loaded.scan("L07-79927398713", DAY).lot == "L07"
    with pytest.raises(ValueError, match="check digit"):
        loaded.scan("L07-79927398714", DAY)
    with pytest.raises(ValueError, match="is of lot 'L07'"):
        loaded.scan("L07-79927398713", DAY, "L08")
