"""The firmware samples: what they are for, and that the script beside them makes them again."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

from flasher.image.cortexm import vector_table
from flasher.image.load import load
from flasher.protocol.spec import BMS, OBC, WMC, Target
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
SCRIPT = SAMPLES / "make_samples.py"
BY_HAND = (SAMPLES / "station").glob("*.t*")
NOT_MADE = {SCRIPT, SAMPLES / ".gitattributes", *BY_HAND}


def test_the_script_makes_every_file_again_bit_for_bit(tmp_path: Path) -> None:
    runpy.run_path(str(SCRIPT))["make"](tmp_path)
    kept = {
        path.relative_to(SAMPLES): path.read_bytes()
        for path in SAMPLES.rglob("*")
        if path.is_file() and path not in NOT_MADE and "__pycache__" not in path.parts
    }
    made = {
        path.relative_to(tmp_path): path.read_bytes()
        for path in tmp_path.rglob("*")
        if path.is_file()
    }
    assert made.keys() == kept.keys()
    assert [name for name in made if made[name] != kept[name]] == []


@each(
    "name, target, version, base",
    [
        ("bms.hex", BMS, "V1r0r4_20220512", 0x0800_8000),
        ("bms.bin", BMS, "V1r0r4_20220512", None),
        ("wmc.hex", WMC, "V2r1r0_20230117", 0x0800_4000),
        ("wmc.s19", WMC, "V2r1r0_20230117", 0x0800_4000),
        ("obc.bin", OBC, "V1r2r0_20221103", None),
        ("obc.elf", OBC, "V1r2r0_20221103", 0x0800_2000),
    ],
)
def test_a_sample_holds_its_version_and_the_name_of_its_target(
    name: str, target: Target, version: str, base: int | None
) -> None:
    image = load(SAMPLES / name)
    assert (image.version, image.base) == (version, base)
    at = image.data.index(version.encode())
    assert target.boot_name.encode() in image.data[at - 8 : at]
    table = vector_table(image)
    assert table is not None
    assert table.plausible


def test_the_bms_sample_has_the_size_of_the_document_s_example() -> None:
    assert (SAMPLES / "bms.bin").stat().st_size == 78_351


def test_the_bms_sample_starts_inside_itself_at_its_base() -> None:
    image = load(SAMPLES / "bms.hex")
    binary = load(SAMPLES / "bms.bin", base=0x0800_8000)
    assert image == replace(binary, format=image.format, source=image.source)
    table = vector_table(image)
    assert table is not None
    assert table.problems == ()


def test_hex_and_s_record_of_the_wmc_are_the_same_image_with_a_gap() -> None:
    hex_image, s_image = load(SAMPLES / "wmc.hex"), load(SAMPLES / "wmc.s19")
    assert hex_image.data == s_image.data
    assert hex_image.segments == s_image.segments
    first, second = hex_image.segments
    assert 0 < second.start - first.end == hex_image.filled_bytes < 4096
